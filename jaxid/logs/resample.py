"""Resampling of uneven or unequal samples to one rate, and what it costs.

Values between two readings are interpolated. If a column has more readings than the new rate keeps, each
new sample is the mean of the interpolated course over one new period, so that noise beyond the new band is
averaged rather than folded into it. Both are linear maps of the readings; their cost is measured by letting
them act on white noise and on a sine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.readers.table import Assumed
from jaxid.names import RESAMPLINGS

if TYPE_CHECKING:
    from jaxtyping import Float

# A column with so many times the readings of the new rate is averaged, one with so few is held.
_DENSE, _RARE = 1.5, 1.0 / 1.5
# Frequency of the sine that shows the loss of amplitude, over the new rate.
_SINE = 0.1
# Largest number of samples after resampling, for a rate that is a slip.
_MOST = 100_000_000
# A column with readings so many times as far apart as the rows of the log has a rate of its own.
_SLOWER = 1.1
# Columns whose readings decide the rate: those that the dynamics are in.
_RATED = ("position", "velocity", "force", "load_position", "load_acceleration", "acceleration")

Operator: TypeAlias = "Callable[[Float[np.ndarray, 'readings _']], Float[np.ndarray, 'samples _']]"


@dataclass(frozen=True)
class Readings:
    """One column with the times at which it has a reading.

    Attributes:
        time: Times of the readings [s].
        values: The readings, (readings, 1).
    """

    time: Float[np.ndarray, " readings"]
    values: Float[np.ndarray, "readings 1"]

    @property
    def period(self) -> float:
        """Mean time between readings [s]."""
        return float((self.time[-1] - self.time[0]) / (self.time.size - 1))


def readings_of(time: np.ndarray, values: np.ndarray, name: str, where: str) -> list[Readings]:
    """Return the readings of each column of a quantity, without the rows in which it has none.

    Raises:
        InputError: If a column has fewer than two readings.
    """
    out = []
    for column in values.T:
        known = np.isfinite(column)
        if np.count_nonzero(known) < 2:
            hint = "check the column, or leave it out of [log]"
            raise InputError(f"{name} has {np.count_nonzero(known)} reading(s)", where=where, hint=hint)
        out.append(Readings(time[known], column[known, None]))
    return out


def resampled(
    columns: Mapping[str, list[Readings]],
    *,
    rate: float | None,
    period: float,
    method: str,
    held: bool,
    where: str,
) -> tuple[np.ndarray, dict[str, np.ndarray], list[Assumed]]:
    """Return all columns at one rate.

    Args:
        columns: Readings by quantity, one entry a column.
        rate: Rate that the user states [Hz]; None: that of the slowest column that the dynamics are in.
        period: Sampling period of the log [s].
        method: One of `jaxid.names.RESAMPLINGS`: lines, or cubic splines, between readings.
        held: Whether the force is stated to be held between its readings.
        where: File, for messages.

    Returns:
        Times [s], columns by quantity, and words on method and cost.

    Raises:
        InputError: If the columns have no time in common, or the rate is beyond reason.
    """
    deciding = {name: max(c.period for c in own) for name, own in columns.items() if name in _RATED}
    slowest = max(deciding, key=deciding.__getitem__)
    # A few missing readings do not change the rate at which a sensor is read.
    found = deciding[slowest] if deciding[slowest] > _SLOWER * period else period
    new = 1.0 / rate if rate is not None else float(f"{found:.9g}")

    begin = max(c.time[0] for own in columns.values() for c in own)
    end = min(c.time[-1] for own in columns.values() for c in own)
    count = int(np.floor((end - begin) / new * (1 + 1e-9))) + 1
    if end <= begin or count > _MOST:
        what = "the columns have no time in common" if end <= begin else f"{count} samples at that rate"
        raise InputError(what, where=where, hint="check the times of the columns, and resample")
    time = begin + new * np.arange(count)

    out, said = {}, []
    costs: dict[str, list[str]] = {}
    for name, own in columns.items():
        made = []
        for column in own:
            kind = _kind(name, column, new, held)
            operator = _operator(column.time, time, new, kind, method)
            made.append(operator(column.values))
            words = _WORDS[kind].format(method=_BETWEEN[method])
            costs.setdefault(f"{words}; {_cost(operator, column, time, new)}", []).append(name)
        out[name] = np.concatenate(made, axis=1)

    why = "as stated" if rate is not None else f"the rate of {slowest}"
    said.append(Assumed("resample", float(f"{1 / new:.9g}"), f"Hz, {why}; {count} samples"))
    for words, those in costs.items():
        said.append(Assumed("resample_method", method, f"{', '.join(dict.fromkeys(those))}: {words}"))
    return time, out, said


_BETWEEN: dict[str, str] = dict(zip(RESAMPLINGS, ("a line", "a cubic spline"), strict=True))
_WORDS = {
    "between": "{method} between readings",
    "mean": "mean over a period of {method} between readings",
    "hold": "the last reading is held",
    "mean of held": "mean over a period of the held readings",
}


def _kind(name: str, column: Readings, new: float, held: bool) -> str:
    """Return how a column is resampled."""
    if name == "force" and held:
        return "mean of held"
    if name == "reference" and new / column.period < _RARE:
        return "hold"
    return "mean" if new / column.period > _DENSE else "between"


def _operator(times: np.ndarray, grid: np.ndarray, new: float, kind: str, method: str) -> Operator:
    """Return the linear map from readings to samples."""
    if kind == "hold":
        at = np.clip(np.searchsorted(times, grid + 1e-9 * new, side="right") - 1, 0, None)
        return lambda values: values[at]
    if kind == "mean of held":
        # A held command acts from its reading on, so the mean is that of the period to come.
        return lambda values: _mean_of_held(times, values, grid, new)
    if method == "band_limited":
        # Imported here, since reading even logs should not wait for it.
        from scipy.interpolate import CubicSpline

        if kind == "between":
            return lambda values: CubicSpline(times, values)(grid)
        return lambda values: _mean_of_spline(CubicSpline(times, values), times, grid, new)
    if kind == "between":
        return lambda values: np.stack([np.interp(grid, times, v) for v in values.T], axis=1)
    return lambda values: _mean_of_line(times, values, grid, new)


def _ends(times: np.ndarray, grid: np.ndarray, new: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds of the period about each sample, within the readings."""
    half = np.minimum(new / 2, np.minimum(grid - times[0], times[-1] - grid))
    half = np.maximum(half, 1e-6 * new)
    return np.clip(grid - half, times[0], times[-1]), np.clip(grid + half, times[0], times[-1])


