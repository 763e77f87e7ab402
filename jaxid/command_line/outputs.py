"""Progress, and files that a command writes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from jaxid.errors import InputError

if TYPE_CHECKING:
    from jaxid.commands.robot_case import RobotCase

# Arguments on which the time of a command does not depend.
_NO_TIME = ("run", "o", "quiet", "force")


class Savable(Protocol):
    """A result that writes itself to a folder."""

    def save(self, folder: str | Path, *, overwrite: bool = False) -> Path: ...


def progress_of(args: argparse.Namespace) -> AbstractContextManager[Callable[[str], None]]:
    """Show progress on a terminal, and nothing when piped or quiet."""
    from jaxid._progress import progress

    timed = {k: v for k, v in vars(args).items() if k not in _NO_TIME}
    files = [str(Path(name).resolve()) for name in (timed.get("case"), *(timed.get("log") or ())) if name]
    words = [f"{k}={v}" for k, v in sorted(timed.items()) if k not in ("case", "log")]
    quiet = getattr(args, "quiet", False)
    return progress([*words, *files], shown=not quiet and sys.stderr.isatty())


def need_writable(args: argparse.Namespace, *files: str) -> None:
    """Refuse a folder before the work if the results could not be written to it."""
    if args.o is not None:
        from jaxid.files import check_folder

        check_folder(Path(args.o), files, overwrite=args.force)


def picture_file(name: str, *, overwrite: bool) -> Path:
    """Return the path of a picture after a check that it may be written."""
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix not in (".png", ".svg", ".pdf"):
        raise InputError(
            f"suffix {path.suffix!r} is no picture", where=name, hint="end it in .png, .svg or .pdf"
        )
    from jaxid.files import ready_file

    return ready_file(path, overwrite=overwrite, suffix=suffix)


def save_result(
    args: argparse.Namespace,
    result: Savable,
    *files: str,
    made: RobotCase | None = None,
    then: Callable[[Path], str] | None = None,
) -> int:
    """Save a result where the user wants it, print it, and return the exit status.

    It is saved first: the reader of the output, such as `head`, may end before the text does.

    Args:
        args: Arguments of the command.
        result: The result, which prints as text.
        files: Names of the files that it writes.
        made: The case that was made from a robot's file, saved beside the result.
        then: Function that writes more files to the folder of the saved result, and returns text to print.
    """
    written, more = [], None
    if args.o is not None:
        result.save(args.o, overwrite=args.force)
        written = [str(Path(args.o) / f) for f in files]
        if made is not None:
            written.append(str(made.save(Path(args.o))))
        more = None if then is None else then(Path(args.o))

    print(result)
    if written:
        print(f"\nwrote {', '.join(written)}")
    if more is not None:
        print(more)
    return 0 if getattr(result, "converged", True) else 1
