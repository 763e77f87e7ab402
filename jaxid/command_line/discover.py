"""`jaxid discover`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.inputs import (
    first_case_files,
    logs_of,
    need_at_least,
    need_known_numerics,
    sound_case,
)
from jaxid.command_line.outputs import need_writable, progress_of, save_result
from jaxid.command_line.parser import (
    Commands,
    add_case_and_logs,
    add_long_command,
    add_numerics,
    add_validation_logs,
)

_EXAMPLES = """\
jaxid discover case.toml log.csv -o out
jaxid discover case.toml log.csv --validate other.csv --max-effects 2"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "find the effects that a case's model lacks, and write the case with them"
    parser = add_long_command(commands, "discover", purpose, run, examples=_EXAMPLES)
    add_case_and_logs(parser)
    add_validation_logs(parser)
    parser.add_argument(
        "--max-effects",
        metavar="N",
        type=int,
        help="most effects to add; default: 5, or three a joint if that is more. Of an arm's servos without "
        "a force: at each joint",
    )
    add_numerics(parser)
    parser.add_argument(
        "--experiments",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="design experiments that separate rival effects; default: except for arms (minutes)",
    )


def run(args: argparse.Namespace) -> int:
    """Search for effects, and return the exit status."""
    need_at_least(0, "--max-effects", args.max_effects)
    need_known_numerics(args)
    _need_writable_results(args)
    case, made = sound_case(args, search=True)

    with progress_of(args) as show:
        show("starting")
        from jaxid.commands.discover import discover

        result = discover(
            case,
            logs_of(args),
            validate=args.validate,
            max_effects=args.max_effects,
            solver=args.solver,
            minimiser=args.minimiser,
            experiments=args.experiments,
            progress=show,
        )
    from jaxid.results.as_json import discovery_files

    return save_result(args, result, *discovery_files(result, Path(args.o or ".")), made=made)


def _need_writable_results(args: argparse.Namespace) -> None:
    """Refuse a folder to which the results could not be written."""
    if args.o is None:
        return
    from jaxid.files import found_case_file

    folder = Path(args.o)
    # An experiment's name follows from the effects found: any that exists already may be meant.
    experiments = [p.name for p in folder.glob("separate_*.csv")]
    corrected = found_case_file(Path(args.case), folder)
    files = ("discovery.json", "report.html", corrected, *experiments, *first_case_files(args))
    need_writable(args, *files)
