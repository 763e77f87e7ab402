"""Multistart of a fit within a prior: fits from many points, and how many reach the same optimum."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.within_prior.evaluations import BOUND, DRAWS, NEAR, NO_PRIOR, fit_each, residuals_at
from jaxid.estimators.within_prior.problem import Problem
from jaxid.estimators.within_prior.subspace import SubspaceFit, fit_in_subspace
from jaxid.numerics.lanes import SolveRequest, Steps

# Grid along the best identified direction, to move starts at which the simulation shows no motion [standard
# deviations of the prior].
_GRID = np.linspace(-3.0, 3.0, 13)
# Relative difference of the cost below which two fits have reached the same optimum.
_SAME = 1e-3


def random_starts(problem: Problem, starts: int) -> np.ndarray:
    """Draw starts uniformly within one standard deviation of the guesses, (starts - 1, q).

    The guesses are the first start and not among them. Nuisance parameters start at zero.
    """
    size = problem.prior.base.size
    w = np.random.default_rng(0).uniform(-1.0, 1.0, (max(starts - 1, 0), size))
    w[:, len(problem.places) :] = 0.0
    return w


def likeliest_prior_draws(problem: Problem, points: int) -> Steps[np.ndarray]:
    """Draw many points from the prior and return those of the highest likelihood, the best first."""
    w = np.random.default_rng(0).standard_normal((DRAWS, problem.prior.base.size))
    with np.errstate(over="ignore", invalid="ignore"):
        costs = np.sum((yield from residuals_at(problem, w)) ** 2, axis=1)
    return w[np.argsort(np.where(np.isfinite(costs), costs, np.inf))[:points]]


def fit_from_many_starts(
    fit: SubspaceFit, points: np.ndarray, most: int
) -> Steps[tuple[SubspaceFit, dict[str, Any]]]:
    """Fit from many starts and return the best fit.

    Args:
        fit: The fit from the guesses.
        points: More starts, in whitened coordinates, (starts, q).
        most: Largest number of directions to fit.

    Returns:
        The best fit, and the entry `starts` of the details: the number of starts, of those that reach the
        same optimum, and of those at which the cost is flat.
    """
    fit = yield from _fit_from_best(fit, points, most)
    spent = fit.evaluations
    origin = np.zeros(points.shape[1])
    for again in (True, False):
        block = fit.leading
        fitted = np.arange(block.shape[1]) < fit.count
        # The fit itself is the last start: it may only be near its optimum.
        z = np.clip(np.concatenate([points, [fit.point]]) @ block, -BOUND, BOUND)
        z = np.where(fitted, z, 0.0)
        active = np.tile(fitted, (len(z), 1))

        # The fit is included, although its answer is not used: one start less would compile again.
        flat = (yield from _flat(fit, z, active))[:-1]
        if np.any(flat):
            z[:-1][flat] = (yield from _moved_to_best_of_grid(fit, z))[:-1][flat]

        noise, costs = np.asarray(fit.problem.noise(fit.minimum, fit.count)), np.zeros(len(z))
        for sharpness in fit.problem.sharpnesses:
            args = (fit.problem.residual, sharpness, noise, origin, block, z, active)
            z, costs, _, _ = (np.asarray(x) for x in (yield SolveRequest(fit_each, args)))
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best, cost = int(np.argmin(costs)), float(fit.minimum.cost)
        if abs(costs[-1] - cost) <= NEAR / len(fit.problem.measured) * cost:
            cost = float(costs[-1])
        if not again or costs[best] >= cost * (1 - _SAME):
            break

        # Other directions may be identifiable at the better optimum.
        other = yield from fit_in_subspace(fit.problem, block @ z[best], most, last=True)
        spent += other.evaluations
        if float(other.minimum.cost) >= cost:
            break
        fit = other

    # A start that reached a lower cost, at a point from which the fit in other directions was worse, is not
    # at the same optimum.
    same = np.abs(np.append(costs[:-1], cost) - cost) <= cost * _SAME
    stated = {"count": len(same), "same_optimum": int(same.sum()), "flat": int(flat.sum())}
    return replace(fit, evaluations=spent), {"starts": stated}


def _fit_from_best(fit: SubspaceFit, points: np.ndarray, most: int) -> Steps[SubspaceFit]:
    """Fit from the best of some points and return the better fit.

    A machine that sticks at the guesses gives no gradient there.
    """
    problem = fit.problem
    origin, inactive = np.zeros(points.shape[1]), np.zeros(points.shape, bool)
    args = (problem.residual, problem.sharpnesses[0], NO_PRIOR, origin, np.eye(origin.size), points, inactive)
    _, costs, _, _ = yield SolveRequest(fit_each, args)
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    other = yield from fit_in_subspace(problem, points[best], most)
    better = float(other.minimum.cost) < float(fit.minimum.cost) * (1 - _SAME)
    return replace(other if better else fit, evaluations=fit.evaluations + other.evaluations)


def _moved_to_best_of_grid(
    fit: SubspaceFit, z: Float[np.ndarray, "starts k"]
) -> Steps[Float[np.ndarray, "starts k"]]:
    """Move each start along the best identified direction to the point of lowest cost on a coarse grid.

    The level of friction keeps a simulation from moving, and it is the best identified parameter.
    """
    problem = fit.problem
    args = (problem.residual, problem.sharpnesses[0], NO_PRIOR, np.zeros(len(fit.vectors)), fit.leading)
    grid = np.tile(z, (len(_GRID), 1, 1))
    grid[:, :, 0] = _GRID[:, None]
    costs = []
    for there in grid:
        costs.append(np.asarray((yield SolveRequest(fit_each, (*args, there, np.zeros(z.shape, bool))))[1]))
    best = np.argmin(np.where(np.isfinite(costs), costs, np.inf), axis=0)
    return grid[best, np.arange(len(z))]


def _flat(
    fit: SubspaceFit, z: Float[np.ndarray, "starts k"], active: Bool[np.ndarray, "starts k"]
) -> Steps[Bool[np.ndarray, " starts"]]:
    """Return the mask of the starts at which the cost is flat: the machine sticks throughout."""
    problem = fit.problem
    # Without the nuisance parameters, which move the residual of a machine that sticks too.
    origin, block = np.zeros(len(fit.vectors)), fit.leading.copy()
    block[len(problem.places) :] = 0.0
    args = (problem.residual, problem.sharpnesses[0], NO_PRIOR, origin, block, z, active)
    ended = np.asarray((yield SolveRequest(fit_each, args))[0])
    return np.all(ended == z, axis=1)
