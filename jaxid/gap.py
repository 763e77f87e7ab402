"""How far simulation and measurement are apart, and what the sensors' noise alone would leave."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.session import OpenedLog
from jaxid.simulation.force_balance import ForceData, force_residual, measured_force, sharpened
from jaxid.simulation.replay import (
    Replay,
    exact_numerics,
    from_rest,
    make_replay,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError

# In a loop an error of the start dies out. On a log of at most so many samples it may not be small
# beside the rest, and the start is fitted too where that explains more than so many times chance; on a longer
# one a start at rest is tried where the start shows.
SHORT = 2000


@dataclass(frozen=True)
class ForceGap:
    """Force measured minus force by inverse dynamics, at the kept samples.

    Args:
        residual: (kept, n) [N or N m]; NaN at rest.
        measured: (kept, n), through the same filter; zero where no joint is driven.
        rms: By joint.
        relative: 2-norm of the residual over that of the measured force, by joint; NaN where none is
            driven.
    """

    residual: Float[np.ndarray, "kept n"]
    measured: Float[np.ndarray, "kept n"]
    rms: Float[np.ndarray, " n"]
    relative: Float[np.ndarray, " n"]


@eqx.filter_jit
def _force_gap(plant: Plant, data: ForceData) -> tuple[Array, Array]:
    return -force_residual(plant, data), measured_force(plant, data)


def force_gap(machine: Machine, data: Prepared) -> ForceGap:
    """Gap between measured force and inverse dynamics, samples at rest left out."""
    residual, measured = _force_gap(sharpened(machine.plant, data), ForceData.of(data))
    residual = np.where(data.moving, np.asarray(residual), np.nan)
    counted = np.where(data.moving, np.asarray(measured), np.nan)
    norm, size = (np.sqrt(np.nansum(x**2, axis=0)) for x in (residual, counted))
    # Of a joint that never moves nothing is said.
    samples = np.sum(np.isfinite(residual), axis=0)
    return ForceGap(
        residual,
        np.asarray(measured),
        norm / np.sqrt(np.where(samples > 0, samples, np.nan)),
        norm / np.where(size > 0, size, np.nan),
    )


@dataclass(frozen=True)
class SimulationGap:
    """Measured minus simulated position, and what the simulated loop commanded.

    Args:
        position: Simulated, (time, n) [m or rad].
        command: Simulated, (time, m); None in open loop.
        rms: Of the difference in position, by joint.
        relative: 2-norm of the difference over that of the measured position, by joint.
        command_relative: The same of the command; None in open loop.
    """

    position: Float[np.ndarray, "time n"]
    command: Float[np.ndarray, "time m"] | None
    rms: Float[np.ndarray, " n"]
    relative: Float[np.ndarray, " n"]
    command_relative: Float[np.ndarray, " m"] | None


_run = eqx.filter_jit(lambda replay, plant: replay(plant))


def simulation_gap(machine: Machine, replay: Replay, log: Log) -> SimulationGap:
    """Gap between measured and simulated position; NaN of joints without an encoder."""
    run = _run(replay, machine.plant)
    position = np.asarray(run.position)
    gap = log.position - position
    closed = replay.controller is not None
    command = np.asarray(run.command) if closed else None
    return SimulationGap(
        position,
        command,
        np.sqrt(np.mean(gap**2, axis=0)),
        np.linalg.norm(gap, axis=0) / np.linalg.norm(log.position, axis=0),
        np.linalg.norm(log.force - command, axis=0) / np.linalg.norm(log.force, axis=0) if closed else None,
    )


def noise_floor(machine: Machine, log: Log, data: Prepared) -> Float[np.ndarray, " n"]:
    """RMS force that the sensors' noise alone leaves in the band [N or N m], by joint."""
    f, power = noise_density(machine, log, data)
    return np.sqrt(np.trapezoid(power, f, axis=0))


