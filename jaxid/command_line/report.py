"""`jaxid report`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.outputs import progress_of
from jaxid.command_line.parser import Commands, add_command, add_result

_EXAMPLES = """\
jaxid report out
jaxid report out/result.json -o fit.html"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "write the report of a result again, such as after an update of jaxid"
    parser = add_command(commands, "report", purpose, run, examples=_EXAMPLES)
    add_result(parser)
    parser.add_argument(
        "-o", metavar="FILE.html", help="file to write; default: report.html beside the result"
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that jaxid did not make")


def run(args: argparse.Namespace) -> int:
    """Write the report, and return the exit status."""
    from jaxid.commands.report import report
    from jaxid.files import check_folder, ready_file, write_whole

    result = Path(args.result)
    if args.o is None:
        folder = result if result.is_dir() else result.parent
        check_folder(folder, ["report.html"], overwrite=args.force)
        path = folder / "report.html"
    else:
        path = ready_file(Path(args.o), overwrite=args.force, suffix=".html")

    with progress_of(args) as show:
        show("drawing")
        page = report(result)
    write_whole(path, page)
    print(f"wrote {path}")
    return 0
