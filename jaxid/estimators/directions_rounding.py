"""What rounding of readings does to a fit that simulates its loop without: found by simulating it.

In a loop with a coarse encoder the instant at which a reading steps is chaotic, and what it does to the
force is neither small nor white, nor the same elsewhere within the prior. So data are drawn over all of that
and a line is laid through what the fit makes of those like the log's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.directions_precision import Told, told_of
from jaxid.estimators.directions_problem import (
    DRAWN,
    NO_PULL,
    STAYS,
    Found,
    Problem,
    at_each,
    at_each_soon,
    columns,
    descent,
)
from jaxid.estimators.steps import Soon, Steps
from jaxid.machine import Machine
from jaxid.replay import with_sensor

# A direction that changes so small a part of what another does is not felt.
_UNFELT = 1e-6
# Data are drawn so many deviations around the estimate, but over this part of the prior at most; the nearest
# of them count.
_REACH, _MOST = 8.0, 2.0
_NEAREST = 0.3
# Then anew within so many of the deviations found, as long as that is less than half as far.
_AGAIN, _PASSES = 4.0, 4
# Fits of so many evaluations until one settles.
_TRIES = 3
# With fewer that did not run away nothing is told.
_FEWEST = 100
# Least part of a residual that is noise.
_OWN = 0.1


def rounds(machine: Machine, problem: Problem) -> bool:
    """Whether the loop reads by counts that its simulation left out."""
    coarse = machine.sensor.position_resolution is not None and problem.on != "position"
    return coarse and problem.replay.controller is not None


def draws_soon(machine: Machine, problem: Problem) -> Soon:
    """What `off_by_rounding` will ask for."""
    return at_each_soon(_rounding(machine, problem))


def _rounding(machine: Machine, problem: Problem) -> Problem:
    """The same with rounding in its loop."""
    return replace(problem, replay=with_sensor(problem.replay, machine.sensor))


def drawn_roundings(
    machine: Machine, problem: Problem, draws: int
) -> Float[np.ndarray, "draws rows"] | None:
    """What rounding does to a residual at the guesses, the start anywhere within its first count.

    Args:
        machine: Its sensor rounds.
        problem: At whose guesses.
        draws: How many, at least.

    Returns:
        Residuals less their mean; None where the loop's readings are not rounded.
    """
    if not rounds(machine, problem):
        return None
    rng, size = np.random.default_rng(2), problem.prior.base.size
    shape, still = (DRAWN, problem.replay.position.size), np.zeros((DRAWN, size))
    count, rounding = np.asarray(machine.sensor.position_resolution), _rounding(machine, problem)
    asked = [
        at_each(rounding, still, rng.uniform(-0.5, 0.5, shape) * count) for _ in range(-(-draws // DRAWN))
    ]
    e = [function(*args) for function, args in asked]
    e = np.concatenate([np.asarray(x).reshape(DRAWN, -1) for x in e])[:draws]
    return e - e.mean(axis=0)


def sifted(machine: Machine, found: Found) -> Steps[tuple[Found, Told | None]]:
    """Let go of directions that are told only as long as noise counts as white, and fit the rest again.

    What rounding of the readings does in the loop moves an estimate farther along them than its prior would
    let it.
    """
    ended = False
    while found.count and np.all(np.isfinite(found.minimum.jacobian)):
        stays, told = _felt(found), None
        if np.all(stays):
            told = told_of(found)
            off, covariance = yield from off_by_rounding(machine, found, told.std)
            told = replace(told, covariance=covariance)
            stays = told.std <= STAYS
        if ended and told is not None and np.all(stays):
            return (yield from _moved(found, off)), told
        rest = np.arange(found.count, len(found.vectors))
        order = np.concatenate([np.flatnonzero(stays), np.flatnonzero(~stays), rest])
        vectors, count = found.vectors[:, order], int(stays.sum())
        some = columns(vectors, count)
        fitted = np.arange(some.shape[1]) < count
        z = np.where(fitted, some.T @ found.point, 0.0)
        origin = np.zeros(len(vectors))
        last, pull = found.problem.ladder[-1], np.asarray(found.problem.noise(found.minimum, found.count))
        settled, spent = False, found.evaluations
        for _ in range(_TRIES):
            if not settled:
                minimum = yield from descent(found.problem, last, pull, origin, some, z, fitted)
                z, settled = np.asarray(minimum.theta), bool(minimum.converged)
                spent += int(minimum.steps)
        found = replace(
            found, vectors=vectors, count=count, minimum=minimum, evaluations=spent, settled=settled
        )
        ended = True
    return found, None


def _felt(found: Found) -> Bool[np.ndarray, " r"]:
    """Which fitted directions still change anything: not those that end where an unknown is at its bound."""
    triangle = np.linalg.qr(np.asarray(found.minimum.jacobian)[:, : found.count], mode="r")
    size = np.abs(np.diag(triangle))
    return size > _UNFELT * size.max()


def _moved(found: Found, off: Float[np.ndarray, " r"]) -> Steps[Found]:
    """The fit with its directions elsewhere; nothing is fitted."""
    z = np.array(found.minimum.theta)
    z[: found.count] += off
    last, nothing = found.problem.ladder[-1], np.zeros(z.size, bool)
    origin = np.zeros(len(found.vectors))
    there = yield from descent(found.problem, last, NO_PULL, origin, found.first, z, nothing)
    if not np.all(np.isfinite(there.jacobian)):
        return found
    return replace(found, minimum=there, evaluations=found.evaluations + 1)


def off_by_rounding(
    machine: Machine, found: Found, std: Float[np.ndarray, " r"]
) -> Steps[tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]]:
    """How far the truth is from the estimate, by simulation.

    Args:
        machine: Its sensor rounds.
        found: The fit, of one direction at least.
        std: Standard deviations of the directions' coordinates without rounding.

    Returns:
        By how much the truth is elsewhere on average, for a loop that rounds is on average not as one that
        does not; and the covariance about that, the prior's where too many data ran away.

    Source:
        Beaumont, Zhang and Balding (2002), "Approximate Bayesian computation in population genetics":
        local linear regression on a summary, here the estimate of one Gauss-Newton step.
    """
    reach = np.minimum(_REACH * (yield from _scatter(machine, found, std)), _MOST)
    for _ in range(_PASSES):
        off, covariance = yield from _within(machine, found, reach)
        closer = np.minimum(_AGAIN * np.sqrt(np.diag(covariance) + off**2), reach)
        if np.all(closer > 0.5 * reach):
            break
        reach = closer
    # What is less than its own deviation is not told: it is not corrected, but counts.
    told = off**2 > np.diag(covariance)
    left = np.where(told, 0.0, off)
    return np.where(told, off, 0.0), covariance + np.outer(left, left)


def _scatter(
    machine: Machine, found: Found, std: Float[np.ndarray, " r"]
) -> Steps[Float[np.ndarray, " r"]]:
    """Standard deviations with what rounding at the estimate does to one Gauss-Newton step: their size."""
    problem = found.problem
    starts = np.random.default_rng(3).uniform(-0.5, 0.5, (DRAWN, problem.replay.position.size))
    starts = starts * np.asarray(machine.sensor.position_resolution)
    w = np.tile(found.point, (DRAWN, 1))
    e = np.asarray((yield at_each(_rounding(machine, problem), w, starts))).reshape(DRAWN, -1)
    e = e[np.all(np.isfinite(e), axis=1)]
    if len(e) < _FEWEST:
        return np.full(std.shape, _MOST)
    inverse = np.linalg.pinv(np.asarray(found.minimum.jacobian)[:, : found.count])
    return np.hypot(std, np.std(e @ inverse.T, axis=0))


def _within(
    machine: Machine, found: Found, reach: Float[np.ndarray, " r"]
) -> Steps[tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]]:
    """The same from data drawn so far around the estimate."""
    problem, r, rng = found.problem, found.count, np.random.default_rng(0)
    best, n = np.asarray(found.minimum.theta), problem.replay.position.size
    count = np.asarray(machine.sensor.position_resolution)
    starts = rng.uniform(-0.5, 0.5, (DRAWN, n)) * count
    off = rng.uniform(-1.0, 1.0, (DRAWN, r)) * reach
    z = np.tile(best, (DRAWN, 1))
    z[:, :r] += off
    # In units of the prior, not of the directions: one compiled call, however many of them there are.
    w = z @ found.first.T
    # What is held is anywhere within its prior too; where the motor starts is drawn already.
    held = rng.standard_normal((DRAWN, len(found.vectors) - r)) @ found.vectors[:, r:].T
    own = slice(0, len(problem.places))
    w[:, own] += held[:, own]
    e = np.asarray((yield at_each(_rounding(machine, problem), w, starts)))
    # Of data drawn, less what the estimate says: what a fit of them would begin with.
    shape = problem.measured.shape
    apart = (np.asarray(found.minimum.residual).reshape(shape) - e).reshape(DRAWN, -1)
    # Far from the estimate a loop may run away.
    sound = np.all(np.isfinite(apart), axis=1)
    if sound.sum() < _FEWEST:
        return np.zeros(r), np.eye(r)
    apart, off = apart[sound], off[sound]
    jacobian = np.asarray(found.minimum.jacobian)[:, :r]
    inverse = np.linalg.pinv(jacobian)
    prior = np.exp(-0.5 * np.sum((best[:r] + off) ** 2, axis=1))
    weight = prior * _near(-apart @ inverse.T)
    left = (apart - apart @ inverse.T @ jacobian.T).reshape(-1, *shape)
    own = _own_noise(np.asarray(found.minimum.residual).reshape(shape), left, weight)
    apart = apart + (rng.standard_normal((len(apart), *shape)) * own).reshape(len(apart), -1)
    ended = -apart @ inverse.T
    return _about_zero(ended, off, prior * _near(ended))


def _near(ended: Float[np.ndarray, "draws r"]) -> Float[np.ndarray, " draws"]:
    """Weights of data whose fits end near the log's own."""
    scale = np.maximum(np.median(np.abs(ended), axis=0), 1e-300)
    distance = np.sum((ended / scale) ** 2, axis=1)
    return np.maximum(1.0 - distance / np.quantile(distance, _NEAREST), 0.0)


def _own_noise(
    residual: Float[np.ndarray, "time k"], left: Float[np.ndarray, "draws time k"],
    weight: Float[np.ndarray, " draws"],
) -> Float[np.ndarray, " k"]:
    """Standard deviation of what rounding does not explain of a residual, by column."""
    power = np.mean(residual**2, axis=0)
    explained = np.average(np.mean(left**2, axis=1), axis=0, weights=weight)
    return np.sqrt(np.maximum(power - explained, _OWN * power))


def _about_zero(
    x: Float[np.ndarray, "draws r"], y: Float[np.ndarray, "draws r"], weight: Float[np.ndarray, " draws"]
) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r r"]]:
    """Of y where x is zero: a weighted line's value there, and the covariance around it."""
    rows = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    root = np.sqrt(weight)[:, None]
    line = np.linalg.lstsq(rows * root, y * root)[0]
    left = y - rows @ line
    weight = weight / weight.sum()
    # The line's value is itself of so many draws.
    return line[0], (left * weight[:, None]).T @ left * (1.0 + np.sum(weight**2))
