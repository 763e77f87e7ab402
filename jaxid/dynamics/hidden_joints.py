"""Motion of joints that have no encoder, that of the others being known.

Their own rows of the balance are an ordinary differential equation that the measured motion drives.
With linear forces this is the elimination by which minimal models arise; friction that they regroup
stays where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.dry_friction import set_valued_step
from jaxid.dynamics.rhs import State, acceleration, affine_flow, hold_polynomial, picked, small_solve, spread
from jaxid.model.balance import Balance
from jaxid.model.plant import Plant
from jaxid.model.smoothing import Smoothing

Motion = tuple[Array, Array, Array]

# Steps of Newton to where joints without an encoder stand.
_RELAXING = 4


class HiddenJoints(Plant):
    """The joints without an encoder as a plant of their own, which the others' motion drives.

    Its force is the declared one and, behind that, position, velocity and acceleration of the others.
    Its ports are its joints: of dry friction only theirs is set-valued.

    Args:
        plant: The whole plant.
        seen, hidden: Its joints with an encoder, and without.
    """

    plant: Plant
    seen: tuple[int, ...] = eqx.field(static=True)
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
    ) -> Balance:
        n = len(self.seen) + q.size
        declared, known = jnp.split(u, [u.size - 3 * len(self.seen)])
        pairs = zip(known.reshape(3, -1), (q, qd, qdd), strict=True)
        motion = (spread(a, self.seen, n) + spread(b, self.hidden, n) for a, b in pairs)
        if reaction is not None:
            reaction = spread(reaction, self.hidden, self.plant.ports(jnp.zeros(n)).size)
        whole = self.plant.balance(*motion, declared, t, states, reaction)
        rows = (picked(a, self.hidden) for a in (whole.residual, whole.dry, whole.stick))
        rising = jnp.stack([picked(r, self.hidden) for r in whole.rising])
        slides, rises = (
            tuple(k for k, i in enumerate(self.hidden) if i in ports) for ports in (whole.slides, whole.rises)
        )
        return Balance(*rows, rising, whole.rates, whole.drive, slides, rises)


def _of_joints(smoothing: Smoothing, joints: tuple[int, ...]) -> Smoothing:
    """Return the smoothing at some joints, if each has a width of its own."""
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
    seen, hidden = (np.flatnonzero(np.equal(measured, side)) for side in (True, False))
    carried = HiddenJoints(plant, tuple(seen.tolist()), tuple(hidden.tolist()))
    known = tuple(a[:, seen] for a in (q, qd, qdd))
    period = times[1] - times[0]
    h = period / steps
    # Force of the carried plant at the start, in the middle and at the end of every step.
    parts = (np.arange(steps)[:, None] + np.array([0.0, 0.5, 1.0])) / steps
    force = jax.vmap(lambda s: jnp.concatenate([u[:-1], *_between(known, s, period)], axis=1), out_axes=1)(
        parts.ravel()
    ).reshape((len(u) - 1) * steps, 3, -1)
    starts = (times[:-1, None] + h * np.arange(steps)).ravel()

    together = [jnp.broadcast_to(jnp.mean(a[0]), hidden.shape) for a in known]
    memory, none = plant.initial_states(u[0]), jnp.zeros(hidden.size)
    relaxed = _relaxed(
        lambda q: carried.balance(q, *together[1:], force[0, 0], times[0], memory, none).residual,
        together[0],
    )
    x0 = State(relaxed, together[1], memory)
    flow = affine_flow(carried, x0, tuple(force[0]), times[0], h)

    def advance(x: State, now: tuple) -> tuple[State, tuple]:
        values, t = tuple(now[0]), now[1]
        bound = None if flow is None else lambda x, *reaction: flow(x, values, *reaction)
        x, reaction = set_valued_step(carried, x, hold_polynomial(values), t, h, bound)
        return x, (x, reaction)

    _, later = jax.lax.scan(advance, x0, (force, starts))
    last = slice(steps - 1, None, steps)
    x, reaction = jax.tree.map(lambda a: a[last], later)
    solved = jax.vmap(lambda *now: acceleration(carried, *now))
    found = (x.q, x.qd, solved(x, force[last, 2], times[1:], reaction))
    own = [jnp.concatenate([a[None], b]) for a, b in zip((relaxed, *together[1:]), found, strict=True)]
    return tuple(a.at[:, hidden].set(b) for a, b in zip((q, qd, qdd), own, strict=True))


def resting(
    plant: Plant, q: Float[np.ndarray, " n"], drives: int, measured: tuple[bool, ...]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
    """Where joints without an encoder stand while all is at rest, and how they go along with the others.

    Args:
        plant: The plant.
        q: Positions; what stands there for joints without an encoder is not used.
        drives: How many forces the plant is driven by.
        measured: Which joints have an encoder, k of them.

    Returns:
        Positions of all joints, and their derivative in those of the joints with an encoder. Joints that
        nothing holds stand where the others do on average.
    """
    if all(measured):
        return q, np.eye(q.size)
    seen, hidden = (np.flatnonzero(np.equal(measured, side)) for side in (True, False))
    carried = HiddenJoints(plant, tuple(seen.tolist()), tuple(hidden.tolist()))
    return tuple(np.asarray(a) for a in _resting(carried, q[seen], drives))


@eqx.filter_jit
def _resting(carried: HiddenJoints, known: Array, drives: int) -> tuple[Array, Array]:
    n, u = len(carried.seen) + len(carried.hidden), jnp.zeros(drives)
    still, memory = jnp.zeros(len(carried.hidden)), carried.plant.initial_states(u)

    def whole(known: Array) -> Array:
        force = jnp.concatenate([u, known, jnp.zeros(2 * known.size)])
        pull = lambda q: carried.balance(q, still, still, force, jnp.zeros(()), memory, still).residual
        own = _relaxed(pull, jnp.broadcast_to(jnp.mean(known), still.shape))
        return spread(known, carried.seen, n) + spread(own, carried.hidden, n)

    return whole(known), jax.jacfwd(whole)(known)


def _relaxed(pull: Callable[[Array], Array], together: Array) -> Array:
    """Where nothing pulls; where the others are if there is no such place, as within a clearance."""
    q = together
    # One step for linear forces; a ripple along a stiff spring takes more, and slopes one more than places.
    for _ in range(_RELAXING):
        q = q - small_solve(jax.jacfwd(pull)(q), pull(q))
    return jnp.where(jnp.all(jnp.abs(pull(q)) <= jnp.abs(pull(together))), q, together)


def _between(known: Motion, s: Array, period: Array) -> Motion:
    """Motion at a fraction of every sample: cubics with the velocities, and accelerations, of its ends."""
    (q0, v0, a0), (q1, v1, a1) = ([a[k : len(a) - 1 + k] for a in known] for k in range(2))

    def hermite(x0: Array, x1: Array, d0: Array, d1: Array) -> Array:
        rise = x1 - x0
        bend = s * (1 - s) * ((1 - s) * (period * d0 - rise) + s * (rise - period * d1))
        return x0 + s * rise + bend

    return hermite(q0, q1, v0, v1), hermite(v0, v1, a0, a1), a0 + s * (a1 - a0)
