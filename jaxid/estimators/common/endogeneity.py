"""Durbin-Wu-Hausman test: whether noise in the regressor biases least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.stats
from jaxtyping import Bool, Float

from jaxid.numerics.coloured_noise import NoiseModel, sandwich

# Singular values of the noise in the scaled regressor below this are rounding.
_ROUNDING = 1e-9
# Probability of the test to reject if least squares is consistent.
SIZE = 0.05
# Bias, in standard deviations, from which it matters: a 95 % interval then holds the truth in 83 %.
_MATTERS = 1.0


@dataclass(frozen=True)
class Endogeneity:
    """Result of the Durbin-Wu-Hausman test.

    Args:
        statistic: Wald statistic; chi-squared if the regressor is independent of the residual.
        degrees_of_freedom: Number of independent columns that the instruments leave of the regressor.
        p_value: Probability of a larger statistic if least squares is consistent.
        bias: Least squares minus instrumental variables, in standard deviations of least squares, (p,).
    """

    statistic: float
    degrees_of_freedom: int
    p_value: float
    bias: Float[np.ndarray, " p"]

    @property
    def biased(self) -> bool:
        """True if the test rejects that least squares is consistent."""
        return self.p_value < SIZE

    def text(self, names: Sequence[str]) -> str:
        """Return the result in one sentence.

        Args:
            names: Names of the unknowns, (p,).
        """
        test = (
            f"Durbin-Wu-Hausman test: chi-squared {self.statistic:.3g} with {self.degrees_of_freedom} "
            f"degrees of freedom, p = {self.p_value:.2g}"
        )
        if not self.biased:
            return f"least squares is not biased by noise in the loop, as far as this log shows ({test})"
        most = int(np.argmax(np.abs(self.bias)))
        size = f"{self.bias[most]:+.2g} of its standard deviations in {names[most]}"
        if abs(self.bias[most]) < _MATTERS:
            return f"noise in the loop biases least squares by little, most by {size} ({test})"
        return f"least squares is biased by noise in the loop, most by {size} ({test})"

    def json(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the object `durbin_wu_hausman` of result.json."""
        return {
            "statistic": self.statistic,
            "degrees_of_freedom": self.degrees_of_freedom,
            "p_value": self.p_value,
            "biased": self.biased,
            "bias_in_std": dict(zip(names, self.bias.tolist(), strict=True)),
            "text": self.text(names),
        }


