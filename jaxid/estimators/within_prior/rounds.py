"""Fit along the directions that a log tells, read anew wherever the fit has moved to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.estimators.within_prior.problem import (
    AT_ONCE,
    DRAWN,
    FAR,
    NEAR,
    STAYS,
    Problem,
    RoundsResult,
    at_each,
    columns,
    descent,
    read,
    signed,
)
from jaxid.numerics.lanes import Steps

# A direction is fitted where its standard deviation is below this part of the prior's; one that was, up to
# `STAYS`.
_TOLD_TWICE = 0.5
# Directions change with the point at which they are read: most rounds, in how many of them they are read
# anew.
_ROUNDS, _READ = 6, 3
# How far a fit looks for where to begin, in priors.
_LOOKED = 2.0


def in_rounds(
    problem: Problem, w: np.ndarray, most: int, *, look: bool = True, last: bool = False
) -> Steps[RoundsResult]:
    """Read the directions, fit along them, so many at most, and again, each time sharper, until they stay.

    `look`: begin at the best of many points; `last`: at the sharpest only, from a point that is near.
    """
    size, spent = problem.prior.base.size, 0
    ladder = problem.ladder[-1:] if last else problem.ladder
    count, cost, settled = 0, np.inf, False
    for rung in range(len(ladder) + _ROUNDS):
        sharpness, before = ladder[min(rung, len(ladder) - 1)], count
        # Between the first rung and the last they hardly turn; those that change places with one another for
        # ever are taken as they are.
        if rung == 0 or len(ladder) - 1 <= rung < len(ladder) + _READ:
            problem, here = problem.weighed((yield from read(problem, sharpness, w)))
            spent += int(here.steps)
            if not np.all(np.isfinite(here.jacobian)):
                # Coordinates are of the first few directions: one of them leads to where this was read.
                whole = np.linalg.qr(np.column_stack([w, np.eye(size)]))[0]
                here = replace(here, theta=columns(whole, 0).T @ w)
                return RoundsResult(problem, whole, 0, here, spent, False)
            noise = problem.noise(here, count)
            vectors, count = identifiable_directions(np.asarray(here.jacobian) / noise, count)
            count = min(count, most)
            if rung == 0 and look and not last and count:
                w = yield from _looked(problem, vectors[:, : min(count, AT_ONCE)], w)
        some = columns(vectors, count)
        fitted = np.arange(some.shape[1]) < count
        start = np.where(fitted, np.clip(some.T @ w, -FAR, FAR), 0.0)
        # These only lead near.
        pull = np.asarray(noise)
        minimum = yield from descent(problem, sharpness, pull, np.zeros(size), some, start, fitted, NEAR)
        spent += int(minimum.steps)
        w = some @ np.asarray(minimum.theta)
        moved = abs(float(minimum.cost) - cost)
        close = before == count and moved <= NEAR / len(problem.measured) * cost
        settled, cost = close and sharpness is ladder[-1], float(minimum.cost)
        if settled or not np.isfinite(cost):
            break
    return RoundsResult(problem, vectors, count, minimum, spent, settled)


def _looked(problem: Problem, told: np.ndarray, w: np.ndarray) -> Steps[np.ndarray]:
    """Of points along what is told best, and the one given, that of the lowest cost: it has many valleys."""
    z = np.random.default_rng(1).uniform(-_LOOKED, _LOOKED, (DRAWN, told.shape[1]))
    points = w + (z - told.T @ w) @ told.T
    points[0] = w
    e = yield from at_each(problem, points)
    costs = np.sum(e**2, axis=1)
    return points[np.argmin(np.where(np.isfinite(costs), costs, np.inf))]


def identifiable_directions(jacobian: np.ndarray, before: int) -> tuple[np.ndarray, int]:
    """Directions as columns, best told first, and how many are fitted; of a Jacobian over the noise."""
    size = jacobian.shape[1]
    # Of its triangle, a tenth as long.
    _, values, rows = np.linalg.svd(np.linalg.qr(jacobian, mode="r"), full_matrices=True)
    told = np.zeros(size)
    told[: values.size] = values
    count = int(np.sum(told > 1.0 / _TOLD_TWICE))
    if before > count:
        count = int(np.sum(told[:before] > 1.0 / STAYS))
    return signed(rows.T), count
