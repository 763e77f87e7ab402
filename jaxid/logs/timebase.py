"""The time column of a log: its faults, its longest unbroken stretch, and its sampling period."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.readers.table import Assumed

if TYPE_CHECKING:
    from jaxtyping import Float

# Chosen: a deviation of 1 % of the period shifts a derivative by 1 %, which is about the size of a friction
# that differs by direction. A few rows do not matter.
_JITTER = 0.01
_FEW_ROWS = 5
# A step longer than so many periods has samples missing; beyond the second bound nothing takes their place.
_MISSING, _GAP = 1.5, 10.0
# Samples at either end that are cut off rather than joined across a missing one.
_EDGE = 5
# Part of the steps that are one period, for stamps that are off in a few rows only.
_USUAL = 0.9
# Part of the steps that may be no multiple of the period for it to be taken from all of them.
_MULTIPLE, _OFF_MULTIPLE = 0.25, 0.05
# Distance of rounded stamps from an even grid, in units of their last decimal: half of one, and as much for
# ends that are rounded as well. Equal stamps of readings that differ could else be taken for rounded ones.
_ROUNDED, _ROUNDED_TWICE = 1.2, 0.6
# Part of all rows that may have the time of the row before.
_DOUBLED = 0.2


@dataclass(frozen=True)
class TimeBase:
    """The samples of a log that are used, and when they were taken.

    Attributes:
        time: Time of each sample that is used [s], rising.
        sample: Sample of each row of the file, from 0; -1: the row is not used.
        period: Sampling period [s].
        even: Whether the samples are at one rate as they are.
        missing: Samples that are missing between others.
        assumed: Everything that the log decided.
        others: Other stretches of rows between gaps, first and end, the longest first, without short ones.
    """

    time: Float[np.ndarray, " samples"]
    sample: np.ndarray
    period: float
    even: bool
    missing: int
    assumed: tuple[Assumed, ...]
    others: tuple[tuple[int, int], ...] = ()

    @property
    def rows(self) -> tuple[int, int]:
        """First row that is used, and the row after the last one."""
        used = np.flatnonzero(self.sample >= 0)
        return int(used[0]), int(used[-1]) + 1

    def of_samples(self, values: np.ndarray) -> np.ndarray:
        """Return the rows of a column that are used, those with one time as their mean."""
        used = self.sample >= 0
        if self.time.size == np.count_nonzero(used):
            return values[used]
        index = self.sample[used]
        known = np.isfinite(values[used])
        total = np.zeros((self.time.size, values.shape[1]))
        count = np.zeros((self.time.size, values.shape[1]))
        np.add.at(total, index, np.where(known, values[used], 0.0))
        np.add.at(count, index, known)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total / np.where(count > 0, count, np.nan)


def time_base(
    time: Float[np.ndarray, " rows"], first: int, where: str, repeats: np.ndarray | None = None
) -> TimeBase:
    """Return the samples of a log and their times.

    Time stamps that were only rounded when they were written (1.638 ms logged as 1 or 2 ms) are no jitter:
    they are put back on their grid. Rows with one time are one sample. A gap ends a stretch, and the longest
    one is used.

    Args:
        time: Time column [s].
        first: Row of the file at which it starts.
        where: File and column, for messages.
        repeats: Whether each row but the first has the readings of the row before; None: not known.

    Raises:
        InputError: If time runs backwards, or stands still in many rows.
    """
    step = np.diff(time)
    _check_forward(time, step, first, where)
    grid = np.linspace(time[0], time[-1], time.size)
    rows = np.arange(time.size)
    doubled = step == 0
    # Rounding makes two stamps equal as well, but not their readings.
    rounded = not doubled.any() or (repeats is not None and not np.any(repeats & doubled))
    room = _ROUNDED_TWICE if doubled.any() else _ROUNDED
    if rounded and np.max(np.abs(time - grid)) <= room * _decimal_unit(time):
        period = (time[-1] - time[0]) / max(time.size - 1, 1)
        return TimeBase(grid, rows, period, True, 0, ())

    assumed: list[Assumed] = []
    if doubled.any():
        again = np.concatenate([[False], doubled])
        rows = np.cumsum(~again) - 1
        time = time[~again]
        what = f"{again.sum()} row(s) have the time of the row before, first row {first + np.argmax(again)}"
        assumed.append(Assumed("doubled_rows", int(again.sum()), f"{what}: their readings are averaged"))
    period = _period(np.diff(time))
    start, end, said, others = _longest(time, period, rows, first)
    assumed += said
    time = time[start:end]
    rows = np.where((rows >= start) & (rows < end), rows - start, -1)
    step = np.diff(time)
    if time.size > 1:
        period = _period(step)
    late = int(np.count_nonzero(np.abs(step - period) > _JITTER * period))
    missing = int(np.sum(np.maximum(np.round(step / period) - 1, 0)[step > _MISSING * period]))
    even = late <= _FEW_ROWS and missing == 0
    if not even:
        k = int(np.argmax(np.abs(step - period)))
        what = (
            f"{late} of {step.size} steps are off the period of {period:.4g} s by more than 1 %, the worst "
            f"by {100 * abs(step[k] / period - 1):.3g} % after row {first + int(np.argmax(rows == k))}"
        )
        what += f"; {missing} sample(s) are missing" if missing else ""
        assumed.append(Assumed("uneven_time", late, what))
    return TimeBase(time, rows, period, even, missing, tuple(assumed), others)


def _check_forward(time: np.ndarray, step: np.ndarray, first: int, where: str) -> None:
    """Refuse time that runs backwards, or stands still for long."""
    back = np.flatnonzero(step < 0)
    if back.size:
        k = int(back[0])
        hint = "restrict the log to one run by rows = [first, end]"
        what = f"time runs backwards in row {first + k + 1} ({time[k]:.9g} s, then {time[k + 1]:.9g} s)"
        raise InputError(what, where=where, hint=hint)
    still = np.flatnonzero(step == 0)
    if still.size > _DOUBLED * step.size:
        hint = "write it with more digits, or give sample_rate in place of time"
        what = f"time repeats in {still.size} rows, first in row {first + int(still[0]) + 1}"
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


def _period(step: np.ndarray) -> float:
    """Return the sampling period: the step of nearly all samples, or the mean, longer ones as several."""
    median = float(np.median(step))
    usual = np.abs(step - median) < _JITTER * median
    if np.mean(usual) > _USUAL:
        return float(step[usual].mean())
    many = np.round(step / median)
    if np.mean(np.abs(step / median - many) > _MULTIPLE) > _OFF_MULTIPLE:
        return median
    near = (many >= 1) & (many <= _GAP)
    return float(step[near].sum() / many[near].sum())


def _longest(
    time: np.ndarray, period: float, rows: np.ndarray, first: int
) -> tuple[int, int, list[Assumed], tuple[tuple[int, int], ...]]:
    """Return the longest stretch of samples without a gap, words on the others, and their rows."""
    step = np.diff(time)
    gaps = np.flatnonzero(step > _GAP * period)
    # A missing sample beside the ends is no reason to invent one.
    holes = np.flatnonzero(step > _MISSING * period)
    ends = holes[(holes < _EDGE) | (holes >= step.size - _EDGE)]
    cuts = np.union1d(gaps, ends).astype(int)
    if not cuts.size:
        return 0, time.size, [], ()
    edges = np.concatenate([[0], cuts + 1, [time.size]])
    lengths = np.diff(edges)
    k = int(np.argmax(lengths))
    row = [first + int(np.searchsorted(rows, sample)) for sample in edges]
    worst = int(cuts[np.argmax(step[cuts])])
    what = (
        f"{cuts.size} gap(s), the longest of {step[worst]:.4g} s after row "
        f"{first + int(np.searchsorted(rows, worst))} (the period is {period:.4g} s): rows {row[k]} to "
        f"{row[k + 1] - 1} are used, the longest stretch, with {lengths[k]} of {time.size} samples"
    )
    others = [n for n in np.argsort(lengths)[::-1] if n != k and lengths[n] > 0.1 * time.size]
    if others:
        listed = ", ".join(f"[{row[n]}, {row[n + 1]}]" for n in others[:4])
        what += f"; others are rows = {listed}"
    said = [Assumed("rows", [row[k], row[k + 1]], what)]
    return int(edges[k]), int(edges[k + 1]), said, tuple((row[n], row[n + 1]) for n in others)
