"""Disturbances that are added to the command in a loop."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.logs.log import Log, one_stretch
from jaxid.logs.readers import read_columns, read_table
from jaxid.logs.units import time_factor
from jaxid.settings import Disturbance

# A disturbance switches at start + k (on + off). The tick at that instant still has the old value, and a
# rounding error of its time stamp must not change that. The tolerance is relative to on + off: half a
# microsecond at a usual 0.5 s, far below any tick and above the jitter of logs.
_SWITCH = 1e-6


def disturbance_at(
    disturbance: Disturbance | str | None,
    times: Float[np.ndarray, " ticks"],
    log: Log | None = None,
) -> Float[np.ndarray, "ticks _"]:
    """Sample the disturbance that is added to the command in a loop.

    A square wave is on for start < t <= start + on, and repeats with the period on + off. The tick at the
    instant of switching still has the old value, however its time stamp is rounded.

    Args:
        disturbance: A square wave, the name of a column, or None for zero.
        times: Times of the ticks on the clock of the log [s].
        log: Log whose file has the column; the values are held between its rows.

    Returns:
        The disturbance at each tick, in units of the command.

    Raises:
        InputError: If there is no such column, or no log is given.
    """
    times = np.asarray(times, dtype=np.float64)
    if disturbance is None:
        return np.zeros((times.size, 1))
    if isinstance(disturbance, str):
        return _column(disturbance, times, log)
    cycle = disturbance.on + disturbance.off
    since = times - disturbance.start - _SWITCH * cycle
    on = (since > 0) & (np.mod(since, cycle) < disturbance.on)
    return np.where(on, disturbance.level, 0.0)[:, None]


def _column(name: str, times: np.ndarray, log: Log | None) -> np.ndarray:
    where = f"disturbance = '{name}'"
    if log is None:
        hint = "give { level, on, off, start } instead"
        raise InputError("a column needs a log that contains it", where=where, hint=hint)
    rows, values = _rows_of(name, log)
    if not np.isfinite(values).all():
        row = log.rows[0] + int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        hint = "correct that row, or cut it out with rows"
        raise InputError(f"row {row} is not a number", where=f"{log.source}, {where}", hint=hint)
    # A tick at the time of a sample belongs to this sample, however its time is rounded.
    held = np.searchsorted(rows, times + 1e-3 * log.period, side="right") - 1
    return values[np.clip(held, 0, len(values) - 1)]


def _rows_of(name: str, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Return a column of a log's file, and the times of its rows [s]."""
    if log.samples == log.rows[1] - log.rows[0] and not log.resampled:
        return log.time, read_columns(log.source, [name], log.rows)[0][name]
    table = log.table
    assert table is not None, "only a log from a file is resampled"
    time = [] if table.time is None else [table.time]
    content = read_table(log.source, [*time, name], one_stretch(table, log.source), table)
    values = content.columns[name]
    if table.time is None:
        return np.arange(*content.rows) / (table.sample_rate or 1.0), values
    stamps = content.columns[table.time] * time_factor(table, content.units.get(table.time, ""))
    read = np.isfinite(values).all(axis=1) if name in content.sparse else np.full(len(values), True)
    return stamps[read, 0], values[read]
