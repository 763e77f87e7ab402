"""Writing results: whole or not at all, and never over files that jaxid did not make."""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError

# A folder with this file in it was made by jaxid, and may be written again.
_MARK = ".jaxid"


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
    """Write a file so that it is either there entirely or not at all."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content.encode("utf-8") if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a result as JSON, numbers as JSON numbers, absent ones as null."""
    write_whole(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


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


def ready_folder(folder: Path, files: Sequence[str], *, overwrite: bool = False) -> Path:
    """Make a folder for results if it does not exist.

    Raises:
        InputError: If `check_folder` refuses it, or it cannot be made.
    """
    check_folder(folder, files, overwrite=overwrite)
    if not folder.exists():
        mark_folder(folder)
    return folder


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
            f"cannot be made: {error.strerror}", where=str(folder), hint="choose another -o"
        ) from error


def ready_file(path: Path, *, overwrite: bool = False) -> Path:
    """Check that a log may be written, before the work that makes it.

    Raises:
        InputError: If the file exists and `overwrite` is false, its folder does not exist, it is a folder, or
            its name does not end in .csv.
    """
    if path.is_dir():
        raise InputError("is a folder", where=str(path), hint="name a file: -o LOG.csv")
    if path.suffix.lower() != ".csv":
        raise InputError(
            f"suffix {path.suffix!r}: the log is written as CSV",
            where=str(path),
            hint="end its name in .csv",
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
