"""The balance of forces along a prepared log: residual, regressor, measured force."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array, library
from jaxid.dynamics.hidden_joints import complete_motion
from jaxid.dynamics.residuals import balance_along, drive_ratio, residual_along
from jaxid.logs.prepare import Prepared
from jaxid.model.drives import Drives
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.kept import kept_jit


class ForceData(eqx.Module):
    """Arrays of a prepared log, as compiled code takes them.

    Args:
        q, qd, qdd, force: Prepared motion and declared force at the log's rate, (time, n) and (time, m).
        weight: Weight of each kept sample, (kept, n); zero for a sample that does not count.
        start: Time of the first sample, from the start of the log [s].
        period: Sampling time of the log [s].
        hold: Time for which a command is held [s]; zero if it is not held.
        decimator: Filter that the balance passes through.
        measured: Whether each joint has an encoder.
        steps: Integration steps per sample for the motion of joints without an encoder.
        passive: Whether no force drives the machine.
    """

    q: Float[Array, "time n"]
    qd: Float[Array, "time n"]
    qdd: Float[Array, "time n"]
    force: Float[Array, "time m"]
    weight: Float[Array, "kept n"]
    start: Float[Array, ""]
    period: float = eqx.field(static=True)
    hold: float = eqx.field(static=True)
    decimator: signals.Decimator = eqx.field(static=True)
    measured: tuple[bool, ...] = eqx.field(static=True, default=(True,))
    steps: int = eqx.field(static=True, default=1)
    passive: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(cls, data: Prepared, rows: np.ndarray | None = None) -> ForceData:
        """Return the arrays of a prepared log; weight one for `rows`, by default every moving sample."""
        rows = data.moving if rows is None else rows
        return cls(
            q=data.q,
            qd=data.qd,
            qdd=data.qdd,
            force=data.force,
            weight=rows.astype(np.float64),
            start=np.asarray(data.start),
            period=data.period,
            hold=data.hold,
            decimator=data.recipe.decimator,
            measured=data.measured,
            steps=data.steps,
            passive=not data.force.any(),
        )


def force_residual(plant: Plant, data: ForceData) -> Float[Array, "kept n"]:
    """Return inverse dynamics minus declared force, passed through one filter and decimated [N or N m]."""
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    motion = whole_motion(plant, data, u)
    return data.decimator(residual_along(plant, *motion, u, data.period, data.start))


def whole_motion(plant: Plant, data: ForceData, u: Array) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of all joints, with and without encoder, (time, n)."""
    times = data.start + data.period * jnp.arange(data.q.shape[0])
    return complete_motion(plant, data.q, data.qd, data.qdd, u, times, data.measured, data.steps)


@kept_jit
def force_and_columns(
    plant: Plant, places: tuple, data: ForceData, theta: Array, directions: Array | None = None
) -> tuple[Float[Array, "kept n"], Float[Array, "kept n c"]]:
    """Return the force residual of a plant and its Jacobian in the unknowns at some places.

    Args:
        plant: The plant.
        places: Places of the unknowns in the plant.
        data: Arrays of the prepared log.
        theta: Values of the unknowns, (p,).
        directions: Directions of the derivatives, (p, c); None: one derivative for each unknown.
    """

    def residual(step: Array) -> tuple[Array, Array]:
        moved = theta + (step if directions is None else directions @ step)
        e = force_residual(scatter(places, plant, moved), data)
        return e, e

    count = theta.size if directions is None else directions.shape[1]
    jacobian, e = jax.jacfwd(residual, has_aux=True)(jnp.zeros(count))
    return e, jacobian


@kept_jit
def scale_columns(
    plant: Plant, places: tuple, data: ForceData, theta: Array, directions: Array
) -> Float[Array, "n c"]:
    """Return the derivatives of the logarithm of the drives' ratio, by which every residual is divided.

    Args:
        plant: The plant.
        places: Places of the unknowns in the plant.
        data: Arrays of the prepared log.
        theta: Values of the unknowns, (p,).
        directions: Directions of the derivatives, (p, c).
    """

    def logarithm(step: Array) -> Array:
        moved = scatter(places, plant, theta + directions @ step)
        delays = moved.command_delays(data.force.shape[1])
        u = signals.delayed(data.force, delays, data.period, hold=data.hold)
        motion = whole_motion(moved, data, u)
        drive = balance_along(moved, *motion, u, data.period, data.start)[1]
        return jnp.log(drive_ratio(moved, drive, u, data.q.shape[1]))

    return jax.jacfwd(logarithm)(jnp.zeros(directions.shape[1]))


def measured_force(plant: Plant, data: ForceData) -> Float[Array, "kept n"]:
    """Return the filtered declared force by joint [N or N m]; zero for a joint without a drive."""
    u = data.decimator(signals.delayed(data.force, np.zeros(()), data.period, hold=data.hold))
    joints = data.q.shape[1]
    if type(plant).applied is not Drives.applied:
        return jax.vmap(lambda u: plant.applied(u, joints))(u)
    # Without a map the arrays of a prepared log stay numpy's, and nothing is compiled.
    if plant.actuated is None:
        return u
    xp = library(u)
    drives = [plant.drive_of(j, u.shape[1]) for j in range(joints)]
    return xp.stack([xp.zeros(len(u)) if k is None else u[:, k] for k in drives], axis=1)


def sharpened(plant: Plant, data: Prepared) -> Plant:
    """Return the plant with a sign as sharp as its log allows.

    The width is a third of the rest velocity. Slower samples do not count, so that the smoothing does not
    bias the fit.
    """
    rest_velocity = np.asarray(data.recipe.rest_velocity)[None]
    return plant.smoothed(np.asarray(1 / 3), typical_velocity(plant, rest_velocity, np.min))


def size_of_force(plant: Plant, data: ForceData) -> Float[Array, ""]:
    """Return the 2-norm of the measured force at the samples that count; of a free motion that of M qdd."""
    force = inertial_force(plant, data) if data.passive else measured_force(plant, data)
    return jnp.linalg.norm(jnp.where(data.weight > 0, force, 0.0))


def inertial_force(plant: Plant, data: ForceData) -> Float[Array, "kept n"]:
    """Return the force of the accelerations alone, filtered, by joint [N or N m]."""
    rest = jnp.zeros(data.q.shape[1])
    force = jax.vmap(lambda q, a: plant.inertial(q, rest, a) - plant.inertial(q, rest, rest))
    return data.decimator(force(jnp.asarray(data.q), jnp.asarray(data.qdd)))


force_size = kept_jit(size_of_force)
