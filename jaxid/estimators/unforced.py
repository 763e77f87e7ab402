"""Logs of a loop without a force: starts for the fit of its position, and unknowns without a scale.

Only the simulated loop relates the unknowns to such a log. All forces, inertias and gains may be multiplied
by one factor if none of them is known: the motion is the same. One of them is then held at its guess, and
the others are given relative to it.
"""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.consistency.absent import without_scale
from jaxid.controllers.linear import PD, PID, CascadePD
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.simulated_output import choose_numerics, output_residual, position_jacobian
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import CONTROLLER, Parameters
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.replay import Numerics, Replay, make_replay
from jaxid.simulation.sensor_noise import position_noise

# Points of the coarse search, their spread about the guesses as a factor, and lanes of a compiled call.
_POINTS, _SPREAD, _LANES = 512, 6.0, 64
# Longest delay that the search tries if its guess is zero [s].
_LONGEST = 0.1
# Keys of each law that give its command a scale; without one that is known, the scale is free.
_GAINS = {CascadePD: ("kv",), PD: ("kp", "kd"), PID: ("kp", "ki", "kd")}


def scale_group(machine: Machine, log: Log) -> tuple[int, ...]:
    """Return the unknowns that may all be multiplied by one factor; empty if something known gives the scale.

    Args:
        machine: The machine at its guesses, with its controller.
        log: The log, for its positions.
    """
    law = machine.controller
    names = next((names for kind, names in _GAINS.items() if type(law) is kind), None)
    if names is None:
        return ()
    free = machine.parameters.free
    unknown = {f.path[1] for f in free if f.path[0] == CONTROLLER}
    stated = [n for n in names if n not in unknown and np.any(np.asarray(getattr(law, n)) != 0)]
    if law is None or (law.limit is not None and "limit" not in unknown):
        stated.append("limit")
    forces = without_scale(machine, log)
    if stated or not forces:
        return ()
    gains = {*names, "limit"} & unknown
    return tuple(
        k for k, f in enumerate(free) if f.name in forces or f.path[0] == CONTROLLER and f.path[1] in gains
    )


def base_of(machine: Machine, group: tuple[int, ...]) -> int:
    """Return the unknown to hold: an inertia if there is one, which a user may find elsewhere."""
    free = machine.parameters.free
    of_plant = [k for k in group if free[k].effect is None and free[k].path[0] != CONTROLLER]
    return (of_plant or list(group))[0]


def without(machine: Machine, base: int) -> Machine:
    """Return the machine with one unknown known at its guess."""
    free = machine.parameters.free
    parameters = Parameters((*free[:base], *free[base + 1 :]), machine.parameters.bodies)
    return machine.with_plant(machine.plant, parameters)


def with_free_scale(estimate: Estimate, machine: Machine, group: tuple[int, ...], base: int) -> Estimate:
    """Return an estimate that was made with one unknown held, as one in which the scale of a group is free.

    Args:
        estimate: Estimate with the base held.
        machine: The machine with all its unknowns.
        group: Unknowns that may all be multiplied by one factor.
        base: The one that was held.

    Returns:
        The estimate. Unknowns of the group are not identifiable; `details["relative"]` gives their ratios to
        the base.
    """
    free = machine.parameters.free
    guess = free[base].guess
    theta = np.insert(estimate.theta, base, guess)
    std = np.insert(estimate.std, base, 0.0)
    relative = {
        free[k].name: {
            "value": float(theta[k] / guess),
            "std": float(std[k] / guess) if np.isfinite(std[k]) else None,
            "unit": f"{free[k].unit}/({free[base].unit})",
        }
        for k in group
        if k != base
    }
    precision = free_precision(estimate.precision, machine, group, base)
    beside = estimate.std_misspecified
    if beside is not None:
        beside = np.insert(beside, base, np.nan)
        beside[list(group)] = np.nan
    names = ", ".join(free[k].name for k in group)
    note = (
        f"the log has no force, and nothing known gives one: {names} may all be multiplied by one factor; "
        "state one of them as a number (an inertia or weight that was measured, a gain of a data sheet)"
    )
    return replace(
        estimate,
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        std_misspecified=beside,
        notes=(*estimate.notes, note),
        details={**estimate.details, "relative": {"to": free[base].name, "values": relative}},
    )


