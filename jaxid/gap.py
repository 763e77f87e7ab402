"""The gap between simulation and measurement, and the part that the sensors' noise alone would cause."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, prepare
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.session import OpenedLog
from jaxid.simulation.force_balance import ForceData, force_residual, measured_force, sharpened
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import (
    Replay,
    exact_numerics,
    from_rest,
    make_replay,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import noise_density as noise_density
from jaxid.simulation.step_size import TooStiffError

# In a loop, the error of the start decays. On a log of at most this many samples it may not be small beside
# the rest, so the start is fitted too if that explains clearly more than chance; on a longer one, a start at
# rest is tried if the error of the start shows.
SHORT = 2000
# An open-loop run that is off by this part of the motion's standard deviation has drifted away.
DRIFTED = 0.1


@dataclass(frozen=True)
class ForceGap:
    """Force measured minus force by inverse dynamics, at the kept samples.

    Args:
        residual: Measured minus modelled force, (kept, n) [N or N m]; NaN at rest.
        measured: Measured force through the same filter, (kept, n); zero for a joint without a drive.
        rms: RMS of the residual, by joint.
        relative: 2-norm of the residual over that of the measured force, by joint; NaN for a joint without a
            drive.
    """

    residual: Float[np.ndarray, "kept n"]
    measured: Float[np.ndarray, "kept n"]
    rms: Float[np.ndarray, " n"]
    relative: Float[np.ndarray, " n"]


@kept_jit
def _unexplained(plant: Plant, data: ForceData) -> Array:
    """Compute the measured force minus that of the model at the kept samples."""
    return -force_residual(plant, data)


def force_gap(machine: Machine, data: Prepared) -> ForceGap:
    """Compute the gap between measured force and inverse dynamics, without samples at rest."""
    if machine.controller is not None and not data.force.any():
        # The log has no force: only the position of the simulated loop can be compared.
        nothing, none = np.full(data.moving.shape, np.nan), np.full(data.moving.shape[1], np.nan)  # pyright: ignore[reportGeneralTypeIssues]  # two axes
        return ForceGap(residual=nothing, measured=np.zeros_like(nothing), rms=none, relative=none)
    plant, arrays = sharpened(machine.plant, data), ForceData.of(data)
    residual, measured = _unexplained(plant, arrays), measured_force(plant, arrays)
    residual = np.where(data.moving, np.asarray(residual), np.nan)
    counted = np.where(data.moving, np.asarray(measured), np.nan)
    norm, size = (np.sqrt(np.nansum(x**2, axis=0)) for x in (residual, counted))
    # A joint that never moves has no RMS.
    samples = np.sum(np.isfinite(residual), axis=0)
    return ForceGap(
        residual=residual,
        measured=np.asarray(measured),
        rms=norm / np.sqrt(np.where(samples > 0, samples, np.nan)),
        relative=norm / np.where(size > 0, size, np.nan),
    )


@dataclass(frozen=True)
class SimulationGap:
    """Measured minus simulated position, and the command of the simulated loop.

    Args:
        position: Simulated position, (time, n) [m or rad].
        command: Simulated command, (time, m); None in open loop.
        rms: RMS of the difference in position, by joint.
        relative: 2-norm of the difference over that of the measured position, by joint.
        command_relative: 2-norm of the difference in command over that of the logged one, by drive; None in
            open loop.
    """

    position: Float[np.ndarray, "time n"]
    command: Float[np.ndarray, "time m"] | None
    rms: Float[np.ndarray, " n"]
    relative: Float[np.ndarray, " n"]
    command_relative: Float[np.ndarray, " m"] | None


@kept_jit
def _run(replay: Replay, plant: Plant) -> Trajectory:
    return replay(plant)


def simulation_gap(machine: Machine, replay: Replay, log: Log) -> SimulationGap:
    """Compute the gap between measured and simulated position; NaN for joints without an encoder."""
    run = _run(replay, machine.plant)
    position = np.asarray(run.position)
    gap = log.position - position
    with np.errstate(over="ignore"):  # an open-loop run may leave the log by orders of magnitude
        rms = np.sqrt(np.mean(gap**2, axis=0))
        relative = np.linalg.norm(gap, axis=0) / np.linalg.norm(log.position, axis=0)
    command, command_relative = None, None
    if replay.controller is not None:
        command = np.asarray(run.command)
        if not log.passive:
            off = np.linalg.norm(log.force - command, axis=0)
            command_relative = off / np.linalg.norm(log.force, axis=0)
    return SimulationGap(
        position=position,
        command=command,
        rms=rms,
        relative=relative,
        command_relative=command_relative,
    )


def noise_floor(
    machine: Machine, log: Log, data: Prepared, force_std: Float[np.ndarray, " m"] | None = None
) -> Float[np.ndarray, " n"]:
    """Compute the RMS force that the sensors' noise alone causes in the band [N or N m], by joint.

    Args:
        machine: The machine.
        log: The log.
        data: The prepared log.
        force_std: Standard deviation of the logged force if the case states none, in place of the estimated
            one, (m,).
    """
    if log.steady is not None:
        return row_noise(machine, log)
    if machine.unforced(log):
        return np.full(log.position.shape[1], np.nan)
    f, power = noise_density(machine, log, data, force_std)
    return np.sqrt(np.trapezoid(power, f, axis=0))


def filter_floor(machine: Machine, run: OpenedLog) -> Float[np.ndarray, " n"]:
    """Compute the RMS force that the filter leaves of a log that the machine simulates [N or N m], by joint.

    A log of few samples between two reversals has motion beyond the band of its filter. Friction then turns
    at a wrong time in the filtered motion, even if the model is complete.

    Returns:
        The RMS force, (n,); zero where the simulation drifts away from the log, as it may in open loop, where
        a joint has no encoder, or if only velocities were measured.
    """
    machine, nothing = run.machine(machine), np.zeros(run.data.q.shape[1])
    if not all(run.log.measured) or run.log.integrated:
        return nothing
    gap = simulated(machine, run.log)
    if gap is None:
        return nothing
    command = gap.command
    if command is None:
        if np.any(gap.rms > DRIFTED * np.std(run.log.position, axis=0)):
            return nothing
        command = run.log.force
    log = replace(run.log, position=gap.position, force=command)
    data = prepare(log, machine.gain, run.data.recipe, machine.hold_period)
    return np.nan_to_num(force_gap(machine, data).rms)


def row_noise(machine: Machine, log: Log) -> Float[np.ndarray, " n"]:
    """Return the RMS of the stated scatter of a steady table's rows [N or N m], by joint; NaN: not known."""
    assert log.steady is not None, "only a steady table has rows with a scatter"
    if log.steady.std is None:
        return np.full(log.position.shape[1], np.nan)
    return np.sqrt(np.mean(np.square(log.steady.std * machine.gain), axis=0))


