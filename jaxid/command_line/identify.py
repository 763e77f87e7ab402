"""`jaxid identify`."""

from __future__ import annotations

import argparse
from functools import partial

from jaxid.command_line.inputs import (
    first_case_files,
    found_robot_files,
    logs_of,
    need_known,
    need_known_numerics,
    sound_case,
)
from jaxid.command_line.methods import when_to_take_which
from jaxid.command_line.outputs import need_writable, progress_of, save_result
from jaxid.command_line.parser import (
    Commands,
    add_case_and_logs,
    add_long_command,
    add_numerics,
    add_validation_logs,
)
from jaxid.errors import InputError
from jaxid.names import LIKELIHOOD_METHODS, METHODS, OUTPUTS

_EXAMPLES = """\
jaxid identify case.toml log.csv -o out
jaxid identify robot.xml log.csv -o out
jaxid identify case.toml a.csv b.csv --validate c.csv
jaxid identify case.toml log.csv --method inverse_dynamics"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "identify the unknowns of a case from a log"
    when = "\n".join(f"  {line}" for line in when_to_take_which())
    more = f"which method when:\n{when}"
    parser = add_long_command(commands, "identify", purpose, run, examples=_EXAMPLES, more=more)
    add_case_and_logs(parser)
    parser.add_argument(
        "--method",
        metavar="M",
        help=f"{', '.join(METHODS)}; absent: chosen from case and log, and the "
        "reason is printed; `jaxid methods` says when to take which",
    )
    parser.add_argument(
        "--on",
        metavar="OUTPUT",
        help=f"output of the loop that output_error fits: {', '.join(OUTPUTS)}; default: that of the case, "
        "or position",
    )
    add_numerics(parser)
    parser.add_argument(
        "--hessian",
        action="store_true",
        default=None,
        help="covariance by the full Hessian in place of Gauss-Newton's, for a method that maximises a "
        f"likelihood: {', '.join(LIKELIHOOD_METHODS)}",
    )
    parser.add_argument(
        "--profile",
        metavar="NAME",
        action="append",
        default=[],
        help="compute the profile likelihood of an unknown, for such a method; may be repeated",
    )
    add_validation_logs(parser)


def run(args: argparse.Namespace) -> int:
    """Identify the unknowns, and return the exit status."""
    if args.method is not None and args.method not in METHODS:
        raise InputError(f"method {args.method!r} is not known", hint=f"choose one of {', '.join(METHODS)}")
    need_known_numerics(args)
    need_known("on", args.on, OUTPUTS)
    files = ("result.json", "report.html")
    need_writable(args, *files, *first_case_files(args), *found_robot_files(args))
    case, made = sound_case(args)

    with progress_of(args) as show:
        show("starting")
        from jaxid.commands.identify import identify

        result = identify(
            case,
            logs_of(args),
            method=args.method,
            solver=args.solver,
            minimiser=args.minimiser,
            on=args.on,
            hessian=args.hessian,
            profile=args.profile,
            validate=args.validate,
            progress=show,
        )
    without_force = result.session.machine.unforced(result.session.fit.log)
    servos = partial(made.save_servos, result) if made is not None and without_force else None
    return save_result(args, result, *files, made=made, then=servos)
