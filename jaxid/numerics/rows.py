"""Residuals of one log or several of a fit, and the precision by all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float

from jaxid.numerics.precision import WINDOWED, Precision, assess, gradient_covariance, precision_of_matrices

# An eigenvalue of one log's information below this part of its largest one says nothing about its noise.
_CLEAR = 1e-8


@dataclass(frozen=True)
class Rows:
    """Residual of one of several logs, at a fit of all of them.

    Args:
        jacobian: Jacobian of the residual by the unknowns of all logs, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        signal: 2-norm of the measured signal that the residual belongs to.
        weight: Weight of the squared residual in the fit.
        covariance: Covariance of the residual at the samples that count; None: it follows from its colour.
    """

    jacobian: Float[np.ndarray, "time n p"]
    residual: Float[np.ndarray, "time n"]
    counts: Bool[np.ndarray, "time n"]
    signal: float
    weight: float = 1.0
    covariance: scipy.sparse.csr_array | None = None

    def matrices(self, norm: Float[np.ndarray, " p"], crossed: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return J'J and J'RJ by the unknowns over `norm`, (p, p) each, R being the residual's covariance."""
        rows = np.where(self.counts[..., None], self.jacobian, 0.0) / norm
        flat = rows.reshape(-1, len(norm))
        meat = gradient_covariance(rows, self.residual, self.counts, crossed, self.covariance)
        return flat.T @ flat, meat

    @property
    def size(self) -> Float[np.ndarray, " p"]:
        """2-norm of each column of the Jacobian over the samples that count, (p,)."""
        return np.sqrt(np.sum(np.where(self.counts[..., None], self.jacobian, 0.0) ** 2, axis=(0, 1)))

    def of_one_fit(self) -> tuple[np.ndarray, int]:
        """Return the residual that a fit of this log alone would leave, (time, n), and its fitted directions.

        It is that of one Gauss-Newton step. A log that the common fit explains badly would else count as
        noisy, and be left out of it.
        """
        size = self.size
        seen = size > 0
        if not seen.any():
            return self.residual, 0
        columns = self.jacobian[self.counts][:, seen] / size[seen]
        values, vectors = np.linalg.eigh(columns.T @ columns)
        clear = values > _CLEAR * values[-1]
        basis = columns @ (vectors[:, clear] / np.sqrt(values[clear]))
        e = self.residual[self.counts]
        left = np.zeros_like(self.residual)
        left[self.counts] = e - basis @ (basis.T @ e)
        return left, int(clear.sum())

    def equivalent_variance(self) -> float:
        """Return the variance of the white residual that would inform as much as that of this log alone.

        It is the mean over the directions that the log shows; of a log that shows none, the mean square.
        """
        left, fitted = self.of_one_fit()
        count = int(self.counts.sum())
        white = float(np.sum(np.where(self.counts, left, 0.0) ** 2)) / max(count - fitted, 1)
        if not fitted:
            return white
        size = self.size
        own = replace(self, residual=left)
        normal, meat = own.matrices(np.where(size > 0, size, 1.0))
        values, vectors = np.linalg.eigh(normal)
        clear = values > _CLEAR * values[-1]
        spread = np.einsum("ik,ij,jk->k", vectors, meat, vectors)
        mean = float(np.mean(np.maximum(spread[clear], 0.0) / values[clear]))
        return mean * count / max(count - fitted, 1)


def assess_together(
    names: list[str],
    logs: Sequence[Rows],
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    crossed: bool = False,
) -> Precision:
    """Return the precision of one least-squares fit to one log or several, each with its noise and weight.

    Args:
        names: Names of the p parameters.
        logs: Residuals of the logs; of one alone the weight does not matter.
        scale: Natural size of each parameter, (p,).
        hessian: Full Hessian of half the weighted sum of squares, (p, p), see `assess`.
        crossed: Whether the columns of a residual have common noise, see `assess`.
    """
    if len(logs) == 1:
        [log] = logs
        shape = (log.jacobian, log.residual, log.counts, log.signal)
        full = None if hessian is None else hessian / log.weight
        return assess(names, *shape, scale, full, crossed, covariance=log.covariance)
    if not names:
        return Precision(np.zeros((0, 0)), np.zeros(0, bool), [], np.zeros(0))
    signal = float(np.sqrt(np.sum([log.weight * log.signal**2 for log in logs])))
    norm = np.sqrt(np.sum([log.weight * log.size**2 for log in logs], axis=0))
    dead = norm * np.abs(scale) <= 1e-9 * signal
    norm = np.where(dead, 1.0, norm)
    normal, meat = np.zeros((len(names),) * 2), np.zeros((len(names),) * 2)
    for log in logs:
        own, coloured = log.matrices(norm, crossed)
        normal += log.weight * own
        meat += log.weight**2 * coloured
    for matrix in (normal, meat):
        matrix[dead] = 0.0
        matrix[:, dead] = 0.0
    found = precision_of_matrices(names, normal, meat, norm, signal, hessian)
    return found if logs[0].covariance is None else replace(found, kind=WINDOWED)
