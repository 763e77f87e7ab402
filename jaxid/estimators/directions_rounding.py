"""What rounding of readings does to a fit that simulates its loop without: found by simulating it.

In a loop with a coarse encoder the instant at which a reading steps is chaotic, and what it does to the
force is neither small nor white, nor the same elsewhere within the prior. So data are drawn over all of that
and a line is laid through what the fit makes of those like the log's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxid.estimators.directions_problem import Found, Problem, residual_of
from jaxid.estimators.steps import Solve, Soon, Steps
from jaxid.machine import Machine
from jaxid.replay import with_sensor

_DRAWS = 512
# Data are drawn so many deviations around the estimate, but over this part of the prior at least, and this
# at most; the nearest of them count.
_REACH, _LEAST, _MOST = 8.0, 0.8, 2.0
_NEAREST = 0.3
# Then anew within so many of the deviations found, as long as that is less than half as far.
_AGAIN, _PASSES = 4.0, 4
# With fewer that did not run away nothing is told.
_FEWEST = 100
# Least part of a residual that is noise.
_OWN = 0.1


@eqx.filter_jit
def _each(*args: Any) -> Array:
    *problem, sharpness, w, starts = args
    replay, places, plant, *rest = problem
    plant = replace(plant, sharpness=sharpness)
    moved = lambda start: eqx.tree_at(lambda r: r.position, replay, replay.position + start)
    at = lambda w, start: residual_of(moved(start), places, plant, *rest, jnp.eye(w.size))(w)
    return eqx.filter_vmap(at)(w, starts)


def rounds(machine: Machine, problem: Problem) -> bool:
    """Whether the loop reads by counts that its simulation left out."""
    coarse = machine.sensor.position_resolution is not None and problem.on != "position"
    return coarse and problem.replay.controller is not None


def draws_soon(machine: Machine, problem: Problem) -> Soon:
    """What `covariance_with_rounding` will ask for."""
    n, size = problem.replay.position.size, problem.prior.base.size
    args = (*_args(machine, problem), np.zeros((_DRAWS, size)), np.zeros((_DRAWS, n)))
    return Soon(_each, args, (_each, jax.tree.structure(args), problem.measured.shape))


def _args(machine: Machine, problem: Problem) -> tuple:
    return with_sensor(problem.replay, machine.sensor), *problem.args[1:], problem.ladder[-1]


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
    shape, still = (_DRAWS, problem.replay.position.size), np.zeros((_DRAWS, size))
    count, args = np.asarray(machine.sensor.position_resolution), _args(machine, problem)
    parts = -(-draws // _DRAWS)
    e = [_each(*args, still, rng.uniform(-0.5, 0.5, shape) * count) for _ in range(parts)]
    e = np.concatenate([np.asarray(x).reshape(_DRAWS, -1) for x in e])[:draws]
    return e - e.mean(axis=0)


def covariance_with_rounding(
    machine: Machine, found: Found, std: Float[np.ndarray, " r"]
) -> Steps[Float[np.ndarray, "r r"]]:
    """Mean square of the truth's distance from the estimate, by simulation.

    Args:
        machine: Its sensor rounds.
        found: The fit, of one direction at least.
        std: Standard deviations of the directions' coordinates without rounding.

    Returns:
        About the estimate, what is off on average included; the prior's where too many data ran away.

    Source:
        Beaumont, Zhang and Balding (2002), "Approximate Bayesian computation in population genetics":
        local linear regression on a summary, here the estimate of one Gauss-Newton step.
    """
    reach = np.clip(_REACH * std, _LEAST, _MOST)
    for _ in range(_PASSES):
        covariance = yield from _within(machine, found, reach)
        closer = np.minimum(_AGAIN * np.sqrt(np.diag(covariance)), reach)
        if np.all(closer > 0.5 * reach):
            break
        reach = closer
    return covariance


def _within(
    machine: Machine, found: Found, reach: Float[np.ndarray, " r"]
) -> Steps[Float[np.ndarray, "r r"]]:
    """The same from data drawn so far around the estimate."""
    problem, r, rng = found.problem, found.count, np.random.default_rng(0)
    best, n = np.asarray(found.minimum.theta), problem.replay.position.size
    count = np.asarray(machine.sensor.position_resolution)
    starts = rng.uniform(-0.5, 0.5, (_DRAWS, n)) * count
    off = rng.uniform(-1.0, 1.0, (_DRAWS, r)) * reach
    z = np.tile(best, (_DRAWS, 1))
    z[:, :r] += off
    # In units of the prior, not of the directions: one compiled call, however many of them there are.
    w = z @ found.first.T
    e = np.asarray((yield Solve(_each, (*_args(machine, problem), w, starts))))
    # Of data drawn, less what the estimate says: what a fit of them would begin with.
    shape = problem.measured.shape
    apart = (np.asarray(found.minimum.residual).reshape(shape) - e).reshape(_DRAWS, -1)
    # Far from the estimate a loop may run away.
    sound = np.all(np.isfinite(apart), axis=1)
    if sound.sum() < _FEWEST:
        return np.eye(r)
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
) -> Float[np.ndarray, "r r"]:
    """Mean square of y where x is zero: a weighted line's value there, and what is left around it."""
    rows = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    root = np.sqrt(weight)[:, None]
    line = np.linalg.lstsq(rows * root, y * root)[0]
    left = y - rows @ line
    return (left * weight[:, None]).T @ left / weight.sum() + np.outer(line[0], line[0])
