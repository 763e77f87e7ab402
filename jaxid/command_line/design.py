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
    examples = "jaxid design case.toml -o reference.csv"
    parser = add_long_command(commands, "design", purpose, run, examples=examples)
    parser.add_argument("case", metavar="CASE.toml", help="the case, with [simulation]")
    parser.add_argument("-o", metavar="SIGNAL.csv", required=True, help="file to write the signal to")


def run(args: argparse.Namespace) -> int:
    """Design and write the signal, and return the exit status."""
    from jaxid.files import ready_file

    path = ready_file(Path(args.o), overwrite=args.force)
    need_sound_case(args)
    with progress_of(args) as show:
        from jaxid.commands.design import design

        found = design(args.case, progress=show)
    found.save(path)
    print(f"{found}\n{len(found.time)} ticks of the {found.signal} in {path}")
    return 0
