"""Gyroscopes and accelerometers on links: their readings, and the motion of the joints from these.

A reading is scale times the quantity along the axes of the sensor, plus bias and noise, clipped to its range.
Gyroscopes read the angular velocity of their link, accelerometers the acceleration of their place less
that of gravity. Both are derivatives of the frame of the link.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant
from jaxid.numerics.elimination import small_solve

# Weight of the held value relative to the readings: it matters only if these do not determine a motion.
_HELD = 1e-9
# A motion is determined if less than this fraction of its variance by the held value alone remains.
_DETERMINED = 1e-3


class Inertial(eqx.Module):
    """One sensor on a link.

    Args:
        kind: One of `jaxid.names.INERTIAL_KINDS`.
        link: Index of its link, 0-based.
        axes: Axes of the sensor that it reads, 0-based.
        position: Place of an accelerometer in the link's frame, (3,) [m].
        rotation: Rotation vector from the axes of the link to those of the sensor, (3,) [rad].
        scale: Reading over quantity, for each axis.
        bias: Reading at zero, for each axis [rad/s or m/s^2].
        noise: Standard deviation of a reading [rad/s or m/s^2].
        range: Largest absolute reading; infinite: no limit.
    """

    kind: str = eqx.field(static=True)
    link: int = eqx.field(static=True)
    noise: Array = eqx.field(converter=as_array)
    axes: tuple[int, ...] = eqx.field(static=True, default=(0, 1, 2))
    position: Array = eqx.field(converter=as_array, default=(0.0, 0.0, 0.0))
    rotation: Array = eqx.field(converter=as_array, default=(0.0, 0.0, 0.0))
    scale: Array = eqx.field(converter=as_array, default=1.0)
    bias: Array = eqx.field(converter=as_array, default=0.0)
    range: Array = eqx.field(converter=as_array, default=np.inf)

    def along(self, x: Float[Array, "3 ..."]) -> Float[Array, "axes ..."]:
        """Project a vector in link coordinates onto the axes of the sensor."""
        turned = _turned(self.rotation)
        return jnp.stack([jnp.tensordot(turned[:, k], x, 1) for k in self.axes])

    @property
    def gyroscope(self) -> bool:
        """True for a gyroscope."""
        return self.kind == "gyroscope"


class InertialSensors(eqx.Module):
    """The inertial sensors of a machine, and their fusion.

    Velocity by the gyroscopes, then acceleration by the accelerometers, are weighted least squares of their
    readings at the measured position; readings at the end of their range have no weight.

    Args:
        sensors: The sensors with their true errors.
        known: The sensors as the fusion knows them: bias, scale and rotation only if calibrated.
        hold: Ticks of the loop for which the fused motion is held.
    """

    sensors: tuple[Inertial, ...]
    known: tuple[Inertial, ...]
    hold: int = eqx.field(static=True, default=1)

    @property
    def count(self) -> int:
        """Number of readings."""
        return sum(len(s.axes) for s in self.sensors)

    @property
    def accelerates(self) -> bool:
        """True if there are accelerometers."""
        return any(s.kind == "accelerometer" for s in self.sensors)

    def read(
        self, plant: Plant, q: Array, qd: Array, qdd: Array, noise: Float[Array, " count"] | None = None
    ) -> Float[Array, " count"]:
        """Return the readings of all sensors; `noise` are standard normal numbers."""
        out, at = [], 0
        for s, x in zip(self.sensors, _quantities(self.sensors, plant, q, qd, qdd), strict=True):
            x = s.scale * x + s.bias
            x = x if noise is None else x + s.noise * noise[at : at + x.size]
            out.append(jnp.clip(x, -s.range, s.range))
            at += x.size
        return jnp.concatenate(out)

    def fused(
        self,
        plant: Plant,
        q: Float[Array, " n"],
        readings: Float[Array, " count"],
        velocity: Float[Array, " n"],
        acceleration: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], Bool[Array, ""]]:
        """Compute velocity and acceleration of all joints, and whether the readings determine them.

        Args:
            plant: Plant with the links that carry the sensors.
            q: Measured position of all joints.
            readings: Readings of all sensors, in their order.
            velocity, acceleration: Values for motions that no reading within its range determines.
        """
        zero, rows = jnp.zeros_like(q), _slopes(self.known, plant, q)
        velocity, sound = self._solved(True, rows, [0.0] * len(rows), readings, velocity)
        if not self.accelerates:
            return velocity, acceleration, sound
        rest = _quantities(self.known, plant, q, velocity, zero)
        acceleration, also = self._solved(False, rows, rest, readings, acceleration)
        return velocity, acceleration, sound & also

    def _solved(
        self, gyroscopes: bool, rows: list[Array], rest: list, readings: Array, held: Array
    ) -> tuple[Array, Array]:
        """Solve the readings of gyroscopes, or accelerometers, for a quantity in which they are affine."""
        ends = np.cumsum([0, *(len(s.axes) for s in self.known)])
        chosen = [k for k, s in enumerate(self.known) if s.gyroscope == gyroscopes]
        values, weights, within = [], [], []
        for k in chosen:
            s, x = self.known[k], readings[ends[k] : ends[k + 1]]
            values.append((x - s.bias) / s.scale - rest[k])
            weights.append(jnp.broadcast_to((s.scale / s.noise) ** 2, x.shape))
            within.append(jnp.abs(x) < s.range)
        value, weight, inside = (jnp.concatenate(x) for x in (values, weights, within))
        slope = jnp.concatenate([rows[k] for k in chosen])
        prior = _HELD * jnp.sum(weight[:, None] * slope**2) / held.size
        weight = jnp.where(inside, weight, 0.0)
        normal = jnp.sum((weight[:, None] * slope)[:, :, None] * slope[:, None, :], axis=0)
        normal = normal + prior * jnp.eye(held.size)
        moment = jnp.sum((weight * value)[:, None] * slope, axis=0) + prior * held
        inverse = jax.vmap(small_solve, (None, 0))(normal, jnp.eye(held.size))
        return jnp.sum(inverse * moment, axis=1), jnp.all(prior * jnp.diagonal(inverse) < _DETERMINED)


def _places(sensors: tuple[Inertial, ...], plant: Plant) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function from positions to the axes of the sensors' links and the places of the sensors."""

    def places(q: Array) -> tuple[Array, Array]:
        frames = {link: plant.frame(link, q) for link in sorted({s.link for s in sensors})}
        axes = jnp.stack([frames[s.link][0] for s in sensors])
        origins = [frames[s.link][1] + jnp.sum(frames[s.link][0] * s.position, axis=1) for s in sensors]
        return axes, jnp.stack(origins)

    return places


