"""The balance of a plant along a measured motion: internal states of effects, and the residual force.

The residual's Jacobian is the regressor: there is no other set of columns.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.rhs import balance_of, phi
from jaxid.model.plant import Plant


def integrate_internal_states(
    plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, period: Array | float, start: Array | float = 0.0
) -> tuple:
    """Integrate the effects' internal states along a measured motion.

    The rate of an internal state is affine in it, and depends only on those of effects before it:
    along a known motion, decay and push are known at every sample, and the equation reduces to a
    linear recurrence.

    Args:
        plant: The plant with its effects.
        q, qd, qdd: Motion, (time, n).
        u: Declared force at the samples, delay applied, (time, m).
        period: Sampling time [s].
        start: Time of the first sample [s].

    Returns:
        The internal states at every sample.
    """
    first = plant.initial_states(u[0])
    if not jax.tree.leaves(first):
        return first
    motion = (q, qd, qdd, u, start + period * jnp.arange(q.shape[0]))
    own = jax.tree.map(lambda z: jnp.broadcast_to(z, (q.shape[0], *jnp.shape(z))), first)
    for i, z in enumerate(first):
        if z is None:
            continue

        def rate(value: Array, i: int = i, own: tuple = own) -> Array:
            at = (*own[:i], jnp.broadcast_to(value, own[i].shape), *own[i + 1 :])
            return jax.vmap(lambda *now: balance_of(plant, *now).rates[i])(*motion, at)

        push = rate(jnp.zeros_like(z))
        if z.ndim:
            here = jax.tree.map(lambda a: a[0], (*motion, own))
            slope = jax.jacfwd(
                lambda v, i=i, at=here: balance_of(plant, *at[:5], (*at[5][:i], v, *at[5][i + 1 :])).rates[i]
            )(z)
            own = (*own[:i], _vector_recurrence(z, slope, push, period), *own[i + 1 :])
            continue
        decay = rate(jnp.ones_like(z)) - push
        own = (*own[:i], _recurrence(z, decay, push, period), *own[i + 1 :])
    return own


def _recurrence(start: Array, decay: Array, push: Array, h: Array | float) -> Array:
    """Solve dz/dt = decay z + push from samples of both: push a cubic between them, decay a line.

    Lines in place of the cubic would be 1 % off at a sixth of the sampling rate, as much as a
    delay of a few hundredths of a sample.

    Source:
        Cox and Matthews (2002), J. Comput. Phys. 176, for the exponential integrals.
    """
    here, line, bend, turn = _cubics(push)
    mean = 0.5 * (decay[:-1] + decay[1:])
    e, p1, p2, p3, p4 = phi(h * mean)
    add = h * (here * p1 + line * p2 + 2 * bend * p3 + 6 * turn * p4)
    # The deviation of the decay from its mean acts as a linear push, in proportion to z at both ends: a
    # friction that slips stays at its level however fast the speed changes.
    gain = e + h * (p1 - p2) * (decay[:-1] - mean)
    scale = 1.0 / (1.0 - h * p2 * (decay[1:] - mean))

    def advance(z: Array, now: tuple) -> tuple[Array, Array]:
        z = now[0] * z + now[1]
        return z, z

    _, later = jax.lax.scan(advance, start, (scale * gain, scale * add))
    return jnp.concatenate([start[None], later])


def _vector_recurrence(start: Array, slope: Array, push: Array, h: Array | float) -> Array:
    """Solve dz/dt = slope z + push, slope constant (k, k), from samples of the push, (time, k)."""
    e, p1, p2, p3, p4 = _matrix_phi(h * slope)
    here, line, bend, turn = _cubics(push)
    add = h * (here @ p1.T + line @ p2.T + 2 * bend @ p3.T + 6 * turn @ p4.T)

    def advance(z: Array, add: Array) -> tuple[Array, Array]:
        # No call to a matrix library inside the loop, which would defeat its flag.
        z = jnp.sum(e * z, axis=1) + add
        return z, z

    _, later = jax.lax.scan(advance, start, add)
    return jnp.concatenate([start[None], later])


def _cubics(x: Array) -> tuple[Array, Array, Array, Array]:
    """Return the coefficients, over the fraction of an interval, of the cubic through four samples."""
    before = jnp.concatenate([2 * x[:1] - x[1:2], x[:-2]])
    here, there = x[:-1], x[1:]
    after = jnp.concatenate([x[2:], 2 * x[-1:] - x[-2:-1]])
    line = there - before / 3 - here / 2 - after / 6
    bend = (before + there) / 2 - here
    turn = (after - before) / 6 + (here - there) / 2
    return here, line, bend, turn


def _matrix_phi(x: Float[Array, "k k"]) -> list[Array]:
    """Compute `phi` of a matrix: the first row of blocks of the exponential of a shifted block matrix.

    By Taylor's series with scaling and squaring: LAPACK inside a batch of a study may wait for ever.
    """
    k, halvings = x.shape[0], 16
    whole = jnp.eye(5 * k, k=k).at[:k, :k].set(x) / 2.0**halvings
    term = total = jnp.eye(5 * k)
    for n in range(1, 7):
        term = jnp.matmul(term, whole) / n
        total = total + term
    for _ in range(halvings):
        total = jnp.matmul(total, total)
    return [total[:k, i * k : (i + 1) * k] for i in range(5)]


def balance_along(
    plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, period: Array | float, start: Array | float = 0.0
) -> tuple[Float[Array, "time n"], Float[Array, "time m"]]:
    """Compute the residual of the balance and the force of the drives along a motion, at the load [N or N m].

    Args:
        plant: The plant; internal states of its effects are integrated along the motion.
        q, qd, qdd: Motion, (time, n).
        u: Declared force at the samples, delay applied, (time, m).
        period: Sampling time [s].
        start: Time of the first sample [s].
    """
    own = integrate_internal_states(plant, q, qd, qdd, u, period, start)
    times = start + period * jnp.arange(q.shape[0])

    def at(q: Array, qd: Array, qdd: Array, u: Array, t: Array, own: tuple) -> tuple:
        balance = balance_of(plant, q, qd, qdd, u, t, own)
        return balance.residual, balance.drive

    if plant.coupled:
        # Along a batch the recursion over links runs through memory: it takes six times as long.
        return jax.lax.map(lambda now: at(*now), (q, qd, qdd, u, times, own))
    return jax.vmap(at)(q, qd, qdd, u, times, own)


def residual_along(
    plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, period: Array | float, start: Array | float = 0.0
) -> Float[Array, "time n"]:
    """Compute inverse dynamics minus declared force, over `drive_ratio` [N or N m, declared units].

    Arguments are those of `balance_along`.
    """
    residual, drive = balance_along(plant, q, qd, qdd, u, period, start)
    return residual / drive_ratio(plant, drive, u, q.shape[1])


def drive_ratio(
    plant: Plant, drive: Float[Array, "time m"], u: Float[Array, "time m"], joints: int
) -> Float[Array, " n"]:
    """Return the force at the load over the declared force, root mean squares over a log, by joint.

    It turns a residual back into declared units. In units of the load, a drive gain of zero, or a
    saturation at zero, would fit any log perfectly. A joint without a drive takes the ratio of all drives
    together: with a single one, all forces of the machine are in proportion to it.
    """
    tiny = 1e-300
    squares = [jnp.sum(x**2, axis=0) for x in (drive, u)]
    own = jnp.sqrt((squares[0] + tiny) / (squares[1] + tiny))
    whole = jnp.sqrt((jnp.sum(squares[0]) + tiny) / (jnp.sum(squares[1]) + tiny))
    places = [plant.drive_of(i, u.shape[1]) for i in range(joints)]
    return jnp.stack([whole if j is None else own[j] for j in places])