def _mean_of_line(times: np.ndarray, values: np.ndarray, grid: np.ndarray, new: float) -> np.ndarray:
    """Return means of the course of lines between readings."""
    low, high = _ends(times, grid, new)
    out = []
    for v in values.T:
        area = np.concatenate([[0.0], np.cumsum(np.diff(times) * (v[1:] + v[:-1]) / 2)])

        def upto(at: np.ndarray, v: np.ndarray = v, area: np.ndarray = area) -> np.ndarray:
            k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, times.size - 2)
            ahead = at - times[k]
            slope = (v[k + 1] - v[k]) / (times[k + 1] - times[k])
            return area[k] + ahead * (v[k] + slope * ahead / 2)

        out.append((upto(high) - upto(low)) / (high - low))
    return np.stack(out, axis=1)


def _mean_of_spline(spline: object, times: np.ndarray, grid: np.ndarray, new: float) -> np.ndarray:
    """Return means of the course of a spline."""
    low, high = _ends(times, grid, new)
    area = spline.antiderivative()  # pyright: ignore[reportAttributeAccessIssue]  # a CubicSpline
    return (area(high) - area(low)) / (high - low)[:, None]


def _mean_of_held(times: np.ndarray, values: np.ndarray, grid: np.ndarray, new: float) -> np.ndarray:
    """Return means, over the period after each sample, of readings that are held."""
    area = np.concatenate(
        [np.zeros((1, values.shape[1])), np.cumsum(np.diff(times)[:, None] * values[:-1], axis=0)]
    )

    def upto(at: np.ndarray) -> np.ndarray:
        k = np.clip(np.searchsorted(times, at, side="right") - 1, 0, None)
        return area[k] + (at - times[k])[:, None] * values[k]

    return (upto(grid + new) - upto(grid)) / new


def _cost(operator: Operator, column: Readings, time: np.ndarray, new: float) -> str:
    """Return in words what a map leaves of white noise and of a sine."""
    rng = np.random.default_rng(0)
    noise = operator(rng.standard_normal((column.time.size, 1)))[:, 0]
    frequency = _SINE / new
    waves = [operator(w(2 * np.pi * frequency * column.time)[:, None])[:, 0] for w in (np.sin, np.cos)]
    wanted = [w(2 * np.pi * frequency * time) for w in (np.sin, np.cos)]
    kept = sum(float(a @ b) for a, b in zip(waves, wanted, strict=True)) / time.size
    neighbours = float(noise[1:] @ noise[:-1] / (noise @ noise))
    return (
        f"it leaves {noise.std():.2f} of the noise of a reading (standard deviation), neighbours correlated "
        f"by {neighbours:+.2f}, and {100 * kept:.3g} % of a sine of {frequency:.3g} Hz"
    )
