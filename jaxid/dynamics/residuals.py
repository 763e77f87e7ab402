"""The balance of a plant along a measured motion: internal states of effects, and the residual force.

The residual's Jacobian is the regressor: there is no other set of columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.rhs import phi
from jaxid.model.balance import Balance, BarePlant, balance
from jaxid.model.effect import Effect, Signals
from jaxid.model.plant import Plant
from jaxid.numerics.affine import depends


# Traced once for all uses along a motion: tracing takes most of the time until a first result.
@eqx.filter_jit
def _balance_of(plant: Plant, bare: BarePlant | None, *now: Any) -> Balance:
    """Compute the balance at one instant, with smoothed dry friction."""
    return plant.balance(*now) if bare is None else balance(plant, *now, reaction=None, bare=bare)


def has_bare_part(plant: Plant) -> bool:
    """Check that a plant without its effects can be computed apart, and that this saves time.

    It can if the balance is that of all plants, and saves time if the joints are coupled.
    """
    return plant.coupled and type(plant).balance is Plant.balance


def bare_along(plant: Plant, q: Array, qd: Array, qdd: Array) -> BarePlant | None:
    """Compute what the plant without its effects does along a motion, (time, ...).

    None without a bare part, see `has_bare_part`: the whole balance is then computed for all samples at once.

    Args:
        plant: The plant; its effects do not matter.
        q, qd, qdd: Motion, (time, n).
    """
    if not has_bare_part(plant):
        return None
    # Along a batch the recursion over links runs through memory: it takes six times as long.
    return jax.lax.map(lambda now: BarePlant.of(plant, *now), (q, qd, qdd))


def integrate_internal_states(
    plant: Plant,
    q: Array,
    qd: Array,
    qdd: Array,
    u: Array,
    period: Array | float,
    start: Array | float = 0.0,
    bare: BarePlant | None = None,
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
        bare: The plant without effects along the motion, as `bare_along` gives it; None: not known.

    Returns:
        The internal states at every sample.
    """
    first = plant.initial_states(u[0])
    if not jax.tree.leaves(first):
        return first
    motion = (bare, q, qd, qdd, u, start + period * jnp.arange(q.shape[0]))
    internal = jax.tree.map(lambda z: jnp.broadcast_to(z, (q.shape[0], *jnp.shape(z))), first)
    for wave in _waves(plant, first, u.shape[1]):
        numbers = [i for i in wave if not first[i].ndim]
        vectors = [i for i in wave if first[i].ndim]
        held = {i: jnp.zeros_like(first[i]) for i in wave}
        push = _rates(plant, motion, internal, held)
        found = {}
        if numbers:
            moved = _rates(plant, motion, internal, held | {i: jnp.ones_like(first[i]) for i in numbers})
            columns = [jnp.stack([x[i] for i in numbers], axis=1) for x in (push, moved)]
            starts = jnp.stack([first[i] for i in numbers])
            together = _recurrence(starts, columns[1] - columns[0], columns[0], period)
            found |= dict(zip(numbers, together.T, strict=True))
        here = jax.tree.map(lambda a: a[0], (*motion, internal))
        for size in {first[i].size for i in vectors}:
            slopes = _slopes(plant, here, [i for i in vectors if first[i].size == size], size)
            found |= {i: _vector_recurrence(first[i], a, push[i], period) for i, a in slopes.items()}
        internal = tuple(found.get(i, z) for i, z in enumerate(internal))
    return internal


def _waves(plant: Plant, first: tuple, drives: int) -> list[list[int]]:
    """Group the effects with an internal state, so that no rate in a group depends on a state in it.

    A group shares its balances, where an arm with every candidate would take two for each effect. A rate
    depends on states of effects that are before it in the same drive only, and not on these if the effect
    makes no use of the drive's force. Groups are in the order in which their states are needed.
    """
    effects = plant.effects
    place = [plant.drive_of(e.port, drives) for e in effects]
    level: dict[int, int] = {}
    for i, z in enumerate(first):
        if z is None:
            continue
        before = [
            level[j]
            for j in level
            if place[j] is not None and place[j] == place[i] and _enters_drive(effects[j])
        ]
        needed = before and _uses_drive(effects[i], z)
        level[i] = 1 + max(before) if needed else 0
    return [[i for i in level if level[i] == k] for k in sorted(set(level.values()))]


