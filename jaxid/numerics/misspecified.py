"""Standard deviations of least squares whose model is incomplete.

If a model lacks something, its estimates scatter about the values that fit best on the average over
experiments. The residual then follows the motion, so that it is no noise independent of the regressor;
its colour alone gives no standard deviation. What remains true is that scores, regressor times residual, of
stretches that are far apart are independent.
"""

from __future__ import annotations

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

# Number of stretches of a log: each should hold a whole move, whose scores belong together; with fewer of
# them the standard deviation itself is uncertain.
_STRETCHES = 12
# Eigenvalues of the scaled normal matrix below this part of the largest are rounding.
_ROUNDING = 1e-12


def std_under_misspecification(
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
) -> Float[np.ndarray, " p"]:
    """Return standard deviations of the values that fit best, which hold even if the model is incomplete.

    They are those of the sandwich whose scores are summed over stretches of the log, each weighted as if the
    stretch had been left out of the fit (the jackknife). They are enlarged by Student's distribution, so that
    1.96 of them is a 95 % interval although the stretches are few.

    Args:
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).

    Returns:
        Standard deviations in the units of the parameters, (p,); NaN if there are too few samples.

    Source:
        White (1982), Econometrica 50, 1-25, for estimates of incomplete models; Bell and McCaffrey (2002),
        Survey Methodology 28, 169-181, for the weights of the stretches (their CR3).
    """
    p, before = jacobian.shape[-1], np.cumsum(counts.sum(axis=1))
    if before[-1] < _STRETCHES * max(p, 1):
        return np.full(p, np.nan)
    edges = np.searchsorted(before, before[-1] * np.arange(1, _STRETCHES) / _STRETCHES)
    normals, scores = [], []
    for j, e, c in zip(*(np.split(x, edges) for x in (jacobian, residual, counts)), strict=True):
        j, e = (j.reshape(-1, p), e.ravel()) if c.all() else (j[c], e[c])
        normals.append(j.T @ j)
        scores.append(j.T @ e)
    whole = np.sum(normals, axis=0)
    norm = np.sqrt(np.diag(whole))
    norm = np.where(norm > 0, norm, 1.0)

    # Without a stretch the fit moves by these steps.
    pairs = zip(normals, scores, strict=True)
    steps = np.stack([_solved((whole - a) / np.outer(norm, norm), g / norm) for a, g in pairs])
    spread = np.sqrt((_STRETCHES - 1) / _STRETCHES * np.sum((steps - steps.mean(axis=0)) ** 2, axis=0))
    few = scipy.stats.t.ppf(0.975, _STRETCHES - 1) / scipy.stats.norm.ppf(0.975)
    return few * spread / norm


def _solved(normal: Float[np.ndarray, "p p"], score: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Solve for the step of least norm; directions of which the rows hold nothing do not move."""
    values, vectors = np.linalg.eigh(normal)
    clear = values > _ROUNDING * max(values[-1], 1e-300)
    return vectors[:, clear] @ ((vectors[:, clear].T @ score) / values[clear])
