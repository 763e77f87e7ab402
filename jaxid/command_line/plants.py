"""`jaxid plants`."""

from __future__ import annotations

import argparse

from jaxid.command_line.parser import Commands, add_command


def add(commands: Commands) -> None:
    """Add the command."""
    purpose = "list the plants with their parameters and units"
    add_command(commands, "plants", purpose, run, examples="jaxid plants")


def run(args: argparse.Namespace) -> int:
    """Print the plants, and return the exit status."""
    from jaxid.results.catalogue import plants_table

    print(plants_table())
    return 0
