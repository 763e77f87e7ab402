"""Columns of HDF5 files, and of the MATLAB files of version 7.3 that are some."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError, cause
from jaxid.logs.readers.array_files import base_of, need_size, pick_columns
from jaxid.logs.readers.extras import need
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Table

# Attributes in which programs keep the unit of a dataset.
_UNITS = ("units", "unit", "Unit", "Units", "unit_string")
# Most values that a dataset may leave out where NaN stands for them [bytes]; chosen: a log that ended early.
_LEFT_OUT = 2**26


def read_hdf5(path: Path, names: list[str], rows: Rows | None) -> Table:
    """Read datasets of an HDF5 file; see `read_table`. Needs h5py.

    The name of a dataset is its path, "group/q" or "/group/q", or its last part if no other has the same. A
    field of a table follows the table's name, "log/q".
    """
    h5py = need("h5py", path, "HDF5")
    with _opened(path, h5py) as file:
        found = _datasets(file, h5py)
        aliases = _aliases(found)
        known: dict[str, Any] = dict.fromkeys(aliases)
        units = {}
        for name in names:
            base = base_of(name, aliases)
            same = [there for there in found if there.rpartition("/")[2] == base]
            if base not in aliases and same:
                hint = f"write '{same[0]}'"
                raise InputError(f"has {len(same)} datasets '{base}'", where=str(path), hint=hint)
            if base in aliases and known[base] is None:
                dataset, field = found[aliases[base]]
                known[base] = _values(dataset, field, f"{path}, dataset '{base}'")
                units |= _unit_of(dataset, name)
    columns, taken = pick_columns(path, known, names, rows)
    return Table(columns, taken, units)


def _values(dataset: Any, field: str, where: str) -> np.ndarray:
    """Read a dataset of numbers, or a field of a table, if the file holds as many as it declares.

    Raises:
        InputError: If it is larger than any log, not numeric, or not in the file.
    """
    kind = dataset.dtype[field] if field else dataset.dtype
    if kind.base.kind not in "fiub":
        hint = "save it as a plain array of real numbers"
        raise InputError(f"is not numeric ({kind})", where=where, hint=hint)
    need_size(float(max(8, kind.itemsize)) * dataset.size, where)
    held = _held(dataset)
    left_out = dataset.size - held
    known_gaps = not field and kind.kind == "f" and np.isnan(dataset.fillvalue)
    if left_out > 0 and not (known_gaps and left_out * kind.itemsize <= _LEFT_OUT):
        what = f"declares {dataset.size} values, and the file holds {held} of them"
        raise InputError(what, where=where, hint="export the log again, without the rest")
    return dataset[field] if field else dataset[()]


def _held(dataset: Any) -> int:
    """Return how many values of a dataset were written; HDF5 gives zeros for the others."""
    if dataset.is_virtual:
        return dataset.size
    if dataset.chunks is not None:
        return min(dataset.id.get_num_chunks() * math.prod(dataset.chunks), dataset.size)
    return min(dataset.id.get_storage_size() // dataset.dtype.itemsize, dataset.size)


def datasets_of(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Return path, shape and unit of each dataset of numbers, and of each field of a table.

    Raises:
        InputError: If it is no HDF5 file.
    """
    h5py = need("h5py", path, "HDF5")
    with _opened(path, h5py) as file:
        found = _datasets(file, h5py)
        kinds = {name: (d.dtype[field] if field else d.dtype).kind for name, (d, field) in found.items()}
        return [
            (name, d.shape, _unit_of(d, name).get(name, ""))
            for name, (d, _) in found.items()
            if kinds[name] in "fiu"
        ]


@contextmanager
def _opened(path: Path, h5py: Any) -> Iterator[Any]:
    """Open a file, and give one line for the exceptions with which h5py answers a damaged one.

    Raises:
        InputError: If it cannot be read.
    """
    try:
        with h5py.File(path, "r") as file:
            yield file
    except InputError:
        raise
    except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
        if isinstance(error, OSError) and error.errno:
            raise
        what = f"cannot be read ({cause(error)})"
        raise InputError(what, where=str(path), hint="is it an HDF5 file? export it again") from error


def _datasets(file: Any, h5py: Any) -> dict[str, tuple[Any, str]]:
    """Return all datasets by their paths, and the fields of tables, each with its dataset and field."""
    found: dict[str, tuple[Any, str]] = {}

    def visit(name: str, entry: Any) -> None:
        # A dataset without a shape holds nothing.
        if not isinstance(entry, h5py.Dataset) or name.startswith("#") or entry.shape is None:
            return
        fields = entry.dtype.names or ()
        found.update({f"{name}/{field}": (entry, field) for field in fields} or {name: (entry, "")})

    file.visititems(visit)
    return found


def _aliases(found: Mapping[str, Any]) -> dict[str, str]:
    """Return the path of each name that stands for one dataset only."""
    last: dict[str, list[str]] = {}
    for path in found:
        last.setdefault(path.rpartition("/")[2], []).append(path)
    short = {name: paths[0] for name, paths in last.items() if len(paths) == 1}
    return {**short, **{f"/{path}": path for path in found}, **{path: path for path in found}}


def _unit_of(dataset: Any, name: str) -> dict[str, str]:
    """Return the unit among the attributes of a dataset, by name; empty if there is none."""
    for key in _UNITS:
        if key in dataset.attrs:
            texts = [t for t in np.ravel(dataset.attrs[key]).tolist() if isinstance(t, str | bytes)]
            return {name: _text(texts[0])} if texts else {}
    return {}


def _text(value: str | bytes) -> str:
    """Return a text of a file, with signs for what is no UTF-8, and could not be printed."""
    raw = value if isinstance(value, bytes) else value.encode(errors="surrogateescape")
    return raw.decode(errors="replace")
