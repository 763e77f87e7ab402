"""Output error in the directions that a log tells; the rest stays at its prior.

A short log cannot tell all unknowns. Fitted all the same they run away along what is flat, and what is
told goes with them. Here each guess is a prior of a stated relative width; combinations of unknowns that
the log tells better than that are fitted, the others are held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.directions_precision import (
    Told,
    add_profiles,
    assessed,
    hessian_of,
    told_of,
)
from jaxid.estimators.directions_problem import (
    AT_ONCE,
    FAR,
    NEAR,
    NO_PULL,
    SETTLED,
    Found,
    Problem,
    columns,
    descent,
    fit_each,
    read,
)
from jaxid.estimators.directions_rounding import covariance_with_rounding, draws_soon, rounds
from jaxid.estimators.output_error import choose_numerics, notes_of
from jaxid.estimators.result import Estimate
from jaxid.estimators.steps import Solve, Steps
from jaxid.io.log import Log
from jaxid.machine import Machine
from jaxid.replay import Numerics

# A direction is fitted where its standard deviation is below this part of the prior's; one that was stays
# up to the second.
_TOLD_TWICE, _STAYS = 0.5, 0.6
# Directions change with the point at which they are read: most rounds, in how many of them they are read
# anew.
_ROUNDS, _READ = 6, 3
# A direction that changes so small a part of what another does is not felt.
_UNFELT = 1e-6
# Starts where the guesses tell nothing.
_WHERE_NOTHING_SHOWS = 32
# Where along the best told direction a start is led from which the simulation does not move [priors].
_LOOK = np.linspace(-3.0, 3.0, 13)
# Two starts end at one optimum where their costs differ by less than this.
_SAME = 1e-3


def directions_steps(
    machine: Machine, log: Log, *, prior: float, on: str = "position", starts: int = 1,
    others: Sequence[np.ndarray] = (), hessian: bool = False, profile: bool = False,
    numerics: Numerics | None = None, widths: Mapping[str, float] | None = None,
) -> Steps[Estimate]:
    """Fit what a log tells of the unknowns in the loop, and hold the rest at the guesses.

    Args:
        machine: The machine; its controller closes the loop, which begins at rest.
        log: The log.
        prior: Relative standard deviation of the guesses.
        on: "position", "force" or "both". On the latter two the loop is simulated without rounding of the
            readings: which count a simulated reading falls on is a coin toss for a coarse encoder, and
            a cost with it a bed of needles.
        starts: Starts drawn within `prior` of the guesses, to see that all end alike.
        others: More starts: values of the unknowns.
        hessian: Take the curvature from the full Hessian in place of Gauss-Newton's.
        profile: Also take profile likelihoods of the fitted directions.
        numerics: How to integrate.
        widths: Standard deviations of single guesses, by name; of what must be positive of its logarithm.

    Returns:
        The estimate. Standard deviations hold what is left of the prior along held directions;
        `details["directions"]` has the combinations with their own.

    Raises:
        InputError: If the loop cannot be simulated, or a guess is zero.

    Source:
        Precision: Bogdan and Abba, (12)-(27), with the residual's colour where they take white noise.
        (27) lacks the inverse of B: 100 (sigma^2 diag B^-1)^(1/2) / theta.
    """
    numerics = numerics or choose_numerics(machine, log)
    problem = Problem.of(machine, log, prior, on, numerics, widths)
    given = [problem.prior.inward(problem.padded(t)) for t in others]
    found, told, many = yield from _searched(machine, problem, starts, given)
    p = len(machine.parameters.free)
    r, z = found.count, np.asarray(found.minimum.theta)
    remarks: list[str] = []
    if hessian and told is not None and rounds(machine, problem):
        remarks.append("rounding was simulated: the Hessian says nothing beside it")
    elif hessian and told is not None:
        args = (*found.problem.args, found.problem.ladder[-1], found.first, z)
        full = np.asarray((yield Solve(hessian_of, args)))[:r, :r]
        if np.linalg.eigvalsh(full)[0] > 0.0:
            told = told_of(found, full)
        else:
            remarks.append("the cost does not curve upwards everywhere: Gauss-Newton's curvature was taken")
    precision, stated = assessed(machine, found, told)
    if profile:
        remarks += yield from add_profiles(found, stated)
    theta = np.asarray(found.problem.prior.outward(found.point))[:p]
    e = np.asarray(found.minimum.residual).reshape(found.problem.measured.shape)
    counts = found.problem.weight > 0
    converged = bool(found.minimum.converged) and found.settled
    message = "the directions that the log tells did not settle"
    if not np.isfinite(float(found.minimum.cost)) or not np.all(np.isfinite(found.minimum.jacobian)):
        message = "the simulation is not finite where the fit ended"
    remarks.insert(0, f"{r} directions of {p} unknowns fitted, the rest held at the guesses")
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else message,
        residual=np.where(counts, e / np.where(counts, found.problem.weight, 1.0), np.nan),
        samples=int(counts.sum()),
        steps=found.evaluations,
        notes=(*notes_of(machine, numerics, log, on), *remarks),
        details={"directions": stated, "criterion_percent": found.problem.criterion(found.minimum), **many},
    )


def _searched(
    machine: Machine, problem: Problem, starts: int, given: Sequence[np.ndarray]
) -> Steps[tuple[Found, Told | None, dict[str, Any]]]:
    """Where the fit ends, how well its directions are told, and what is to be stated of its starts."""
    # What rounding does leaves few directions told in the end: the best of them come first.
    most = problem.prior.base.size
    if rounds(machine, problem):
        most = AT_ONCE
        yield draws_soon(machine, problem)
    found = yield from _rounds(problem, np.zeros(problem.prior.base.size), most)
    many: dict[str, Any] = {}
    if starts > 1 or given:
        found, many = yield from _many_starts(found, np.array([*given, *_drawn(problem, starts)]), most)
    found, told = yield from _sifted(machine, found)
    if told is None and not many:
        # A machine that sticks at the guesses, or nearly, shows nothing.
        found, many = yield from _many_starts(found, _drawn(problem, _WHERE_NOTHING_SHOWS), most)
        found, told = yield from _sifted(machine, found)
    while found.count == most and found.more:
        most += AT_ONCE
        spent = found.evaluations
        found = yield from _rounds(found.problem, found.point, most, last=True)
        found, told = yield from _sifted(machine, replace(found, evaluations=found.evaluations + spent))
    return found, told, many


def _drawn(problem: Problem, starts: int) -> np.ndarray:
    """Starts within one prior of the guesses, (starts - 1, p); the guesses themselves are the first."""
    size = problem.prior.base.size
    w = np.random.default_rng(0).uniform(-1.0, 1.0, (max(starts - 1, 0), size))
    w[:, len(problem.places) :] = 0.0
    return w


def _rounds(problem: Problem, w: np.ndarray, most: int, *, last: bool = False) -> Steps[Found]:
    """Read the directions, fit along them, so many at most, and again, each time sharper, until they stay.

    `last`: at the sharpest only, from a point that is near.
    """
    size, spent = problem.prior.base.size, 0
    # Where rounding will let go of most of them it is enough to be near.
    enough = NEAR if most < size and not last else SETTLED
    ladder = problem.ladder[-1:] if last else problem.ladder
    count, more, cost, settled = 0, False, np.inf, False
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
                return Found(problem, whole, 0, here, spent, False, False)
            noise = problem.noise(here, count)
            vectors, count = _directions(np.asarray(here.jacobian) / noise, count)
            more, count = count > most, min(count, most)
        some = columns(vectors, count)
        fitted = np.arange(some.shape[1]) < count
        start = np.where(fitted, np.clip(some.T @ w, -FAR, FAR), 0.0)
        pull = np.asarray(0.0 if sharpness is ladder[-1] else noise)
        # A rung above the last is only to lead near.
        left = enough if sharpness is ladder[-1] else NEAR
        minimum = yield from descent(problem, sharpness, pull, np.zeros(size), some, start, fitted, left)
        spent += int(minimum.steps)
        w = some @ np.asarray(minimum.theta)
        moved = abs(float(minimum.cost) - cost)
        close = before == count and moved <= enough / len(problem.measured) * cost
        settled, cost = close and sharpness is ladder[-1], float(minimum.cost)
        if settled or not np.isfinite(cost):
            break
    return Found(problem, vectors, count, minimum, spent, settled, more)


def _sifted(machine: Machine, found: Found) -> Steps[tuple[Found, Told | None]]:
    """Let go of directions that are told only as long as noise counts as white, and fit the rest again.

    A residual's colour, and above all what rounding of the readings does in the loop, moves an estimate
    farther along them than its prior would let it.
    """
    ended = not rounds(machine, found.problem)
    while found.count and np.all(np.isfinite(found.minimum.jacobian)):
        stays, told = _felt(found), None
        if np.all(stays):
            told = told_of(found)
            if rounds(machine, found.problem):
                covariance = yield from covariance_with_rounding(machine, found, told.std)
                told = replace(told, covariance=covariance)
            stays = told.std <= _STAYS
        if ended and told is not None and np.all(stays):
            return found, told
        rest = np.arange(found.count, len(found.vectors))
        order = np.concatenate([np.flatnonzero(stays), np.flatnonzero(~stays), rest])
        vectors, count = found.vectors[:, order], int(stays.sum())
        some = columns(vectors, count)
        fitted = np.arange(some.shape[1]) < count
        z = np.where(fitted, some.T @ found.point, 0.0)
        origin = np.zeros(len(vectors))
        last = found.problem.ladder[-1]
        minimum = yield from descent(found.problem, last, NO_PULL, origin, some, z, fitted)
        spent = found.evaluations + int(minimum.steps)
        found = replace(found, vectors=vectors, count=count, minimum=minimum, evaluations=spent)
        ended = True
    return found, None


def _felt(found: Found) -> Bool[np.ndarray, " r"]:
    """Which fitted directions still change anything: not those that end where an unknown is at its bound."""
    triangle = np.linalg.qr(np.asarray(found.minimum.jacobian)[:, : found.count], mode="r")
    size = np.abs(np.diag(triangle))
    return size > _UNFELT * size.max()


def _directions(jacobian: np.ndarray, before: int) -> tuple[np.ndarray, int]:
    """Directions as columns, best told first, and how many are fitted; of a Jacobian over the noise."""
    size = jacobian.shape[1]
    # Of its triangle, a tenth as long.
    _, values, rows = np.linalg.svd(np.linalg.qr(jacobian, mode="r"), full_matrices=True)
    told = np.zeros(size)
    told[: values.size] = values
    count = int(np.sum(told > 1.0 / _TOLD_TWICE))
    if before > count:
        count = int(np.sum(told[:before] > 1.0 / _STAYS))
    # Eigenvectors come with either sign: the largest entry is taken positive.
    return rows.T * np.sign(rows[np.arange(size), np.argmax(np.abs(rows), axis=1)]), count


def _elsewhere(found: Found, points: np.ndarray, most: int) -> Steps[Found]:
    """The rounds from the best of some points too: a machine that sticks at the guesses shows nothing."""
    problem, nothing = found.problem, np.zeros(points.shape[1])
    still = (nothing, np.eye(points.shape[1]), points, np.zeros(points.shape, bool))
    _, costs, _, _ = yield Solve(fit_each, (*problem.args, problem.ladder[0], NO_PULL, *still))
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    other = yield from _rounds(problem, points[best], most)
    better = float(other.minimum.cost) < float(found.minimum.cost) * (1 - _SAME)
    return replace(other if better else found, evaluations=found.evaluations + other.evaluations)


def _many_starts(
    found: Found, points: np.ndarray, most: int
) -> Steps[tuple[Found, dict[str, Any]]]:
    """The best of many starts, and how many end there."""
    found = yield from _elsewhere(found, points, most)
    spent = found.evaluations
    for again in (True, False):
        some, origin = found.first, np.zeros(points.shape[1])
        fitted = np.arange(some.shape[1]) < found.count
        # The fit itself is the last of them: it may only be near its own optimum.
        z = np.concatenate([np.clip(points @ some, -FAR, FAR), [np.asarray(found.minimum.theta)]])
        z = np.where(fitted, z, 0.0)
        active = np.tile(fitted, (len(z), 1))
        flat = yield from _flat(found, z[:-1], active[:-1])
        if np.any(flat):
            z[:-1][flat] = (yield from _led(found, z))[:-1][flat]
        noise = found.problem.noise(found.minimum, found.count)
        ladder = found.problem.ladder
        for sharpness in ladder:
            pull = np.asarray(0.0 if sharpness is ladder[-1] else noise)
            args = (*found.problem.args, sharpness, pull, origin, some, z, active)
            z, costs, _, _ = (np.asarray(x) for x in (yield Solve(fit_each, args)))
        costs = np.where(np.isfinite(costs), costs, np.inf)
        best, cost = int(np.argmin(costs)), float(found.minimum.cost)
        if abs(costs[-1] - cost) <= NEAR / len(found.problem.measured) * cost:
            cost = float(costs[-1])
        if not again or costs[best] >= cost * (1 - _SAME):
            break
        # Other directions may be told from there.
        other = yield from _rounds(found.problem, some @ z[best], most, last=True)
        spent += other.evaluations
        if float(other.minimum.cost) >= cost:
            break
        found = other
    # A start that ended lower, where other directions are told and the fit was worse, is not alike.
    same = np.abs(np.append(costs[:-1], cost) - cost) <= cost * _SAME
    stated = {"count": len(same), "same_optimum": int(same.sum()), "flat": int(flat.sum())}
    return replace(found, evaluations=spent), {"starts": stated}


def _led(found: Found, z: Float[np.ndarray, "starts k"]) -> Steps[Float[np.ndarray, "starts k"]]:
    """Each start led along the best told direction to where, at a coarse look, its cost is lowest.

    What keeps a simulation from moving is the level of its friction, and that is what is told best.
    """
    args = (*found.problem.args, found.problem.ladder[0], NO_PULL, np.zeros(len(found.vectors)), found.first)
    looked = np.tile(z, (len(_LOOK), 1, 1))
    looked[:, :, 0] = _LOOK[:, None]
    costs = []
    for there in looked:
        costs.append(np.asarray((yield Solve(fit_each, (*args, there, np.zeros(z.shape, bool))))[1]))
    best = np.argmin(np.where(np.isfinite(costs), costs, np.inf), axis=0)
    return looked[best, np.arange(len(z))]


def _flat(
    found: Found, z: Float[np.ndarray, "starts k"], active: Bool[np.ndarray, "starts k"]
) -> Steps[Bool[np.ndarray, " starts"]]:
    """Which starts show no slope: a machine that sticks throughout says nothing of where to go."""
    origin, own = np.zeros(len(found.vectors)), found.first.copy()
    own[len(found.problem.places) :] = 0.0
    args = (*found.problem.args, found.problem.ladder[0], NO_PULL, origin, own, z, active)
    ended = np.asarray((yield Solve(fit_each, args))[0])
    return np.all(ended == z, axis=1)
