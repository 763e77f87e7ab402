"""Least squares of a minimal model, with the statistics that are published of such fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.estimators.minimal.columns import Regression
from jaxid.numerics.precision import Precision, assess

# A coefficient can be dropped where the residual's norm grows by less than this part without it.
DROPPED = 0.01


@dataclass(frozen=True)
class MinimalFit:
    """What least squares says of the coefficients chi.

    Args:
        chi: (k,).
        precision: Under the residual's own colour.
        white: Standard deviations as published, for white noise of one level in all rows, (k,).
        residual: Of each row over its weight, (kept, rows); zero where it does not count.
        size: 2-norm of Y.
        condition: Of W.
        condition_scaled: Of W with columns of one length.
        without: Norm of the residual without each coefficient, over that with all, (k,).
        root: Upper triangle R of W = Q R, (k, k).
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
        """Norm of the residual over that of Y."""
        return float(np.linalg.norm(self.residual) / self.size)


def least_squares(names: tuple[str, ...], data: Regression, weight: Float[np.ndarray, " rows"]) -> MinimalFit:
    """Ordinary least squares of all rows, stacked.

    Args:
        names: Of the coefficients.
        data: The regression.
        weight: On each row.

    Source:
        Gautier (1997) for the white standard deviations, sigma^2 = |e|^2 / (rows - k).
    """
    counts = data.counts
    y = np.where(counts, data.y * weight, 0.0)
    w = np.where(counts[..., None], data.w * weight[:, None], 0.0)
    flat, target = w.reshape(-1, w.shape[-1]), y.ravel()
    norm = np.linalg.norm(flat, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    root = np.linalg.qr(flat / norm, mode="r")
    chi = np.linalg.lstsq(flat / norm, target, rcond=None)[0] / norm
    residual = y - w @ chi
    size, left = float(np.linalg.norm(y)), float(np.linalg.norm(residual))
    inverse = np.linalg.pinv(root)
    spread = left / np.sqrt(max(int(counts.sum()) - len(chi), 1))
    white = spread * np.linalg.norm(inverse, axis=1) / norm
    # Without one coefficient the squares grow by chi^2 / (W'W)^-1_jj.
    growth = (chi * norm / np.linalg.norm(inverse, axis=1)) ** 2
    return MinimalFit(
        chi=chi,
        precision=assess(list(names), w, residual, counts, size, np.where(chi != 0, chi, 1.0)),
        white=white,
        residual=residual,
        size=size,
        condition=float(np.linalg.cond(root * norm)),
        condition_scaled=float(np.linalg.cond(root)),
        without=np.sqrt(1 + growth / left**2),
        root=root * norm,
    )


def chance(chi_square: float, freedom: int) -> float:
    """Probability of a chi-square at least as large."""
    return float(scipy.stats.chi2.sf(chi_square, freedom))


@dataclass(frozen=True)
class Constraint:
    """Whether coefficients that are more than the parameters agree with them.

    Args:
        chi_square: Distance of the coefficients from those of any plant, over their covariance.
        freedom: How many coefficients there are to spare.
        p_value: Probability of as much by chance.
        regrouped: Parameters that were moved to others first, so that there were any to spare.
    """

    chi_square: float
    freedom: int
    p_value: float
    regrouped: tuple[str, ...]
