"""`jaxid simulate`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.inputs import is_robot, need_at_least, need_sound_case
from jaxid.command_line.outputs import picture_file, progress_of
from jaxid.command_line.parser import Commands, add_long_command

_EXAMPLES = """\
jaxid simulate case.toml -o log.csv
jaxid simulate case.toml -o log.csv --seed 3
jaxid simulate robot.xml -o free.csv --picture free.png"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "simulate the log that a case describes"
    parser = add_long_command(commands, "simulate", purpose, run, examples=_EXAMPLES)
    parser.add_argument(
        "case", metavar="CASE.toml", help="the case; or a robot's MJCF or URDF, which is let go at zero"
    )
    parser.add_argument("-o", metavar="LOG.csv", required=True, help="file to write the log to")
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of the noise; default: 0")
    parser.add_argument(
        "--picture", metavar="FILE", help="an arm's motion as a strip of frames: .png, .svg or .pdf"
    )


def run(args: argparse.Namespace) -> int:
    """Simulate and write the log, and return the exit status."""
    from jaxid.files import ready_file

    need_at_least(0, "--seed", args.seed)
    path, case = ready_file(Path(args.o), overwrite=args.force), args.case
    picture = None if args.picture is None else picture_file(args.picture, overwrite=args.force)
    if is_robot(case):
        from jaxid.commands.robot_case import let_go

        case = let_go(case)
    else:
        need_sound_case(args)

    with progress_of(args) as show:
        show("simulating")
        from jaxid.commands.simulate import motion_picture, simulate

        simulated_log = simulate(case, seed=args.seed)
        figure = None if picture is None else motion_picture(case, simulated_log)
    simulated_log.save(path)
    if picture is not None and figure is not None:
        figure.savefig(picture, dpi=160)
        print(f"wrote {picture}")
    print(f"{simulated_log.log.samples} samples at {simulated_log.log.rate_hz:g} Hz in {path}")
    return 0
