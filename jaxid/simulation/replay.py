"""Simulation of a machine with the input of a log: in closed loop if its controller is known, else open."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from jaxid.arrays import Array, library
from jaxid.controllers import PID, Controller, with_effects
from jaxid.dynamics.hidden_joints import resting
from jaxid.errors import InputError
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter_controller
from jaxid.numerics import filters as signals
from jaxid.numerics.kept import kept_jit
from jaxid.references.unknown import UnknownReference
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.law_replay import commands
from jaxid.simulation.loops import Drive, Trajectory, closed_loop, open_loop
from jaxid.simulation.reference_course import reference_at
from jaxid.simulation.solvers import AdaptiveStep
from jaxid.simulation.step_size import needed_steps

# Ticks of past command that a loop keeps for a delay at least, and at most.
_SHORTEST_MEMORY, LONGEST_MEMORY = 12, 1536
# The memory over the delay at its guess, so that a fit finds a delay so many times as long.
_LONGER = 2.0
# Number of first samples in which an error of a loop's start appears, and the factor by which their mean
# square residual then exceeds that of the others.
_FIRST, _FAR_MORE = 100, 5.0
# Part of the typical speed from which a log begins in motion.
_MOVING = 0.2
# A joint stands still if its first so many readings are within so many times their noise of the first one.
_STANDS, _APART = 5, 5.0
# Part of the travel of a joint that the least visible motion may be, so that readings show whether it stands.
_OF_TRAVEL = 0.05
# Factor by which a band-limited command is upsampled before its samples are joined by lines.
_REFINE = 8


@dataclass(frozen=True)
class Numerics:
    """Settings of the integration in a replay.

    Args:
        set_valued: Whether dry friction sticks exactly; otherwise it is smoothed.
        substeps: Integration steps between samples of the command.
        longest_delay: Samples of past command kept for delays in a loop.
        segment: Samples after which an open-loop run restarts from the log; None: never.
        solver: One of `jaxid.names.SOLVERS`, which replaces the fixed steps and
            smooths dry friction; None: fixed steps.
    """

    set_valued: bool = True
    substeps: int = 1
    longest_delay: int = 0
    segment: int | None = None
    solver: str | None = None

    @property
    def sticks(self) -> bool:
        """True if dry friction sticks exactly."""
        return self.set_valued and self.solver is None


class Replay(eqx.Module):
    """Inputs of a log, ready to drive a plant; call it with the plant.

    Args:
        drive: Gain, hold and integration of the command.
        controller: The control law; None: open loop.
        sensor: Sensor that the controller reads.
        reference, disturbance: Values by drive at every tick (closed loop). An `UnknownReference` has
            unknowns.
        command: Logged command (open loop), upsampled if it is band-limited.
        position, velocity: State at the start, (n,) each.
        restart: Flags, positions and velocities of segments (open loop).
        every: Number of ticks per sample of the log.
        follow: Matrix from positions of joints with an encoder to positions of all at rest, (n, k).
        load: Known forces behind those of the drives at every tick (closed loop); None: there are none.
    """

    drive: Drive
    controller: Controller | None
    sensor: Sensor
    reference: Array | UnknownReference | None
    disturbance: Array | None
    command: Array | None
    position: Float[Array, " n"]
    velocity: Float[Array, " n"]
    restart: tuple[Array, Array, Array] | None
    every: int = eqx.field(static=True)
    follow: Float[Array, "n k"]
    load: Array | None = eqx.field(default=None, kw_only=True)

    def __call__(
        self, plant: Plant, nudge: Array | None = None, noise: Float[Array, "ticks n"] | None = None
    ) -> Trajectory:
        """Return the trajectory at the samples of the log.

        Args:
            plant: The plant to simulate.
            nudge: Change of position and velocity at the start, (2 n,).
            noise: Standard normal numbers for the noise of the readings of a loop; None: no noise.
        """
        q, v = self.position, self.velocity
        if nudge is not None:
            q, v = q + nudge[: q.size], v + nudge[q.size :]
        if self.controller is not None:
            reference = self.reference() if isinstance(self.reference, UnknownReference) else self.reference
            assert reference is not None, "make_replay gives a loop its reference"
            assert self.disturbance is not None, "and its disturbance, which may be zero"
            run = closed_loop(
                plant,
                self.drive,
                self.controller,
                reference,
                self.disturbance,
                q,
                v,
                self.sensor,
                noise,
                self.load,
            )
        else:
            assert self.command is not None, "make_replay gives an open loop its command"
            run = open_loop(plant, self.drive, self.command, q, v, None, self.restart)
        return jax.tree.map(lambda a: a[:: self.every], run)

    def started(self, start: Float[Array, " k"]) -> Replay:
        """Return the run with a changed start: joints with an encoder move by `start`, the others follow."""
        return replace(self, position=self.position + self.follow @ start)

    def following(self, places: tuple, theta: Float[Array, " p"]) -> Replay:
        """Return the run with the values theta for the unknowns of its reference and its controller."""
        controller = scatter_controller(places, self.controller, theta)
        out = self if controller is self.controller else replace(self, controller=controller)
        if not isinstance(out.reference, UnknownReference):
            return out
        return replace(out, reference=out.reference.with_unknowns(places, theta))


def make_replay(machine: Machine, log: Log, numerics: Numerics | None = None) -> Replay:
    """Prepare a log to drive its machine.

    Args:
        machine: The machine; with a controller the loop is closed.
        log: The log; for a closed loop it needs a reference.
        numerics: Settings of the integration; by default exact sticking and the steps that the plant needs.

    Raises:
        InputError: If the loop is closed and the log has no reference, or its sampling time is not
            a multiple of the controller's.
    """
    numerics = numerics or Numerics(substeps=needed_steps(machine, log))
    position, follow = resting(machine.plant, log.filled[0], machine.gain.size, log.measured)
    velocity = follow @ start_velocity(log)[list(log.measured)]
    start = (position, velocity)
    if machine.controller is None:
        return _open(machine, log, numerics, start, follow)
    period = machine.controller.period
    every = max(1, round(log.period / period))
    if abs(log.period / period / every - 1) > 1e-3:
        raise InputError(
            f"{log.source}: one sample every {log.period:g} s is no whole multiple of the "
            f"controller's period {period:g} s; resample the log or correct [controller] period."
        )
    if log.reference is None and machine.unknown_reference is None:
        raise InputError(
            f"{log.source}: the loop cannot be simulated without a reference; name its column "
            "as reference in [log], or leave out [controller] to simulate from the measured force."
        )
    driven = log.force.shape[1]
    if log.reference is not None and log.reference.shape[1] not in (1, driven):
        raise InputError(
            f"{log.source}: the reference has {log.reference.shape[1]} columns for {driven} drives; "
            "name one a drive in [log]."
        )
    ticks = log.time[0] + period * np.arange((log.samples - 1) * every + 1)
    if log.reference is None:
        assert machine.unknown_reference is not None, "refused above"
        reference, times = machine.unknown_reference.at(ticks - log.time[0]), ticks
    elif every == 1:
        reference, times = log.reference, log.time
    else:
        reference, times = reference_at(log.time, log.reference, ticks, machine.reference_hold), ticks
    disturbance = disturbance_at(machine.disturbance, times, log)
    return Replay(
        _drive(machine, log, numerics, period, "zero_order"),
        _in_motion(machine, log, every, disturbance),
        machine.sensor.mean,
        reference,
        disturbance,
        None,
        *start,
        None,
        every,
        follow,
        load=_load_at(machine, log, times + 0.5 * period),
    )


def _load_at(machine: Machine, log: Log, times: np.ndarray) -> np.ndarray | None:
    """Return the known load of a machine at some times, (times, m); None if there is none.

    Args:
        machine: The machine.
        log: Its log.
        times: The middles of all ticks [s].
    """
    if machine.held_load is not None:
        return machine.held_load
    return None if machine.load is None else reference_at(log.time, machine.load, times, "linear")


def _in_motion(machine: Machine, log: Log, every: int, disturbance: np.ndarray | Array) -> Controller:
    """Return the controller of a machine, its integral as the first commands of a moving log have it.

    Before a log that begins at rest the integral counts as zero.
    """
    controller = machine.controller
    assert controller is not None, "only a loop has a controller"
    if not isinstance(controller, PID):
        return controller
    # One shape for all logs, so that they share compiled code.
    controller = replace(controller, integral=jnp.zeros(log.force.shape[1]))
    law = with_effects(controller, machine.plant, log.force.shape[1])
    if log.reference is None or every > 1 or not all(log.measured):
        return controller
    velocity, first = start_velocity(log), min(_FIRST, log.samples)
    typical = np.sqrt(np.mean((np.diff(log.position, axis=0) / log.period) ** 2, axis=0))
    if not np.any(np.abs(velocity) > _MOVING * typical):
        return controller
    driven, shape = machine.plant.driven(log.position.shape[1]), log.force[:first].shape
    reference, extra = (np.broadcast_to(x[:first], shape) for x in (log.reference, disturbance))
    readings = (jnp.asarray(x) for x in (log.position[:first], reference, extra, velocity))
    made = np.asarray(commands(law, driven, *readings))
    inside = np.ones(shape, bool)
    if controller.limit is not None:
        inside = np.abs(log.force[:first]) < (1 - 1e-6) * np.asarray(controller.limit)
    missing = np.nanmedian(np.where(inside, log.force[:first] - made, np.nan), axis=0)
    gain = np.broadcast_to(np.asarray(controller.ki), missing.shape)
    integral = np.where(np.isfinite(missing) & (gain != 0), missing / np.where(gain != 0, gain, 1.0), 0.0)
    return replace(controller, integral=jnp.asarray(integral))


def _drive(machine: Machine, log: Log, numerics: Numerics, period: float, hold: str) -> Drive:
    solver = None
    if numerics.solver is not None:
        sizes = float(np.std(log.filled, axis=0).max()), float(np.max(machine.plant.smoothing.velocity_scale))
        solver = AdaptiveStep.sized(numerics.solver, *sizes)
    return Drive(
        machine.gain,
        period,
        hold,
        numerics.substeps,
        numerics.sticks,
        numerics.longest_delay,
        solver,
    )


def from_rest(replay: Replay) -> Replay:
    """Return the run with zero velocity at its start."""
    return eqx.tree_at(lambda r: r.velocity, replay, np.zeros_like(replay.velocity))


def start_shows(off: Float[np.ndarray, "time k"]) -> bool:
    """Check that the residual of a run's first samples is far larger than that of the others.

    Args:
        off: Measured minus simulated position, (time, k); NaN for a missing reading.
    """
    squares = np.nanmean(np.square(off), axis=1)
    return bool(np.mean(squares[:_FIRST]) > _FAR_MORE * np.mean(squares[_FIRST:]))


def start_shows_by_run(off: Float[Array, "time runs k"]) -> Bool[Array, " runs"]:
    """Check each of several runs like `start_shows`, without missing readings."""
    first, rest = ((x * x).sum(axis=(0, 2)) / len(x) for x in (off[:_FIRST], off[_FIRST:]))
    return first > _FAR_MORE * rest


def with_sensor(replay: Replay, sensor: Sensor) -> Replay:
    """Return the run with another sensor for its controller."""
    return eqx.tree_at(lambda r: r.sensor, replay, sensor, is_leaf=lambda x: isinstance(x, Sensor))


def with_fitted_start(replay: Replay, plant: Plant, log: Log, samples: int = 100) -> Replay:
    """Return an open-loop run whose initial position and velocity fit the first samples of its log.

    A slope through noisy samples is a poor velocity, especially if an oscillation has only ten samples per
    period; the model of the plant relates the first samples to each other.

    Args:
        replay: The run to start; a closed loop is returned unchanged.
        plant: The plant that is simulated.
        log: The log with the measured positions.
        samples: Number of first samples in the fit.
    """
    if replay.controller is not None or replay.restart is not None:
        return replay
    count = min(samples, log.samples)
    assert replay.command is not None, "make_replay gives an open loop its command"
    short = eqx.tree_at(lambda r: r.command, replay, replay.command[: (count - 1) * replay.every + 1])
    nudge = _start(short, plant, log.readings[:count], log.measured, log.integrated)
    n = replay.position.size
    moved = (replay.position + nudge[:n], replay.velocity + nudge[n:])
    return eqx.tree_at(lambda r: (r.position, r.velocity), replay, moved)


def stands_still(log: Log) -> bool:
    """Check that no joint with an encoder moves in the first samples of a log.

    Noise may hide motion: readings say that a joint stands only if their noise is small beside its travel.
    """
    readings = log.readings[:, list(log.measured)]
    away, least = np.abs(readings[:_STANDS] - readings[0]), _APART * signals.high_band_std(readings)
    shows = least <= _OF_TRAVEL * np.ptp(readings, axis=0)
    return bool(not log.integrated and np.all(shows) and np.all(away <= least))


@kept_jit
def _start(
    replay: Replay, plant: Plant, readings: Array, measured: tuple[bool, ...], of_velocity: bool
) -> Array:
    def residual(nudge: Array) -> Array:
        run = replay(plant, nudge)
        simulated = run.velocity if of_velocity else run.position
        return ((simulated - readings) * np.array(measured)).ravel()

    def improve(_: int, nudge: Array) -> Array:
        jacobian = jax.jacfwd(residual)(nudge)
        scale = jnp.linalg.norm(jacobian, axis=0) + 1e-300
        step = jnp.linalg.lstsq(jacobian / scale, residual(nudge))[0] / scale
        return nudge - step

    # Three steps suffice: over so short a run the position is almost linear in the start. It is not where dry
    # friction holds the machine, whose steps may lead anywhere.
    before = jnp.zeros(2 * replay.position.size)
    nudge = jax.lax.fori_loop(0, 3, improve, before)
    nearer = jnp.sum(residual(nudge) ** 2) < jnp.sum(residual(before) ** 2)
    return jnp.where(nearer, nudge, before)


def _open(
    machine: Machine, log: Log, numerics: Numerics, start: tuple[np.ndarray, np.ndarray], follow: np.ndarray
) -> Replay:
    command, period, hold, every = log.force, log.period, log.hold, 1
    if hold == "band_limited":
        command, every = _refined(command), _REFINE
        period, hold = period / every, "linear"
        numerics = replace(numerics, substeps=max(1, round(numerics.substeps / every)))
    drive = _drive(machine, log, numerics, period, hold)
    restart = None
    if numerics.segment:
        flags, q, v = _segments(log, numerics.segment, every)
        seen = list(log.measured)
        restart = flags, start[0] + (q - start[0])[:, seen] @ follow.T, v[:, seen] @ follow.T
    return Replay(
        drive,
        None,
        machine.sensor.mean,
        None,
        None,
        command,
        *start,
        restart,
        every,
        follow,
    )


def noise_of_command(
    replay: Replay, std: Float[np.ndarray, " m"], rng: np.random.Generator, runs: int
) -> Float[np.ndarray, "runs ticks m"]:
    """Draw noise of the logged command of an open loop, at the ticks of its simulation.

    Args:
        replay: Run in open loop.
        std: Standard deviation of a logged command, (m,).
        rng: Source of the random numbers.
        runs: Number of draws.
    """
    assert replay.command is not None, "make_replay gives an open loop its command"
    samples = (len(replay.command) - 1) // replay.every + 1
    noise = std * rng.standard_normal((runs, samples, len(std)))
    return noise if replay.every == 1 else np.stack([_refined(one) for one in noise])


def _refined(command: np.ndarray) -> np.ndarray:
    """Return the band-limited interpolation; an odd extension avoids ringing at the ends."""
    n = len(command)
    pad = min(n - 1, 200)
    whole = np.concatenate(
        [2 * command[0] - command[pad:0:-1], command, 2 * command[-1] - command[-2 : -pad - 2 : -1]]
    )
    fine = np.asarray(scipy.signal.resample(whole, len(whole) * _REFINE, axis=0))
    return fine[pad * _REFINE : (pad + n - 1) * _REFINE + 1]


def _segments(log: Log, length: int, every: int) -> tuple[Array, Array, Array]:
    """Return the restarts, one every `length` samples, from the measured position and its local slope."""
    n = (log.samples - 1) * every + 1
    flags = np.zeros(n, bool)
    q, v = np.zeros((n, log.filled.shape[1])), np.zeros((n, log.filled.shape[1]))
    noise = signals.high_band_std(log.filled)
    for k in range(0, log.samples, length):
        flags[k * every] = True
        q[k * every], v[k * every] = local_line(log, k, noise)
    return flags, q, v


# Reaches of the parabola that gives a velocity [samples], and the largest difference, in standard
# deviations, between the velocities of a wider and a narrower one.
_REACHES = (2, 3, 5, 7, 10)
_STRAY = 2.0


def local_line(
    log: Log, k: int, noise: Float[np.ndarray, " n"] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position and velocity at sample k, by joint, from parabolas through its neighbours.

    The widest parabola counts that agrees with all narrower ones. A wide one averages the noise, but a
    machine that starts with a jerk does not follow a parabola for twenty samples.

    Args:
        log: The log with the positions.
        k: Number of the sample.
        noise: Standard deviation of a reading by joint, (n,); None: estimated from the log.
    """
    if log.integrated:
        return log.position[k], np.asarray(_parabola(log.readings, log.period, k, _REACHES[0])[0])
    noise = signals.high_band_std(log.filled) if noise is None else noise
    position, velocity = line_at(log.filled, log.period, k, noise)
    return np.asarray(position), np.asarray(velocity)


