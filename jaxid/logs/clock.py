"""Clocks that drift: the delay between the force and the motion that it causes, along the log."""

from __future__ import annotations

import numpy as np

from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.rough_inertia import Signal, smooth, windows

# Stretches in which the delay is estimated, and samples that each must have.
_STRETCHES, _FEWEST = 12, 100
# Part of the force that a rigid joint must explain for its delay to count.
_EXPLAINED = 0.9
# A drift is reported beyond so many periods from start to end, and so many of its standard deviations.
# Chosen: of 19 measured and simulated logs with one clock the highest ratio to the deviation is 4.6.
_PERIODS, _SURE = 0.5, 8.0
# Noise in the derivative makes an estimated delay too small; the estimate is repeated on the shifted force.
_REPEATS = 4


def clock_findings(log: Log, path: str) -> list[Finding]:
    """Find a delay between force and position that grows along the log, as that of two clocks does.

    A constant delay is not judged: viscous friction looks the same in a single log.

    Args:
        log: The log, of one joint with its drive; others are not judged.
        path: Name of the log in messages.
    """
    if log.position.shape[1] != 1 or log.force.shape[1] != 1 or log.samples < _STRETCHES * _FEWEST:
        return []
    force, q = log.force[:, 0], log.position[:, 0]
    time = np.arange(log.samples) * log.period
    begin = drift = 0.0
    for repeat in range(_REPEATS):
        line = _line(np.interp(time + begin + drift * time, time, force), q, log.period)
        if line is None:
            return []
        begin, drift = begin + line[0], drift + line[1]
        if repeat == 0 and abs(drift) < _SURE * line[2]:
            return []
    grown = drift * time[-1]
    if abs(grown) < _PERIODS * log.period:
        return []
    what = (
        f"the delay between force and motion changes by {1e3 * grown:+.3g} ms over the log: their clocks "
        f"drift by {1e6 * drift:+.3g} ppm"
    )
    hint = "record both with one clock, or fit shorter stretches by rows"
    return [Finding("warning", what, f"{path}, force", hint, "time")]


def _line(force: Signal, q: Signal, period: float) -> tuple[float, float, float] | None:
    """Return delay at the start [s], its growth, and the deviation of that; None if it is not clear."""
    found = _delays(force, q, period)
    if found is None:
        return None
    time, delay = found
    design = np.stack([np.ones_like(time), time], axis=1)
    inverse = np.linalg.inv(design.T @ design)
    line = inverse @ design.T @ delay
    scatter = float(np.sum((delay - design @ line) ** 2)) / (len(time) - 2)
    return float(line[0]), float(line[1]), float(np.sqrt(scatter * inverse[1, 1]))


def _delays(force: Signal, q: Signal, period: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return times and delays of the force, by stretches; None if no rigid joint explains it.

    The force of the joint is that of least squares with an inertia, viscous and dry friction, a spring and an
    offset over the whole log. A small delay d adds -d times its derivative.
    """
    velocity = (q[2:] - q[:-2]) / (2.0 * period)
    acceleration = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / period**2

    best, chosen = _EXPLAINED, None
    for window in windows(q.size // _STRETCHES):
        f, a, v, x = (smooth(s, window) for s in (force[1:-1], acceleration, velocity, q[1:-1]))
        columns = np.stack([a, v, np.sign(v), x, np.ones_like(x)], axis=1)
        scale = np.sqrt(np.mean(columns**2, axis=0))
        columns = columns / np.where(scale > 0, scale, 1.0)
        model = columns @ np.linalg.lstsq(columns, f, rcond=1e-9)[0]
        explained = 1.0 - float(np.var(f - model) / np.var(f)) if np.var(f) > 0 else 0.0
        if explained > best:
            best, chosen = explained, (f, model, window)

    if chosen is None:
        return None
    f, model, window = chosen

    slope = np.gradient(model, period)
    edges = np.linspace(0, f.size, _STRETCHES + 1).astype(int)
    times, delays = [], []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        part = slope[low:high]
        if float(part @ part) == 0:
            return None
        near = np.stack([model[low:high], part], axis=1)
        times.append(0.5 * (low + high) * period)
        delays.append(-float(np.linalg.lstsq(near, f[low:high], rcond=None)[0][1]))
    return np.array(times), np.array(delays)
