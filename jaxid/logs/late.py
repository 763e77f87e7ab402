"""Forces that were logged late or through a low-pass, taken back to when they acted, as the case states."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.settings import LogTable


def taken_back(
    groups: Mapping[str, np.ndarray], time: Float[np.ndarray, " samples"], table: LogTable, where: str
) -> dict[str, np.ndarray]:
    """Return the columns of a log with the forces at the time at which they acted.

    Args:
        groups: Columns by quantity at one rate, (samples, width) each.
        time: Time of the samples [s].
        table: The `[log]` table with `lag` and `delay`.
        where: The file, for messages.

    Raises:
        InputError: If a time is stated for a column that the log does not have, or is longer than the log.
    """
    out = dict(groups)
    for key, change in (("lag", _without_low_pass), ("delay", earlier)):
        for quantity, stated in dict(getattr(table, key) or {}).items():
            if table.force is None:
                hint = f"add the column, or leave out {key}.{quantity}"
                what = f"{key}.{quantity} changes nothing: [log] names no {quantity}"
                raise InputError(what, where=where, hint=hint)
            values = out[quantity]
            times = _by_column(stated, values.shape[1], f"{key}.{quantity}", where)
            if max(times) >= time[-1] - time[0]:
                raise InputError(
                    f"{key}.{quantity} = {max(times):g} s is as long as the log",
                    where=where,
                    hint="give it in s",
                )
            columns = [change(time, x, t, table.hold) for x, t in zip(values.T, times, strict=True)]
            out[quantity] = np.stack(columns, axis=1)
    return out


def _by_column(stated: float | tuple[float, ...], width: int, name: str, where: str) -> tuple[float, ...]:
    """Return a time for each column."""
    times = stated if isinstance(stated, tuple) else (stated,) * width
    if len(times) != width:
        what = f"{name} has {len(times)} entries, and there are {width} columns"
        raise InputError(what, where=where, hint="give one time for all, or one a column")
    return times


def earlier(
    time: Float[np.ndarray, " samples"], x: Float[np.ndarray, "samples ..."], delay: float, hold: str | None
) -> Float[np.ndarray, "samples ..."]:
    """Return a signal as it will be read after a delay; readings beyond the ends are those at the ends.

    Between samples of a held force lines give the mean of what was held over a sample; of one that is not
    held they would damp what is fast, so that it follows cubic splines.
    """
    import scipy.interpolate  # a third of a second, which reading another log does not need

    then = np.clip(time + delay, time[0], time[-1])
    if hold in (None, "zero_order"):
        return scipy.interpolate.make_interp_spline(time, x, k=1)(then)
    return scipy.interpolate.CubicSpline(time, x)(then)


def _without_low_pass(time: np.ndarray, x: np.ndarray, lag: float, hold: str | None) -> np.ndarray:
    """Return the signal u behind a low-pass that drives compute: x[k] = x[k-1] + a (u[k] - x[k-1]).

    a = 1 - exp(-period / lag) is that of a first-order lag of its input held over a sample.
    """
    del hold  # the low-pass takes readings as they come
    period = (time[-1] - time[0]) / (time.size - 1)
    part = -np.expm1(-period / lag)
    return np.concatenate([x[:1], x[:-1] + np.diff(x) / part])
