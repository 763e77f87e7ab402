"""Noise of the sensors, as stated or as estimated from a log, and the force that it causes in a balance."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics import filters as signals
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.force_balance import ForceData


def position_noise(machine: Machine, log: Log) -> Float[np.ndarray, " n"]:
    """Return the standard deviation of a reading of each joint, (n,) [m or rad].

    It is the stated one, or else an estimate from the high band of the log. A joint without an encoder has
    zero. Of a log of velocities it is the deviation of a velocity [m/s or rad/s].
    """
    stated = machine.sensor.velocity_noise if log.integrated else machine.sensor.position_std
    if stated is None:
        stated = signals.high_band_std(log.readings)
    return np.broadcast_to(np.asarray(stated), log.position.shape[1]) * log.measured


def force_noise(machine: Machine, data: Prepared) -> Float[np.ndarray, " m"]:
    """Return the standard deviation of each logged force, (m,), in units of the command.

    It is the stated one, or else that of the prepared log, which `jaxid.consistency.noise` estimates; zero if
    there is neither.
    """
    known = data.force_noise if machine.sensor.force_noise is None else machine.sensor.force_noise
    return np.broadcast_to(np.zeros(()) if known is None else np.asarray(known), machine.gain.shape)


def high_band_force_noise(log: Log, data: Prepared) -> Float[np.ndarray, " m"]:
    """Estimate the standard deviation of the logged force from its high band, in its units, (m,).

    It is an upper bound of the noise that `force_noise` returns: in a loop it also holds the controller's
    answer to the noise of its encoder. That really acts, but a search must not take it for the colour of an
    effect. Of a force that was taken back in time it is that of the force as it was logged.
    """
    if data.high_band is not None:
        return data.high_band
    found = np.minimum(signals.high_band_std(log.force), signals.noise_within_stretches(log.force))
    return found / signals.median_noise(data.recipe.median) if data.recipe.median else found


def position_density(
    machine: Machine, log: Log, data: Prepared
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f n"]]:
    """Compute the one-sided density of the force that position noise alone causes [N^2/Hz], by joint.

    The noise passes the plant's impedance -M w^2 + i C w + K (linearised at a typical velocity), the response
    of each derivative and the parallel filter. Noise of a measured velocity counts as that of its integral. A
    force that answers to the noise of its row's reading, as in the log of a faster loop, is a part of it.

    Args:
        machine: The machine; its parameters enter through the impedance only.
        log: The log before preparation.
        data: The prepared log.

    Returns:
        Frequencies up to half the log's sampling rate [Hz], and the density at these.
    """
    rate, recipe = log.rate_hz, data.recipe
    f = np.linspace(0, rate / 2, 2049)[1:]
    sigma = position_noise(machine, log)
    mass, damping, stiffness = (np.asarray(a) for a in linearised_balance(machine.plant, ForceData.of(data)))
    w = 2 * np.pi * f[:, None, None]
    of_position, of_velocity, of_acceleration = (recipe.response(f, rate, k)[:, None, None] for k in range(3))
    impedance = _measured_joints(
        -mass * w**2 * of_acceleration + 1j * w * damping * of_velocity + stiffness * of_position,
        -mass * w**2 + 1j * w * damping + stiffness,
        data.measured,
    )
    through = recipe.decimator.response(f, rate)
    if log.integrated:
        through = through / w[:, 0, 0]
    if data.answer is not None:
        # The force, which is subtracted, answers to the same noise.
        each = np.asarray(machine.plant.applied(jnp.asarray(data.answer * machine.gain), len(mass)))
        impedance = impedance - np.diag(each)
    density = 2 * np.square(np.broadcast_to(sigma, (len(mass),))) / rate
    return f, np.einsum("fij,j->fi", np.abs(impedance) ** 2, density) * through[:, None] ** 2


def noise_density(
    machine: Machine,
    log: Log,
    data: Prepared,
    force_std: Float[np.ndarray, " m"] | None = None,
) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, "f n"]]:
    """Compute the one-sided density of the force that the sensors' noise alone causes [N^2/Hz], by joint.

    Position noise enters as in `position_density`; force noise passes the parallel filter. The noise is that
    of the case's `[sensor]`, or else the one estimated from the log.

    Args:
        machine: The machine; its parameters enter through the impedance only.
        log: The log before preparation.
        data: The prepared log.
        force_std: Standard deviation of the logged force if the case states none, in place of the estimated
            one, (m,).

    Returns:
        Frequencies up to half the log's sampling rate [Hz], and the density at these.
    """
    f, power = position_density(machine, log, data)
    std = force_noise(machine, data)
    if force_std is not None and machine.sensor.force_noise is None:
        std = force_std
    if data.answer is not None:
        driven = list(machine.plant.driven(machine.plant.joints))
        answer = data.answer * position_noise(machine, log)[driven]
        std = np.sqrt(np.maximum(np.square(std) - np.square(answer), 0.0))
    if np.any(std):
        by_drive = jnp.asarray(2 * np.square(std * machine.gain) / log.rate_hz)
        white = np.asarray(machine.plant.applied(by_drive, power.shape[1]))
        power = power + white * data.recipe.decimator.response(f, log.rate_hz)[:, None] ** 2
    return f, power


def _measured_joints(impedance: np.ndarray, exact: np.ndarray, measured: tuple[bool, ...]) -> np.ndarray:
    """Reduce an impedance to the joints with an encoder; rows and columns of the others become zero.

    Args:
        impedance: Impedance with the response of the filters, (f, n, n).
        exact: Exact impedance, by which joints without an encoder follow the others, (f, n, n).
        measured: Whether each joint has an encoder.
    """
    if all(measured):
        return impedance
    known, hidden = np.flatnonzero(measured), np.flatnonzero(~np.array(measured))

    def part(of: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
        return of[:, i[:, None], j]

    follow = np.linalg.solve(part(exact, hidden, hidden), part(exact, hidden, known))
    through = part(impedance, known, hidden) @ follow
    out = np.zeros_like(impedance)
    out[:, known[:, None], known] = part(impedance, known, known) - through
    return out


@kept_jit
def linearised_balance(plant: Plant, data: ForceData) -> tuple[Array, Array, Array]:
    """Linearise the balance at median position and RMS velocity: mass, damping and stiffness, (n, n)."""
    q, v = jnp.median(data.q, axis=0), jnp.sqrt(jnp.mean(data.qd**2, axis=0))
    u = jnp.median(data.force, axis=0)
    states = plant.initial_states(u)

    def residual(q: Array, v: Array, a: Array) -> Array:
        return plant.balance(q, v, a, u, jnp.zeros(()), states).residual

    stiffness, damping, mass = jax.jacfwd(residual, argnums=(0, 1, 2))(q, v, jnp.zeros_like(q))
    return mass, damping, stiffness
