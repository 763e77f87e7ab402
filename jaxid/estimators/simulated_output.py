"""Simulated output of a log beside the measured one: their difference, and the settings of the simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.tangents import varying
from jaxid.simulation.loops import Drive, needed_substeps
from jaxid.simulation.replay import (
    LONGEST_MEMORY,
    Numerics,
    Replay,
    exact_numerics,
    make_replay,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.solvers import RELATIVE

# An open-loop run whose RMS distance from the log exceeds this part of the log's standard deviation is cut
# into segments.
_LOST = 0.5
# See `turning_steps`: factor of a step's error, its allowed part of the noise, and the most steps.
_TURNING = 0.04
_LITTLE = 0.1
_MOST = 4
# Least steps a sample of a free motion.
_FREE = 4
# Number of segments; each is long enough to show friction and short enough not to drift away.
_SEGMENTS = 40


def output_residual(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    on: str = "position",
    noise: Array | None = None,
) -> Callable[[Array], Array]:
    """Return measured minus simulated output as a function of the unknowns, (time, k), weighted.

    The unknowns may end with changes of the position and velocity at the start, (2 n,). `noise` is that of
    `jaxid.simulation.replay.Replay`.
    """

    def residual(theta: Array) -> Array:
        extra = theta[len(places) :]
        nudge = extra if extra.size else None
        start = varying((jnp.asarray(replay.position), jnp.asarray(replay.velocity)), theta)
        begun = eqx.tree_at(lambda r: (r.position, r.velocity), replay, start)
        run = begun.following(places, theta)(scatter(places, plant, theta), nudge, noise)
        outputs: dict[str, tuple[Array, ...]] = {
            "position": (run.position,),
            "velocity": (run.velocity,),
            "force": (replay.drive.gain * run.command,),
        }
        outputs["both"] = outputs["position"] + outputs["force"]
        return weight * (measured - jnp.concatenate(outputs[on], axis=1))

    return residual


def need_loop(machine: Machine, log: Log, what: str, other: str) -> None:
    """Refuse an open loop, whose force is the logged one, so that the fit would compare it with itself.

    Args:
        machine: The machine that is simulated.
        log: The log, named in the message.
        what: Request that needs the loop, for the message.
        other: Alternative to naming the controller, for the hint.

    Raises:
        InputError: If the machine has no controller.
    """
    if machine.controller is None:
        raise InputError(
            f"{what} needs a loop, whose simulation gives a force",
            where=log.source,
            hint=f"name the controller in [controller] and the reference's column in [log], {other}",
        )


def need_output_force(machine: Machine, log: Log, on: str) -> None:
    """Refuse a fit of a force that was not logged.

    Raises:
        InputError: If the log has no force.
    """
    if machine.unforced(log):
        raise InputError(
            f"the log has no force, which a fit on {on} compares", where=log.source, hint="fit position"
        )


def measured_output(machine: Machine, log: Log, on: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a log's output, (time, k), and the mask of columns that count; see `output_residual`."""
    force = log.force * machine.gain
    outputs = {"position": (log.filled,), "force": (force,), "both": (log.filled, force)}
    outputs["velocity"] = (log.readings,)
    counts = {"position": log.measured, "velocity": log.measured, "force": (True,) * force.shape[1]}
    counts["both"] = counts["position"] + counts["force"]
    return np.concatenate(outputs[on], axis=1), np.array(counts[on])


def position_jacobian(machine: Machine, log: Log, numerics: Numerics) -> np.ndarray:
    """Return the derivative of the simulated position by the unknowns at their guesses, (time, n, p).

    Args:
        machine: The machine to simulate.
        log: Log whose input drives the machine.
        numerics: Settings of the integration.
    """
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    unknown = machine.parameters
    measured = jnp.asarray(log.filled)
    return -np.asarray(_jacobian(replay, unknown.places, machine.plant, measured, unknown.guess))


def position_gap(machine: Machine, log: Log, numerics: Numerics) -> np.ndarray:
    """Return measured minus simulated position at the guesses, (time, n); see `position_jacobian`."""
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    return log.filled - np.asarray(_position(replay, machine.plant))


@kept_jit
def _position(replay: Replay, plant: Plant) -> Array:
    return replay(plant).position


@kept_jit
def _jacobian(replay: Replay, places: tuple, plant: Plant, measured: Array, theta: Array) -> Array:
    residual = output_residual(replay, places, plant, measured, jnp.ones(measured.shape))
    return jax.jacfwd(residual)(theta)


def forgets(machine: Machine, numerics: Numerics, theta: np.ndarray) -> bool:
    """Check that a fitted delay reaches the end of the past commands, and that a loop can keep more."""
    if machine.controller is None or not 0 < numerics.longest_delay <= LONGEST_MEMORY // 2:
        return False
    fitted = machine.with_estimate(theta).plant
    delay = float(np.max(np.asarray(fitted.command_delays(machine.gain.size))))
    return bool(delay >= (numerics.longest_delay - 1) * machine.controller.period)


def kept_delay(machine: Machine, numerics: Numerics) -> dict[str, float]:
    """Return the longest delay that a simulated loop has, `longest_delay` [s]; empty without any delay."""
    if machine.controller is None or not numerics.longest_delay:
        return {}
    return {"longest_delay": numerics.longest_delay * machine.controller.period}


