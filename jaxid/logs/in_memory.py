"""Logs that are in memory already: tables of pandas, polars or xarray, and arrays by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.log import Log, read_log
from jaxid.logs.readers.array_files import pick_columns
from jaxid.logs.readers.rows import Rows
from jaxid.logs.readers.table import Table
from jaxid.logs.units import Frame
from jaxid.settings import LogTable


class NamedColumns(Protocol):
    """Named columns: a DataFrame of pandas or polars, an xarray Dataset, or a dictionary of arrays."""

    def __getitem__(self, name: Any, /) -> Any: ...


# Every type that a command takes for a log.
LogLike = Log | str | Path | NamedColumns


def as_log(
    log: LogLike,
    columns: LogTable | Mapping[str, Any],
    *,
    joints: int | None = 1,
    drives: int | None = None,
    frame: Frame | None = None,
) -> Log:
    """Return a log, in memory or from a file, with the same checks.

    Args:
        log: A log, which is returned as it is; a file; or a table, whose columns `columns` names.
        columns: The `[log]` table of a case, see `jaxid.logs.log.read_log`. The index of a DataFrame counts
            as a column if it has a name.
        joints: Number of positions expected; None takes what there is.
        drives: Number of forces and references expected; None: no more than positions.
        frame: The machine, for the conversion of units, see `jaxid.logs.log.read_log`.

    Raises:
        InputError: If the table is of no known kind, or a key, a column, a value or the time base is unsound.
    """
    if isinstance(log, Log):
        return log
    if isinstance(log, str | Path):
        return read_log(log, columns, joints=joints, drives=drives, frame=frame)
    name, known = arrays_of(log)
    units = units_of_table(log)

    def read(source: Path, names: list[str], rows: Rows | None) -> Table:
        return Table(*pick_columns(source, known, list(dict.fromkeys(names)), rows), units)

    return read_log(name, columns, joints=joints, drives=drives, frame=frame, read=read)


def arrays_of(log: Any) -> tuple[str, Mapping[str, Any]]:
    """Return the name of a table in messages, and its columns by name.

    No library is imported, because the library of a given table is loaded already.
    """
    library, kind = type(log).__module__.partition(".")[0], type(log).__name__
    if isinstance(log, Mapping) and library != "xarray":
        return "arrays", {str(name): values for name, values in log.items()}
    # The libraries are optional, and their classes are known by name only.
    table: Any = log
    if library == "pandas" and kind == "DataFrame":
        return kind, _of_pandas(table)
    if library == "polars" and kind in ("DataFrame", "LazyFrame"):
        table = table.collect() if kind == "LazyFrame" else table
        return "DataFrame", {name: table[name].to_numpy() for name in table.columns}
    if library == "xarray" and kind == "Dataset":
        return kind, {str(name): values.to_numpy() for name, values in table.variables.items()}
    raise InputError(
        f"a log cannot be a {type(table).__name__}",
        hint="give a file, a jaxid.Log, a DataFrame, an xarray Dataset, or a dictionary of arrays",
    )


def units_of_table(log: Any) -> dict[str, str]:
    """Return the units among the attributes of an xarray Dataset, by the name of the variable."""
    variables = log.variables.items() if type(log).__module__.partition(".")[0] == "xarray" else ()
    return {str(name): str(v.attrs["units"]) for name, v in variables if v.attrs.get("units")}


def _of_pandas(table: Any) -> dict[str, np.ndarray]:
    """Return the columns of a pandas table, and its index if that has a name."""
    twice = table.columns[table.columns.duplicated()]
    if len(twice):
        raise InputError(f"has two columns {str(twice[0])!r}", where="DataFrame", hint="rename one of them")
    index = {} if table.index.name is None else {str(table.index.name): table.index}
    columns = {**index, **{str(name): table[name] for name in table.columns}}
    return {name: _numbers(values) for name, values in columns.items()}


def _numbers(values: Any) -> np.ndarray:
    """Return a column as an array, missing entries of pandas' nullable numbers as NaN."""
    if getattr(values.dtype, "tz", None) is not None:
        # NumPy knows no time zones; only differences count.
        return values.to_numpy(dtype="datetime64[ns]")
    if isinstance(values.dtype, np.dtype) or getattr(values.dtype, "kind", "O") not in "fiub":
        return values.to_numpy()
    return values.to_numpy(dtype=np.float64, na_value=np.nan)
