"""Output error in the directions that a log tells; the rest stays at its prior.

A short log cannot tell all unknowns. Fitted all the same they run away along what is flat, and what is
told goes with them. Here each guess is a prior of a stated relative width; combinations of unknowns that
the log tells better than that are fitted, the others follow their prior: they move only where guesses and
log together are more probable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import choose_numerics, notes_of
from jaxid.estimators.within_prior.posterior import loss_of, most_probable, past_kinks, quadratic, spread
from jaxid.estimators.within_prior.precision import (
    DirectionPrecision,
    add_profiles,
    assessed,
    hessian_of,
    precision_of_directions,
    with_guesses,
)
from jaxid.estimators.within_prior.problem import (
    AT_ONCE,
    DRAWN,
    STAYS,
    Problem,
    RoundsResult,
    at_each_soon,
    read,
)
from jaxid.estimators.within_prior.rounding import draws_soon, rounded, rounds, through_rounding
from jaxid.estimators.within_prior.rounds import identifiable_directions, in_rounds
from jaxid.estimators.within_prior.starts import likely_points, many_starts, starts_within
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision
from jaxid.simulation.replay import Numerics

# Points from which the fit begins where the guesses tell nothing.
_ELSEWHERE = 3
# A simulation without rounding follows a loop in which that moves what is compared by this part of its
# variance at most.
_FOLLOWED = 0.1


def directions_steps(
    machine: Machine,
    log: Log,
    *,
    prior: float,
    on: str = "position",
    starts: int = 1,
    others: Sequence[np.ndarray] = (),
    hessian: bool = False,
    profile: bool = False,
    numerics: Numerics | None = None,
    widths: Mapping[str, float] | None = None,
    begin: np.ndarray | None = None,
    drawn: bool = True,
) -> Steps[Estimate]:
    """Fit what a log tells of the unknowns in the loop, and leave the rest to the guesses.

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
        begin: Values of the unknowns to begin at; absent: the best of many points about the guesses.
        drawn: Draw what else is as probable, and what rounding does. Without it deviations are those of the
            quadratic picture, of a loop that does not round, in a fraction of the time.

    Returns:
        The estimate. Standard deviations hold what is left of the prior along other directions, and what
        those do to the fitted ones; `details["directions"]` has the combinations with their own.

    Raises:
        InputError: If the loop cannot be simulated, or a guess is zero.

    Source:
        Precision: Bogdan and Abba, (12)-(27), with the residual's colour where they take white noise.
        (27) lacks the inverse of B: 100 (sigma^2 diag B^-1)^(1/2) / theta.
    """
    numerics = numerics or choose_numerics(machine, log)
    problem = Problem.of(machine, log, prior, on, numerics, widths)
    given = [problem.prior.inward(problem.padded(t)) for t in others]
    first = None if begin is None else problem.prior.inward(problem.padded(begin))
    found, told, many = yield from _searched(machine, problem, first, starts, given, drawn)
    simulated = drawn and rounds(machine, problem)
    unknowns = len(problem.places)
    remarks = [f"{found.count} directions of {unknowns} unknowns fitted, the rest left to the guesses"]
    if told is not None and not simulated and hessian:
        told, said = yield from _by_hessian(found, told)
        remarks += said
    precision, stated = assessed(machine, found, told)
    if told is not None and not simulated and profile:
        remarks += yield from add_profiles(found, found.problem.noise(found.minimum, found.count), stated)
    if rounds(machine, problem):
        remarks += _of_rounding(drawn, told is not None, hessian or profile)
    notes = (*notes_of(machine, numerics, log, on), *remarks)
    return _estimate(machine, found, precision, notes, {"directions": stated} | many)


def _of_rounding(drawn: bool, told: bool, more: bool) -> list[str]:
    """What to remark of a loop whose readings round; `more`: a Hessian or profiles were asked for."""
    if not drawn:
        return ["drawn = false: what rounding of the readings does is in no value, nor deviation"]
    if not told:
        return []
    words = [
        "what rounding of the readings does on average was taken off; criterion and residual are those of "
        "the fit before that"
    ]
    if more:
        words.append("rounding was simulated: neither Hessian nor profiles say anything beside it")
    return words


def _estimate(
    machine: Machine,
    found: RoundsResult,
    precision: Precision,
    notes: tuple[str, ...],
    details: dict[str, Any],
) -> Estimate:
    """The fit as a result."""
    problem, minimum = found.problem, found.minimum
    theta = np.asarray(problem.prior.outward(found.point))[: len(problem.places)]
    e, counts = np.asarray(minimum.residual).reshape(problem.measured.shape), problem.weight > 0
    message = "converged" if found.settled else "the fit within the prior did not settle"
    if not found.settled and not (np.isfinite(float(minimum.cost)) and np.all(np.isfinite(minimum.jacobian))):
        message = "the simulation is not finite where the fit ended"
    of_cost = {"criterion_percent": problem.criterion(minimum), "effective_parameters": found.effective}
    return Estimate(
        method="within_prior",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=found.settled,
        message=message,
        residual=np.where(counts, e / np.where(counts, problem.weight, 1.0), np.nan),
        samples=int(counts.sum()),
        steps=found.evaluations,
        notes=notes,
        details=details | of_cost,
    )


def _by_hessian(found: RoundsResult, told: DirectionPrecision) -> Steps[tuple[DirectionPrecision, list[str]]]:
    """With the full Hessian's quadratic picture, where it has one; and what to remark."""
    z, noise = np.asarray(found.minimum.theta), found.problem.noise(found.minimum, found.count)
    args = (*found.problem.args, found.problem.ladder[-1], found.vectors, z)
    full = np.asarray((yield SolveRequest(hessian_of, args))) / noise**2 + np.eye(z.size)
    if np.linalg.eigvalsh(full)[0] <= 0.0:
        return told, ["the cost does not curve upwards everywhere: its curvature was not taken"]
    return with_guesses(
        found, precision_of_directions(found), found.vectors @ np.linalg.inv(full) @ found.vectors.T
    ), []


