"""`jaxid check`."""

from __future__ import annotations

import argparse

from jaxid.command_line.inputs import first_case_files, logs_of, sound_case
from jaxid.command_line.outputs import need_writable, progress_of, save_result
from jaxid.command_line.parser import Commands, add_case_and_logs, add_long_command

_EXAMPLES = """\
jaxid check case.toml log.csv
jaxid check case.toml log.csv -o out"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "check before any fit whether a log is sound and excites the unknowns of a case"
    add_case_and_logs(add_long_command(commands, "check", purpose, run, examples=_EXAMPLES))


def run(args: argparse.Namespace) -> int:
    """Check the logs, and return the exit status."""
    need_writable(args, "check.json", *first_case_files(args))
    case, made = sound_case(args)
    with progress_of(args) as show:
        show("checking")
        from jaxid.commands.check import check

        result = check(case, logs_of(args))
    return save_result(args, result, "check.json", made=made)
