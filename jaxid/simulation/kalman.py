"""Extended Kalman filter on the plant's step: innovations of a log, and their variances.

The measured command drives the plant, so that a log from a loop and one without a controller are the same
case. Noise of the force is process noise, and noise of the encoders is measurement noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.dynamics.rhs import State, small_solve
from jaxid.logs.log import Log
from jaxid.logs.soundness import position_levels
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.filters import high_band_std
from jaxid.simulation.loops import Drive, interval_forces, stays_held
from jaxid.simulation.replay import Numerics, make_replay
from jaxid.simulation.sensor_noise import position_noise

# Noise of this many counts makes each rounding error independent of the one before.
_DITHERS = 0.5
# Samples over which a speed is averaged, and the largest number of samples at rest between two readings
# that count.
_SMOOTH, _REST = 21, 500
# Samples beside one at rest that count as slow too.
_AROUND = 3
# Distance of the outer nodes of Gauss and Hermite from the mean [standard deviations]; their weight is 1/6.
_NODE = 3.0**0.5
# Least standard deviation of a velocity over that of the start, and least at all [m/s or rad/s].
_SLOWEST = (1e-6, 1e-12)


class KalmanFilter(eqx.Module):
    """Inputs of a log for an extended Kalman filter; call it with a plant and the noise.

    Args:
        drive: Gain, hold and integration of the command.
        command: Logged command at every tick, (ticks, m).
        readings: Readings at every tick, (ticks, n); between the samples of the log any number.
        used: Mask of the readings that correct the state, (ticks, n).
        kicks: Standard deviation of a change of each joint's velocity by an unknown force on it, at every
            tick, (ticks, n) [m/s or rad/s].
        places: Positions at the samples, from which the motion of coupled joints is computed, (time, n).
        start: Position and velocity before the first reading, (2 n,).
        spread: Standard deviations of `start`, (2 n,).
        measured: Joints with an encoder.
        offset: Standard deviation of a constant error of the command, (m,); None: it has none.
        every: Number of ticks per sample of the log.
        of_velocity: Whether the readings are velocities.
    """

    drive: Drive
    command: Float[Array, "ticks m"]
    readings: Float[Array, "ticks n"]
    used: Bool[Array, "ticks n"]
    kicks: Float[Array, "ticks n"]
    places: Float[Array, "time n"]
    start: Float[Array, " 2n"]
    spread: Float[Array, " 2n"]
    offset: Float[Array, " m"] | None
    measured: tuple[int, ...] = eqx.field(static=True)
    every: int = eqx.field(static=True)
    of_velocity: bool = eqx.field(static=True, default=False)

    def __call__(
        self, plant: Plant, force_noise: Float[Array, " m"], reading_noise: Float[Array, " k"]
    ) -> tuple[Float[Array, "time k"], Float[Array, "time k"]]:
        """Return the innovations and their variances at the samples, for the k joints with an encoder.

        Args:
            plant: The plant.
            force_noise: Standard deviation of the command's error, constant between two ticks, (m,).
            reading_noise: Standard deviation of a reading, (k,) [m or rad, of a velocity per s].

        Source:
            Anderson & Moore (1979), Optimal Filtering, section 8.2; readings are taken one after the other,
            so that no matrix is inverted.
        """
        drive, n = self.drive, self.readings.shape[1]
        # The state begins with the positions, which the velocities follow.
        first = n if self.of_velocity else 0
        before, after = interval_forces(plant, drive, self.command)
        held = stays_held(plant, drive)

        x0 = State(self.start[:n], self.start[n:], plant.resting_states(self.start[:n], before[0]))
        x, unravel = ravel_pytree(x0)
        size, m = x.size, before.shape[1]
        moving, speeds = np.arange(2 * n), n + np.arange(n)
        jolts = self._jolts(plant)
        advance = drive.stepper(plant, x0, (before[0],) if held else (before[0], after[0]))
        force_variance, reading_variance = (drive.gain * force_noise) ** 2, reading_noise**2

        # A constant error of the force follows the plant's states.
        whole = size if self.offset is None else size + m
        x, p = jnp.pad(x, (0, whole - size)), jnp.zeros((whole, whole)).at[moving, moving].set(self.spread**2)
        if self.offset is not None:
            errors = size + jnp.arange(m)
            p = p.at[errors, errors].set((drive.gain * self.offset) ** 2)

        least = jnp.maximum(_SLOWEST[0] * self.spread[n:], _SLOWEST[1])

        def tick(carry: tuple[Array, Array], now: tuple) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
            x, p = carry
            u0, u1, t, reading, used, jolt = now

            innovations, variances = [], []
            for i, j in enumerate(self.measured):
                at = first + j
                e, s = reading[j] - x[at], p[at, at] + reading_variance[i]
                gain = jnp.where(used[j], p[:, at] / s, 0.0)
                x, p = x + gain * e, p - s * gain[:, None] * gain[None, :]
                innovations.append(e)
                variances.append(s)

            def step(z: Array) -> Array:
                state, error, noise = z[:size], z[size:whole], z[whole:]
                force = noise if self.offset is None else error + noise
                ends = (u0 + force,) if held else (u0 + force, u1 + force)
                new = ravel_pytree(advance(unravel(jnp.asarray(state)), ends, t))[0]
                return new if self.offset is None else jnp.concatenate([new, error])

            x, p = by_nodes(step, jnp.concatenate([x, jnp.zeros(m)]), p, force_variance, speeds, least)
            p = p.at[speeds, speeds].add(jolt) if jolt.ndim == 1 else p.at[n : 2 * n, n : 2 * n].add(jolt)
            return (x, 0.5 * (p + p.T)), (jnp.stack(innovations), jnp.stack(variances))

        times = drive.period * jnp.arange(self.command.shape[0])
        inputs = (before, after, times, self.readings, self.used, jolts)
        out = jax.lax.scan(tick, (x, p), inputs)[1]
        return out[0][:: self.every], out[1][:: self.every]

    def _jolts(self, plant: Plant) -> Array:
        """Return the covariance of the change of velocity at every tick: (ticks, n, n), or its diagonal.

        A force on one of several coupled joints accelerates the others too: by the column of the inverse
        mass matrix.
        """
        if not plant.coupled or self.kicks.shape[1] == 1:
            return self.kicks**2
        kicks, one = self.kicks[:: self.every], jnp.eye(self.kicks.shape[1])

        def mass(q: Array) -> Array:
            still = jnp.zeros_like(q)
            return jax.jacfwd(lambda qdd: plant.inertial(q, still, qdd))(still)

        # Where nothing is unknown the matrix does not matter, and may be singular.
        known = ~jnp.any(kicks > 0, axis=1)
        masses = jnp.where(known[:, None, None], one, jax.vmap(mass)(self.places))
        by_force = jax.vmap(small_solve, in_axes=(None, 0), out_axes=1)
        inverse = jax.vmap(by_force, in_axes=(0, None))(masses, one)
        push = inverse / jnp.diagonal(inverse, axis1=1, axis2=2)[:, None]
        at_samples = jnp.einsum("tij,tj,tkj->tik", push, kicks**2, push)
        every_tick = jnp.zeros((len(self.kicks), *one.shape))
        return every_tick.at[:: self.every].set(at_samples)


def by_nodes(
    step: Callable[[Array], Array],
    centre: Float[Array, " k"],
    p: Float[Array, "x x"],
    force_variance: Float[Array, " m"],
    speeds: np.ndarray,
    least: Float[Array, " n"],
) -> tuple[Float[jax.Array, " x"], Float[jax.Array, "x x"]]:
    """Predict mean and covariance of the state after a step.

    A step in which dry friction stops a joint has no slope by its velocity, although it has one by other
    velocities that are as likely. Mean and covariance by each velocity are those of its three nodes; by all
    else they are those of the slope.

    Args:
        step: Function from state and noise to the next state.
        centre: State, and the noise's mean, (x + m,).
        p: Covariance of the state, (x, x).
        force_variance: Variance of the noise, (m,).
        speeds: Indices of the velocities in the state, (n,).
        least: Least distance that counts, as a standard deviation of each velocity, (n,) [m/s or rad/s].

    Source:
        Ito & Xiong (2000), Gaussian filters for nonlinear filtering problems, IEEE Trans. Automatic Control
        45(5).
    """
    whole, n, m = len(p), len(speeds), len(force_variance)
    axes, rest = jnp.eye(whole + m), np.delete(np.arange(whole), speeds)
    others = axes[np.append(rest, whole + np.arange(m))]

    apart = _NODE * jnp.sqrt(p[speeds, speeds] + least**2)
    moved = apart[:, None] * axes[speeds]
    ends = jax.vmap(lambda d: step(centre + d))(jnp.concatenate([moved, -moved]))
    x, tangents = jax.vmap(lambda d: jax.jvp(step, (centre,), (d,)), out_axes=(None, 1))(others)

    secants = (ends[:n] - ends[n:]).T / (2 * apart)
    a = jnp.zeros((whole, whole)).at[:, speeds].set(secants).at[:, rest].set(tangents[:, :-m])
    b, bends = tangents[:, -m:], (ends[:n] + ends[n:]).T / 2 - x[:, None]
    mean = x + jnp.sum(bends, axis=1) / _NODE**2
    return mean, a @ p @ a.T + (b * force_variance) @ b.T + 2 / 9 * bends @ bends.T


def make_filter(
    machine: Machine,
    log: Log,
    numerics: Numerics,
    slow: np.ndarray | None = None,
    offset: np.ndarray | None = None,
) -> KalmanFilter:
    """Prepare a log for the Kalman filter of its machine.

    Args:
        machine: The machine; its controller is not used.
        log: The log; its force is the command that drives the filter.
        numerics: Settings of the integration.
        slow: Mask of the samples at which the model is not to predict the velocity, see `slow_samples`,
            (time, n); None: it always does.
        offset: Standard deviation of a constant error of the command, (m,); None: it has none.
    """
    # The command is the logged one: no law is needed.
    replay = make_replay(replace(machine, controller=None), log, numerics)
    assert replay.command is not None, "make_replay gives an open loop its command"
    every, ticks, n = replay.every, len(replay.command), log.position.shape[1]
    slow = np.zeros(log.position.shape, bool) if slow is None else slow

    used, readings, kicks = np.zeros((ticks, n), bool), np.zeros((ticks, n)), np.zeros((ticks, n))
    used[::every], readings[::every] = readings_used(machine, log) | (slow & log.measured), log.readings
    fastest = np.max(np.abs(np.diff(smooth_steps(log), axis=0)), axis=0, initial=0.0) / log.period
    kicks[::every] = slow * fastest

    noise, stroke = position_noise(machine, log), np.maximum(np.ptp(log.filled, axis=0), 1e-300)
    speed = np.sqrt(np.mean(np.diff(log.filled, axis=0) ** 2, axis=0)) / log.period
    # A joint without an encoder may be anywhere within the stroke of the others.
    # The start of an integrated position is chosen, and so it is known.
    noise = 0.0 * noise if log.integrated else noise
    unsure = np.where(log.measured, np.maximum(3 * noise, 1e-6 * stroke), 0.1 * np.max(stroke))
    speed = np.where(log.measured, speed, np.max(speed))
    return KalmanFilter(
        drive=replay.drive,
        command=replay.command,
        readings=readings,
        used=used,
        kicks=kicks,
        places=log.filled,
        start=np.concatenate([replay.position, replay.velocity]),
        spread=np.concatenate([unsure, speed]),
        offset=offset,
        measured=tuple(np.flatnonzero(log.measured).tolist()),
        every=every,
        of_velocity=log.integrated,
    )


def smooth_steps(log: Log) -> Float[np.ndarray, "time n"]:
    """Return the change of position from sample to sample, smoothed, (time, n) [m or rad]."""
    width = min(_SMOOTH, (log.samples - 1) // 2 * 2 + 1)
    padded = np.pad(log.filled, ((width // 2, width // 2), (0, 0)), mode="edge")
    sums = np.cumsum(np.concatenate([np.zeros((1, log.filled.shape[1])), padded]), axis=0)
    return np.gradient((sums[width:] - sums[:-width]) / width, axis=0)


def slow_samples(log: Log, rest_velocity: Float[np.ndarray, " n"]) -> Bool[np.ndarray, "time n"]:
    """Return the mask of the samples at and around rest, (time, n).

    At rest and at reversals a filter is degenerate: under noise of the force it is not known when a joint
    sticks, and neither a slope nor a variance of the step shows that.

    Args:
        log: The log.
        rest_velocity: Speed below which a sample counts as at rest, (n,) [m/s or rad/s].
    """
    steps = smooth_steps(log)
    turned = np.diff(np.sign(steps), axis=0, prepend=np.sign(steps[:1])) != 0
    slow = (np.abs(steps) < np.asarray(rest_velocity) * log.period) | turned
    wide = slow.copy()
    for k in range(1, _AROUND + 1):
        wide[k:] |= slow[:-k]
        wide[:-k] |= slow[k:]
    return wide


def readings_used(machine: Machine, log: Log) -> Bool[np.ndarray, "time n"]:
    """Return the mask of the readings whose rounding error is independent of the others, (time, n).

    Rounding is noise of a twelfth of the squared step only if the position moves by a step, or is dithered,
    from one reading to the next. On slower motion readings are left out, so many that one is taken a step.
    """
    n = log.position.shape[1]
    if log.integrated:
        return np.broadcast_to(log.measured, log.position.shape)
    stated, resolution = machine.sensor.position_noise, machine.sensor.position_resolution
    step = np.zeros(n) if resolution is None else np.broadcast_to(np.asarray(resolution), n)
    noise = position_noise(machine, log) if stated is None else np.broadcast_to(np.asarray(stated), n)
    return independent_readings(log, step, noise)


def rounded_readings(machine: Machine, log: Log) -> Bool[np.ndarray, "time n"]:
    """Return the mask of `readings_used`, with the resolution that the readings show where none is stated."""
    n = log.position.shape[1]
    stated = machine.sensor.position_resolution
    if stated is not None or log.integrated:
        return readings_used(machine, log)
    step = np.zeros(n)
    for j in np.flatnonzero(log.measured):
        step[j] = position_levels(log.position[:, j])[1]
    # What is left in the high band beside the rounding is noise that dithers it.
    high = high_band_std(log.filled)
    return independent_readings(log, step, np.sqrt(np.maximum(high**2 - step**2 / 12, 0.0)).reshape(n))


def independent_readings(
    log: Log, step: Float[np.ndarray, " n"], noise: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, "time n"]:
    """Return the mask of the readings whose rounding error is independent, see `readings_used`.

    Args:
        log: The log.
        step: Step of each encoder, (n,); zero for one that does not round.
        noise: Standard deviation of the noise before rounding, (n,).
    """
    # The speed is smoothed: a choice by the readings themselves would prefer one side of a count.
    steps, used = np.abs(smooth_steps(log)), np.zeros(log.position.shape, bool)
    for j in np.flatnonzero(log.measured):
        if noise[j] >= _DITHERS * step[j]:
            used[:, j] = True
            continue
        travel = np.clip(steps[:, j] / step[j], 1 / _REST, 1.0)
        used[:, j] = np.diff(np.floor(np.cumsum(travel) + 0.5), prepend=0.0) > 0
    return used
