"""`jaxid init`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.parser import Commands, add_long_command

_EXAMPLES = """\
jaxid init log.csv
jaxid init joint_states.csv --urdf arm.urdf -o arm.toml
jaxid init log.csv --mjcf robot.xml -o arm.toml"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "write a first case from a raw log"
    parser = add_long_command(commands, "init", purpose, run, examples=_EXAMPLES)
    parser.add_argument("log", metavar="LOG", help="the log, as the drive or the robot wrote it")
    parser.add_argument("--urdf", metavar="FILE", help="file that describes the robot of the log")
    parser.add_argument(
        "--tip",
        metavar="LINK",
        help="its last link whose joints the log has; else all joints, or those that the log names",
    )
    parser.add_argument("--mjcf", metavar="FILE", help="MuJoCo model of the robot of the log")
    parser.add_argument(
        "-o", metavar="CASE.toml", default="case.toml", help="file to write the case to; default: case.toml"
    )


def run(args: argparse.Namespace) -> int:
    """Write the case, and return the exit status."""
    from jaxid.commands.init import check_target, init

    path = check_target(Path(args.o), overwrite=args.force)
    first = init(args.log, urdf=args.urdf, tip=args.tip, mjcf=args.mjcf, folder=path.parent)
    first.save(path, overwrite=args.force)
    print(f"{first}\n\nwrote {path}; next: jaxid check {path} {args.log}")
    return 0
