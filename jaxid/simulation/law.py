"""The command that a declared law gives along a log, computed from the logged readings and reference."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller, Tick
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.filters import high_band_std
from jaxid.simulation.replay import make_replay

# First ticks at which the memory of the law is not known.
_SETTLING = 20
# Largest autocorrelation of the difference between the logged command and that of the law, at lags 1 to 5, at
# which it counts as noise of the reading; and the largest such noise, as a part of the command.
_WHITE, _LAGS, _NOISE = 0.1, 5, 0.5
# A difference below this part of the command is rounding.
_EXACT = 1e-6
# Readings to which a law may answer at a tick.
_TAPS = 8


@eqx.filter_jit
def _along(
    controller: Controller,
    driven: tuple[int, ...],
    reference: Array,
    disturbance: Array,
    position: Array,
    velocity: Array,
) -> Array:
    path = controller.path(reference)
    first = jax.tree.map(lambda x: x[0], path)
    memory = controller.start(Tick(position[0], first, driven), velocity, path)

    def tick(memory: tuple, now: tuple) -> tuple[tuple, Array]:
        path, disturbance, reading = now
        u, memory = controller.command(Tick(reading, path, driven), memory, disturbance)
        return memory, u

    return jax.lax.scan(tick, memory, (path, disturbance, position))[1]


def command_along(machine: Machine, log: Log) -> Float[np.ndarray, "time m"] | None:
    """Return the command that the law gives on the logged readings, (time, m).

    Args:
        machine: The machine with its controller.
        log: The log, one row per tick of the controller.

    Returns:
        The command in units of the log; None if the law cannot be computed: there is no controller
        or no reference, the log is slower than the loop, or a joint has no encoder.
    """
    controller = machine.controller
    if controller is None or log.reference is None or not all(log.measured):
        return None
    if controller.of_machine or machine.sensor.inertial is not None or machine.sensor.hold != 1:
        return None
    if abs(log.period / controller.period - 1) > 1e-3:
        return None
    replay = make_replay(machine, log)
    assert replay.disturbance is not None, "make_replay gives a loop its disturbance"
    driven = machine.plant.driven(log.position.shape[1])
    disturbance = np.broadcast_to(replay.disturbance, log.force.shape)
    reference = np.broadcast_to(np.asarray(log.reference), log.force.shape)
    velocity = jnp.asarray(replay.velocity)
    return np.asarray(_along(controller, driven, reference, disturbance, log.position, velocity))


def noise_free_command(machine: Machine, log: Log) -> Float[np.ndarray, "time m"] | None:
    """Return the command of the law if the logged one is the same but for white noise of its reading.

    The applied command is then known without that noise.

    Returns:
        The command, (time, m); None if the law cannot be computed or does not explain the logged command.
    """
    command = command_along(machine, log)
    if command is None or not np.all(np.isfinite(command)) or log.samples < 10 * _SETTLING:
        return None
    off = (log.force - command)[_SETTLING:]
    size, noise = np.std(log.force, axis=0), np.sqrt(np.mean(off**2, axis=0))
    if np.any(noise > _NOISE * size):
        return None
    if np.all(noise <= _EXACT * size):
        return command
    # The mean counts too: an integral that began elsewhere, or a disturbance, is no noise.
    power = np.maximum(np.sum(off**2, axis=0), 1e-300)
    correlation = [np.sum(off[k:] * off[:-k], axis=0) / power for k in range(1, _LAGS + 1)]
    if np.max(np.abs(correlation)) > _WHITE:
        return None
    return np.concatenate([log.force[:_SETTLING], command[_SETTLING:]])


def reading_noise(log: Log) -> Float[np.ndarray, " m"]:
    """Estimate the noise with which the command was read, (m,), in units of the log.

    A sampled law answers to the readings of a few ticks, so that the logged command is rough even if it is
    logged exactly. What no such law explains, at the top of the spectrum, is noise of its reading.
    """
    columns = [log.filled] if log.reference is None else [log.filled, log.reference]
    signals = np.concatenate(columns, axis=1)
    rows = np.concatenate([signals[_TAPS - k : len(signals) - k] for k in range(_TAPS)], axis=1)
    force = log.force[_TAPS:]
    if len(force) < 4 * rows.shape[1]:
        return high_band_std(log.force)
    # Differences, because moves and integrals are slow.
    rows, steps = np.diff(rows, axis=0), np.diff(force, axis=0)
    rows = rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    weights = np.linalg.lstsq(rows, steps, rcond=1e-9)[0]
    left = np.cumsum(np.concatenate([force[:1], steps - rows @ weights]), axis=0)
    return np.minimum(high_band_std(left), high_band_std(log.force))