def endogeneity(
    e: Float[np.ndarray, "time n"],
    columns: Float[np.ndarray, "time n p"],
    basis: Float[np.ndarray, "samples r"],
    counts: Bool[np.ndarray, "time n"],
) -> Endogeneity | None:
    """Test whether the regressor is correlated with the residual, by the augmented regression.

    The residual is regressed on the regressor X and on U, an orthonormal basis of V = X - P X, with P the
    projection on the instruments: the part of X that the instruments do not explain, which holds its noise.
    Least squares is consistent if the coefficients of U are zero. They are a linear function L e of the
    residual, and the statistic is (L e)' C^-1 (L e). There are two estimates of their covariance C, both with
    the residual as it is under the hypothesis: L R L' with its coloured model R, by joint, and the sum of its
    products with L over time, which also holds if its variance changes. The smaller statistic is returned.

    Args:
        e: Residual at an estimate by the instruments, (time, n); entries that do not count are ignored.
        columns: Its Jacobian there, (time, n, p).
        basis: Orthonormal basis of the instruments over the entries that count, (samples, r).
        counts: Mask of the samples that count, (time, n).

    Returns:
        The result; None if the instruments explain the whole regressor.

    Source:
        Hausman (1978), Econometrica 46, 1251-1271; Janot, Vandanjon and Gautier (2016), Control Engineering
        Practice 48, 52-62, for robots. Covariance of a coloured residual in place of the white one:
        Wooldridge (2010), "Econometric analysis of cross section and panel data", 6.3.1.
    """
    x, y = columns[counts], e[counts]
    norm = np.linalg.norm(x, axis=0)
    x = x / np.where(norm > 0, norm, 1.0)
    explained = basis @ (basis.T @ x)
    left, sizes, right = np.linalg.svd(x - explained, full_matrices=False)
    kept = sizes > _ROUNDING
    if not kept.any():
        return None
    noise = left[:, kept]
    # In the orthonormal columns Q of P X and U the regressor is Q T + U S W'.
    q, singular, turned = np.linalg.svd(explained, full_matrices=False)
    regular = singular > _ROUNDING * singular[0]
    of_x = turned[regular].T @ (q[:, regular].T / singular[regular, None])
    of_noise = noise.T - (sizes[kept, None] * right[kept]) @ of_x

    gamma, rest = of_noise @ y, np.where(counts, e, 0.0)
    rows = np.zeros((*e.shape, len(gamma)))
    rows[counts] = of_noise.T
    covariance = np.zeros((len(gamma), len(gamma)))
    for k in range(e.shape[1]):
        if counts[:, k].any():
            covariance += sandwich(rows[:, k], NoiseModel.fit(rest[:, k], counts[:, k]))
    # The residual may be larger at reversals, where the regressor is off too, and a finite sum of products is
    # itself uncertain: the covariance that leaves more room decides.
    scores = np.sum(rows * rest[..., None], axis=1)
    both = [_wald(gamma, c) for c in (covariance, _sum_of_products(scores - scores.mean(axis=0)))]
    statistic, freedom = min(both)
    if not freedom:
        return None
    p_value = float(scipy.stats.chi2.sf(statistic, freedom))
    return Endogeneity(statistic, freedom, p_value, _bias(e, columns, counts))


def _wald(gamma: Float[np.ndarray, " g"], covariance: Float[np.ndarray, "g g"]) -> tuple[float, int]:
    """Return the Wald statistic of some coefficients, and the number of directions that have a variance."""
    values, vectors = np.linalg.eigh(covariance)
    sound = values > _ROUNDING * max(values[-1], np.finfo(float).tiny)
    return float(np.sum((vectors[:, sound].T @ gamma) ** 2 / values[sound])), int(sound.sum())


def _sum_of_products(scores: Float[np.ndarray, "time g"]) -> Float[np.ndarray, "g g"]:
    """Return the covariance of the sum of scores, which may be correlated and of unequal variance.

    Source:
        Newey and West (1987), Econometrica 55, 703-708, with the lags of Lazarus, Lewis, Stock and Watson
        (2018), J. Business and Economic Statistics 36, 541-559: 1.3 times the root of the samples.
    """
    lags = int(np.ceil(1.3 * np.sqrt(len(scores))))
    total = scores.T @ scores
    for k in range(1, min(lags, len(scores) - 1) + 1):
        part = (1.0 - k / (lags + 1.0)) * (scores[k:].T @ scores[:-k])
        total += part + part.T
    return total


def _bias(
    e: Float[np.ndarray, "time n"], columns: Float[np.ndarray, "time n p"], counts: Bool[np.ndarray, "time n"]
) -> Float[np.ndarray, " p"]:
    """Return the step from an estimate to that of least squares, in standard deviations, (p,)."""
    x = columns[counts]
    norm = np.linalg.norm(x, axis=0)
    x = x / np.where(norm > 0, norm, 1.0)
    inverse = np.linalg.pinv(x)
    step = -inverse @ e[counts]
    rest = np.zeros(e.shape)
    rest[counts] = e[counts] + x @ step
    rows = np.zeros((*e.shape, x.shape[1]))
    rows[counts] = inverse.T
    variance = np.zeros(x.shape[1])
    for k in range(e.shape[1]):
        if counts[:, k].any():
            variance += np.diag(sandwich(rows[:, k], NoiseModel.fit(rest[:, k], counts[:, k])))
    return np.divide(step, np.sqrt(variance), out=np.zeros_like(step), where=variance > 0)
