"""Writing results: whole or not at all, and never over files that jaxid did not make."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import glob
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError

# A folder with this file in it was made by jaxid, and may be written again.
_MARK = ".jaxid"
# End of the name of a file that is being written.
_PART = ".part"


def plain(value: Any) -> Any:
    """Convert arrays and numbers to JSON types; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain(v) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file so that it is either there entirely or not at all.

    Raises:
        InputError: If it cannot be written; a file that was there stays as it was.
    """
    write_together({path: content})


def write_together(files: Mapping[Path, str | bytes]) -> None:
    """Write several files so that either all are there entirely, or none is changed.

    All are written under other names before the first takes its own, so that a full disk changes nothing.
    If the process is killed while they take their names, each is the old or the new one, and entire.

    Args:
        files: Content by path; text is written as UTF-8.

    Raises:
        InputError: If one cannot be written; files that were there stay as they were.
    """
    with contextlib.ExitStack() as stack:
        ready = {}
        for path, content in files.items():
            with _named(path):
                if path.is_dir():
                    raise IsADirectoryError(errno.EISDIR, "is a folder")
                ready[path] = stack.enter_context(_temporary(path, content))
        for path, temporary in ready.items():
            with _named(path):
                os.replace(temporary, path)


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Raise an error of the system as one line with the path of the file."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"cannot be written: {error.strerror or error}", where=str(path), hint=_remedy(error)
        ) from error


def _remedy(error: OSError) -> str:
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    return "free some space there, or choose another -o" if full else "choose another -o"


@contextlib.contextmanager
def _temporary(path: Path, content: str | bytes) -> Iterator[str]:
    """Write a file beside its place, under another name that is free again at the end.

    The writer holds a lock on it: one without a lock is of a process that was killed, and is removed.
    """
    _remove_abandoned(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=_PART)
    try:
        with os.fdopen(handle, "wb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
            os.chmod(temporary, 0o644)
            yield temporary
    finally:
        Path(temporary).unlink(missing_ok=True)


def _remove_abandoned(path: Path) -> None:
    for part in path.parent.glob(f".{glob.escape(path.name)}.*{_PART}"):
        with contextlib.suppress(OSError), part.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            part.unlink()


def json_text(content: Mapping[str, Any]) -> str:
    """Format a result as JSON, numbers as JSON numbers, absent ones as null."""
    return json.dumps(plain(content), indent=1, allow_nan=False) + "\n"


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a result as JSON, numbers as JSON numbers, absent ones as null.

    Raises:
        InputError: If it cannot be written.
    """
    write_whole(path, json_text(content))


def check_folder(folder: Path, files: Sequence[str], *, overwrite: bool = False) -> None:
    """Check that results may be written to a folder, before the work that makes them.

    Raises:
        InputError: If the folder holds one of the files, jaxid did not make it, and `overwrite` is false;
            or if the path is that of a file.
    """
    existing = next((p for p in (folder, *folder.parents) if p.exists()), folder)
    if existing.exists() and not existing.is_dir():
        raise InputError("is a file, not a folder", where=str(existing), hint="choose another -o")
    taken = [f for f in files if (folder / f).exists()]
    if taken and not (folder / _MARK).exists() and not overwrite:
        raise InputError(
            f"holds {', '.join(taken)} already",
            where=str(folder),
            hint="choose another -o, or overwrite with --force",
        )


def found_case_file(case: Path | None, folder: Path) -> str:
    """Return the name of the corrected case in a folder: never that of the case itself.

    Args:
        case: The case file; None for a case without one.
        folder: The folder of the results.
    """
    same = case is not None and case.resolve() == (folder / "case.toml").resolve()
    return "case_found.toml" if same else "case.toml"


def write_results(folder: Path, files: Mapping[str, str | bytes], *, overwrite: bool = False) -> None:
    """Write the files of a result to a folder, which is made if it does not exist: all of them or none.

    Args:
        folder: The folder.
        files: Content by name.
        overwrite: Whether to overwrite files that jaxid did not make.

    Raises:
        InputError: If `check_folder` refuses the folder, or it or a file cannot be written.
    """
    check_folder(folder, list(files), overwrite=overwrite)
    with new_folder(folder):
        write_together({folder / name: content for name, content in files.items()})


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Make a folder if it does not exist, and remove it again if the block fails before a file is in it.

    A folder that is made is marked as jaxid's own, which may then write there again.

    Raises:
        InputError: If it cannot be made.
    """
    made = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        if made:
            mark_folder(folder)
        yield
    except BaseException:
        # Only what is empty apart from the mark.
        if made and folder.is_dir() and {p.name for p in folder.iterdir()} <= {_MARK}:
            (folder / _MARK).unlink(missing_ok=True)
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def mark_folder(folder: Path) -> None:
    """Make a folder and mark it as made by jaxid, which may then write there again.

    Raises:
        InputError: If it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / _MARK).write_text("made by jaxid\n", encoding="utf-8")
    except OSError as error:
        raise InputError(
            f"cannot be made: {error.strerror}", where=str(folder), hint=_remedy(error)
        ) from error


def ready_file(
    path: Path, *, overwrite: bool = False, suffix: str = ".csv", also: Sequence[str] = ()
) -> Path:
    """Check that a log, or another file, may be written, before the work that makes it.

    Args:
        path: The file.
        overwrite: Whether it may exist.
        suffix: End of its name.
        also: Further ends that are as good.

    Raises:
        InputError: If the file exists and `overwrite` is false, its folder does not exist, it is a folder, or
            its name does not end in the suffix.
    """
    if path.is_dir():
        raise InputError("is a folder", where=str(path), hint=f"name a file: -o LOG{suffix}")
    if path.suffix.lower() not in (suffix, *also):
        raise InputError(
            f"suffix {path.suffix!r}: the {'log' if suffix == '.csv' else 'file'} is written as "
            f"{suffix[1:].upper()}",
            where=str(path),
            hint=f"end its name in {suffix}",
        )
    if path.exists() and not overwrite:
        raise InputError(
            "exists already", where=str(path), hint="choose another -o, or overwrite with --force"
        )
    if not path.parent.is_dir():
        raise InputError("has no such folder", where=str(path), hint="make the folder first")
    return path


def signal_csv(signal: str, time: np.ndarray, values: np.ndarray) -> str:
    """Format time and a signal as `[reference] kind = "csv"` or `[input]` reads them, with every digit.

    Args:
        signal: "reference" or "input".
        time: Time of the ticks [s].
        values: Signal by drive, (ticks, m).
    """
    names = [signal] if values.shape[1] == 1 else [f"{signal}_{k + 1}" for k in range(values.shape[1])]
    rows = np.column_stack([time, values])
    lines = [",".join(repr(float(v)) for v in row) for row in rows]
    return "\n".join([",".join(["t", *names]), *lines]) + "\n"
