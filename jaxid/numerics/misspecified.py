"""Standard deviations of least squares by blocks of a log, for an incomplete model or a lasting error.

If a model lacks something, its estimates scatter about the values that fit best on the average over
experiments. The residual then follows the motion, so that it is no noise independent of the regressor;
its colour alone gives no standard deviation. What remains true is that scores, regressor times residual, of
stretches that are far apart are independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float, Int

from jaxid.numerics.precision import Precision

# Number of stretches of a log: each should hold a whole move, whose scores belong together; with fewer of
# them the standard deviation itself is uncertain.
_STRETCHES = 12
# Number of blocks whose scores give the least variance of an estimate.
_BLOCKS = 40
# Eigenvalues of the scaled normal matrix below this part of the largest are rounding.
_ROUNDING = 1e-12


def std_under_misspecification(
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
) -> Float[np.ndarray, " p"]:
    """Return standard deviations of the values that fit best, which hold even if the model is incomplete.

    They are those of `block_covariance` with stretches of equally many samples, each left out in turn. They
    are enlarged by Student's distribution, so that 1.96 of them is a 95 % interval although the stretches are
    few.

    Args:
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).

    Returns:
        Standard deviations in the units of the parameters, (p,); NaN if there are too few samples.
    """
    p, before = jacobian.shape[-1], np.cumsum(counts.sum(axis=1))
    if before[-1] < _STRETCHES * max(p, 1):
        return np.full(p, np.nan)
    edges = np.searchsorted(before, before[-1] * np.arange(1, _STRETCHES) / _STRETCHES)
    covariance = block_covariance(jacobian, residual, counts, edges)
    few = scipy.stats.t.ppf(0.975, _STRETCHES - 1) / scipy.stats.norm.ppf(0.975)
    return few * np.sqrt(np.diag(covariance))


def widening(
    precision: Precision,
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    logs: Sequence[int] = (),
) -> Float[np.ndarray, " p"]:
    """Return the factors of standard deviations that make them as large as the scores of long blocks imply.

    Rounding of a steady motion, and an incomplete model, leave errors that last longer than any model of the
    residual's colour remembers. The sum of the scores over a block has their whole variance.

    Args:
        precision: Precision by a model of the residual's colour.
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        logs: Samples of each log, if several stand one behind the other.

    Returns:
        Factors of at least one, (p,); one where the log is too short or the unknown is not identifiable.
    """
    keep, factor = precision.identifiable, np.ones(len(precision.identifiable))
    lengths = tuple(logs) or (len(residual),)
    if not keep.any() or min(lengths) < 2 * _BLOCKS:
        return factor
    # Blocks of equal time in each log.
    ends = np.cumsum(lengths).tolist()
    blocks = [
        part[0]
        for length, end in zip(lengths, ends, strict=True)
        for part in np.array_split(np.arange(end - length, end), _BLOCKS)
    ]
    edges = np.array(blocks[1:])
    covariance = block_covariance(jacobian[..., keep], residual, counts, edges)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(np.diag(covariance)) / precision.std[keep]
    factor[keep] = np.where(np.isfinite(ratio), np.maximum(ratio, 1.0), 1.0)
    return factor


def block_covariance(
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    edges: Int[np.ndarray, " blocks-1"],
) -> Float[np.ndarray, "p p"]:
    """Return the covariance of a least-squares fit by the sandwich whose scores are summed over blocks.

    Each block moves the fit by the inverse of the normal matrix without it, times its score, so that few
    blocks give no covariance that is too small (the jackknife). The covariance is the sum of the squares of
    these steps.

    Args:
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        edges: First sample of each block but the first, ascending, (blocks - 1,).

    Returns:
        The covariance; NaN if the Jacobian overflows.

    Source:
        White (1982), Econometrica 50, 1-25, for estimates of incomplete models; Kunsch (1989), Annals of
        Statistics 17, for blocks of dependent samples; Bell and McCaffrey (2002), Survey Methodology 28,
        169-181, for blocks that are left out (their CR3).
    """
    p, normals, scores = jacobian.shape[-1], [], []
    if p == 0:
        return np.zeros((0, 0))
    for j, e, c in zip(*(np.split(x, edges) for x in (jacobian, residual, counts)), strict=True):
        j, e = (j.reshape(-1, p), e.ravel()) if c.all() else (j[c], e[c])
        normals.append(j.T @ j)
        scores.append(j.T @ e)
    whole = np.sum(normals, axis=0)
    size = np.sqrt(np.diag(whole))
    size = np.where(size > 0, size, 1.0)
    scaled = [(whole - own) / np.outer(size, size) for own in normals]
    if not (np.all(np.isfinite(scaled)) and np.all(np.isfinite(scores))):
        # The derivatives of a loop that is not stable overflow, and say nothing.
        return np.full((p, p), np.nan)
    steps = np.stack([_solved(normal, score / size) for normal, score in zip(scaled, scores, strict=True)])
    steps = np.sqrt(1 - 1 / len(steps)) * (steps - steps.mean(axis=0))
    return steps.T @ steps / np.outer(size, size)


def _solved(normal: Float[np.ndarray, "p p"], score: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Solve for the step of least norm; directions of which the rows hold nothing do not move."""
    values, vectors = np.linalg.eigh(normal)
    clear = values > _ROUNDING * max(values[-1], 1e-300)
    return vectors[:, clear] @ ((vectors[:, clear].T @ score) / values[clear])
