"""`jaxid compare`."""

from __future__ import annotations

import argparse

from jaxid.command_line.inputs import need_at_least, need_sound_case
from jaxid.command_line.outputs import need_writable, progress_of, save_result
from jaxid.command_line.parser import Commands, add_long_command

_EXAMPLES = """\
jaxid compare axis.toml monday.csv friday.csv -o friday
jaxid compare axis.toml machine_1.csv machine_2.csv machine_3.csv
jaxid compare axis.toml"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "find what differs between logs: a parameter, or an effect in one of them only"
    parser = add_long_command(commands, "compare", purpose, run, examples=_EXAMPLES)
    parser.add_argument("case", metavar="CASE.toml", help="the case of the machine")
    parser.add_argument(
        "log", metavar="LOG", nargs="*", help="the logs, the base first; absent: those of [[fit]]"
    )
    parser.add_argument("-o", metavar="DIR", help="folder for the results; default: only print them")
    parser.add_argument(
        "--max-changes", metavar="N", type=int, default=5, help="most changes of the model; default: 5"
    )


def run(args: argparse.Namespace) -> int:
    """Compare the logs, and return the exit status."""
    need_at_least(1, "--max-changes", args.max_changes)
    files = ("comparison.json", "report.html")
    need_writable(args, *files)
    need_sound_case(args)
    with progress_of(args) as show:
        show("starting")
        from jaxid.commands.compare import compare

        result = compare(args.case, args.log or None, max_changes=args.max_changes, progress=show)
    return save_result(args, result, *files)
