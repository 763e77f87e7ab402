"""Rough signal arithmetic for checks: running means in place of filters.

Nothing here needs the accuracy of the package's filters; it has to be there at
once, before JAX or scipy are loaded.
"""

import math
from itertools import pairwise

import numpy as np
from jaxtyping import Float

# A force of which the acceleration explains less than this part is a controller's own: a spring and a damper
# to a reference that stands. It says nothing of the inertia.
_SHARE = 0.01

Signal = Float[np.ndarray, " samples"]


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
    """Window lengths worth trying on so many samples: powers of two up to a sixteenth."""
    return [2**k for k in range(12) if 2**k <= max(1, samples // 16)]


def correlation(one: Signal, other: Signal) -> float:
    """Correlation coefficient; 0 where one of them is constant."""
    one, other = one - one.mean(), other - other.mean()
    scale = float(np.sqrt((one @ one) * (other @ other)))
    return float(one @ other) / scale if scale > 0 else 0.0


def implied_inertia(
    force: Signal, q: Signal, period: float, others: Float[np.ndarray, "samples k"] | None = None
) -> float | None:
    """Estimate an inertia roughly, with no knowledge of the machine.

    A regression lets viscous and dry friction, a spring and an offset have their share of the
    force. Noise makes an acceleration too large and its inertia too small, by less the longer
    the window; so the value is believed where twice the window gives the same. Where inertia
    and spring are alike in every window (a single tone), the ratio of the scatters has to do.

    Args:
        force: Force at the load [N or N m].
        q: Position [m or rad].
        period: Sampling period [s].
        others: Positions of other joints, which springs may join to this one; None without any.

    Returns:
        The inertia [kg or kg m^2]; None where no value is to be believed.
    """
    velocity = (q[2:] - q[:-2]) / (2.0 * period)
    acceleration = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / period**2
    positions = [q[1:-1]] if others is None else [q[1:-1], *others[1:-1].T]
    tried = []
    for window in windows(q.size):
        # Force and acceleration pass the same means: the law between them stays as it was.
        f, a, v, *x = (smooth(s, window) for s in (force[1:-1], acceleration, velocity, *positions))
        if a.std() > 0 and f.std() > 0:
            explained, value = _regress(f, a, v, *x)
            tried.append((explained, value, float(f.std() / a.std())))
    best = max((explained for explained, _, _ in tried), default=0.0)
    told = [value if explained > 0.9 * best > 0.5 else None for explained, value, _ in tried]
    if any(value is not None for value in told):
        return _plateau(told)
    return _plateau([ratio for _, _, ratio in tried])


def _plateau(values: list[float | None]) -> float | None:
    """The first value that the next one confirms to 25 %."""
    for one, other in pairwise(values):
        if one is not None and other is not None and 0.8 < one / other < 1.25:
            return other
    return None


def _regress(f: Signal, a: Signal, v: Signal, *x: Signal) -> tuple[float, float | None]:
    """Share of the force explained, and the coefficient of the acceleration where it is told.

    It is NaN where the acceleration has no share.
    """
    columns = np.stack([a, v, np.sign(v), *x], axis=1)
    columns = columns - columns.mean(axis=0)
    scale = columns.std(axis=0)
    scale[scale == 0] = 1.0
    columns, f = columns / scale, f - f.mean()
    theta = np.linalg.lstsq(columns, f, rcond=1e-6)[0]
    left = f - columns @ theta
    # What the other columns leave of the acceleration is all that can tell the inertia.
    others = columns[:, 1:] @ np.linalg.lstsq(columns[:, 1:], columns[:, 0], rcond=1e-6)[0]
    told = float(np.var(columns[:, 0] - others))
    value = float(theta[0] / scale[0])
    explained = 1.0 - float(left @ left) / float(f @ f)
    if abs(theta[0]) < _SHARE * f.std():
        return explained, math.nan
    return explained, value if told > 0.01 and value > 0 else None