def _quantities(
    sensors: tuple[Inertial, ...], plant: Plant, q: Array, qd: Array, qdd: Array
) -> list[Float[Array, " axes"]]:
    """Compute the quantity that each sensor measures, along its axes [rad/s or m/s^2]."""
    places = _places(sensors, plant)

    def rate(q: Array, qd: Array) -> tuple:
        return jax.jvp(places, (q,), (qd,))

    ((axes, _), (turn, _)), (_, (_, second)) = jax.jvp(rate, (q, qd), (qd, qdd))
    turning, free = _vector(axes, turn[..., None])[..., 0], second - plant.base_gravity
    moving = jnp.sum(axes * free[:, :, None], axis=1)
    return [s.along(turning[k] if s.gyroscope else moving[k]) for k, s in enumerate(sensors)]


def _slopes(sensors: tuple[Inertial, ...], plant: Plant, q: Array) -> list[Float[Array, "axes n"]]:
    """Compute the derivative of each measured quantity in the joints' velocities, or accelerations."""
    places = _places(sensors, plant)
    turn, move = jax.jacfwd(places)(q)
    axes = places(q)[0]
    turning = _vector(axes, turn)
    moving = jnp.sum(axes[:, :, :, None] * move[:, :, None, :], axis=1)
    return [s.along(turning[k] if s.gyroscope else moving[k]) for k, s in enumerate(sensors)]


def _vector(axes: Float[Array, "s 3 3"], turn: Float[Array, "s 3 3 n"]) -> Float[Array, "s 3 n"]:
    """Return the angular velocities in the turning axes from the derivatives of these axes."""
    across = jnp.sum(axes[:, :, :, None, None] * turn[:, :, None, :, :], axis=1)
    return jnp.stack([across[:, 2, 1], across[:, 0, 2], across[:, 1, 0]], axis=1)


def _turned(rotation: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the axes of a sensor, as columns, in those of its link, by Rodrigues' formula."""
    angle = jnp.sqrt(jnp.sum(rotation**2) + 1e-300)
    x, y, z = rotation / angle
    cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    square = jnp.sum(cross[:, :, None] * cross[None, :, :], axis=1)
    return jnp.eye(3) + jnp.sin(angle) * cross + (1 - jnp.cos(angle)) * square


def scale_factor(raw: Float[np.ndarray, " time"], known: Float[np.ndarray, " time"]) -> float:
    """Compute the factor of raw readings that matches a known motion, by least squares.

    Noise lowers it, by its share of the mean square of the readings; `calibrate` has no such bias.

    Source:
        Righettini et al. (2025), Robotics 14, 36, (47) and (48).
    """
    return float(raw @ known / (raw @ raw))


def calibrate(
    raw: Float[np.ndarray, "time axes"], known: Float[np.ndarray, "time 3"]
) -> tuple[Float[np.ndarray, "axes 3"], Float[np.ndarray, " axes"], Float[np.ndarray, "axes 4"]]:
    """Compute scale, mounting and bias of a sensor from a known motion, by least squares.

    Args:
        raw: Raw readings of the sensor.
        known: True quantity along the axes of its link.

    Returns:
        Matrix from the quantity to the readings (scale times mounting, not constrained to right angles),
        bias, and the standard deviations of both, for white noise.

    Raises:
        ValueError: If the motion does not excite all unknowns, or is too short.
    """
    columns = np.concatenate([known, np.ones((len(known), 1))], axis=1)
    if len(columns) <= 4:
        raise ValueError(f"{len(columns)} samples do not determine 4 numbers for each axis; take more.")
    size = np.sqrt(np.mean(columns**2, axis=0))
    values = np.linalg.svd(columns / np.where(size > 0, size, 1.0), compute_uv=False)
    if not np.all(size > 0) or values[-1] < 1e-9 * values[0]:
        raise ValueError("the motion does not turn (or accelerate) along three axes, at several rates.")
    solution, *_ = np.linalg.lstsq(columns, raw, rcond=None)
    residual = raw - columns @ solution
    variance = np.sum(residual**2, axis=0) / (len(columns) - 4)
    std = np.sqrt(variance[:, None] * np.diagonal(np.linalg.inv(columns.T @ columns)))
    return solution[:3].T, solution[3], std
