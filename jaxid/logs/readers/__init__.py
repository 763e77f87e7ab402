"""Named columns of numbers from the file formats that logs come in."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.array_files import read_mat, read_npz, read_parquet
from jaxid.logs.readers.csv_file import read_csv
from jaxid.logs.readers.excel_file import read_excel
from jaxid.logs.readers.hdf5_file import read_hdf5
from jaxid.logs.readers.lerobot import INFO, read_lerobot, root_of
from jaxid.logs.readers.ros_bag import read_ros
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Table
from jaxid.logs.readers.tdms_file import read_tdms
from jaxid.settings import LogTable

if TYPE_CHECKING:
    from jaxtyping import Float

# Each reader: (path, names, rows) -> ({name: (samples, width)}, rows that were read), or a `Table`. One that
# has a fourth argument, `settings`, is also given the [log] table.
Read: TypeAlias = "tuple[dict[str, Float[np.ndarray, 'samples _']], Rows] | Table"
Reader = Callable[..., Read]
READERS: dict[str, Reader] = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".tsv": read_csv,
    ".dat": read_csv,
    ".asc": read_csv,
    ".lvm": read_csv,
    ".npz": read_npz,
    ".mat": read_mat,
    ".parquet": read_parquet,
    ".h5": read_hdf5,
    ".hdf5": read_hdf5,
    ".hdf": read_hdf5,
    ".xlsx": read_excel,
    ".xlsm": read_excel,
    ".tdms": read_tdms,
    ".mcap": read_ros,
    ".db3": read_ros,
    ".bag": read_ros,
}
# Folders that are one log, by a file that is in them.
FOLDERS: dict[str, Reader] = {
    "metadata.yaml": read_ros,
    INFO: read_lerobot,
}


def register_reader(suffix: str, reader: Reader) -> None:
    """Register a file format, so that every command reads logs whose name ends so.

    Args:
        suffix: End of the file's name, with its dot, as ".jsonl".
        reader: Function of path, names of columns and rows, see `read_columns`.

    Raises:
        InputError: If the suffix is not one dot and a name, or is that of another format.
    """
    suffix = suffix.lower()
    known = READERS.get(suffix)
    if not suffix.startswith(".") or len(suffix) < 2 or "." in suffix[1:]:
        raise InputError(f"suffix {suffix!r} is not one dot and a name", hint='write it as ".jsonl"')
    if known is not None and (known.__module__, known.__qualname__) != (
        reader.__module__,
        reader.__qualname__,
    ):
        raise InputError(f"suffix {suffix!r} is that of another format", hint="choose another suffix")
    READERS[suffix] = reader


def read_columns(
    path: str | Path, names: list[str], rows: Rows | None = None
) -> tuple[dict[str, Float[np.ndarray, "samples _"]], Rows]:
    """Read the named columns of a file, unchanged and without regard to their meaning; see `read_table`.

    Returns:
        The columns by name, each of shape (samples, width), and the rows in the file.
    """
    table = read_table(path, names, rows)
    return table.columns, table.rows


def read_table(
    path: str | Path, names: list[str], rows: Rows | None = None, settings: LogTable | None = None
) -> Table:
    """Read the named columns of a file with everything that was assumed to read them.

    A matrix in `.npz` or `.mat` has its samples along the longer side. A name
    like `pos[2]` is its second column.

    Args:
        path: The file; its suffix determines the format.
        names: Names of the columns.
        rows: First row and end, 0-based and half open; None: all. Rows outside are not examined.
        settings: The `[log]` table, for formats that need more than names; None: nothing is stated.

    Returns:
        The columns by name, with the rows in the file, units and assumptions.

    Raises:
        InputError: If the file, a column, a cell or the rows are not there or not numbers.
    """
    path = Path(path)
    try:
        if not path.exists():
            beside = [p.name for p in path.parent.glob("*" + path.suffix)]
            hint = f"check the path; in that folder there is: {', '.join(sorted(beside)[:8]) or 'none'}"
            raise InputError("no such file", where=str(path), hint=hint)
        reader = reader_of(path, None if settings is None else settings.format)
        if path.is_file() and path.stat().st_size == 0:
            raise InputError("is empty", where=str(path), hint="export the log again")
        wanted = list(dict.fromkeys(names))
        more = (settings,) if "settings" in inspect.signature(reader).parameters else ()
        read = reader(path, wanted, rows, *more)
        return read if isinstance(read, Table) else Table(*read)
    except OSError as error:
        hint = "check the permissions of the file"
        raise InputError(f"cannot be read ({cause(error)})", where=str(path), hint=hint) from error
    except MemoryError as error:
        hint = "cut or decimate the log"
        raise InputError("is too large for the memory", where=str(path), hint=hint) from error


def reader_of(path: Path, stated: str | None) -> Reader:
    """Return the reader of a log: of the stated format, by a file in its folder, or by its suffix.

    Raises:
        InputError: If the path is no log, or its format is not known.
    """
    if path.is_dir():
        known = next((reader for file, reader in FOLDERS.items() if (path / file).is_file()), None)
        if known is not None:
            return known
    if not path.is_file():
        hint = f"give the path of the log, or a folder with {' or '.join(FOLDERS)}"
        raise InputError("is not a file", where=str(path), hint=hint)
    if stated is not None:
        suffix = f".{stated.casefold().removeprefix('.')}"
        if suffix not in READERS:
            known_formats = [name.removeprefix(".") for name in READERS]
            raise InputError(
                f"format = '{stated}' is unknown", where="[log]", hint=suggest(stated, known_formats)
            )
        return READERS[suffix]
    if path.suffix.lower() == ".parquet" and root_of(path) is not None:
        return read_lerobot
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        hint = f"use one of {', '.join(READERS)}, or say format in [log]"
        raise InputError(f"unknown suffix '{path.suffix}'", where=str(path), hint=hint)
    return reader
