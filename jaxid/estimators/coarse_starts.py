"""Starts for the fit of a simulated loop: the best of many points about the guesses, in simulation."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.several.parts import Part
from jaxid.estimators.several.weights import start_weights
from jaxid.estimators.simulated_output import output_residual
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import CONTROLLER
from jaxid.simulation.replay import Numerics, Replay, make_replay

# Points of the coarse search, their spread about the guesses as a factor, and lanes of a compiled call.
_POINTS, _SPREAD, _LANES = 512, 6.0, 64
# Points that are simulated along all of several logs; the best ones along the fastest log.
_FINALISTS = 64
# Longest delay that the search tries if its guess is zero [s].
_LONGEST = 0.1


def coarse_starts(
    machine: Machine,
    parts: Sequence[Part],
    numerics: Sequence[Numerics],
    count: int = 3,
    ratios: Sequence[str] = (),
) -> list[Float[np.ndarray, " p"]]:
    """Return starts of a fit: the guesses, and the best of many points about them in simulation.

    The points are a Sobol sequence in the logarithms of the unknowns that must be positive, within a factor
    of six of their guesses. A delay is tried from zero on. Unknowns of free sign stay at their guesses. A
    parameter with a value of its own in each log is the same in all of them. Of several logs the fastest one
    chooses the points that are simulated along all, and the guesses take their place among the others.

    Args:
        machine: Machine of all logs with its guesses.
        parts: The logs.
        numerics: Settings of the integration of each.
        count: Number of points beside the guesses.
        ratios: Names of unknowns that count relative to one that is held, so that the errors of two guesses
            are in them. They vary by the square of the factor.
    """
    points = points_about(machine, ratios=ratios)
    if points is None:
        return [machine.parameters.guess]
    if len(parts) == 1:
        costs = costs_along(parts[0], numerics[0], points[1:])
        best = np.argsort(costs, kind="stable")[:count]
        return [points[0], *points[1 + best]]

    fastest = int(np.argmax([_speed(part) for part in parts]))
    ranked = np.argsort(costs_along(parts[fastest], numerics[fastest], points), kind="stable")
    # The guesses stay in any case.
    kept = points[np.unique(np.append(ranked[: _FINALISTS - 1], 0))]
    signals = [float(np.linalg.norm(part.log.filled - part.log.filled.mean(axis=0))) for part in parts]
    weights = start_weights(signals, [part.log.filled.size for part in parts])
    logs = zip(weights, parts, numerics, strict=True)
    costs = np.sum([weight * costs_along(part, stated, kept) for weight, part, stated in logs], axis=0)
    return list(kept[np.argsort(costs, kind="stable")[: count + 1]])


def points_about(
    machine: Machine, count: int = _POINTS, ratios: Sequence[str] = ()
) -> Float[np.ndarray, "points p"] | None:
    """Return the guesses and so many points about them; None if no unknown moves.

    Args:
        machine, ratios: As in `coarse_starts`.
        count: Number of points, a power of two.
    """
    unknown = machine.parameters
    guess, (lower, upper) = unknown.guess, unknown.bounds
    delays = np.array([f.path[0] == CONTROLLER and f.path[1] == "delay" for f in unknown.free])
    moved = np.array([f.sign != "free" for f in unknown.free]) & ((guess > 0) | delays)
    if not moved.any():
        return None
    names = list(dict.fromkeys(f.parameter for f, m in zip(unknown.free, moved, strict=True) if m))
    draws = scipy.stats.qmc.Sobol(len(names), scramble=False).random(count)
    points = np.tile(guess, (count, 1))
    for k in np.flatnonzero(moved):
        own = draws[:, names.index(unknown.free[k].parameter)]
        longest = max(_SPREAD * guess[k], _LONGEST)
        spread = _SPREAD**2 if unknown.free[k].name in ratios else _SPREAD
        points[:, k] = longest * own if delays[k] else guess[k] * spread ** (2 * own - 1)
    return np.concatenate([guess[None], np.clip(points, lower, upper)])


def _speed(part: Part) -> float:
    """Return the largest RMS velocity of a joint over the spread of its position [1/s]."""
    q = part.log.filled
    spread = np.maximum(np.std(q, axis=0), 1e-300)
    return float(np.max(np.sqrt(np.mean(np.diff(q, axis=0) ** 2, axis=0)) / spread) / part.log.period)


def costs_along(
    part: Part, numerics: Numerics, points: Float[np.ndarray, "points p"], lanes: int = _LANES
) -> Float[np.ndarray, " points"]:
    """Return the squared residual of a log at each point; infinite where the loop diverges.

    Args:
        part: The log.
        numerics: Settings of the integration.
        points: Values of the unknowns of all logs, (points, p).
        lanes: Points in a compiled call.
    """
    machine, log, own = part.machine, part.log, points[:, part.index]
    replay = make_replay(machine, log, numerics)
    measured = jnp.asarray(log.filled)
    weight = jnp.asarray(np.array(log.measured, float)) * jnp.ones(measured.shape)
    whole = -(-len(own) // lanes) * lanes
    # Whole calls, so that one shape of compiled code serves them.
    filled = own[np.minimum(np.arange(whole), len(own) - 1)]
    places, plant = machine.parameters.places, machine.plant
    costs = [
        np.asarray(_costs(replay, places, plant, measured, weight, filled[k : k + lanes]))
        for k in range(0, whole, lanes)
    ]
    return np.nan_to_num(np.concatenate(costs)[: len(own)], nan=np.inf)


@eqx.filter_jit
def _costs(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, points: Array
) -> Array:
    residual = output_residual(replay, places, plant, measured, weight)
    return jax.vmap(lambda theta: jnp.sum(jnp.square(residual(theta))))(points)
