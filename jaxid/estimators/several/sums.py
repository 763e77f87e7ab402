"""Sums over the residuals of logs that are fitted together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from jaxid.estimators.several.descent import Model
from jaxid.numerics.rows import Rows


def summed(logs: list[Rows], inner: Callable[[np.ndarray], np.ndarray]) -> Model:
    """Return half the weighted sum of squares of some logs, and its model on the scale of the solver.

    Args:
        logs: Residuals and Jacobians by the physical values; both are zero at samples that do not count.
        inner: Function that returns derivatives by the physical values, (rows, q), as those by the solver's.
    """
    cost, q = 0.0, logs[0].jacobian.shape[-1]
    gradient, normal = np.zeros(q), np.zeros((q, q))
    # A step may lead where a simulation diverges: its cost is no finite number, and it is refused.
    with np.errstate(invalid="ignore", over="ignore"):
        for log in logs:
            e, columns = log.residual.ravel(), inner(log.jacobian.reshape(-1, q))
            cost += 0.5 * log.weight * float(e @ e)
            gradient += log.weight * (columns.T @ e)
            normal += log.weight * (columns.T @ columns)
    return Model(cost, gradient, normal, logs)


def stacked(logs: list[Rows]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Jacobian, residual and mask of all logs, one behind the other, over the root of their noise."""
    roots = [np.sqrt(log.weight) for log in logs]
    jacobian = np.concatenate([r * log.jacobian for r, log in zip(roots, logs, strict=True)])
    residual = np.concatenate([r * log.residual for r, log in zip(roots, logs, strict=True)])
    return jacobian, residual, np.concatenate([log.counts for log in logs])


def shares(logs: list[Rows]) -> list[dict[str, float | int]]:
    """Return for each log its samples, and the standard deviation of white noise that informs as much."""
    return [{"samples": int(log.counts.sum()), "noise": float(log.weight**-0.5)} for log in logs]


def counted(
    values: Sequence[np.ndarray], masks: Sequence[np.ndarray], weights: Sequence[float] | np.ndarray
) -> np.ndarray:
    """Return the entries of all logs that count, one behind the other, times the root of their weights.

    Args:
        values: Residuals of each log, (time, n), or their Jacobians, (time, n, p).
        masks: Masks of the samples that count, (time, n) each.
        weights: Weight of each log.
    """
    roots = np.sqrt(np.asarray(weights))
    return np.concatenate([r * x[mask] for r, x, mask in zip(roots, values, masks, strict=True)])


def projected(
    values: Sequence[np.ndarray], bases: Sequence[np.ndarray], masks: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the Jacobian of each log projected on a span of its own, zero where nothing counts.

    Args:
        values: Jacobian of each log, (time, n, p).
        bases: Orthonormal basis of the span over the samples that count, (rows, r) each.
        masks: Masks of the samples that count, (time, n) each.
    """
    out = []
    for x, basis, mask in zip(values, bases, masks, strict=True):
        inside = np.zeros_like(x)
        inside[mask] = basis @ (basis.T @ x[mask])
        out.append(inside)
    return out
