"""The variable over which a residual follows a pattern most clearly."""

from __future__ import annotations

import numpy as np

from jaxid.results.report.curves import drawable
from jaxid.results.report.data import LogView

# Numbers of bins that are tried, and samples that each needs on average.
_BINS, _LEAST = (30, 60, 240), 8
# Part of the variance that a pattern must explain.
_CLEAR = 0.2


def telling_variable(view: LogView) -> str:
    """Return "position", "velocity" or "time": the first two if the residual follows them, the clearer one.

    The residual is that of the declared model, if there are two.

    Args:
        view: The log; it must have a residual.
    """
    residual = view.residual_after if view.residual_before is None else view.residual_before
    if view.steady or residual is None:
        return "velocity"
    shares = {name: share_explained(getattr(view, name), residual) for name in ("velocity", "position")}
    best = max(shares, key=lambda name: shares[name])
    return best if shares[best] >= _CLEAR else "time"


def share_explained(x: np.ndarray, y: np.ndarray) -> float:
    """Return the part of the variance of y that its mean over bins of x explains, less that of chance.

    It is the adjusted coefficient of determination of a step function, the best of several widths.

    Args:
        x: Abscissa, (K,).
        y: Values, (K,).
    """
    x, y = drawable(x), drawable(y)
    good = np.isfinite(x) & np.isfinite(y)
    x, y = x[good], y[good]
    total = float(np.sum(y**2))
    if x.size < _BINS[0] or np.ptp(x) == 0 or total == 0:
        return 0.0
    best = 0.0
    for bins in (b for b in _BINS if x.size >= _LEAST * b or b == _BINS[0]):
        index = np.minimum((x - x.min()) / np.ptp(x) * bins, bins - 1).astype(int)
        # Dry friction jumps at rest, within the middle bin.
        index = 2 * index + (x >= 0)
        _, index = np.unique(index, return_inverse=True)
        count = np.bincount(index)
        mean = np.bincount(index, y) / count
        left, freedom = float(np.sum((y - mean[index]) ** 2)), x.size - count.size
        if freedom > 0:
            best = max(best, 1 - left / total * x.size / freedom)
    return best