def _searched(
    machine: Machine,
    problem: Problem,
    first: np.ndarray | None,
    starts: int,
    given: Sequence[np.ndarray],
    drawn: bool,
) -> Steps[tuple[RoundsResult, DirectionPrecision | None, dict[str, Any]]]:
    """Where the fit ends, how well its directions are told, and what is to be stated of its starts."""
    if drawn or first is None:
        yield at_each_soon(problem)
    most = problem.prior.base.size
    if rounds(machine, problem):
        # What rounding does leaves few directions told in the end, and others many valleys.
        most = AT_ONCE
        if drawn:
            yield draws_soon(machine, problem)
    nowhere = np.zeros(problem.prior.base.size)
    found = yield from in_rounds(problem, nowhere if first is None else first, most, look=first is None)
    many: dict[str, Any] = {}
    if starts > 1 or given:
        found, many = yield from many_starts(found, np.array([*given, *starts_within(problem, starts)]), most)
    found, told = yield from _most_probable(machine, found, drawn)
    if told is None and not many:
        # A machine that sticks at the guesses, or nearly, shows nothing, nor does it near them.
        found = yield from _begun_elsewhere(found, drawn)
        found, told = yield from _most_probable(machine, found, drawn)
    return found, told, many


def _begun_elsewhere(found: RoundsResult, drawn: bool) -> Steps[RoundsResult]:
    """The most probable of where the fit ends from a few likely points, and of where it did.

    Points that do not simulate are passed over, and so is where it did if that does not.
    """
    problem, best = found.problem, found
    for w in (yield from likely_points(problem, _ELSEWHERE)):
        here = yield from read(problem, problem.ladder[-1], w)
        if not np.all(np.isfinite(here.jacobian)):
            continue
        if not np.all(np.isfinite(best.minimum.jacobian)):
            best = found = RoundsResult(problem, np.eye(w.size), 0, here, found.evaluations, False)
        noise = best.noise
        found = yield from _ended(found, w, drawn)
        best = min(best, found, key=lambda f: loss_of(noise, f.minimum, f.point))
    return replace(best, evaluations=found.evaluations)


