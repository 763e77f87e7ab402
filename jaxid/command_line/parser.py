"""The parser of a command, and arguments that several commands have."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, NoReturn

from jaxid.errors import InputError
from jaxid.names import MINIMISERS, SOLVERS

Commands = argparse._SubParsersAction


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line, with exit status 2."""

    def __init__(self, *args: Any, **options: Any):
        """Keep the lines of the examples below a help text as they are."""
        super().__init__(*args, formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def error(self, message: str) -> NoReturn:
        raise InputError(message, hint=f"see {self.prog} --help")


def add_command(
    commands: Commands,
    name: str,
    purpose: str,
    run: Callable[[argparse.Namespace], int],
    *,
    examples: str,
    more: str = "",
) -> argparse.ArgumentParser:
    """Add a command.

    Args:
        commands: The commands so far.
        name: Its name.
        purpose: Line of the help text that says what it does.
        run: Function that runs it and returns the exit status.
        examples: Lines that the command accepts, for the end of its help text.
        more: Paragraph above them.
    """
    shown = "\n".join(f"  {line}" for line in examples.splitlines())
    end = f"{more}\n\nexamples:\n{shown}".strip()
    parser = commands.add_parser(name, help=purpose, description=purpose, epilog=end)
    parser.set_defaults(run=run, command=name)
    return parser


def add_long_command(
    commands: Commands,
    name: str,
    purpose: str,
    run: Callable[[argparse.Namespace], int],
    *,
    examples: str,
    more: str = "",
) -> argparse.ArgumentParser:
    """Add a command with a progress bar and files, as `add_command` does."""
    parser = add_command(commands, name, purpose, run, examples=examples, more=more)
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    parser.add_argument("--force", action="store_true", help="overwrite files that jaxid did not make")
    return parser


def add_case_and_logs(parser: argparse.ArgumentParser) -> None:
    """Add a case, its logs, and the folder of the results."""
    parser.add_argument(
        "case",
        metavar="CASE.toml",
        help="the case; or a robot's MJCF or URDF, with the columns of the log named after its joints",
    )
    parser.add_argument(
        "log",
        metavar="LOG",
        nargs="*",
        help="the log, or several that are fitted together; absent: those of [[fit]]",
    )
    parser.add_argument("-o", metavar="DIR", help="folder for the results; default: only print them")


def add_validation_logs(parser: argparse.ArgumentParser) -> None:
    """Add the option `--validate`."""
    parser.add_argument(
        "--validate",
        metavar="LOG2",
        action="append",
        default=[],
        help="a log to validate on, beside those of the case; may be repeated",
    )


def add_numerics(parser: argparse.ArgumentParser) -> None:
    """Add the options `--solver` and `--minimiser`."""
    parser.add_argument(
        "--solver",
        metavar="NAME",
        help="let diffrax integrate in output_error, dry friction smoothed: "
        f"{', '.join(SOLVERS)}; absent: as the case says, or fixed steps, dry friction exact",
    )
    parser.add_argument(
        "--minimiser",
        metavar="NAME",
        help=f"minimiser of output_error: {', '.join(MINIMISERS)}; absent: as the case says, or the first",
    )


def add_result(parser: argparse.ArgumentParser) -> None:
    """Add a stored result."""
    parser.add_argument(
        "result", metavar="RESULT", help="result.json, discovery.json, or the folder that holds one"
    )
