"""Changes of an estimate by changes of its residual, to first order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.numerics.rows import Rows

# Eigenvalue of the scaled normal matrix, relative to the largest, below which a direction does not move.
_BLIND = 1e-10


def changes_by_pairs(
    residual: Callable[[Array], Array], noise: Float[Array, "pairs ticks n"]
) -> tuple[Float[Array, "pairs time k"], Float[Array, "pairs time k"]]:
    """Return the even and the odd change of a residual by each pair of opposite noise.

    Args:
        residual: Residual as a function of the noise of a run, (time, k).
        noise: Noise of one run of each pair.
    """
    quiet = residual(0.0 * noise[0])

    def both(noise: Array) -> tuple[Array, Array]:
        plus, minus = residual(noise), residual(-noise)
        return 0.5 * (plus + minus) - quiet, 0.5 * (plus - minus)

    return jax.lax.map(both, noise)


@dataclass(frozen=True)
class Scores:
    """Sums over logs for steps of Gauss-Newton by several changes of the residual.

    Args:
        normal: Sum of J'J, (q, q).
        scores: Sums of J' times each change, (changes, q).
    """

    normal: Float[np.ndarray, "q q"]
    scores: Float[np.ndarray, "changes q"]

    @classmethod
    def none(cls, rows: Rows, changes: int) -> Scores:
        """Return the sums over no log, for residuals with the unknowns of `rows`."""
        q = rows.jacobian.shape[-1]
        return cls(np.zeros((q, q)), np.zeros((changes, q)))

    def with_log(self, rows: Rows, changes: Float[np.ndarray, "changes time n"]) -> Scores:
        """Return the sums with another log.

        Args:
            rows: Residual of the log at the fit.
            changes: Changes of this residual.
        """
        q = rows.jacobian.shape[-1]
        flat = np.where(rows.counts[..., None], rows.jacobian, 0.0).reshape(-1, q)
        normal = self.normal + rows.weight * flat.T @ flat
        return Scores(normal, self.scores + rows.weight * changes.reshape(len(changes), -1) @ flat)

    def steps(self) -> Float[np.ndarray, "changes q"]:
        """Return the step of Gauss-Newton by each change of the residual, (changes, q)."""
        return -self.scores @ self.inverse

    @property
    def inverse(self) -> Float[np.ndarray, "q q"]:
        """Inverse of J'J, zero in the directions that do not move."""
        size = np.sqrt(np.maximum(np.diag(self.normal), 1e-300))
        inverse = np.linalg.pinv(self.normal / np.outer(size, size), rcond=_BLIND, hermitian=True)
        return inverse / np.outer(size, size)