def line_at(
    x: Float[Array, "time k"], period: float, k: int, noise: Float[Array, " k"]
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the position and velocity at sample k of each column; see `local_line`.

    Args:
        x: Positions by column, (time, k).
        period: Sampling time [s].
        k: Number of the sample.
        noise: Standard deviation of a reading by column, (k,).
    """
    xp = library(x)
    position, velocity, size = _parabola(x, period, k, _REACHES[0])
    # The second term tolerates rounding in a log without noise.
    spread = _STRAY * size * noise + 1e-12 * xp.abs(velocity)
    low, high = velocity - spread, velocity + spread
    going = np.ones(position.shape, bool)
    for reach in _REACHES[1:]:
        q, v, size = _parabola(x, period, k, reach)
        spread = _STRAY * size * noise + 1e-12 * xp.abs(v)
        low, high = xp.maximum(low, v - spread), xp.minimum(high, v + spread)
        going = going & (low <= high)
        position, velocity = xp.where(going, q, position), xp.where(going, v, velocity)
    return position, velocity


def _parabola(x: Float[Array, "time k"], period: float, k: int, reach: int) -> tuple[Array, Array, float]:
    """Return value and slope at sample k, and the slope's standard deviation for noise of deviation one."""
    lo = int(np.clip(k - reach, 0, max(len(x) - 2 * reach - 1, 0)))
    x = x[lo : lo + 2 * reach + 1]
    t = period * (np.arange(lo, lo + len(x)) - k)
    fit = np.linalg.pinv(np.vander(t / period, 3, increasing=True))
    q, v = fit[0] @ x, fit[1] @ x / period
    return q, v, float(np.linalg.norm(fit[1]) / period)


def start_velocity(log: Log) -> np.ndarray:
    """Return the velocity at the first sample, (n,) [m/s or rad/s]."""
    return local_line(log, 0)[1]


def exact_numerics(machine: Machine, log: Log, steps: int | None = None) -> Numerics:
    """Return the integration for a run that is not differentiated: dry friction sticks exactly.

    Args:
        machine: The machine to simulate.
        log: The log that drives it.
        steps: Integration steps between samples of the command; None: as many as the machine needs.

    Raises:
        TooStiffError: If the machine needs more steps than any plausible one.
        InputError: If a delay reaches back more ticks of the controller than a loop can keep.
    """
    steps = needed_steps(machine, log) if steps is None else steps
    return Numerics(substeps=steps, longest_delay=remembered_ticks(machine, log))


def remembered_ticks(machine: Machine, log: Log) -> int:
    """Return the ticks of past command that the machine's loop keeps for its delays; 0 without any.

    They reach twice as far back as the delays at their guesses, and as far as their stated upper bounds.

    Raises:
        InputError: If these are more ticks of the controller than a loop can keep.
    """
    if machine.controller is None or not any(e.delays_command() for e in machine.plant.effects):
        return 0
    effects, period = machine.plant.effects, machine.controller.period
    delay = float(np.max(np.asarray(machine.plant.command_delays(machine.gain.size))))
    stated = [
        f.upper
        for f in machine.parameters.free
        if f.effect is not None and effects[f.effect].delays_command() and np.isfinite(f.upper)
    ]
    needed = int(np.ceil(max(_LONGER * delay, *stated, 0.0) / period))
    if needed > LONGEST_MEMORY:
        raise InputError(
            f"a delay of {delay:g} s, which may grow to {needed * period:g} s in a fit, is {needed} ticks of "
            f"the controller, and a loop keeps at most {LONGEST_MEMORY}",
            where=log.source,
            hint="give the delay a smaller guess or max, or leave out [controller]",
        )
    # Few lengths, so that fits of similar delays share compiled code.
    ticks = _SHORTEST_MEMORY
    while ticks < needed:
        ticks *= 2
    return ticks
