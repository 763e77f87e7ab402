"""Columns of files that hold arrays: NumPy, MATLAB and Parquet."""

from __future__ import annotations

import math
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.lib import format as npy

from jaxid.errors import InputError, cause, suggest
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.mat_file import MatFile
from jaxid.logs.readers.rows import Rows, resolve_rows
from jaxid.logs.readers.table import Table

if TYPE_CHECKING:
    from jaxtyping import Float

Columns: TypeAlias = "tuple[dict[str, Float[np.ndarray, 'samples _']], Rows]"
_INDEXED = re.compile(r"(.+)\[(\d+)\]$")
# Largest array that is read [bytes]; chosen: 20 hours at 1 kHz and 7 columns.
_LARGEST = 4 * 2**30


def read_npz(path: Path, names: list[str], rows: Rows | None) -> Columns:
    """Read columns of a NumPy archive; see `read_columns`. Pickled objects are refused, and never loaded."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = {base_of(name, members) for name in names} & set(members)
            known = {key: _array(archive, members[key], path) if key in wanted else None for key in members}
    except InputError:
        raise
    except OSError:
        raise
    except Exception as error:
        # A damaged archive raises errors of a dozen kinds, down to those of zlib and struct.
        hint = "save arrays of numbers with numpy.savez(path, t=t, q=q, u=u)"
        raise InputError(f"cannot be read ({cause(error)})", where=str(path), hint=hint) from error
    return pick_columns(path, known, names, rows)


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo, path: Path) -> np.ndarray:
    """Read an array of an archive, after its declared size and the size of its data."""
    where = f"{path}, variable '{info.filename.removesuffix('.npy')}'"
    # The archive reads no more than this size states, however much its data would expand to.
    need_size(info.file_size, where)
    shape, kind = header_of(archive, info)
    if kind.hasobject:
        hint = "save it as a plain array of real numbers"
        raise InputError("is not numeric (object)", where=where, hint=hint)
    declared = math.prod(shape) * kind.itemsize
    if declared > info.file_size:
        what = f"declares the shape {shape}, and its data are {info.file_size} bytes"
        raise InputError(what, where=where, hint="save the log again")
    with archive.open(info) as file:
        return npy.read_array(file, allow_pickle=False)


def header_of(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> tuple[tuple[int, ...], np.dtype]:
    """Return the shape and the type that an array of an archive declares, without reading it."""
    with archive.open(info) as file:
        version = npy.read_magic(file)
        header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
        shape, _, kind = header(file)
        return shape, kind


def need_size(size: float, where: str) -> None:
    """Refuse an array that is larger than any log, before memory is taken for it."""
    if size > _LARGEST:
        what = f"is {size / 2**30:.3g} GiB large"
        raise InputError(what, where=where, hint=f"at most {_LARGEST / 2**30:g} GiB: cut or decimate the log")


def read_mat(path: Path, names: list[str], rows: Rows | None) -> Columns | Table:
    """Read columns of a MATLAB file; see `read_columns`. One of version 7.3 needs h5py."""
    hint = "is it a MATLAB file? save it again with -v7"
    content = path.read_bytes()
    if content[124:128] in (b"\x00\x02IM", b"\x02\x00MI"):
        from jaxid.logs.readers.hdf5_file import read_hdf5

        return read_hdf5(path, names, rows)
    try:
        if content[126:128] not in (b"IM", b"MI"):
            known = _matrices_of_level_4(path, names)
        else:
            file = MatFile(content)
            known = {name: _matrix(file, name, names, path) for name in file.variables}
    except (InputError, OSError, MemoryError):
        raise
    except Exception as error:
        # A damaged file raises errors of a dozen kinds.
        raise InputError(f"cannot be read ({cause(error)})", where=str(path), hint=hint) from error
    return pick_columns(path, known, names, rows)


def _matrix(file: MatFile, name: str, names: list[str], path: Path) -> np.ndarray | None:
    """Read a variable of a MATLAB file; None if no column is of it."""
    if name not in {base_of(wanted, file.variables) for wanted in names}:
        return None
    variable, where = file.variables[name], f"{path}, variable '{name}'"
    if not variable.numeric:
        hint = "save it as a plain array of real numbers"
        raise InputError(f"is not numeric ({variable.kind})", where=where, hint=hint)
    need_size(variable.bytes, where)
    return file.read(name)


def _matrices_of_level_4(path: Path, names: list[str]) -> dict[str, np.ndarray | None]:
    """Read variables of a MATLAB file of level 4; SciPy's parser of these is Python alone."""
    # Imported here, since reading other files should not wait for it.
    from scipy.io import loadmat, whosmat

    # A variable that cannot be read is a warning of SciPy.
    with warnings.catch_warnings(action="error"):
        shapes = {name: shape for name, shape, _ in whosmat(path)}
        wanted = {base_of(name, shapes) for name in names} & set(shapes)
        for name in wanted:
            need_size(8 * math.prod(shapes[name]), f"{path}, variable '{name}'")
        content = loadmat(path, variable_names=sorted(wanted))
    return {name: content.get(name) for name in shapes}


