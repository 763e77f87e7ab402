"""Fits within a prior from many starts: where they end, and how many end alike."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.within_prior.problem import (
    DRAWN,
    FAR,
    NEAR,
    NO_PULL,
    Problem,
    RoundsResult,
    at_each,
    fit_each,
)
from jaxid.estimators.within_prior.rounds import in_rounds
from jaxid.numerics.lanes import SolveRequest, Steps

# Where along the best told direction a start is led from which the simulation does not move [priors].
_LOOK = np.linspace(-3.0, 3.0, 13)
# Two starts end at one optimum where their costs differ by less than this.
_SAME = 1e-3


def starts_within(problem: Problem, starts: int) -> np.ndarray:
    """Starts within one prior of the guesses, (starts - 1, p); the guesses themselves are the first."""
    size = problem.prior.base.size
    w = np.random.default_rng(0).uniform(-1.0, 1.0, (max(starts - 1, 0), size))
    w[:, len(problem.places) :] = 0.0
    return w


def likely_points(problem: Problem, points: int) -> Steps[np.ndarray]:
    """Of many drawn as the guesses say those that the log speaks least against, the best first."""
    w = np.random.default_rng(0).standard_normal((DRAWN, problem.prior.base.size))
    with np.errstate(over="ignore", invalid="ignore"):
        costs = np.sum((yield from at_each(problem, w)) ** 2, axis=1)
    return w[np.argsort(np.where(np.isfinite(costs), costs, np.inf))[:points]]


def many_starts(
    found: RoundsResult, points: np.ndarray, most: int
) -> Steps[tuple[RoundsResult, dict[str, Any]]]:
    """The best of many starts, and how many end there."""
    found = yield from _elsewhere(found, points, most)
    spent = found.evaluations
    for again in (True, False):
        some, origin = found.first, np.zeros(points.shape[1])
        fitted = np.arange(some.shape[1]) < found.count
        # The fit itself is the last of them: it may only be near its own optimum.
        z = np.clip(np.concatenate([points, [found.point]]) @ some, -FAR, FAR)
        z = np.where(fitted, z, 0.0)
        active = np.tile(fitted, (len(z), 1))
        # Asked of the fit too, for nothing: of one count less the same code would be compiled once more.
        flat = (yield from _flat(found, z, active))[:-1]
        if np.any(flat):
            z[:-1][flat] = (yield from _led(found, z))[:-1][flat]
        noise = np.asarray(found.problem.noise(found.minimum, found.count))
        for sharpness in found.problem.ladder:
            args = (*found.problem.args, sharpness, noise, origin, some, z, active)
            z, costs, _, _ = (np.asarray(x) for x in (yield SolveRequest(fit_each, args)))
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best, cost = int(np.argmin(costs)), float(found.minimum.cost)
        if abs(costs[-1] - cost) <= NEAR / len(found.problem.measured) * cost:
            cost = float(costs[-1])
        if not again or costs[best] >= cost * (1 - _SAME):
            break
        # Other directions may be told from there.
        other = yield from in_rounds(found.problem, some @ z[best], most, last=True)
        spent += other.evaluations
        if float(other.minimum.cost) >= cost:
            break
        found = other
    # A start that ended lower, where other directions are told and the fit was worse, is not alike.
    same = np.abs(np.append(costs[:-1], cost) - cost) <= cost * _SAME
    stated = {"count": len(same), "same_optimum": int(same.sum()), "flat": int(flat.sum())}
    return replace(found, evaluations=spent), {"starts": stated}


def _elsewhere(found: RoundsResult, points: np.ndarray, most: int) -> Steps[RoundsResult]:
    """The rounds from the best of some points too: a machine that sticks at the guesses shows nothing."""
    problem, nothing = found.problem, np.zeros(points.shape[1])
    still = (nothing, np.eye(points.shape[1]), points, np.zeros(points.shape, bool))
    _, costs, _, _ = yield SolveRequest(fit_each, (*problem.args, problem.ladder[0], NO_PULL, *still))
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    other = yield from in_rounds(problem, points[best], most)
    better = float(other.minimum.cost) < float(found.minimum.cost) * (1 - _SAME)
    return replace(other if better else found, evaluations=found.evaluations + other.evaluations)


def _led(found: RoundsResult, z: Float[np.ndarray, "starts k"]) -> Steps[Float[np.ndarray, "starts k"]]:
    """Each start led along the best told direction to where, at a coarse look, its cost is lowest.

    What keeps a simulation from moving is the level of its friction, and that is what is told best.
    """
    args = (*found.problem.args, found.problem.ladder[0], NO_PULL, np.zeros(len(found.vectors)), found.first)
    looked = np.tile(z, (len(_LOOK), 1, 1))
    looked[:, :, 0] = _LOOK[:, None]
    costs = []
    for there in looked:
        costs.append(np.asarray((yield SolveRequest(fit_each, (*args, there, np.zeros(z.shape, bool))))[1]))
    best = np.argmin(np.where(np.isfinite(costs), costs, np.inf), axis=0)
    return looked[best, np.arange(len(z))]


def _flat(
    found: RoundsResult, z: Float[np.ndarray, "starts k"], active: Bool[np.ndarray, "starts k"]
) -> Steps[Bool[np.ndarray, " starts"]]:
    """Which starts show no slope: a machine that sticks throughout says nothing of where to go."""
    origin, own = np.zeros(len(found.vectors)), found.first.copy()
    own[len(found.problem.places) :] = 0.0
    args = (*found.problem.args, found.problem.ladder[0], NO_PULL, origin, own, z, active)
    ended = np.asarray((yield SolveRequest(fit_each, args))[0])
    return np.all(ended == z, axis=1)
