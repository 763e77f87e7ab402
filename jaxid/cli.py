"""The command line: a thin layer over the Python interface, which is loaded when a command needs it."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from jaxid import _cache
from jaxid.command_line import (
    check,
    compare,
    demo,
    design,
    discover,
    effects,
    export,
    identify,
    init,
    methods,
    plants,
    plot,
    report,
    schema,
    simulate,
    study,
)
from jaxid.command_line.parser import Parser
from jaxid.errors import InputError

# In the order of the help text.
_COMMANDS = (
    demo,
    methods,
    plants,
    effects,
    schema,
    init,
    simulate,
    design,
    check,
    identify,
    discover,
    compare,
    study,
    export,
    report,
    plot,
)
_GREETING = """\
jaxid identifies machines with friction from their logs, and finds the physics that a simulation is missing.

  jaxid demo                                  the whole way, on a log that ships with jaxid
  jaxid init log.csv                          a first case, case.toml, from a log of your own
  jaxid identify case.toml log.csv -o out     its unknowns, and a report: out/report.html

jaxid --help lists all commands, and jaxid COMMAND --help the options of one, with examples."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 done, whatever the verdict; 2 bad input; 1 anything else, no convergence included.
    """
    try:
        given = sys.argv[1:] if argv is None else argv
        if not given:
            print(_GREETING)
            return 0
        args = build_parser().parse_args(given)
        status = args.run(args)
        sys.stdout.flush()
        return status
    except InputError as error:
        print(f"jaxid: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxid: interrupted", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of the output has ended; Python would report that once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        print(f"jaxid: {error}", file=sys.stderr)
        return 1


def entry() -> None:
    """Run the installed command."""
    # Imports make many objects that stay: looking for garbage after every 700 takes a tenth of their time.
    gc.set_threshold(100_000, 50, 50)
    _cache.configure()
    sys.exit(main())


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    parser = Parser(
        prog="jaxid",
        description="Identify machines with friction, and find the physics that a simulation is missing.",
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for command in _COMMANDS:
        command.add(commands)
    return parser


class _Version(argparse.Action):
    """The option `--version`, which looks the version up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from jaxid import __version__

        print(f"jaxid {__version__}")
        parser.exit()


if __name__ == "__main__":
    entry()
