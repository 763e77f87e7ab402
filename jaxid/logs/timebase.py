"""Check that a time column is that of a log sampled at one rate."""

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError

# Chosen: a deviation of 1 % of the period shifts a derivative by 1 %, which is about the size of a friction
# that differs by direction. A few rows do not matter.
_JITTER = 0.01
_FEW_ROWS = 5
# A step longer than so many periods is a gap.
_GAP = 1.5


def sound_time(time: Float[np.ndarray, " samples"], first: int, where: str) -> Float[np.ndarray, " samples"]:
    """Check that time runs forward at one rate.

    Time stamps that were only rounded when they were written (1.638 ms logged as 1 or 2 ms) are no jitter:
    they are put back on their grid.

    Args:
        time: Time column [s].
        first: Row of the file at which it starts.
        where: File and column, for the message.

    Returns:
        The time [s], on its grid if it had been rounded.

    Raises:
        InputError: If time stands still, runs backwards, has gaps or jitters.
    """
    step = np.diff(time)
    _check_forward(time, step, first, where)
    grid = np.linspace(time[0], time[-1], time.size)
    if np.max(np.abs(time - grid)) <= 1.2 * _decimal_unit(time):
        return grid
    period = float(np.median(step))
    _check_gaps(time, step, period, first, where)
    _check_jitter(step, period, first, where)
    return time


def _check_forward(time: np.ndarray, step: np.ndarray, first: int, where: str) -> None:
    """Refuse time that repeats or runs backwards."""
    wrong = np.flatnonzero(step <= 0)
    if not wrong.size:
        return
    k = int(wrong[0])
    if wrong.size > 0.2 * step.size and not np.any(step < 0):
        hint = "write it with more digits, or give sample_rate in place of time"
        what = f"time repeats in {wrong.size} rows, first in row {first + k + 1}"
        raise InputError(what, where=where, hint=hint)
    verb = "repeats" if step[k] == 0 else "runs backwards"
    hint = "remove the doubled rows, or restrict the log to one run by rows = [first, end]"
    what = f"time {verb} in row {first + k + 1} ({time[k]:.9g} s, then {time[k + 1]:.9g} s)"
    raise InputError(what, where=where, hint=hint)


def _decimal_unit(time: np.ndarray) -> float:
    """Return the last decimal of the time stamps [s]; 0 if there is none.

    Only the later half is examined: with a fixed number of digits, small numbers are written more finely, and
    the coarsest unit is the limiting one.
    """
    late = time[time.size // 2 :]
    for decimals in range(10):
        scaled = late * 10.0**decimals
        if np.all(np.abs(scaled - np.round(scaled)) < 1e-9 * np.maximum(1.0, np.abs(scaled))):
            return 10.0**-decimals
    return 0.0


def _check_gaps(time: np.ndarray, step: np.ndarray, period: float, first: int, where: str) -> None:
    """Refuse a log with a few long gaps in its time."""
    gaps = np.flatnonzero(step > _GAP * period)
    # Irregular timing throughout is jitter; a gap is an exception.
    if not gaps.size or gaps.size > 0.05 * step.size:
        return
    k = int(gaps[np.argmax(step[gaps])])
    hint = _widest(gaps, step.size + 1, first)
    what = (
        f"{gaps.size} gap(s) in time, the longest of {step[k]:.4g} s after row {first + k} "
        f"(t = {time[k]:.6g} s; the period is {period:.4g} s)"
    )
    raise InputError(what, where=where, hint=hint)


def _widest(gaps: np.ndarray, count: int, first: int) -> str:
    """Suggest the longest range of rows without a gap."""
    edges = np.concatenate([[0], gaps + 1, [count]])
    k = int(np.argmax(np.diff(edges)))
    start, end = first + edges[k], first + edges[k + 1]
    return f"take an unbroken stretch, e.g. rows = [{start}, {end}], or resample the log"


def _check_jitter(step: np.ndarray, period: float, first: int, where: str) -> None:
    """Refuse a log whose sampling period varies."""
    off = np.abs(step - period) / period
    loose = np.flatnonzero(off > _JITTER)
    if loose.size <= _FEW_ROWS:
        return
    k = int(np.argmax(off))
    what = (
        f"the sampling period is not constant: {loose.size} of {step.size} steps are off the "
        f"median {period:.4g} s by more than 1 %, the worst by {100 * off[k]:.3g} % "
        f"after row {first + k}"
    )
    hint = "resample the log to a constant rate, or take an even stretch with rows = [first, end]"
    raise InputError(what, where=where, hint=hint)
