"""The content of a file as a reader hands it over: columns, and all that was assumed to read them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.logs.readers.rows import Rows

if TYPE_CHECKING:
    from jaxtyping import Float


@dataclass(frozen=True)
class Assumed:
    """One setting that a file or the data decided, not the user.

    Attributes:
        setting: Name of the setting, that of its key in `[log]` if it has one.
        value: The value that was taken.
        reason: Evidence for it, and how to state another one.
    """

    setting: str
    value: Any
    reason: str

    def __str__(self) -> str:
        """Format the setting as one line."""
        value = f"'{self.value}'" if isinstance(self.value, str) else self.value
        return f"{self.setting} = {value}: {self.reason}"

    def json(self) -> dict[str, Any]:
        """Return the entry of check.json and result.json."""
        return {"setting": self.setting, "value": self.value, "reason": self.reason}


@dataclass(frozen=True)
class Table:
    """Named columns of a file.

    Attributes:
        columns: Columns by the name that was asked for, (samples, width) each.
        rows: Rows of the file that were read, 0-based and half open.
        units: Units that the file states, by the name of the column.
        assumed: Settings that the file decided.
        sparse: Names of columns in which NaN stands for "no reading at this time".
    """

    columns: dict[str, Float[np.ndarray, "samples _"]]
    rows: Rows
    units: Mapping[str, str] = field(default_factory=dict)
    assumed: tuple[Assumed, ...] = ()
    sparse: frozenset[str] = frozenset()


def on_one_time(
    readings: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> tuple[Float[np.ndarray, " rows"], dict[str, Float[np.ndarray, "rows _"]]]:
    """Give columns with times of their own one time.

    Args:
        readings: Times, (readings,), and values, (readings, width), by name; a reading without time does not
            count.

    Returns:
        All times that occur, rising, and the columns, NaN at times at which they have no reading.
    """
    first = next(iter(readings.values()))[0] if readings else np.empty(0)
    if all(t is first for t, _ in readings.values()) and np.all(np.diff(first) > 0):
        # One sensor: its columns are taken as they are, without a copy.
        return first, {name: v for name, (_, v) in readings.items()}
    known = {name: (t[np.isfinite(t)], v[np.isfinite(t)]) for name, (t, v) in readings.items()}
    times = np.unique(np.concatenate([t for t, _ in known.values()])) if known else np.empty(0)
    columns = {}
    for name, (t, v) in known.items():
        columns[name] = np.full((times.size, v.shape[1]), np.nan)
        columns[name][np.searchsorted(times, t)] = v
    return times, columns
