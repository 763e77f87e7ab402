"""`jaxid study`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from jaxid.command_line.inputs import need_sound_case
from jaxid.command_line.parser import Commands, add_long_command

_EXAMPLES = """\
jaxid study case.toml -o study --runs 50
jaxid study case.toml -o study --resume"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "simulate and identify a case many times: bias, spread and coverage of the intervals"
    parser = add_long_command(commands, "study", purpose, run, examples=_EXAMPLES)
    parser.add_argument("case", metavar="CASE.toml", help="the case, with [simulation]")
    parser.add_argument("-o", metavar="DIR", help="folder for chunks and results; default: only print them")
    parser.add_argument(
        "--runs", metavar="N", type=int, help="runs under each setting; default: those of the case, or 100"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of all draws; default: 0")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted study")
    parser.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, whose workers run the chunks"
    )


def run(args: argparse.Namespace) -> int:
    """Run the study, and return the exit status."""
    from tqdm import tqdm

    need_sound_case(args)
    from jaxid.commands.study import study

    with tqdm(disable=args.quiet or not sys.stderr.isatty(), leave=False, unit="run") as bar:

        def show(done: int, runs: int) -> None:
            if bar.total is None:
                bar.reset(total=runs)
                bar.initial = done
            bar.update(done - bar.n)

        result = study(
            args.case,
            runs=args.runs,
            seed=args.seed,
            folder=args.o,
            resume=args.resume,
            overwrite=args.force,
            scheduler=args.scheduler,
            progress=show,
        )
    print(result)
    if args.o is not None:
        from jaxid.studies.result import FILES

        print(f"\nwrote {', '.join(str(Path(args.o) / f) for f in FILES)}")
    return 0