def free_precision(old: Precision, machine: Machine, group: tuple[int, ...], base: int) -> Precision:
    """Return a precision with one unknown held as one in which the scale of a group is free."""
    covariance = np.insert(np.insert(old.covariance, base, np.nan, axis=0), base, np.nan, axis=1)
    identifiable = np.insert(old.identifiable, base, False)
    for k in group:
        identifiable[k] = False
        covariance[k], covariance[:, k] = np.nan, np.nan
    # Relative to their values all of the group move by the same part.
    weight = 1 / np.sqrt(len(group))
    combination = {machine.parameters.free[k].name: weight for k in group}
    white = old.equivalent_variance
    return Precision(
        covariance,
        identifiable,
        [*old.unidentifiable, combination],
        np.append(0.0, old.information),
        old.kind,
        old.curvature,
        None if white is None else np.insert(white, base, np.nan),
    )


def precision_at_guesses(machine: Machine, log: Log) -> Precision:
    """Return the precision that a log without a force allows at best, by its simulated loop at the guesses.

    Args:
        machine: The machine at its guesses.
        log: The log, whose encoders have white noise.
    """
    group = scale_group(machine, log)
    base = base_of(machine, group) if group else None
    fitted = machine if base is None else without(machine, base)
    jacobian = position_jacobian(fitted, log, choose_numerics(fitted, log))
    noise = np.random.default_rng(0).standard_normal(log.filled.shape) * position_noise(machine, log)
    guess = fitted.parameters.guess
    precision = assess(
        fitted.parameters.names,
        jacobian,
        noise,
        np.broadcast_to(np.array(log.measured), noise.shape),
        float(np.linalg.norm(log.filled - log.filled.mean(axis=0))),
        np.where(guess != 0, guess, 1.0),
    )
    return precision if base is None else free_precision(precision, machine, group, base)


def coarse_starts(
    machine: Machine, log: Log, numerics: Numerics, count: int = 3
) -> list[Float[np.ndarray, " p"]]:
    """Return starts of a fit: the guesses, and the best of many points about them in simulation.

    The points are a Sobol sequence in the logarithms of the unknowns that must be positive, within a factor
    of six of their guesses. A delay is tried from zero on. Unknowns of free sign stay at their guesses.

    Args:
        machine: The machine with its guesses.
        log: The log.
        numerics: Settings of the integration.
        count: Number of points beside the guesses.
    """
    unknown = machine.parameters
    guess, (lower, upper) = unknown.guess, unknown.bounds
    delays = np.array([f.path[0] == CONTROLLER and f.path[1] == "delay" for f in unknown.free])
    moved = np.array([f.sign != "free" for f in unknown.free]) & ((guess > 0) | delays)
    if not moved.any():
        return [guess]
    sampler = scipy.stats.qmc.Sobol(int(moved.sum()), scramble=False)
    draws = sampler.random(_POINTS)
    points = np.tile(guess, (_POINTS, 1))
    points[:, moved] = guess[moved] * _SPREAD ** (2 * draws - 1)
    longest = np.maximum(_SPREAD * guess, _LONGEST)
    for k in np.flatnonzero(delays):
        points[:, k] = longest[k] * draws[:, int(np.sum(moved[:k]))]
    points = np.clip(points, lower, upper)

    replay = make_replay(machine, log, numerics)
    measured = jnp.asarray(log.filled)
    weight = jnp.asarray(np.array(log.measured, float)) * jnp.ones(measured.shape)
    parts = [
        np.asarray(_costs(replay, unknown.places, machine.plant, measured, weight, points[k : k + _LANES]))
        for k in range(0, _POINTS, _LANES)
    ]
    costs = np.nan_to_num(np.concatenate(parts), nan=np.inf)
    best = np.argsort(costs, kind="stable")[:count]
    return [guess, *points[best]]


@eqx.filter_jit
def _costs(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, points: Array
) -> Array:
    residual = output_residual(replay, places, plant, measured, weight)
    return jax.vmap(lambda theta: jnp.sum(jnp.square(residual(theta))))(points)
