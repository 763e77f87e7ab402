"""`jaxid methods`."""

from __future__ import annotations

import argparse

from jaxid.command_line.parser import Commands, add_command
from jaxid.names import METHODS, SEVERAL_LOGS, WHEN


def add(commands: Commands) -> None:
    """Add the command."""
    purpose = "list the methods of identify, and when to take which"
    add_command(commands, "methods", purpose, run, examples="jaxid methods")


def when_to_take_which() -> list[str]:
    """Return a line for each method."""
    width = max(map(len, METHODS))
    return [f"{name.ljust(width)}  {WHEN[name]}" for name in METHODS]


def run(args: argparse.Namespace) -> int:
    """Print the methods, and return the exit status."""
    print("\n".join(when_to_take_which()))
    print(f"\nSeveral logs in one fit: {', '.join(SEVERAL_LOGS)}. The other methods fit one log.")
    return 0