def _enters_drive(effect: Effect) -> bool:
    """Check that an effect may change the force of its drive; a user's may without declaring it."""
    return effect.in_drive or type(effect).__module__.partition(".")[0] != "jaxid"


def _uses_drive(effect: Effect, state: Array) -> bool:
    """Check that the rate of an effect's state depends on the force of the drive, or may depend on it."""
    zero, one = jnp.zeros(()), jnp.ones(())
    still = {f.name: zero for f in fields(Signals)} | {"width": one, "dry_scale": one}
    return depends(lambda u: effect.act(Signals(**still | {"u": u}), state).rate, (zero,))


def _rates(plant: Plant, motion: tuple, internal: tuple, values: Mapping[int, Any]) -> dict[int, Array]:
    """Return the rates of some internal states along a motion, each state held at a value."""
    at = tuple(jnp.broadcast_to(values[i], z.shape) if i in values else z for i, z in enumerate(internal))
    return jax.vmap(lambda *now: {i: _balance_of(plant, *now).rates[i] for i in values})(*motion, at)


def _slopes(plant: Plant, here: tuple, vectors: list[int], size: int) -> dict[int, Array]:
    """Return the derivatives of rates by their internal states, vectors of one size, at one instant."""
    *motion, internal = here

    def rates(shift: Array) -> dict[int, Array]:
        at = tuple(z + shift if i in vectors else z for i, z in enumerate(internal))
        whole = _balance_of(plant, *motion, at).rates
        return {i: whole[i] for i in vectors}

    return jax.jacfwd(rates)(jnp.zeros(size))


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
    plant: Plant,
    q: Array,
    qd: Array,
    qdd: Array,
    u: Array,
    period: Array | float,
    start: Array | float = 0.0,
    bare: BarePlant | None = None,
) -> tuple[Float[Array, "time n"], Float[Array, "time m"]]:
    """Compute the residual of the balance and the force of the drives along a motion, at the load [N or N m].

    Args:
        plant: The plant; internal states of its effects are integrated along the motion.
        q, qd, qdd: Motion, (time, n).
        u: Declared force at the samples, delay applied, (time, m).
        period: Sampling time [s].
        start: Time of the first sample [s].
        bare: The plant without effects along the motion; None: `bare_along` is computed here.
    """
    bare = bare_along(plant, q, qd, qdd) if bare is None else bare
    internal = integrate_internal_states(plant, q, qd, qdd, u, period, start, bare)
    times = start + period * jnp.arange(q.shape[0])

    def at(*now: Any) -> tuple[Array, Array]:
        whole = _balance_of(plant, *now)
        return whole.residual, whole.drive

    now = (bare, q, qd, qdd, u, times, internal)
    if bare is None and plant.coupled:
        return jax.lax.map(lambda now: at(*now), now)
    return jax.vmap(at)(*now)


def residual_along(
    plant: Plant,
    q: Array,
    qd: Array,
    qdd: Array,
    u: Array,
    period: Array | float,
    start: Array | float = 0.0,
    bare: BarePlant | None = None,
) -> tuple[Float[Array, "time n"], Float[Array, " n"]]:
    """Compute inverse dynamics minus declared force [N or N m, declared units].

    Arguments are those of `balance_along`.

    Returns:
        The residual of the balance over the `drive_ratio`, (time, n); and that ratio, (n,).
    """
    residual, drive = balance_along(plant, q, qd, qdd, u, period, start, bare)
    ratio = drive_ratio(plant, drive, u, q.shape[1])
    return residual / ratio, ratio


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
    by_drive = jnp.sqrt((squares[0] + tiny) / (squares[1] + tiny))
    whole = jnp.sqrt((jnp.sum(squares[0]) + tiny) / (jnp.sum(squares[1]) + tiny))
    places = [plant.drive_of(i, u.shape[1]) for i in range(joints)]
    return jnp.stack([whole if j is None else by_drive[j] for j in places])
