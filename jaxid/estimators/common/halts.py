"""Friction around halts and reversals, which a filtered velocity does not tell.

A joint that halts is held by any force up to the level of its dry friction, and a filter blurs the instant at
which it stops or turns. The balance takes the friction of the filtered velocity, whose error there follows
the motion: it is no noise that averages out over a log.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.residuals import drive_ratio, integrate_internal_states
from jaxid.logs.prepare import Prepared, turning
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.force_balance import ForceData

# Error of a filtered velocity where the acceleration jumps, over the jump times a period of the cut-off: an
# ideal low-pass loses the spectrum of a kink beyond its cut-off, which falls with 1 / f^2.
_KINK = 0.5 / np.pi**2
# Powers of time with which the error of the friction varies over a halt: windows are long beside one.
_MOMENTS = 2


class Friction(NamedTuple):
    """Dry friction of a plant on the average over a log.

    Args:
        level: Half the jump of each row of the balance where the velocity of each joint changes its sign, in
            units of the declared force, (n, n).
        ratio: Force at the load over the declared force, by joint, (n,).
        jump: Largest jump of each joint's acceleration where it halts or turns [m/s^2 or rad/s^2], (n,).
    """

    level: Float[Array, "n n"]
    ratio: Float[Array, " n"]
    jump: Float[Array, " n"]


@kept_jit
def dry_friction(plant: Plant, data: ForceData, rest_velocity: Float[Array, " n"]) -> Friction:
    """Compute the level of dry friction at the median position, and what it does to the acceleration.

    Args:
        plant: The plant, its friction sharp enough to be whole at the rest velocity.
        data: Arrays of the prepared log.
        rest_velocity: Velocity below which a joint counts as at rest [m/s or rad/s], (n,).
    """
    joints, u, zero = data.q.shape[1], data.force, jnp.zeros(data.q.shape[1])
    q, v, middle = jnp.median(data.q, axis=0), jnp.sqrt(jnp.mean(data.qd**2, axis=0)), jnp.median(u, axis=0)
    states = plant.initial_states(middle)

    def force(velocity: Array, acceleration: Array) -> Array:
        return plant.balance(q, velocity, acceleration, middle, jnp.zeros(()), states).residual

    def half(joint: Array) -> Array:
        ends = [force(v.at[joint].set(slow), zero) for slow in (rest_velocity[joint], -rest_velocity[joint])]
        return 0.5 * jnp.abs(ends[0] - ends[1])

    level = jax.vmap(half, out_axes=1)(jnp.arange(joints))
    # A joint that halts loses at most the acceleration by twice its friction.
    mass = jnp.abs(jnp.diagonal(jax.jacfwd(force, argnums=1)(v, zero)))
    jump = 2 * jnp.diagonal(level) / jnp.where(mass > 0, mass, 1.0)

    own = integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)
    times = data.start + data.period * jnp.arange(len(data.q))
    drive = jax.vmap(lambda q, v, u, t, own: plant.balance(q, v, zero, u, t, own).drive)
    ratio = drive_ratio(plant, drive(data.q, data.qd, u, times, own), u, joints)
    return Friction(level / ratio[:, None], ratio, jump)


def errors_at_halts(data: Prepared, friction: Friction) -> scipy.sparse.csr_array:
    """Return the errors of the friction around halts, a column for each in units of its standard deviation.

    The friction is taken at one end of its range and may be at the other: an error of up to twice its level,
    whose standard deviation is about the level. Over a halt it is a constant and a slope in time.

    Args:
        data: The prepared log.
        friction: The dry friction.

    Returns:
        The errors at all samples of joint 1, then of joint 2 and so on, (n time, errors).
    """
    (time, n), level = data.qd.shape, np.asarray(friction.level)
    off = _KINK * np.asarray(friction.jump) / data.recipe.motion_hz(1.0 / data.period)
    slow = np.abs(data.qd) < np.asarray(data.recipe.rest_velocity) + off
    rows, columns, values, count = [], [], [], 0
    for joint, flags in enumerate((slow | turning(data.qd)).T):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
        for start, end in edges.reshape(-1, 2):
            course = np.linspace(-1.0, 1.0, end - start)[:, None] ** np.arange(_MOMENTS)
            for i in np.flatnonzero(level[:, joint]):
                for k, x in enumerate(course.T):
                    rows.append(i * time + np.arange(start, end))
                    columns.append(np.full(end - start, count + k))
                    values.append(level[i, joint] * x)
            count += _MOMENTS
    if not rows:
        return scipy.sparse.csr_array((n * time, 0))
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.csr_array(entries, shape=(n * time, count))
