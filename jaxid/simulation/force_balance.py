"""The balance of forces along a prepared log: residual, regressor, measured force."""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array, library
from jaxid.dynamics.hidden_joints import complete_motion
from jaxid.dynamics.residuals import bare_along, has_bare_part, residual_along
from jaxid.logs.prepare import Prepared
from jaxid.model.balance import BarePlant
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
    hold: Float[Array, ""]
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
            hold=np.asarray(data.hold),
            decimator=data.recipe.decimator,
            measured=data.measured,
            steps=data.steps,
            passive=not data.force.any(),
        )


def force_residual(plant: Plant, data: ForceData, bare: BarePlant | None = None) -> Float[Array, "kept n"]:
    """Return inverse dynamics minus declared force, passed through one filter and decimated [N or N m].

    Args:
        plant: The plant with its effects.
        data: Arrays of the prepared log.
        bare: The plant without effects along the log, as `bare_plant` gives it; None: not known.
    """
    return _residual_and_ratio(plant, data, bare)[0]


def _residual_and_ratio(
    plant: Plant, data: ForceData, bare: BarePlant | None
) -> tuple[Float[Array, "kept n"], Float[Array, " n"]]:
    """Return the force residual, and the drives' ratio by which it is divided."""
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    motion = whole_motion(plant, data, u)
    residual, ratio = residual_along(plant, *motion, u, data.period, data.start, bare)
    return data.decimator(residual), ratio


def whole_motion(plant: Plant, data: ForceData, u: Array) -> tuple[Array, Array, Array]:
    """Return position, velocity and acceleration of all joints, with and without encoder, (time, n)."""
    times = data.start + data.period * jnp.arange(data.q.shape[0])
    return complete_motion(plant, data.q, data.qd, data.qdd, u, times, data.measured, data.steps)


class Linearised(NamedTuple):
    """The force residual of a plant at some values of its unknowns, with derivatives in some directions.

    Args:
        residual: Inverse dynamics minus declared force, over the drives' ratio, (kept, n).
        columns: Its derivatives, (kept, n, c).
        ratio: Ratio of the drives, by joint, (n,).
        slopes: Derivatives of the logarithm of that ratio, (n, c).
    """

    residual: Array
    columns: Array
    ratio: Array
    slopes: Array


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
    found = _linearised(plant, places, data, theta, directions, None)
    return found.residual, found.columns


@kept_jit
def force_linearised(
    plant: Plant, places: tuple, data: ForceData, theta: Array, directions: Array, bare: BarePlant | None
) -> Linearised:
    """Return the force residual of a plant with its derivatives in some directions.

    Args:
        plant, places, data, theta, directions: See `force_and_columns`.
        bare: The plant without effects along the log, which the directions leave as it is; None: not known.
    """
    return _linearised(plant, places, data, theta, directions, bare)


def _linearised(
    plant: Plant,
    places: tuple,
    data: ForceData,
    theta: Array,
    directions: Array | None,
    bare: BarePlant | None,
) -> Linearised:
    def residual(step: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        moved = theta + (step if directions is None else directions @ step)
        e, ratio = _residual_and_ratio(scatter(places, plant, moved), data, bare)
        return (e, jnp.log(ratio)), (e, ratio)

    count = theta.size if directions is None else directions.shape[1]
    (columns, slopes), (e, ratio) = jax.jacfwd(residual, has_aux=True)(jnp.zeros(count))
    return Linearised(e, columns, ratio, slopes)


def knows_bare_plant(plant: Plant, data: ForceData) -> bool:
    """Check that a log determines what the plant does without its effects: the motion of all joints."""
    return has_bare_part(plant) and all(data.measured)


@kept_jit
def bare_plant(plant: Plant, data: ForceData) -> BarePlant | None:
    """Return what the plant without its effects does along a log, if that can be known beside its effects.

    Args:
        plant: The plant; its effects do not matter.
        data: Arrays of a log in which all joints have an encoder.
    """
    return bare_along(plant, data.q, data.qd, data.qdd)


@kept_jit
def inertial_columns(plant: Plant, places: tuple, data: ForceData, theta: Array) -> Float[Array, "kept n p"]:
    """Return the derivatives of the inertial forces by unknowns of the plant, filtered and decimated.

    Args:
        plant: The plant without effects.
        places: Places of the unknowns in the plant.
        data: Arrays of a log in which all joints have an encoder.
        theta: Values of the unknowns, (p,).
    """

    def at(motion: tuple) -> Array:
        return jax.jacfwd(lambda theta: scatter(places, plant, theta).inertial(*motion))(theta)

    columns = jax.lax.map(at, (data.q, data.qd, data.qdd))
    filtered = data.decimator(columns.reshape(len(columns), -1))
    return filtered.reshape(len(filtered), *columns.shape[1:])


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
    """Return the 2-norm of the measured force times the weights; of a free motion that of M qdd."""
    force = inertial_force(plant, data) if data.passive else measured_force(plant, data)
    return jnp.linalg.norm(data.weight * force)


def inertial_force(plant: Plant, data: ForceData) -> Float[Array, "kept n"]:
    """Return the force of the accelerations alone, filtered, by joint [N or N m]."""
    rest = jnp.zeros(data.q.shape[1])
    force = jax.vmap(lambda q, a: plant.inertial(q, rest, a) - plant.inertial(q, rest, rest))
    return data.decimator(force(jnp.asarray(data.q), jnp.asarray(data.qdd)))


force_size = kept_jit(size_of_force)
