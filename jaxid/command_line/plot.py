"""`jaxid plot`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.inputs import need_known
from jaxid.command_line.outputs import picture_file
from jaxid.command_line.parser import Commands, add_command, add_result
from jaxid.names import PICTURES, SIGNALS

_EXAMPLES = """\
jaxid plot out friction -o friction.png
jaxid plot out/result.json scatter --against position -o ripple.svg
jaxid plot out motion -o motion.png
jaxid plot out signals -o signals.csv"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    parser = add_command(commands, "plot", "draw one picture of a result", run, examples=_EXAMPLES)
    add_result(parser)
    parser.add_argument(
        "kind",
        metavar="KIND",
        help=f"{', '.join(PICTURES)}; forces: measured and model over each other; or {SIGNALS}: measured and "
        "simulated signals as a table for PlotJuggler (.csv)",
    )
    parser.add_argument("-o", metavar="FILE", help="file to write: .png, .svg, .pdf; default: KIND.png")
    parser.add_argument(
        "--log", metavar="NAME", default="0", help="name or number of the log; default: 0, the first"
    )
    parser.add_argument("--joint", metavar="N", type=int, default=1, help="joint of several; default: 1")
    parser.add_argument(
        "--against",
        metavar="QUANTITY",
        help="abscissa of scatter: velocity, position or time; default: that which the residual follows",
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there")


def run(args: argparse.Namespace) -> int:
    """Draw the picture, or write the table of signals, and return the exit status."""
    need_known("plot", args.kind, (*PICTURES, SIGNALS))
    path = _write_signals(args) if args.kind == SIGNALS else _draw(args)
    print(f"wrote {path}")
    return 0


def _draw(args: argparse.Namespace) -> Path:
    path = picture_file(args.o or f"{args.kind}.png", overwrite=args.force)
    from jaxid.commands.report import read_content
    from jaxid.results.stored_plots import picture

    figure = picture(
        read_content(args.result), args.kind, log=args.log, joint=args.joint, against=args.against
    )
    figure.savefig(path, dpi=160)
    return path


def _write_signals(args: argparse.Namespace) -> Path:
    from jaxid.commands.report import read_content
    from jaxid.files import ready_file, write_whole
    from jaxid.results.stored_plots import signals_csv

    path = ready_file(Path(args.o or f"{SIGNALS}.csv"), overwrite=args.force)
    write_whole(path, signals_csv(read_content(args.result)))
    return path
