"""`jaxid demo`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.outputs import progress_of
from jaxid.command_line.parser import Commands, add_long_command

_EXAMPLES = """\
jaxid demo
jaxid demo -o my-demo"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "run check, identify and discover on a log that ships with jaxid"
    parser = add_long_command(commands, "demo", purpose, run, examples=_EXAMPLES)
    parser.add_argument(
        "-o", metavar="DIR", default="jaxid-demo", help="folder for the results; default: jaxid-demo"
    )


def run(args: argparse.Namespace) -> int:
    """Run the demonstration, and return the exit status."""
    from jaxid.demo import run_demo

    with progress_of(args) as show:
        show("starting")
        text, converged = run_demo(Path(args.o), overwrite=args.force, progress=show)
    print(text)
    return 0 if converged else 1