def choose_numerics(
    machine: Machine, log: Log, *, segments: bool = True, solver: str | None = None
) -> Numerics:
    """Choose the integration that suits a machine and its log.

    Dry friction sticks exactly. Its gradient is exact too, because the force is continuous at the onset of
    sliding. With break-away friction it is not, so that friction is smoothed; likewise with a solver of
    diffrax.

    Args:
        machine: The machine to simulate.
        log: The log that drives it.
        segments: Whether an open-loop run may be cut into segments.
        solver: One of `jaxid.names.SOLVERS`; None: fixed steps.
    """
    breaks_away = any(e.break_away_level is not None for e in machine.plant.effects)
    exact = exact_numerics(machine, log, 1 if solver else None)
    numerics = replace(
        exact,
        substeps=1 if solver else max(exact.substeps, turning_steps(machine, log)),
        set_valued=not breaks_away and solver is None,
        solver=solver,
    )
    if log.passive and machine.controller is None and solver is None:
        # Without noise of a force the phase of a swing is so precise that it shows the error of a step.
        numerics = replace(numerics, substeps=max(numerics.substeps, _FREE))
    if not numerics.set_valued and solver is None:
        numerics = replace(numerics, substeps=max(numerics.substeps, _sharp_steps(machine, log)))
    if machine.controller is not None or not segments:
        return numerics
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    run = eqx.filter_jit(lambda r, p: r(p).position)(replay, machine.plant)
    off = np.sqrt(np.nanmean((np.asarray(run) - log.position) ** 2))
    if np.isfinite(off) and off < _LOST * np.nanstd(log.position):
        return numerics
    length = max(20, log.samples // _SEGMENTS)
    return replace(numerics, segment=length)


def turning_steps(machine: Machine, log: Log) -> int:
    """Return the steps per sample that keep the error at reversals of dry friction below the noise.

    A joint that comes to rest within a step h is afterwards off by about 0.04 F / m h^2 with F its dry
    friction; a tenth of a reading's noise is small enough for thousands of samples.
    """
    plant, inertia = machine.plant, machine.plant.own_inertia()
    noise = position_noise(machine, log)
    if inertia is None or not np.any(noise > 0):
        return 1
    period = machine.controller.period if machine.controller is not None else log.period
    if machine.ticks_between_rows(log):
        # The highest frequencies of a slow log are motion: its noise is not known from them.
        return _MOST
    # Noise of a velocity moves an integrated position by as much in one sample.
    noise = noise * log.period if log.integrated else noise
    n = log.position.shape[1]
    zero, u = jnp.zeros(n), jnp.zeros(log.force.shape[1])
    q = jnp.asarray(log.filled[0])
    dry = np.asarray(_levels(plant, q, zero, u))[:n]
    off = _TURNING * np.max(np.abs(dry) / np.broadcast_to(np.asarray(inertia), n)) * period**2
    return int(np.clip(np.ceil(np.sqrt(off / (_LITTLE * np.min(noise[noise > 0])))), 1, _MOST))


@kept_jit
def _levels(plant: Plant, q: Array, v: Array, u: Array) -> Array:
    """Return the level of dry friction at rest by port, including break-away [N or N m]."""
    levels = plant.balance(q, v, v, u, jnp.zeros(()), plant.initial_states(u))
    return levels.dry + levels.stick


def _sharp_steps(machine: Machine, log: Log) -> int:
    """Return the steps per sample that the smoothed sign needs; with fewer steps the gradient is wrong."""
    period = machine.controller.period if machine.controller is not None else log.period
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = jnp.asarray(log.filled[picks]), jnp.asarray(log.force[picks] * machine.gain)
    drive = Drive(jnp.asarray(machine.gain), period)
    return needed_substeps(machine.plant, drive, q, jnp.zeros_like(q), u)


def notes_of(
    machine: Machine,
    numerics: Numerics,
    log: Log,
    on: str,
    minimiser: str | Minimiser | None = None,
) -> tuple[str, ...]:
    """Return remarks for the user about simulation and minimisation."""
    where = "in the loop" if machine.controller is not None else "open loop"
    how = "sticks exactly" if numerics.sticks else "is smoothed"
    steps = f"{numerics.substeps} step(s) a sample"
    if numerics.solver is not None:
        steps = f"by diffrax's {numerics.solver}, each step within {RELATIVE:g}"
    notes = [f"simulated {where}, {steps}; dry friction {how}"]
    if on != "position":
        notes.append(f"fitted on {'position and force' if on == 'both' else on}")
    if numerics.segment:
        seconds = numerics.segment * log.period
        notes.append(f"restarted from the log every {seconds:.3g} s, because it would drift off otherwise")
    law = machine.controller
    if law is not None and "model" in law.of_machine and "estimator" not in law.of_machine:
        notes.append(
            "the law computes forces with the guesses of the case: with other guesses it is another law"
        )
    if minimiser_of(minimiser) is not None:
        notes.append(f"minimised by {minimiser_name(minimiser)}")
    return tuple(notes)
