"""`jaxid design`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.inputs import need_sound_case
from jaxid.command_line.outputs import progress_of
from jaxid.command_line.parser import Commands, add_long_command


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "find the reference or input within [limits] whose log identifies the unknowns best"
    examples = "jaxid design case.toml -o reference.csv\njaxid design no_force.toml log.csv -o reference.csv"
    parser = add_long_command(commands, "design", purpose, run, examples=examples)
    parser.add_argument("case", metavar="CASE.toml", help="the case, with [simulation]")
    parser.add_argument(
        "log",
        metavar="LOG",
        nargs="*",
        help="logs without a force that there are: they are fitted first, and the experiment adds to them",
    )
    parser.add_argument("-o", metavar="SIGNAL.csv", required=True, help="file to write the signal to")


def run(args: argparse.Namespace) -> int:
    """Design and write the signal, and return the exit status."""
    from jaxid.errors import InputError
    from jaxid.files import ready_file

    path = ready_file(Path(args.o), overwrite=args.force)
    if path.resolve() in {Path(log).resolve() for log in args.log}:
        what = f"the signal would be written over {args.o}, a log of the fit"
        raise InputError(what, where=f"-o {args.o}", hint="choose another name for -o")
    need_sound_case(args)
    from jaxid.case.case import load_case

    case = path.with_suffix(".toml") if load_case(args.case).without_force else None
    if case is not None:
        if case.resolve() == Path(args.case).resolve():
            what = f"the case of the experiment would be written over {args.case}"
            raise InputError(what, where=f"-o {args.o}", hint="choose another name for -o")
        ready_file(case, overwrite=args.force, suffix=".toml")
    with progress_of(args) as show:
        from jaxid.commands.design import design
        from jaxid.experiment_design.unforced_design import UnforcedDesign

        found = design(args.case, args.log or None, progress=show)
    found.save(path)
    print(f"{found}\n{len(found.time)} ticks of the {found.signal} in {path}")
    if isinstance(found, UnforcedDesign):
        found.save_case(path)
        print(f"case of the fit in {case}: record the logs that [[fit]] names there")
    return 0
