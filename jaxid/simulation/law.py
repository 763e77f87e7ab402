"""The command that a declared law gives along a log, computed from the logged readings and reference."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.simulation.law_replay import commands
from jaxid.simulation.replay import make_replay

# First ticks at which the memory of the law is not known.
_SETTLING = 20
# Largest autocorrelation of the difference between the logged command and that of the law, at lags 1 to 5, at
# which it counts as noise of the reading; and the largest such noise, as a part of the command.
_WHITE, _LAGS, _NOISE = 0.1, 5, 0.5
# Standard deviation of normal noise over its median size, and the largest ratio of the difference's standard
# deviation to that which its median implies.
_NORMAL, _OUTLIERS = 1.4826, 1.2
# A difference below this part of the command is rounding.
_EXACT = 1e-6


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
    return np.asarray(commands(controller, driven, log.position, reference, disturbance, velocity))


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
    # A law that is right but for a few ticks, such as a pulse that begins a tick later, leaves outliers.
    middle = _NORMAL * np.median(np.abs(off), axis=0)
    if np.any(noise > _OUTLIERS * middle):
        return None
    # The mean counts too: an integral that began elsewhere, or a disturbance, is no noise.
    power = np.maximum(np.sum(off**2, axis=0), 1e-300)
    correlation = [np.sum(off[k:] * off[:-k], axis=0) / power for k in range(1, _LAGS + 1)]
    if np.max(np.abs(correlation)) > _WHITE:
        return None
    return np.concatenate([log.force[:_SETTLING], command[_SETTLING:]])
