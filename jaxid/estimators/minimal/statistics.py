"""Least squares for the coefficients of a minimal model, with the published statistics of such fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.estimators.minimal.columns import Regression
from jaxid.numerics.precision import Precision, assess

# A coefficient can be dropped if the residual's norm grows by less than this fraction without it.
DROPPED = 0.01


@dataclass(frozen=True)
class MinimalFit:
    """Least-squares fit of the coefficients chi.

    Args:
        chi: The fitted coefficients, (k,).
        precision: Their precision, with the colour of the residual.
        white: Standard deviations as published, for white noise of one level in all rows, (k,).
        residual: Weighted residual, zero for samples that do not count, (kept, rows).
        size: 2-norm of Y.
        condition: Condition number of W.
        condition_scaled: Condition number of W with columns of unit length.
        without: Norm of the residual without each coefficient, over that with all, (k,).
        root: Upper triangular factor R of W = Q R, (k, k).
    """

    chi: Float[np.ndarray, " k"]
    precision: Precision
    white: Float[np.ndarray, " k"]
    residual: Float[np.ndarray, "kept rows"]
    size: float
    condition: float
    condition_scaled: float
    without: Float[np.ndarray, " k"]
    root: Float[np.ndarray, "k k"]

    @property
    def relative(self) -> float:
        """Norm of the residual over the norm of Y."""
        return float(np.linalg.norm(self.residual) / self.size)


def least_squares(names: tuple[str, ...], data: Regression, weight: Float[np.ndarray, " rows"]) -> MinimalFit:
    """Fit the coefficients by ordinary least squares over all rows, stacked.

    Args:
        names: Names of the coefficients.
        data: The regression.
        weight: Weight of each row of the model, (rows,).

    Source:
        Gautier (1997) for the white standard deviations, sigma^2 = |e|^2 / (rows - k).
    """
    counts = data.counts
    y = np.where(counts, data.y * weight, 0.0)
    w = np.where(counts[..., None], data.w * weight[:, None], 0.0)
    flat, target = w.reshape(-1, w.shape[-1]), y.ravel()
    norm = np.linalg.norm(flat, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    root = np.asarray(np.linalg.qr(flat / norm, mode="r"))
    chi = np.linalg.lstsq(flat / norm, target, rcond=None)[0] / norm
    residual = y - w @ chi
    size, remaining = float(np.linalg.norm(y)), float(np.linalg.norm(residual))

    inverse = np.linalg.pinv(root)
    spread = remaining / np.sqrt(max(int(counts.sum()) - len(chi), 1))
    white = spread * np.linalg.norm(inverse, axis=1) / norm
    # Without one coefficient the sum of squares grows by chi^2 / (W'W)^-1_jj.
    growth = (chi * norm / np.linalg.norm(inverse, axis=1)) ** 2
    return MinimalFit(
        chi=chi,
        precision=assess(list(names), w, residual, counts, size, np.where(chi != 0, chi, 1.0)),
        white=white,
        residual=residual,
        size=size,
        condition=float(np.linalg.cond(root * norm)),
        condition_scaled=float(np.linalg.cond(root)),
        without=np.sqrt(1 + growth / remaining**2),
        root=root * norm,
    )


def chance(chi_square: float, freedom: int) -> float:
    """Return the probability of a chi-square at least as large."""
    return float(scipy.stats.chi2.sf(chi_square, freedom))


@dataclass(frozen=True)
class Constraint:
    """Test of the coefficients against those of a plant, which has fewer parameters.

    Args:
        chi_square: Squared distance from the coefficients of the nearest plant, over their covariance.
        freedom: Degrees of freedom: number of coefficients less the number of parameters.
        p_value: Probability of a distance at least as large by chance.
        regrouped: Names of parameters that were regrouped with others first, to have degrees of freedom.
    """

    chi_square: float
    freedom: int
    p_value: float
    regrouped: tuple[str, ...]
