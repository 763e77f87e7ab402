"""Arguments that a command was given, checked before JAX is loaded, which takes longer than these checks."""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.errors import InputError, suggest
from jaxid.names import FIRST_CASE, MINIMISERS, ROBOT_FILES, SOLVERS

if TYPE_CHECKING:
    from jaxid.commands.robot_case import RobotCase

# Suffixes of logs, by which arguments in the wrong order are noticed.
_LOGS = (
    ".csv",
    ".txt",
    ".tsv",
    ".mat",
    ".npz",
    ".h5",
    ".hdf5",
    ".parquet",
    ".xlsx",
    ".tdms",
    ".mcap",
    ".bag",
)


def need_known(kind: str, value: str | None, known: Collection[str]) -> None:
    """Refuse a value of an option that is not among the known ones; None is accepted."""
    if value is not None and value not in known:
        raise InputError(f"{kind} {value!r} is not known", hint=suggest(value, known))


def need_known_numerics(args: argparse.Namespace) -> None:
    """Refuse a solver or a minimiser of another name."""
    need_known("solver", args.solver, SOLVERS)
    need_known("minimiser", args.minimiser, MINIMISERS)


def need_at_least(least: int, option: str, value: int | None) -> None:
    """Refuse a number below the least, which is 0 or 1; None is accepted."""
    if value is not None and value < least:
        raise InputError(f"{option} is {value}", hint=f"give {('zero', 'one')[least]} or more")


def need_sound_case(args: argparse.Namespace) -> None:
    """Refuse an unsound case, or a log in its place."""
    _need_case_first(args)
    from jaxid.case.case import refuse_unsound

    refuse_unsound(Path(args.case))


def _need_case_first(args: argparse.Namespace) -> None:
    """Refuse a log in the place of the case."""
    if Path(args.case).suffix.lower() not in _LOGS:
        return
    logs = getattr(args, "log", [])
    case = next((name for name in logs if Path(name).suffix.lower() == ".toml"), None)
    if case is not None:
        rest = [args.case if name == case else name for name in logs]
        hint = f"the case comes first: jaxid {args.command} {' '.join([case, *rest])}"
    else:
        hint = f"the case comes first; jaxid init {args.case} writes one"
    raise InputError("is a log, in the place of the case", where=args.case, hint=hint)


def is_robot(path: str) -> bool:
    """Tell by its suffix whether a file describes a robot, in MJCF or URDF."""
    return Path(path).suffix.lower() in ROBOT_FILES


def sound_case(args: argparse.Namespace, *, search: bool = False) -> tuple[Any, RobotCase | None]:
    """Return the case of a command; if it is given a robot's file, the one that this and the log imply.

    Returns:
        The case, and the same with its file to be written, if it was made from a robot's file.
    """
    if not is_robot(args.case):
        need_sound_case(args)
        return args.case, None
    from jaxid.commands.robot_case import RobotCase

    made = RobotCase.of(args.case, args.log, search=search)
    return made.tables, made


def first_case_files(args: argparse.Namespace) -> list[str]:
    """Return the name of the case that is written beside the results, if a robot's file is given for one."""
    return [FIRST_CASE] if is_robot(args.case) else []


def found_robot_files(args: argparse.Namespace) -> list[str]:
    """Return the name of the MJCF with the result in it, if one is given in place of a case."""
    if not is_robot(args.case) or args.case.endswith(".urdf"):
        return []
    from jaxid.commands.robot_case import found_file

    return [found_file(args.case)]


def logs_of(args: argparse.Namespace) -> str | list[str] | None:
    """Return the logs of a command: one, several, or none."""
    return args.log[0] if len(args.log) == 1 else args.log or None
