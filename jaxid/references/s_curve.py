"""Fastest motion from rest to rest under bounds of velocity, acceleration and jerk, in seven segments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float


class MotionBounds(NamedTuple):
    """Bounds of a forward motion; each positive.

    Args:
        speed: Largest velocity [position/s].
        gain, loss: Largest acceleration, and largest deceleration [position/s^2].
        rise, fall: Largest rate at which acceleration grows, and at which it falls [position/s^3].
    """

    speed: float
    gain: float
    loss: float
    rise: float
    fall: float


@dataclass(frozen=True)
class SCurve:
    """Seven segments of constant jerk, zero in the second, fourth and sixth.

    Attributes:
        distance: Distance of the motion, with its sign [position].
        durations: Durations of the segments [s]; zero if a limit is not reached, (7,).
        jerks: Jerks in the segments [position/s^3], (7,).
    """

    distance: float
    durations: Float[np.ndarray, "7"]
    jerks: Float[np.ndarray, "7"]

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.durations.sum())

    def position(self, time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Return the distance covered [position] at instants from the motion's start [s]; rest outside."""
        ends = np.cumsum(self.durations)
        state, states = np.zeros(3), []
        for h, jerk in zip(self.durations, self.jerks, strict=True):
            states.append(state)
            s, v, a = state
            state = np.array(
                [s + h * (v + h * (a / 2 + h * jerk / 6)), v + h * (a + h * jerk / 2), a + h * jerk]
            )
        # A segment without length holds no instant.
        k = np.minimum(np.searchsorted(ends, time, side="right"), 6)
        s, v, a = np.array(states)[k].T
        t = np.maximum(time, 0.0) - (ends - self.durations)[k]
        way = s + t * (v + t * (a / 2 + t * self.jerks[k] / 6))
        return np.where(time >= ends[-1], self.distance, way)


def plan_s_curve(distance: float, bounds: MotionBounds) -> SCurve:
    """Find the fastest motion from rest to rest.

    Velocity rises to a peak and falls back to zero. Rise and fall each take three segments. The
    middle one has no length if the peak is reached before the limit of acceleration. Without a segment of
    constant velocity, rise and fall together cover the distance, which determines the peak. It has a closed
    form if both or neither reach their limits of acceleration; if only one does, it is the bracketed root of
    a polynomial of fourth order.

    Args:
        distance: Distance of the motion, not negative [position].
        bounds: Bounds of a forward motion; a backward motion is its mirror image.

    Source:
        Biagiotti & Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), section 3.4,
        for bounds that are the same in both directions. The order of the jerks (largest, none, least, none,
        least, none, largest) is that of Pontryagin's principle; a fall is a rise reversed in time, with
        jerks in the same order.
    """
    speed, gain, loss, rise, fall = bounds
    jerks = np.array([rise, 0.0, -fall, 0.0, -fall, 0.0, rise])
    if distance == 0.0:
        return SCurve(0.0, np.zeros(7), jerks)
    peak = min(speed, _peak(distance, bounds))
    up, down = _segments(peak, gain, rise, fall), _segments(peak, loss, rise, fall)
    left = distance - _way(peak, gain, rise, fall) - _way(peak, loss, rise, fall)
    cruise = max(left, 0.0) / peak if peak == speed else 0.0
    return SCurve(distance, np.array([*up, cruise, *down[::-1]]), jerks)


def _segments(peak: float, limit: float, rise: float, fall: float) -> tuple[float, float, float]:
    """Return the durations from rest to a peak velocity: acceleration grows, holds, falls."""
    both = 1 / rise + 1 / fall
    held = min(limit, np.sqrt(2 * peak / both))
    return held / rise, max(peak / held - held * both / 2, 0.0), held / fall


def _way(peak: float, limit: float, rise: float, fall: float) -> float:
    """Return the distance from rest to a peak velocity."""
    t1, t2, t3 = _segments(peak, limit, rise, fall)
    a = rise * t1
    return a * (t1**2 / 6 + t1 * t2 / 2 + t2**2 / 2 + (t1 / 2 + t2) * t3 + t3**2 / 3)


def _peak(distance: float, bounds: MotionBounds) -> float:
    """Return the peak velocity whose rise and fall cover the distance, without a limit of velocity."""
    _, gain, loss, rise, fall = bounds
    both, mean = 1 / rise + 1 / fall, 1 / (6 * rise) + 1 / (3 * fall)
    # Neither reaches its limit: each covers a^3 both mean.
    a = (distance / (2 * both * mean)) ** (1 / 3)
    if a <= min(gain, loss):
        return a**2 * both / 2
    low, high = (limit**2 * both / 2 for limit in sorted((gain, loss)))
    excess = lambda v: _way(v, gain, rise, fall) + _way(v, loss, rise, fall) - distance
    if excess(high) < 0:
        # Both do: each covers A^3 both mean + (v - A^2 both / 2) A slope + (v - A^2 both / 2)^2 / (2 A).
        slope = 1 / (2 * rise) + 1 / fall
        square = linear = constant = 0.0
        for A in (gain, loss):
            v = A**2 * both / 2
            square += 1 / (2 * A)
            linear += A * slope - v / A
            constant += A**3 * both * mean - v * A * slope + v**2 / (2 * A)
        constant -= distance
        return (-linear + np.sqrt(linear**2 - 4 * square * constant)) / (2 * square)
    if excess(low) >= 0:  # by rounding
        return low
    import scipy.optimize  # only if there is no closed form

    root: Any = scipy.optimize.brentq(excess, low, high, xtol=1e-300, rtol=4 * np.finfo(float).eps)
    return root
