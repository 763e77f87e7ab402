"""Rough signal processing for checks: running means in place of filters.

These checks do not need the accuracy of the package's filters; they must run at once, before JAX or SciPy are
loaded.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

# A force of which the acceleration explains less than this part comes from the controller: a spring and a
# damper to a constant reference. It does not determine the inertia.
_SHARE = 0.01
# Velocity below which a sample counts as at rest, over the largest one, and fewest samples of a fit.
_REST, _ENOUGH = 0.02, 20
# Part of a column of that fit which the columns before it must leave, and samples from which it takes fewer.
_APART, _MANY = 0.1, 10_000

Signal: TypeAlias = "Float[np.ndarray, ' samples']"


def smooth(values: Signal, window: int) -> Float[np.ndarray, " fewer"]:
    """Take the running mean three times; whole windows only, so that it gets shorter.

    Args:
        values: The signal.
        window: Samples in one mean.

    Returns:
        A signal shorter by 3 (window - 1).
    """
    for _ in range(3):
        # Sums over a long log lose digits to an offset; it is put back afterwards.
        offset = values.mean()
        total = np.concatenate([[0.0], np.cumsum(values - offset)])
        values = (total[window:] - total[:-window]) / window + offset
    return values


def windows(samples: int) -> list[int]:
    """Return window lengths for so many samples: powers of two up to a sixteenth of them."""
    return [2**k for k in range(12) if 2**k <= max(1, samples // 16)]


def correlation(one: Signal, other: Signal) -> float:
    """Return the correlation coefficient; 0 if one signal is constant."""
    one, other = one - one.mean(), other - other.mean()
    scale = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / scale if scale > 0 else 0.0


class Strokes(NamedTuple):
    """How far one position moves beside another.

    Args:
        ratio: Stroke of the first over that of the second; negative if they move against each other.
        offset: The first where the second is zero, of positions at rest.
        left: Part of the variance of the first that its fit leaves.
    """

    ratio: float
    offset: float
    left: float


def ratio_of_strokes(first: Signal, second: Signal) -> Strokes:
    """Estimate how many times as far one position moves as another, which it follows or is joined to.

    A coupling gives, and a loop lags, with velocity, friction and acceleration, which stand beside the second
    position in a fit, as far as the motion tells them from it. Of all running means the one that leaves least
    of the first position decides.

    Args:
        first, second: Two positions of one length.
    """
    step = 1 + first.size // _MANY
    first, second = first[::step], second[::step]
    best = Strokes(0.0, 0.0, np.inf)
    for window in windows(second.size - 2):
        signals = (
            first[1:-1],
            second[1:-1],
            (second[2:] - second[:-2]) / 2.0,
            second[2:] - 2 * second[1:-1] + second[:-2],
        )
        q, x, v, a = (smooth(s, window) for s in signals)
        if q.size <= _ENOUGH or q.std() == 0 or x.std() == 0:
            continue
        moves = np.where(np.abs(v) < _REST * np.abs(v).max(), 0.0, np.sign(v))
        columns, accelerates = _apart([np.ones_like(x), x - x.mean(), v, moves, a])
        theta = np.linalg.lstsq(columns, q, rcond=None)[0]
        left = float(np.var(q - columns @ theta)) / float(np.var(q))
        if left < best.left:
            # Of a single sine only the amplitude is that of the stroke: acceleration acts as position does.
            ratio = float(theta[1]) if accelerates else float(np.copysign(q.std() / x.std(), theta[1]))
            best = Strokes(ratio, float(theta[0] - ratio * x.mean()), left)
    return best


def _apart(columns: list[Signal]) -> tuple[Float[np.ndarray, "samples k"], bool]:
    """Return those columns of a fit that those before them do not nearly give, and whether the last is one.

    The acceleration of a single sine is its position, and the velocity of a ramp is a constant. The first two
    columns stay in any case.
    """
    kept, axes = [], []
    for k, column in enumerate(columns):
        rest = column.copy()
        for axis in axes:
            rest -= (axis @ rest) * axis
        size = float(np.linalg.norm(rest))
        if k > 1 and size <= _APART * float(np.linalg.norm(column)):
            continue
        kept.append(column)
        axes.append(rest / size)
    return np.stack(kept, axis=1), kept[-1] is columns[-1]


def implied_inertia(
    force: Signal, q: Signal, period: float, others: Float[np.ndarray, "samples k"] | None = None
) -> float | None:
    """Estimate an inertia roughly, without knowledge of the machine.

    A regression attributes parts of the force to viscous and dry friction, a spring and an offset. Noise
    makes an acceleration too large and its inertia too small, by less for a longer window; so a value is
    accepted if twice the window gives the same. If inertia and spring cannot be distinguished in any window
    (a single tone), the ratio of the standard deviations is used.

    Args:
        force: Force at the load [N or N m].
        q: Position [m or rad].
        period: Sampling period [s].
        others: Positions of other joints, which springs may join to this one; None without any.

    Returns:
        The inertia [kg or kg m^2]; None if no value is reliable.
    """
    velocity = (q[2:] - q[:-2]) / (2.0 * period)
    acceleration = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / period**2
    positions = [q[1:-1]] if others is None else [q[1:-1], *others[1:-1].T]
    tried = []
    for window in windows(q.size):
        # Force and acceleration pass through the same means, so the law between them is unchanged.
        f, a, v, *x = (smooth(s, window) for s in (force[1:-1], acceleration, velocity, *positions))
        if a.std() > 0 and f.std() > 0:
            explained, value = _regress(f, a, v, *x)
            tried.append((explained, value, float(f.std() / a.std())))
    best = max((explained for explained, _, _ in tried), default=0.0)
    believed = [value if explained > 0.9 * best > 0.5 else None for explained, value, _ in tried]
    if any(value is not None for value in believed):
        return _plateau(believed)
    return _plateau([ratio for _, _, ratio in tried])


def _plateau(values: list[float | None]) -> float | None:
    """Return the first value that the next one confirms to 25 %."""
    for one, other in pairwise(values):
        if one is not None and other is not None and 0.8 < one / other < 1.25:
            return other
    return None


def _regress(f: Signal, a: Signal, v: Signal, *x: Signal) -> tuple[float, float | None]:
    """Return the part of the force explained, and the coefficient of the acceleration if it is identifiable.

    The coefficient is NaN if the acceleration has no share of the force.
    """
    columns = np.stack([a, v, np.sign(v), *x], axis=1)
    columns = columns - columns.mean(axis=0)
    scale = columns.std(axis=0)
    scale[scale == 0] = 1.0
    columns, f = columns / scale, f - f.mean()
    theta = np.linalg.lstsq(columns, f, rcond=1e-6)[0]
    remaining = f - columns @ theta
    # Only the part of the acceleration that other columns do not explain determines the inertia.
    others = columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0], rcond=1e-6)[0]
    independent = float(np.var(columns[:, 0] - others))
    value = float(theta[0] / scale[0])
    explained = 1.0 - float(remaining @ remaining) / float(f @ f)
    if abs(theta[0]) < _SHARE * f.std():
        return explained, math.nan
    return explained, value if independent > 0.01 and value > 0 else None
