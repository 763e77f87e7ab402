"""Test of whether the readings of a log follow the jitter of its time stamps.

A device that samples at one rate may be read through a bus and stamped when the message arrives. The jitter
is then that of the transport, and a log that is resampled by its stamps gains noise that no sensor has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jaxid.logs.readers.table import Assumed
from jaxid.logs.timebase import TimeBase

if TYPE_CHECKING:
    from jaxtyping import Float

# Distance of a step from a whole number of periods, in periods, up to which rows can be counted through.
_COUNTED = 0.35
# Fourth difference: what it leaves of a motion is small, and what it leaves of jitter is large.
_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
# Slope of the parabola through five neighbours, by row.
_SLOPE = np.array([2.0, 1.0, 0.0, -1.0, -2.0]) / 10
# Shifts of the jitter along the log, which show how far chance takes the part that is followed.
_SHIFTS = 60
# Standard deviations by which the part must be below one half for the rows to be taken as even.
_SURE = 4.0
# Fewest rows, and least jitter in periods, with which the test means anything.
_ROWS, _JITTER = 40, 1e-3


@dataclass(frozen=True)
class Followed:
    """The part of the jitter of the stamps that the readings follow.

    Attributes:
        part: The part; 1 if readings were taken at their stamps, 0 if they were taken at one rate.
        std: Its standard deviation.
        jitter: Deviation of the stamps from an even grid [periods], RMS.
    """

    part: float
    std: float
    jitter: float


def with_even_rows(base: TimeBase, readings: Float[np.ndarray, "rows n"]) -> TimeBase:
    """Return a time base at one rate, if the readings do not follow the jitter of the stamps.

    Args:
        base: Samples and stamps.
        readings: The readings by sample, one row each.

    Returns:
        The time base with its samples on an even grid, on which missing ones are still missing; the given one
        if the readings follow the stamps, or show neither.
    """
    index = _index(base)
    if index is None:
        return base
    grid = np.polyval(np.polyfit(index, base.time, 1), index)
    period = float(grid[-1] - grid[0]) / float(index[-1] - index[0])
    found = followed((base.time - grid) / period, readings, index)
    if found is None or found.part + _SURE * found.std > 0.5:
        return base
    what = (
        f"Hz: the stamps are off an even grid by {1e3 * period * found.jitter:.3g} ms (RMS), and the "
        f"readings follow {found.part:.2f} +- {found.std:.2f} of that (1 if they were taken at their "
        "stamps): the rows are taken as even; state resample in [log] to go by the stamps"
    )
    even = Assumed("even_rows", float(f"{1 / period:.9g}"), what)
    return replace(base, time=grid, period=period, even=base.missing == 0, assumed=(*base.assumed, even))


def followed(
    jitter: Float[np.ndarray, " rows"],
    readings: Float[np.ndarray, "rows n"],
    index: Float[np.ndarray, " rows"],
) -> Followed | None:
    """Estimate the part of the jitter of the stamps that readings follow.

    Readings that were taken at their stamps are off those of an even grid by the jitter times their slope.
    Both are compared in their fourth differences, by least squares.

    Args:
        jitter: Deviation of each stamp from an even grid [periods].
        readings: The readings by row; columns without motion do not count.
        index: Number of each row on the even grid, without those that are missing.

    Returns:
        The part; None if rows are too few, stamps are even, or nothing moves.
    """
    if jitter.size < _ROWS or np.std(jitter) < _JITTER:
        return None
    moves = np.ptp(readings, axis=0) > 0
    scaled = readings[:, moves] / np.std(readings[:, moves], axis=0)
    if not scaled.size:
        return None
    slopes = np.stack([np.convolve(column, _SLOPE, "same") for column in scaled.T], axis=1)
    # A difference counts if its five slopes were taken from rows without one missing between them.
    reach = len(_SLOPE) - 1
    counts = np.flatnonzero(index[2 * reach :] - index[: -2 * reach] == 2 * reach) + reach // 2
    seen = _differences(scaled)[counts]
    if not counts.size:
        return None

    def of_jitter(shift: int) -> np.ndarray:
        return _differences(slopes * np.roll(jitter, shift)[:, None])[counts]

    own = of_jitter(0)
    if not np.any(own):
        return None
    part = float(np.sum(own * seen) / np.sum(np.square(own)))
    left = seen - part * own
    by_chance = []
    for k in range(1, _SHIFTS + 1):
        other = of_jitter(k * jitter.size // (_SHIFTS + 1))
        by_chance.append(float(np.sum(other * left) / np.sum(np.square(other))))
    return Followed(part, float(np.std(by_chance)), float(np.std(jitter)))


def _differences(columns: np.ndarray) -> np.ndarray:
    return np.stack([np.convolve(column, _DIFFERENCE, "valid") for column in columns.T], axis=1)


def _index(base: TimeBase) -> np.ndarray | None:
    """Return the number of each sample on an even grid; None if the stamps do not show it."""
    step = np.diff(base.time) / base.period
    if base.missing == 0:
        return np.arange(base.time.size)
    if np.max(np.abs(step - np.round(step))) > _COUNTED:
        return None
    return np.concatenate([[0], np.cumsum(np.round(step).astype(int))])
