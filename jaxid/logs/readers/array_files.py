"""Columns of files that hold arrays: NumPy, MATLAB and Parquet."""

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.logs.readers.rows import Rows, resolve_rows

Columns = tuple[dict[str, Float[np.ndarray, "samples _"]], Rows]
_INDEXED = re.compile(r"(.+)\[(\d+)\]$")


def read_npz(path: Path, names: list[str], rows: Rows | None) -> Columns:
    """Read columns of a NumPy archive; see `read_columns`. Pickled objects are refused."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not hasattr(archive, "files"):
                raise InputError("holds no named arrays", where=str(path), hint="use numpy.savez")
            wanted = {_base(name, archive.files) for name in names} & set(archive.files)
            known = {key: archive[key] if key in wanted else None for key in archive.files}
    except (ValueError, zipfile.BadZipFile, EOFError) as error:
        if isinstance(error, InputError):
            raise
        hint = "save plain arrays of numbers with numpy.savez"
        raise InputError(f"cannot be read ({error})", where=str(path), hint=hint) from error
    return pick_columns(path, known, names, rows)


def read_mat(path: Path, names: list[str], rows: Rows | None) -> Columns:
    """Read columns of a MATLAB file up to version 7.2; see `read_columns`."""
    # Imported here, since reading a CSV should not wait for it.
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        content = loadmat(path)
    except NotImplementedError as error:
        hint = "in MATLAB: save('log.mat', '-v7', ...), or export CSV"
        raise InputError("is a MATLAB v7.3 (HDF5) file", where=str(path), hint=hint) from error
    except (MatReadError, ValueError, TypeError, KeyError, IndexError) as error:
        hint = "is it a MATLAB file? save it again with -v7"
        raise InputError(f"cannot be read ({error})", where=str(path), hint=hint) from error
    known = {key: value for key, value in content.items() if not key.startswith("__")}
    return pick_columns(path, known, names, rows)


def read_parquet(path: Path, names: list[str], rows: Rows | None) -> Columns:
    """Read columns of a Parquet file; see `read_columns`. Needs pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        hint = "pip install pyarrow, or export CSV"
        raise InputError("Parquet needs pyarrow", where=str(path), hint=hint) from error
    try:
        known: dict[str, Any] = dict.fromkeys(parquet.read_schema(path).names)
        wanted = [name for name in names if name in known]
        table = parquet.read_table(path, columns=wanted)
        known.update({name: table[name].to_numpy() for name in wanted})
    except pyarrow.ArrowException as error:
        hint = "is it a Parquet file? export it again"
        raise InputError(f"cannot be read ({error})", where=str(path), hint=hint) from error
    return pick_columns(path, known, names, rows)


def _base(name: str, known: Mapping[str, Any] | list[str]) -> str:
    """Return the variable of a name like `pos[2]`; a variable with that literal name takes precedence."""
    match = _INDEXED.match(name)
    return match[1] if match and name not in known else name


def pick_columns(path: Path, known: Mapping[str, Any], names: list[str], rows: Rows | None) -> Columns:
    """Take the named columns out of arrays and cut the rows.

    Args:
        path: The file, or another name of the source, for messages.
        known: All variables by name; those that are not requested may be None.
        names: Names of the requested columns.
        rows: First row and end, 0-based and half open; None: all.
    """
    columns = {name: _column(path, known, name) for name in names}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        sizes = ", ".join(f"'{name}' {count}" for name, count in lengths.items())
        hint = "all columns of a log need the same length"
        raise InputError(f"unequal lengths: {sizes}", where=str(path), hint=hint)
    count = next(iter(lengths.values()), 0)
    if names and not count:
        raise InputError("is empty", where=str(path), hint="export the log again")
    first, end = resolve_rows(rows, count, path)
    return {name: values[first:end] for name, values in columns.items()}, (first, end)


def _column(path: Path, known: Mapping[str, Any], name: str) -> Float[np.ndarray, "samples _"]:
    """Return one column as an array (samples, width) of float64."""
    base = _base(name, known)
    if base not in known:
        hint = suggest(base, known)
        raise InputError(f"has no variable '{name}'", where=str(path), hint=hint)
    values = np.asarray(known[base])
    where = f"{path}, variable '{base}'"
    if values.dtype.kind not in "fiub":
        hint = "save it as a plain array of real numbers"
        raise InputError(f"is not numeric ({values.dtype})", where=where, hint=hint)
    if values.ndim > 2:
        raise InputError(f"has {values.ndim} dimensions", where=where, hint="save a matrix")
    values = np.atleast_1d(values).astype(np.float64)
    values = values[:, None] if values.ndim == 1 else values
    # A log has more samples than joints, so the longer side is time.
    values = values.T if values.shape[0] < values.shape[1] else values
    if base == name:
        return values
    index = int(name[len(base) + 1 : -1])
    if not 1 <= index <= values.shape[1]:
        hint = f"it has columns 1 to {values.shape[1]}"
        raise InputError(f"has no column {index}", where=where, hint=hint)
    return values[:, index - 1 : index]