def noise_density(
    machine: Machine,
    log: Log,
    data: Prepared,
    force_noise: Float[np.ndarray, " m"] | None = None,
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f n"]]:
    """One-sided density of the force that the sensors' noise alone leaves [N^2/Hz], by joint.

    Position noise passes the plant's impedance -M w^2 + i C w + K (linearised at a typical
    velocity), the response of each derivative and the parallel filter; force noise passes the
    parallel filter. The noise is the case's `[sensor]`; where that is silent, position noise is read
    off the high band of the log and the logged force counts as exact.

    Args:
        machine: The machine; its parameters enter through the impedance only.
        log: The log.
        data: The same, prepared.
        force_noise: Standard deviation of the logged force where the case states none.

    Returns:
        Frequencies up to half the log's sampling rate [Hz], and the density there.
    """
    rate, recipe = log.rate_hz, data.recipe
    f = np.linspace(0, rate / 2, 2049)[1:]
    sigma = position_noise(machine, log)
    mass, damping, stiffness = (np.asarray(a) for a in _impedance(machine.plant, ForceData.of(data)))
    w = 2 * np.pi * f[:, None, None]
    stiff, damped, heavy = (recipe.response(f, rate, k)[:, None, None] for k in range(3))
    impedance = _seen(
        -mass * w**2 * heavy + 1j * w * damping * damped + stiffness * stiff,
        -mass * w**2 + 1j * w * damping + stiffness,
        data.measured,
    )
    through = recipe.decimator.response(f, rate)
    density = 2 * np.square(np.broadcast_to(sigma, (len(mass),))) / rate
    power = np.einsum("fij,j->fi", np.abs(impedance) ** 2, density) * through[:, None] ** 2
    stated = machine.sensor.force_noise
    force_noise = force_noise if stated is None else stated
    if force_noise is not None:
        by_drive = jnp.asarray(2 * np.square(np.asarray(force_noise) * machine.gain) / rate)
        white = np.asarray(machine.plant.applied(by_drive, len(mass)))
        power = power + white * recipe.decimator.response(f, rate)[:, None] ** 2
    return f, power


def _seen(impedance: np.ndarray, exact: np.ndarray, measured: tuple[bool, ...]) -> np.ndarray:
    """Of the joints that have an encoder, the others moving as they must by the exact one; zero of those."""
    if all(measured):
        return impedance
    seen, hidden = np.flatnonzero(measured), np.flatnonzero(~np.array(measured))
    part = lambda i, j: impedance[:, i[:, None], j]
    own = lambda i, j: exact[:, i[:, None], j]
    through = part(seen, hidden) @ np.linalg.solve(own(hidden, hidden), own(hidden, seen))
    out = np.zeros_like(impedance)
    out[:, seen[:, None], seen] = part(seen, seen) - through
    return out


@eqx.filter_jit
def _impedance(plant: Plant, data: ForceData) -> tuple[Array, Array, Array]:
    """Mass, damping and stiffness of the balance at the middle position, at RMS velocity."""
    q, v = jnp.median(data.q, axis=0), jnp.sqrt(jnp.mean(data.qd**2, axis=0))
    u = jnp.median(data.force, axis=0)
    own = plant.initial_states(u)

    def residual(q: Array, v: Array, a: Array) -> Array:
        return plant.balance(q, v, a, u, jnp.zeros(()), own).residual

    stiffness, damping, mass = jax.jacfwd(residual, argnums=(0, 1, 2))(q, v, jnp.zeros_like(q))
    return mass, damping, stiffness


@dataclass(frozen=True)
class Gap:
    """How far a machine is from one log.

    Args:
        name: Of the log.
        force: In force, by inverse dynamics.
        simulation: In position, by simulation; None where it diverges.
    """

    name: str
    force: ForceGap
    simulation: SimulationGap | None


def gaps(machine: Machine, runs: Sequence[OpenedLog]) -> tuple[Gap, ...]:
    """Gap of a machine on each log."""
    return tuple(
        Gap(r.name, force_gap(r.machine(machine), r.data), _shown(r.machine(machine), r.log)) for r in runs
    )


def _shown(machine: Machine, log: Log) -> SimulationGap | None:
    """The gap in position; in a loop that of a start at rest where it shows, or may, and is nearer.

    Where a log begins with a jerk, a parabola through its first readings is no velocity, however few:
    six masses that start from rest were off by up to half a millimetre, whatever the parameters.
    """
    gap = simulated(machine, log)
    if gap is None or gap.command is None:
        return gap
    if log.samples > SHORT and not start_shows((log.position - gap.position)[:, list(log.measured)]):
        return gap
    rested = simulated(machine, log, at_rest=True)
    nearer = rested is not None and np.nansum(rested.rms**2) < np.nansum(gap.rms**2)
    return rested if nearer else gap


def simulated(machine: Machine, log: Log, *, at_rest: bool = False) -> SimulationGap | None:
    """Gap in position over the whole log; None where the simulation cannot run or diverges."""
    if machine.controller is not None and log.reference is None and machine.unknown_reference is None:
        machine = replace(machine, controller=None)
    # Nothing is differentiated here: friction sticks exactly, break-away friction too.
    try:
        numerics = exact_numerics(machine, log)
    except TooStiffError:
        return None
    replay = make_replay(machine, log, numerics)
    replay = from_rest(replay) if at_rest else with_fitted_start(replay, machine.plant, log)
    gap = simulation_gap(machine, replay, log)
    seen = list(log.measured)
    return gap if np.all(np.isfinite(gap.rms[seen])) and np.all(gap.relative[seen] < 1e3) else None
