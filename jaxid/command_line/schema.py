"""`jaxid schema`."""

from __future__ import annotations

import argparse
import json

from jaxid.command_line.parser import Commands, add_command

_EXAMPLES = """\
jaxid schema case > case.schema.json
jaxid schema comparison"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "the JSON Schema of a file, for editors that complete and check by it"
    parser = add_command(commands, "schema", purpose, run, examples=_EXAMPLES)
    parser.add_argument(
        "file",
        metavar="FILE",
        choices=("case", "comparison"),
        help="case: the case file; comparison: what compare writes",
    )


def run(args: argparse.Namespace) -> int:
    """Print the schema, and return the exit status."""
    if args.file == "comparison":
        from jaxid.results.comparison_schema import comparison_schema as schema
    else:
        from jaxid.case.json_schema import case_schema as schema

    print(json.dumps(schema(), indent=2, ensure_ascii=False))
    return 0
