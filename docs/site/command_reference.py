"""The reference of the command line, from its parser."""

from __future__ import annotations

import argparse
from pathlib import Path

from docs.site.markdown import code, prose, table
from jaxid import cli

_INTRODUCTION = """# Commands

This page is made from the parser of the command line; `jaxid COMMAND --help` prints the same.

Exit status: 0 done, whatever the verdict; 2 bad input (one line on stderr: what, where, hint); 1 anything
else, a fit that did not converge included. Files that jaxid did not make are overwritten with `--force`
only."""


def page(folder: Path) -> str:
    """Return the page."""
    subparsers = next(a for a in cli.build_parser()._actions if isinstance(a, argparse._SubParsersAction))
    parts = [_INTRODUCTION]
    for name, parser in subparsers.choices.items():
        usage = parser.format_usage().removeprefix("usage: ")
        purpose = (parser.description or "").strip()
        purpose = prose(purpose[:1].upper() + purpose[1:].rstrip(".") + ".")
        parts += [f"## `jaxid {name}`", purpose, code(usage)]
        rows = [_row(a) for a in parser._actions if a.dest != "help" and a.help != argparse.SUPPRESS]
        if rows:
            parts.append(table(["argument", "meaning"], rows))
        if parser.epilog:
            parts.append(code(parser.epilog))
    return "\n\n".join(parts) + "\n"


def _row(action: argparse.Action) -> list[str]:
    value = action.metavar if isinstance(action.metavar, str) else ""
    value = "" if action.nargs == 0 else value
    names = [" ".join(filter(None, (o, value))) for o in action.option_strings] or [value or action.dest]
    return [", ".join(f"`{n}`" for n in names), prose(" ".join((action.help or "").split()))]