def expected_steps(
    machine: Machine, problem: Problem, own: Float[np.ndarray, " k"]
) -> Steps[Float[np.ndarray, "q q"]]:
    """How well a log will tell the unknowns of a machine whose readings round, simulated at the guesses.

    Args:
        machine: The machine.
        problem: What is to be compared, with nothing measured: zeros.
        own: Noise beside what rounding does, by column, over what the problem weighs it by.

    Returns:
        Covariance of all unknowns in units of the prior; the prior's where nothing is told, and where
        rounding moves the loop so far that a fit which simulates it without will not find its way.
    """
    rng, here = np.random.default_rng(0), np.zeros((DRAWN, problem.prior.base.size))
    # A residual is of what is measured less what is simulated.
    exact = -(yield from rounded(machine, problem, np.random.default_rng(4)))[0]
    exact = exact.reshape(problem.measured.shape)
    log = exact + own * rng.standard_normal(exact.shape)
    problem = replace(problem, measured=log / problem.weight)
    minimum = yield from read(problem, problem.ladder[-1], here[0])
    followed = log - np.asarray(minimum.residual).reshape(log.shape)
    if np.any(np.var(exact - followed, axis=0) > _FOLLOWED * np.var(followed, axis=0)):
        return np.eye(len(here[0]))
    jacobian = np.asarray(minimum.jacobian)
    vectors, count = identifiable_directions(jacobian / problem.noise(minimum, 0), 0)
    minimum = replace(minimum, theta=vectors.T @ here[0], jacobian=jacobian @ vectors)
    if count:
        _, told = yield from through_rounding(
            machine, RoundsResult(problem, vectors, count, minimum, 1, True)
        )
        if told is not None:
            return told.whole
    return np.eye(len(vectors))


def _most_probable(
    machine: Machine, found: RoundsResult, drawn: bool
) -> Steps[tuple[RoundsResult, DirectionPrecision | None]]:
    """On to where guesses and log agree, and how well directions are told there by both."""
    if not np.all(np.isfinite(found.minimum.jacobian)):
        return found, None
    found = yield from _ended(found, found.point, drawn)
    if not found.count:
        return found, None
    if drawn and rounds(machine, found.problem):
        return (yield from through_rounding(machine, found))
    if drawn:
        whole, best = yield from spread(found, found.noise)
        if np.any(best != found.point):
            # It ended in a valley that is not the best.
            found = yield from _ended(found, best, drawn)
            whole, _ = yield from spread(found, found.noise)
    else:
        whole = quadratic(found, found.noise)
    while found.count:
        told = with_guesses(found, precision_of_directions(found), whole)
        stays = told.std <= STAYS
        if np.all(stays):
            return found, told
        # What noise of the residual's colour leaves too wide goes behind those that stay.
        order = np.argsort(~np.append(stays, np.zeros(len(whole) - found.count, bool)), kind="stable")
        found = _along(found, found.vectors[:, order], int(stays.sum()))
    return found, None


def _ended(found: RoundsResult, w: Float[np.ndarray, " q"], drawn: bool) -> Steps[RoundsResult]:
    """The fit taken from a point to the most probable one, its directions those that are told there."""
    noise = found.problem.noise(found.minimum, found.count)
    w, here, settled = yield from (past_kinks if drawn else most_probable)(found.problem, noise, w)
    vectors, count = identifiable_directions(np.asarray(here.jacobian) / noise, found.count)
    spent = found.evaluations + int(here.steps)
    return _along(RoundsResult(found.problem, np.eye(len(w)), count, here, spent, settled), vectors, count)


def _along(found: RoundsResult, vectors: np.ndarray, count: int) -> RoundsResult:
    """The same point along other directions, of which so many are fitted."""
    turn = vectors.T @ found.vectors
    minimum = found.minimum
    minimum = replace(minimum, theta=turn @ minimum.theta, jacobian=np.asarray(minimum.jacobian) @ turn.T)
    return replace(found, vectors=vectors, count=count, minimum=minimum)
