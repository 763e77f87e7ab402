"""Fit in the subspace of directions that a log identifies, which is recomputed as the fit moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.within_prior.evaluations import (
    BLOCK,
    BOUND,
    DRAWS,
    NEAR,
    descent,
    linearise,
    residuals_at,
)
from jaxid.estimators.within_prior.problem import Problem
from jaxid.numerics.lanes import Steps

# A direction is fitted if the log alone gives it a standard deviation below this, in standard deviations of
# the prior. A direction that was fitted before stays up to the second value.
_FITTED_STD = 0.5
KEPT_STD = 0.6
# Directions change with the point of linearisation: rounds at the final sharpness at most, and the number of
# them in which the directions are recomputed.
_ROUNDS, _RECOMPUTED = 6, 3
# Half width of the box in which a start is searched, in standard deviations of the prior.
_SEARCHED = 2.0


@dataclass(frozen=True)
class SubspaceFit:
    """A fit in the identifiable subspace.

    Args:
        problem: The problem that was fitted.
        vectors: All directions in whitened coordinates, as columns, the best identified first, (q, q).
        count: Number of directions that are fitted; the others stay at their prior.
        minimum: The minimum, in coordinates of the leading directions or of all; any others are zero.
        evaluations: Evaluations of residual and Jacobian that the fit took.
        settled: Whether the fit converged.
    """

    problem: Problem
    vectors: np.ndarray
    count: int
    minimum: Minimum
    evaluations: int
    settled: bool

    @property
    def leading(self) -> np.ndarray:
        """The fitted directions and those that fill up the width of compiled code, as columns."""
        return leading_directions(self.vectors, self.count)

    @property
    def point(self) -> np.ndarray:
        """The optimum in whitened coordinates, (q,)."""
        theta = np.asarray(self.minimum.theta)
        return self.vectors[:, : theta.size] @ theta

    @property
    def effective(self) -> float:
        """Effective number of parameters: the sum over directions of the share that the log determines.

        Source:
            Hastie, Tibshirani and Friedman, "The elements of statistical learning", 7.6: the trace of the
            matrix that maps measured to fitted values, here with the prior as the penalty.
        """
        jacobian = np.asarray(self.minimum.jacobian) / self.problem.noise(self.minimum, self.count)
        if not np.all(np.isfinite(jacobian)):
            return 0.0
        information = np.linalg.svd(np.linalg.qr(jacobian, mode="r"), compute_uv=False) ** 2
        return float(np.sum(information / (1.0 + information)))

    @property
    def noise(self) -> float:
        """Standard deviation of the residual, as white noise, given the effective number of parameters."""
        return self.problem.noise(self.minimum, self.effective)


def fit_in_subspace(
    problem: Problem, w: np.ndarray, most: int, *, search_start: bool = True, last: bool = False
) -> Steps[SubspaceFit]:
    """Fit along the identifiable directions and recompute them, by continuation, until they stay the same.

    Args:
        problem: The problem to fit.
        w: Start in whitened coordinates, (q,).
        most: Largest number of directions to fit.
        search_start: Begin at the best of many points along the best identified directions.
        last: Fit at the final sharpness only, from a point that is near the optimum.
    """
    size, spent = problem.prior.base.size, 0
    sharpnesses = problem.sharpnesses[-1:] if last else problem.sharpnesses
    count, cost, settled = 0, np.inf, False
    final = len(sharpnesses) - 1
    vectors, noise, minimum = np.eye(size), np.nan, None
    for k in range(len(sharpnesses) + _ROUNDS):
        sharpness, before = sharpnesses[min(k, final)], count

        # Directions hardly turn between the first sharpness and the final one. Directions that keep changing
        # places with one another are taken as they are after a few rounds.
        if k == 0 or final <= k < len(sharpnesses) + _RECOMPUTED:
            problem, here = problem.reweighted((yield from linearise(problem, sharpness, w)))
            spent += int(here.steps)
            if not np.all(np.isfinite(here.jacobian)):
                return _not_finite(problem, w, here, spent)
            noise = problem.noise(here, count)
            vectors, count = identifiable_directions(np.asarray(here.jacobian) / noise, count)
            count = min(count, most)
            if k == 0 and search_start and not last and count:
                w = yield from _best_start(problem, vectors[:, : min(count, BLOCK)], w)

        block = leading_directions(vectors, count)
        fitted = np.arange(block.shape[1]) < count
        start = np.where(fitted, np.clip(block.T @ w, -BOUND, BOUND), 0.0)
        # The tolerance is loose: these fits only have to come near the optimum.
        minimum = yield from descent(
            problem, sharpness, np.asarray(noise), np.zeros(size), block, start, fitted, NEAR
        )
        spent += int(minimum.steps)
        w = block @ np.asarray(minimum.theta)

        moved = abs(float(minimum.cost) - cost)
        close = before == count and moved <= NEAR / len(problem.measured) * cost
        settled, cost = close and sharpness is sharpnesses[-1], float(minimum.cost)
        if settled or not np.isfinite(cost):
            break
    assert minimum is not None, "there is at least one round"
    return SubspaceFit(
        problem=problem,
        vectors=vectors,
        count=count,
        minimum=minimum,
        evaluations=spent,
        settled=settled,
    )


def _not_finite(problem: Problem, w: np.ndarray, here: Minimum, spent: int) -> SubspaceFit:
    """Return a fit that ended at a point whose Jacobian is not finite; no direction is fitted."""
    # Coordinates are those of the leading directions: the first of them is made to point at w.
    vectors = np.linalg.qr(np.column_stack([w, np.eye(w.size)]))[0]
    here = replace(here, theta=leading_directions(vectors, 0).T @ w)
    return SubspaceFit(
        problem=problem, vectors=vectors, count=0, minimum=here, evaluations=spent, settled=False
    )


def _best_start(problem: Problem, directions: np.ndarray, w: np.ndarray) -> Steps[np.ndarray]:
    """Return the point of lowest cost among w and random points along some directions.

    The cost has many local minima along the best identified directions.
    """
    z = np.random.default_rng(1).uniform(-_SEARCHED, _SEARCHED, (DRAWS, directions.shape[1]))
    points = w + (z - directions.T @ w) @ directions.T
    points[0] = w
    e = yield from residuals_at(problem, points)
    # Links that no body can be may run away: their cost is infinite.
    with np.errstate(over="ignore"):
        costs = np.sum(e**2, axis=1)
    return points[np.argmin(np.where(np.isfinite(costs), costs, np.inf))]


def identifiable_directions(
    jacobian: Float[np.ndarray, "rows q"], before: int
) -> tuple[Float[np.ndarray, "q q"], int]:
    """Return all directions as columns, the best identified first, and the number of identifiable ones.

    Args:
        jacobian: Jacobian of the residual in whitened coordinates over the standard deviation of the noise.
        before: Number of directions that were fitted so far, which are kept more readily.
    """
    size = jacobian.shape[1]
    # The singular values are those of the triangular factor, which is a tenth as long.
    _, values, rows = np.linalg.svd(np.linalg.qr(jacobian, mode="r"), full_matrices=True)
    precision = np.zeros(size)
    precision[: values.size] = values
    count = int(np.sum(precision > 1.0 / _FITTED_STD))
    if before > count:
        count = int(np.sum(precision[:before] > 1.0 / KEPT_STD))
    return with_definite_signs(rows.T), count


def with_definite_signs(vectors: Float[np.ndarray, "q k"]) -> Float[np.ndarray, "q k"]:
    """Return the columns, each with the sign that makes its largest entry positive."""
    largest = np.argmax(np.abs(vectors), axis=0)
    return vectors * np.sign(vectors[largest, np.arange(vectors.shape[1])])


def leading_directions(vectors: Float[np.ndarray, "q q"], count: int) -> Float[np.ndarray, "q k"]:
    """Return the first `count` directions and more, up to a multiple of `BLOCK`, at least one block."""
    return vectors[:, : BLOCK * max(1, -(-count // BLOCK))]