@dataclass(frozen=True)
class Gap:
    """Gap between a machine and one log.

    Args:
        name: Name of the log.
        force: Gap in force, by inverse dynamics.
        simulation: Gap in position, by simulation; None if the simulation diverges.
    """

    name: str
    force: ForceGap
    simulation: SimulationGap | None


def gaps(machine: Machine, runs: Sequence[OpenedLog]) -> tuple[Gap, ...]:
    """Compute the gap of a machine on each log."""
    return tuple(
        Gap(r.name, force_gap(r.machine(machine), r.data), simulation_of_log(r.machine(machine), r.log))
        for r in runs
    )


def simulation_of_log(machine: Machine, log: Log) -> SimulationGap | None:
    """Simulate a log; in a loop, also from rest if the error of the start shows, and return the smaller gap.

    The start's velocity is that of a parabola through the first readings, which is wrong if a log begins with
    a jerk: six masses that start from rest were off by up to half a millimetre, whatever the parameters.
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
    """Compute the gap in position over the whole log; None if the simulation cannot run or diverges."""
    if log.steady is not None:
        return None
    if machine.controller is not None and log.reference is None and machine.unknown_reference is None:
        machine = replace(machine, controller=None)
    # No gradient is needed here: dry friction sticks exactly, break-away friction too.
    try:
        numerics = exact_numerics(machine, log)
    except TooStiffError:
        return None
    replay = make_replay(machine, log, numerics)
    replay = from_rest(replay) if at_rest else with_fitted_start(replay, machine.plant, log)
    gap = simulation_gap(machine, replay, log)
    measured = list(log.measured)
    return gap if np.all(np.isfinite(gap.rms[measured])) and np.all(gap.relative[measured] < 1e3) else None