def read_parquet(path: Path, names: list[str], rows: Rows | None) -> Columns:
    """Read columns of a Parquet file; see `read_columns`. Needs pyarrow."""
    pyarrow, parquet = need("pyarrow", path, "Parquet"), need("pyarrow.parquet", path, "Parquet")
    try:
        known: dict[str, Any] = dict.fromkeys(parquet.read_schema(path).names)
        wanted = [name for name in names if name in known]
        count = parquet.read_metadata(path).num_rows
        need_size(8.0 * count * max(len(wanted), 1), str(path))
        table = parquet.read_table(path, columns=wanted)
        known.update({name: table[name].to_numpy() for name in wanted})
    except InputError:
        raise
    except (pyarrow.ArrowException, ValueError, KeyError, TypeError) as error:
        hint = "is it a Parquet file? export it again"
        raise InputError(f"cannot be read ({cause(error)})", where=str(path), hint=hint) from error
    return pick_columns(path, known, names, rows)


def base_of(name: str, known: Mapping[str, Any] | list[str]) -> str:
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


def _asarray(values: Any, where: str) -> np.ndarray:
    """Return values as an array, masked ones as NaN."""
    if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "fiub":
        return np.ma.filled(values.astype(np.float64), np.nan)
    try:
        return np.asarray(values)
    except Exception as error:
        hint = "give a plain array of real numbers"
        raise InputError(f"is no array ({cause(error)})", where=where, hint=hint) from error


def _seconds(values: np.ndarray) -> np.ndarray:
    """Return dates as seconds since the first one, and durations as seconds; missing ones as NaN."""
    since = values - values.ravel()[0] if values.dtype.kind == "M" and values.size else values
    seconds = since.astype("timedelta64[ns]").astype(np.float64) * 1e-9
    return np.where(np.isnat(values), np.nan, seconds)


def _column(path: Path, known: Mapping[str, Any], name: str) -> Float[np.ndarray, "samples _"]:
    """Return one column as an array (samples, width) of float64."""
    base = base_of(name, known)
    if base not in known:
        hint = suggest(base, known)
        raise InputError(f"has no variable '{name}'", where=str(path), hint=hint)
    where = f"{path}, variable '{base}'"
    values = _asarray(known[base], where)
    if values.dtype.kind in "mM":
        values = _seconds(values)
    if values.dtype.kind not in "fiub":
        hint = "save it as a plain array of real numbers"
        raise InputError(f"is not numeric ({values.dtype})", where=where, hint=hint)
    if values.ndim > 2:
        raise InputError(f"has {values.ndim} dimensions", where=where, hint="save a matrix")
    if not values.size:
        raise InputError("is empty", where=where, hint="export the log again")

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
