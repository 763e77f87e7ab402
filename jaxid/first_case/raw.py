"""A raw log with all its columns of numbers, before it is known what they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.first_case.columns import NO_TIME_RATE
from jaxid.first_case.words import meaning_of
from jaxid.logs.in_memory import LogLike, arrays_of, units_of_table
from jaxid.logs.readers import read_table
from jaxid.logs.readers.contents import Contents, contents_of
from jaxid.settings import LogTable


@dataclass(frozen=True)
class RawLog:
    """All columns of a log as they are.

    Attributes:
        source: Name of the log.
        contents: Its list of columns.
        data: Columns of numbers by name, (rows, 1).
        units: Units that the file states.
        sparse: Whether its reader takes NaN for "no reading at this time".
    """

    source: str
    contents: Contents
    data: dict[str, np.ndarray]
    units: Mapping[str, str]
    sparse: bool = False


def raw_log(log: LogLike) -> RawLog:
    """Read all columns of numbers of a log."""
    if not isinstance(log, str | Path):
        source, arrays = arrays_of(log)
        data = {}
        for name, values in arrays.items():
            values = np.asarray(values)
            if values.dtype.kind == "M":
                values = (values - values[0]) / np.timedelta64(1, "s")
            if values.dtype.kind in "fiub" and values.ndim == 1:
                data[name] = values.astype(np.float64)[:, None]
        return RawLog(source, Contents(tuple(data)), data, units_of_table(log))

    path = Path(log)
    if not path.exists():
        beside = sorted(p.name for p in path.parent.glob("*" + path.suffix))
        hint = f"check the path; in that folder there is: {', '.join(beside[:8]) or 'none'}"
        raise InputError("no such file", where=str(path), hint=hint)
    contents = contents_of(path)

    names: list[str] = [contents.time] if contents.time else []
    names += [name for name in contents.names if name != contents.time]
    time = contents.time or next((n for n in names if meaning_of(n).quantity == "time"), None)
    settings = LogTable(
        time=time,
        sample_rate=None if time else NO_TIME_RATE,
        position=names[0] if names else "q",
        force=names[0] if names else "u",
        episode=0 if contents.episodes > 1 else None,
    )

    try:
        read = read_table(path, names, None, settings)
        columns, units, sparse = read.columns, dict(read.units), bool(read.sparse)
    except InputError:
        # One column of text or of another length is no reason to refuse the others.
        columns, units, sparse = _one_by_one(path, names, contents, settings)

    data = {name: values for name, values in columns.items() if values.shape[1] == 1}
    rows = max((len(v) for v in data.values()), default=0)
    data = {name: values for name, values in data.items() if len(values) == rows > 1}
    return RawLog(str(path), contents, data, {**contents.units, **units}, sparse)


def _one_by_one(
    path: Path, names: Sequence[str], contents: Contents, settings: LogTable
) -> tuple[dict[str, np.ndarray], dict[str, str], bool]:
    """Read those columns that are numbers."""
    columns: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    first: InputError | None = None
    sparse = False
    for name in names:
        wanted = [name] if not contents.time or name == contents.time else [contents.time, name]
        try:
            read = read_table(path, wanted, None, settings)
        except InputError as error:
            first = first or error
            continue
        columns |= read.columns
        units |= dict(read.units)
        sparse |= bool(read.sparse)
    if not columns and first is not None:
        raise first
    return columns, units, sparse
