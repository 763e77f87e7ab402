"""References that are read from a CSV file."""

from typing import Any

import numpy as np

from jaxid.references.family import Family, Grid
from jaxid.schema import Key, number, text


def _sample(values: dict[str, Any], grid: Grid) -> np.ndarray:
    path = grid.base_dir / values["file"]
    names = [values["column"]] + ([values["time"]] if values["time"] else [])
    from jaxid.logs.readers import read_columns

    data, _ = read_columns(path, names)
    for name in names:
        bad = np.flatnonzero(~np.isfinite(data[name]).all(axis=1))
        if bad.size:
            raise grid.fault(f"{path}, column '{name}', row {bad[0]} is no number", "correct the row")
    position = data[values["column"]]
    if position.shape[1] > 1:
        hint = f"name one of its columns: '{values['column']}[1]'"
        raise grid.fault(f"{path}: '{values['column']}' is a matrix", hint)
    if not values["time"]:
        rate = values["sample_rate"] or grid.rate_hz
        return _resample(np.arange(len(position)) / rate, position[:, 0], grid)
    time = data[values["time"]][:, 0]
    wrong = np.flatnonzero(np.diff(time) <= 0)
    if wrong.size:
        what = f"{path}: time does not run forward in row {wrong[0] + 1}"
        raise grid.fault(what, "sort the rows and remove doubled ones")
    return _resample(time - time[0], position[:, 0], grid)


def _resample(time: np.ndarray, position: np.ndarray, grid: Grid) -> np.ndarray:
    """Interpolate linearly between the rows, and hold the last row."""
    return np.interp(grid.time, time, position)


CSV = Family(
    kind="csv",
    doc="a column of a file, from its first row on; past the last one it holds",
    keys={
        "file": Key(text, "the file, relative to the case", True),
        "column": Key(text, "the column with the reference", True),
        "time": Key(text, "the column with its time", unit="s"),
        "sample_rate": Key(
            number("positive"), "rows per second, if the file has no time", unit="Hz", note="the simulation's"
        ),
    },
    sample=_sample,
)
