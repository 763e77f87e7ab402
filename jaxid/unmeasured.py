"""Motion of joints that have no encoder, that of the others being known.

Their own rows of the balance are an ordinary differential equation that the measured motion drives.
With linear forces this is the elimination by which minimal models arise; friction that they regroup
stays where it is.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxid.affine import affine
from jaxid.model import Plant
from jaxid.readings import overshot, own_reaction, small_solve

Motion = tuple[Array, Array, Array]


def complete_motion(
    plant: Plant, q: Array, qd: Array, qdd: Array, u: Array, times: Float[Array, " time"],
    measured: tuple[bool, ...], steps: int,
) -> Motion:
    """Fill in the motion of joints without an encoder.

    Args:
        plant: The plant; dry friction of those joints sticks exactly.
        q, qd, qdd: Motion, (time, n); what stands there for joints without an encoder is not used.
        u: Declared force at the samples, delay applied, (time, m).
        times: Of the samples [s].
        measured: Which joints have an encoder.
        steps: Integration steps a sample.

    Returns:
        The whole motion, (time, n). It starts where the joints would follow the others rigidly, in
        balance; what was otherwise dies out.
    """
    if all(measured):
        return q, qd, qdd
    seen = [i for i, m in enumerate(measured) if m]
    hidden = [i for i, m in enumerate(measured) if not m]
    order = jnp.argsort(jnp.asarray(seen + hidden))

    def joined(known: Array, own: Array) -> Array:
        return jnp.concatenate([known, own])[order]

    ports = plant.ports(jnp.zeros(len(measured))).size
    at_ports = jnp.zeros((ports, len(hidden))).at[jnp.asarray(hidden), jnp.arange(len(hidden))].set(1.0)

    def balance(known: Motion, own: Motion, memory: tuple, u: Array, t: Array, reaction: Array) -> tuple:
        motion = (joined(a, b) for a, b in zip(known, own, strict=True))
        return plant.balance(*motion, u, t, memory, at_ports @ reaction)

    def solved(known: Motion, x: tuple, u: Array, t: Array, reaction: Array) -> tuple[Array, Array]:
        """Accelerations, and the mass that they are of."""
        force = lambda a: balance(known, (*x[:2], a), x[2], u, t, reaction).residual[jnp.asarray(hidden)]
        zero = jnp.zeros_like(x[0])
        mass = jax.jacfwd(force)(zero)
        return small_solve(mass, -force(zero)), mass

    def rate(known: Motion, x: tuple, u: Array, t: Array, reaction: Array) -> tuple:
        hdd, _ = solved(known, x, u, t, reaction)
        return x[1], hdd, balance(known, (*x[:2], hdd), x[2], u, t, reaction).rates

    known = tuple(a[:, jnp.asarray(seen)] for a in (q, qd, qdd))
    first = tuple(a[0] for a in known)
    together = [jnp.broadcast_to(jnp.mean(a), (len(hidden),)) for a in first]
    memory, none = plant.initial_states(u[0]), jnp.zeros(len(hidden))
    pull = lambda h: balance(
        first, (h, *together[1:]), memory, u[0], times[0], none
    ).residual[jnp.asarray(hidden)]
    start = together[0] - small_solve(jax.jacfwd(pull)(together[0]), pull(together[0]))
    period = times[1] - times[0]
    h = period / steps

    def flow(at: list[Motion], x: tuple, u: Array, reaction: Array, t: Array) -> tuple:
        go = lambda slope, c: jax.tree.map(lambda a, b: a + c * h * b, x, slope)
        k1 = rate(at[0], x, u, t, reaction)
        k2 = rate(at[1], go(k1, 0.5), u, t, reaction)
        k3 = rate(at[1], go(k2, 0.5), u, t, reaction)
        k4 = rate(at[2], go(k3, 1.0), u, t, reaction)
        return jax.tree.map(lambda a, *b: a + h / 6 * (b[0] + 2 * b[1] + 2 * b[2] + b[3]), x, k1, k2, k3, k4)

    # Where forces are affine, a step is one matrix, worked out here once.
    x0 = (start, together[1], memory)
    matrix = affine(flow, ([first] * 3, x0, u[0], none), (times[0],))
    go_on = flow if matrix is None else lambda at, x, u, reaction, t: matrix(at, x, u, reaction)

    def step(at: list[Motion], x: tuple, u: Array, t: Array) -> tuple[tuple, Array]:
        """The state a step later, and the reaction of dry friction over it: it sticks exactly."""
        free = go_on(at, x, u, none, t)
        middle = tuple(0.5 * (a + b) for a, b in zip(x[:2], free[:2], strict=True))
        levels = balance(at[1], (*middle, none), x[2], u, t, none)
        dry, stick = (a[jnp.asarray(hidden)] for a in (levels.dry, levels.stick))
        own = h / jnp.diagonal(solved(at[1], x, u, t, none)[1])
        reaction, stuck, _, part = own_reaction(own, free[1], x[1], dry, dry + stick)
        q, v, memory = go_on(at, x, u, reaction, t)
        v = jnp.where(stuck, 0.0, v)
        return (q - overshot(x[1], v, part, h), v, memory), reaction

    def advance(x: tuple, now: tuple) -> tuple[tuple, tuple]:
        ends, u, t = now
        for k in range(steps):
            at = [_between(ends, (k + c) / steps, period) for c in (0.0, 0.5, 1.0)]
            x, reaction = step(at, x, u, t)
        return x, (x, reaction)

    ends = tuple(tuple(a[k : len(a) - 1 + k] for a in known) for k in range(2))
    _, (later, reactions) = jax.lax.scan(advance, x0, (ends, u[:-1], times[:-1]))
    accelerations = jax.vmap(lambda *now: solved(*now)[0])(ends[1], later, u[:-1], times[1:], reactions)
    at_start = (start, together[1], together[2])
    found = (*later[:2], accelerations)
    own = [jnp.concatenate([a[None], b]) for a, b in zip(at_start, found, strict=True)]
    return tuple(jax.vmap(joined)(a, b) for a, b in zip(known, own, strict=True))


def _between(ends: tuple[Motion, Motion], s: float, period: Array) -> Motion:
    """Motion at a fraction of a sample: cubics that have the velocities, and accelerations, of its ends."""
    (q0, v0, a0), (q1, v1, a1) = ends

    def hermite(x0: Array, x1: Array, d0: Array, d1: Array) -> Array:
        rise = x1 - x0
        bend = s * (1 - s) * ((1 - s) * (period * d0 - rise) + s * (rise - period * d1))
        return x0 + s * rise + bend

    return hermite(q0, q1, v0, v1), hermite(v0, v1, a0, a1), a0 + s * (a1 - a0)
