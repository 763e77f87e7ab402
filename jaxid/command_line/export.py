"""`jaxid export`."""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxid.command_line.inputs import need_at_least, need_known
from jaxid.command_line.parser import Commands, add_command
from jaxid.errors import InputError
from jaxid.names import TARGETS

_EXAMPLES = """\
jaxid export out/result.json --to mjcf -o found.xml --check log.csv
jaxid export out/result.json --to urdf --model robot.urdf -o found.urdf
jaxid export out/discovery.json --to c -o feed_forward.h"""


def add(commands: Commands) -> None:
    """Add the command and its arguments."""
    purpose = "put the values of a result into the robot's file, or into one of another program"
    parser = add_command(commands, "export", purpose, run, examples=_EXAMPLES)
    parser.add_argument(
        "result", metavar="RESULT.json", help="result.json or discovery.json of an arm or tree"
    )
    parser.add_argument("--to", metavar="TARGET", required=True, help=f"one of {', '.join(TARGETS)}")
    parser.add_argument(
        "--model",
        metavar="ROBOT.xml",
        help="for mjcf and urdf, the file that the case names; default: the path in the case, or a new "
        "file if it names none",
    )
    parser.add_argument("-o", metavar="FILE", required=True, help="file to write")
    parser.add_argument(
        "--check",
        metavar="LOG",
        help="replay a log by the file in MuJoCo: how far it is from jaxid's simulation, by joint, and "
        "what each thing that the file lacks costs",
    )
    parser.add_argument(
        "--samples",
        metavar="N",
        type=int,
        help="also write N models drawn from the posterior, FILE_1 to FILE_N",
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="seed of these draws; default: 0")
    parser.add_argument("--force", action="store_true", help="overwrite a file that jaxid did not make")


def run(args: argparse.Namespace) -> int:
    """Write the files, and return the exit status."""
    need_known("target", args.to, TARGETS)
    if args.samples is not None and not 1 <= args.samples <= 10_000:
        raise InputError(f"--samples is {args.samples}", hint="give 1 to 10000")
    need_at_least(0, "--seed", args.seed)
    from jaxid.commands.export import check_export, draw_exports, export
    from jaxid.files import ready_file, write_together

    suffix, *also = TARGETS[args.to]
    path, count = Path(args.o), args.samples or 0
    drawn_paths = [path.with_stem(f"{path.stem}_{k:0{len(str(count))}}") for k in range(1, count + 1)]
    for one in (path, *drawn_paths):
        ready_file(one, overwrite=args.force, suffix=suffix, also=also)

    # All that can fail precedes the first file.
    exported = export(args.result, args.to, args.model, name=path.stem)
    files = {path: exported.content}
    drawn = None
    if count:
        drawn = draw_exports(args.result, args.to, count, args.model, seed=args.seed)
        files |= {one: file.content for one, file in zip(drawn_paths, drawn.files, strict=True)}
    checked = None
    if args.check is not None:
        checked = check_export(args.result, args.to, exported, args.check, args.model)
    write_together(files)

    lines = [f"not exported: {note}" for note in exported.notes]
    changed = ", ".join(exported.changed) or "nothing"
    own = args.to in ("mjcf", "urdf")
    if exported.new:
        lines.append(f"the case names no {args.to.upper()} to change: a new one is written")
    lines.append(f"{'changed' if own and not exported.new else 'wrote'} {changed} in {path}")
    if drawn is not None:
        lines.append(f"drew {count} models, {drawn_paths[0].name} to {drawn_paths[-1].name}; {drawn}")
    if checked is not None:
        lines += ["", str(checked)]
    print("\n".join(lines))
    return 0
