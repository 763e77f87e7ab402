"""Motion of joints without an encoder, driven by the measured motion of the others.

Their rows of the balance are an ordinary differential equation with the measured motion as input.
With linear forces this is the elimination that leads to minimal models; friction that those regroup
stays at its joint here.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, acceleration, affine_flow, hold_polynomial, picked, spread
from jaxid.model.balance import Balance
from jaxid.model.plant import Plant
from jaxid.model.smoothing import Smoothing
from jaxid.numerics.affine import Affine
from jaxid.numerics.elimination import small_solve
from jaxid.numerics.kept import kept_jit

Motion = tuple[Array, Array, Array]

# Newton steps to the rest position of joints without an encoder.
_RELAXING = 4


class HiddenJoints(Plant):
    """The joints without an encoder as a separate plant that the motion of the others drives.

    Its input is the declared force and, behind that, position, velocity and acceleration of the others.
    Its ports are its joints: only their dry friction is set-valued.

    Args:
        plant: The whole plant.
        measured: Its joints with an encoder.
        hidden: Its joints without one.
    """

    plant: Plant
    measured: tuple[int, ...] = eqx.field(static=True)
    hidden: tuple[int, ...] = eqx.field(static=True)
    effects: ClassVar[property] = property(lambda self: self.plant.effects)
    smoothing: ClassVar[property] = property(lambda self: _of_joints(self.plant.smoothing, self.hidden))
    diagonal: ClassVar[property] = property(lambda self: self.plant.diagonal)

    def balance(
        self,
        q: Array,
        qd: Array,
        qdd: Array,
        u: Array,
        t: Array,
        states: tuple,
        reaction: Array | None = None,
        *,
        behind: bool = False,
    ) -> Balance:
        # Beside measured joints links count as in front of springs, whatever is asked.
        n = len(self.measured) + q.size
        declared, known = jnp.split(u, [u.size - 3 * len(self.measured)])
        pairs = zip(known.reshape(3, -1), (q, qd, qdd), strict=True)
        if reaction is not None:
            reaction = spread(reaction, self.hidden, self.plant.ports(jnp.zeros(n)).size)
        q, qd, qdd = (spread(a, self.measured, n) + spread(b, self.hidden, n) for a, b in pairs)
        whole = self.plant.balance(q, qd, qdd, declared, t, states, reaction)
        rising = jnp.stack([picked(r, self.hidden) for r in whole.rising])
        slides, rises = (
            tuple(k for k, i in enumerate(self.hidden) if i in ports) for ports in (whole.slides, whole.rises)
        )
        residual, dry, stick = (picked(a, self.hidden) for a in (whole.residual, whole.dry, whole.stick))
        return Balance(
            residual=residual,
            dry=dry,
            stick=stick,
            rising=rising,
            rates=whole.rates,
            drive=whole.drive,
            slides=slides,
            rises=rises,
        )


def _of_joints(smoothing: Smoothing, joints: tuple[int, ...]) -> Smoothing:
    """Return the smoothing of some joints, with their velocity scales if each joint has one."""
    scale = smoothing.velocity_scale
    return smoothing if scale.ndim == 0 else Smoothing(smoothing.sharpness, scale[np.asarray(joints)])


def complete_motion(
    plant: Plant,
    q: Array,
    qd: Array,
    qdd: Array,
    u: Array,
    times: Float[Array, " time"],
    measured: tuple[bool, ...],
    steps: int,
) -> Motion:
    """Fill in the motion of joints without an encoder.

    Args:
        plant: The plant; dry friction of those joints sticks exactly.
        q, qd, qdd: Motion, (time, n); columns of joints without an encoder are not used.
        u: Declared force at the samples, delay applied, (time, m).
        times: Times of the samples [s].
        measured: Flags of the joints with an encoder.
        steps: Integration steps per sample.

    Returns:
        The whole motion, (time, n). It starts in balance, with the joints following the others rigidly;
        any other start dies out.
    """
    if all(measured):
        return q, qd, qdd
    visible, hidden = (np.flatnonzero(np.equal(measured, side)) for side in (True, False))
    carried = HiddenJoints(plant, tuple(visible.tolist()), tuple(hidden.tolist()))
    known = (q[:, visible], qd[:, visible], qdd[:, visible])
    period = times[1] - times[0]
    h = period / steps
    # Force of the carried plant at the start, in the middle and at the end of every step.
    parts = (np.arange(steps)[:, None] + np.array([0.0, 0.5, 1.0])) / steps
    force = jax.vmap(lambda s: jnp.concatenate([u[:-1], *_between(known, s, period)], axis=1), out_axes=1)(
        parts.ravel()
    ).reshape((len(u) - 1) * steps, 3, -1)
    starts = (times[:-1, None] + h * np.arange(steps)).ravel()

    q0, qd0, qdd0 = (jnp.broadcast_to(jnp.mean(a[0]), hidden.shape) for a in known)
    memory, none = plant.initial_states(u[0]), jnp.zeros(hidden.size)
    relaxed = _relaxed(
        lambda q: carried.balance(q, qd0, qdd0, force[0, 0], times[0], memory, none).residual,
        q0,
    )
    x0 = State(relaxed, qd0, memory)
    flow = affine_flow(carried, x0, tuple(force[0]), times[0], h)

    def advance(x: State, now: tuple) -> tuple[State, tuple]:
        values, t = tuple(now[0]), now[1]
        bound = None if flow is None else functools.partial(_under, flow, values)
        x, reaction = set_valued_step(carried, x, hold_polynomial(values), t, h, bound)
        return x, (x, reaction)

    _, later = jax.lax.scan(advance, x0, (force, starts))
    last = slice(steps - 1, None, steps)
    x, reaction = jax.tree.map(lambda a: a[last], later)
    solved = jax.vmap(lambda *now: acceleration(carried, *now))
    motion = (x.q, x.qd, solved(x, force[last, 2], times[1:], reaction))
    filled = [jnp.concatenate([a[None], b]) for a, b in zip((relaxed, qd0, qdd0), motion, strict=True)]
    q, qd, qdd = (jnp.asarray(a).at[:, hidden].set(b) for a, b in zip((q, qd, qdd), filled, strict=True))
    return q, qd, qdd


def _under(flow: Affine, values: tuple[Array, ...], x: State, *reaction: Array) -> State:
    """Apply a flow under a force, given as `hold_polynomial` takes it."""
    return flow(x, values, *reaction)


def resting(
    plant: Plant, q: Float[np.ndarray, " n"], drives: int, measured: tuple[bool, ...]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
    """Compute the rest position of joints without an encoder, and how they follow the others.

    Args:
        plant: The plant with its effects.
        q: Positions; entries of joints without an encoder are not used.
        drives: Number of drives of the plant.
        measured: Flags of the joints with an encoder, k of them.

    Returns:
        Positions of all joints, and their derivative in those of the joints with an encoder. Joints that
        nothing holds take the mean position of the others.
    """
    if all(measured):
        return q, np.eye(q.size)
    visible, hidden = (np.flatnonzero(np.equal(measured, side)) for side in (True, False))
    carried = HiddenJoints(plant, tuple(visible.tolist()), tuple(hidden.tolist()))
    rest, follow = _resting(carried, q[visible], drives)
    return np.asarray(rest), np.asarray(follow)


@kept_jit
def _resting(carried: HiddenJoints, known: Array, drives: int) -> tuple[Array, Array]:
    n, u = len(carried.measured) + len(carried.hidden), jnp.zeros(drives)
    still, memory = jnp.zeros(len(carried.hidden)), carried.plant.initial_states(u)

    def whole(known: Array) -> Array:
        force = jnp.concatenate([u, known, jnp.zeros(2 * known.size)])
        pull = lambda q: carried.balance(q, still, still, force, jnp.zeros(()), memory, still).residual
        rest = _relaxed(pull, jnp.broadcast_to(jnp.mean(known), still.shape))
        return spread(known, carried.measured, n) + spread(rest, carried.hidden, n)

    return whole(known), jax.jacfwd(whole)(known)


def _relaxed(pull: Callable[[Array], Array], together: Array) -> Array:
    """Find the position without forces; return that of the others if there is none, as within a clearance."""
    q = together
    # Linear forces take one step; a ripple along a stiff spring more, and slopes one more than positions.
    for _ in range(_RELAXING):
        q = q - small_solve(jax.jacfwd(pull)(q), pull(q))
    return jnp.where(jnp.all(jnp.abs(pull(q)) <= jnp.abs(pull(together))), q, together)


def _between(known: Motion, s: Array, period: Array) -> Motion:
    """Interpolate the motion at a fraction of every sample: cubics with the derivatives at its ends."""
    (q0, v0, a0), (q1, v1, a1) = ([a[k : len(a) - 1 + k] for a in known] for k in range(2))

    def hermite(x0: Array, x1: Array, d0: Array, d1: Array) -> Array:
        rise = x1 - x0
        bend = s * (1 - s) * ((1 - s) * (period * d0 - rise) + s * (rise - period * d1))
        return x0 + s * rise + bend

    return hermite(q0, q1, v0, v1), hermite(v0, v1, a0, a1), a0 + s * (a1 - a0)
