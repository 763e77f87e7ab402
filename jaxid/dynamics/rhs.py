"""Accelerations from the balance of a plant at an instant, and its motion over a step.

The step in which dry friction sticks exactly is in `jaxid.dynamics.dry_friction`; residuals along a measured
motion, whose Jacobians are regressors, are in `jaxid.dynamics.residuals`.
"""

from __future__ import annotations

from collections.abc import Callable
from math import factorial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.model.balance import Balance
from jaxid.model.plant import Plant
from jaxid.numerics.affine import Affine, affine
from jaxid.numerics.elimination import small_solve
from jaxid.numerics.smooth import ramp, sign
from jaxid.numerics.tangents import varying

# Traced once for all uses in a step: tracing takes most of the time until a first result.
balance_of = eqx.filter_jit(lambda plant, *args: plant.balance(*args, behind=True))

# Coordinates, velocities, and internal states in one array.
Split = tuple[Array, Array, Array]


class State(eqx.Module):
    """Motion and memory: coordinates, velocities, and the effects' internal states (None without memory)."""

    q: Float[Array, " n"]
    qd: Float[Array, " n"]
    own: tuple


@jax.custom_jvp
def inverse(a: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Invert a positive definite matrix by unrolled elimination of whole rows, without pivoting.

    For several right-hand sides it replaces `small_solve`: 0.17 against 0.78 us for seven joints.
    """
    unit = np.eye(len(a))
    rows = jnp.concatenate([a, unit], axis=1)
    for k in range(len(a)):
        pivot = rows[k] / rows[k, k]
        # The row itself loses all but the pivot.
        rows = rows - (rows[:, k] - unit[k])[:, None] * pivot
    return rows[:, len(a) :]


@inverse.defjvp
def _inverse_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    out = inverse(*primals)
    half = jnp.sum(out[:, :, None] * tangents[0][None], axis=1)
    return out, -jnp.sum(half[:, :, None] * out[None], axis=1)


def acceleration(
    plant: Plant, x: State, u: Array, t: Array, reaction: Array | None = None
) -> Float[Array, " n"]:
    """Solve the balance, affine in the acceleration, for it.

    Args:
        plant: The plant.
        x: State.
        u: Declared force of each drive, delay applied [N or N m].
        t: Time from the start of the log [s].
        reaction: Dry-friction force by port from a set-valued step; absent: smoothed.
    """
    if plant.coupled and reaction is not None:
        return _coupled_acceleration(plant, x, u, t, reaction)
    mass, rest = _mass_and_rest(plant, x, u, t, reaction)
    if reaction is not None or not rest.rises:
        if plant.coupled:
            return _coupled_acceleration(plant, x, u, t, reaction)
        return solved(mass, -rest.residual)
    # At zero acceleration the balance contains no friction of growing speed: up to its level, that resists
    # the remaining force.
    each = need_apart(plant, mass, rest.rises)
    direction = sign(x.qd, plant.port_width(x.q)[: x.q.size])
    forth, back = (spread(picked(r, rest.rises), rest.rises, each.size) for r in rest.rising)
    remaining = -rest.residual
    forth, back = 0.5 * (1 + direction) * forth, 0.5 * (1 - direction) * back
    corner = plant.smoothing.sharpness
    more = ramp(remaining, forth, corner * forth) - ramp(-remaining, back, corner * back)
    return (remaining - more) / each


def _mass_and_rest(
    plant: Plant, x: State, u: Array, t: Array, reaction: Array | None
) -> tuple[Array, Balance]:
    """Return the mass, (n, n), or (n,) if diagonal, and the balance at zero acceleration."""

    def residual(qdd: Array) -> tuple[Array, Balance]:
        balance = balance_of(plant, x.q, x.qd, qdd, u, t, x.own, reaction)
        return balance.residual, balance

    return mass_of(plant, residual, x.q)


@eqx.filter_custom_jvp
def _coupled_acceleration(
    plant: Plant, x: State, u: Array, t: Array, reaction: Array | None
) -> Float[Array, " n"]:
    """Solve the balance with derivatives by the implicit function.

    A tangent takes one balance under given accelerations. The inverse of the mass is shared by all tangents;
    neither it nor the mass is differentiated.
    """
    mass, rest = _mass_and_rest(plant, x, u, t, reaction)
    return -jnp.sum(inverse(mass) * rest.residual, axis=1)


@_coupled_acceleration.def_jvp
def _coupled_acceleration_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    mass, rest = _mass_and_rest(*primals)
    mobility = inverse(mass)
    qdd = -jnp.sum(mobility * rest.residual, axis=1)

    def residual(plant: Plant, x: State, u: Array, t: Array, reaction: Array | None) -> Array:
        return balance_of(plant, x.q, x.qd, qdd, u, t, x.own, reaction).residual

    missing = eqx.filter_jvp(residual, primals, tangents)[1]
    return qdd, -jnp.sum(mobility * missing, axis=1)


def need_apart(plant: Plant, mass: Array, ports: tuple[int, ...]) -> Array:
    """Return the mass of each joint, if no joint accelerates another and the given ports are joints.

    Raises:
        InputError: Otherwise: friction that depends on the acceleration cannot be solved there.
    """
    apart = mass.ndim == 1 or mass.shape == (1, 1)
    if apart and max(ports) < mass.shape[0]:
        return mass if mass.ndim == 1 else mass[0]
    raise InputError(
        f"velocity_hysteresis cannot be simulated here: on kind = {plant.kind!r} "
        + ("it, or other dry friction beside it, acts in a spring" if apart else "joints push each other"),
        hint="put it on a joint of a machine whose joints do not push each other, "
        "and leave dry friction out of the springs",
    )


def mass_of(plant: Plant, residual: Callable[[Array], tuple], q: Array) -> tuple[Array, Any]:
    """Return the derivative of a residual in the accelerations, (n, n), or (n,) if diagonal; and its aux."""
    zero = jnp.zeros_like(q)
    if plant.diagonal:
        return jax.jvp(residual, (zero,), (jnp.ones_like(q),), has_aux=True)[1:]
    return jax.jacfwd(residual, has_aux=True)(zero)


def solved(mass: Array, force: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the accelerations that forces give a mass, which is a matrix or its diagonal."""
    return force / mass if mass.ndim == 1 else small_solve(mass, force)


def derivative(plant: Plant, x: State, u: Array, t: Array, reaction: Array | None = None) -> State:
    """Compute the time derivative of the state: the right-hand side."""
    qdd = acceleration(plant, x, u, t, reaction)
    rates = balance_of(plant, x.q, x.qd, qdd, u, t, x.own, reaction).rates
    return State(x.qd, qdd, rates)


# Traced once for all stages of a step.
_derivative = eqx.filter_jit(derivative)


def vector_field(t: Array, x: State, args: tuple[Plant, Callable[[Array], Array]]) -> State:
    """Compute the right-hand side in diffrax's form: args are the plant and the force as function of time."""
    plant, force = args
    drives = jax.eval_shape(force, t).size
    late = [force(t - d)[j] for j, d in enumerate(plant.command_delays(drives))]
    return derivative(plant, x, jnp.stack(late), t)


def _own_decay(plant: Plant, x: State, u: Array, t: Array) -> State:
    """Return the decay rate of each internal state, as a tree like the state; zero for the motion.

    The rate of an internal state is affine in it, so that its slope is the decay; a lag far shorter
    than the step, or a presliding spring at speed, is then stepped exactly instead of blowing up.
    Vectors (oscillators) have no single decay, and belong to the explicit part.
    """

    def rates(own: tuple) -> tuple:
        return balance_of(plant, x.q, x.qd, jnp.zeros_like(x.q), u, t, own).rates

    slopes = jax.jvp(rates, (x.own,), (jax.tree.map(jnp.ones_like, x.own),))[1]
    slopes = jax.tree.map(lambda s: s if s.ndim == 0 else jnp.zeros_like(s), slopes)
    zero = jnp.zeros_like(x.q)
    return State(zero, zero, slopes)


def phi(x: Array) -> list[Array]:
    """Compute e^x, (e^x - 1)/x and the next three of that family, by series near zero (cancellation)."""
    small = jnp.abs(x) < 0.3
    safe = jnp.where(small, 1.0, x)
    closed = [jnp.expm1(safe) / safe]
    for k in range(1, 4):
        closed.append((closed[-1] - 1 / factorial(k)) / safe)
    series = [jnp.zeros_like(x)] * 4
    for k in reversed(range(12)):  # twelve terms leave 1e-16 at 0.3
        series = [s * x + 1 / factorial(k + i) for i, s in enumerate(series, start=1)]
    return [jnp.exp(x), *(jnp.where(small, s, c) for s, c in zip(series, closed, strict=True))]


def step(
    plant: Plant,
    x: State,
    u: Callable[[Array], Array],
    t: Array,
    h: Array,
    reaction: Array | None = None,
) -> State:
    """Advance one fourth-order step: Runge-Kutta for the motion, its exponential form for internal states.

    Args:
        plant: The plant with its effects.
        x: State at time t.
        u: Declared force, delay applied, as a function of the fraction of the step in [0, 1].
        t: Time at the start of the step [s].
        h: Length of the step [s].
        reaction: Dry-friction force by port, constant over the step; absent: smoothed.

    Source:
        Cox and Matthews (2002), J. Comput. Phys. 176, ETDRK4. The linear part is the decay of internal
        states and their push on the velocities (without which a lag far shorter than the step
        acts a sixth of a step late); without internal states it is the classical method.
    """
    if not jax.tree.leaves(x.own):
        return _classical_step(plant, x, u, t, h, reaction)
    start, middle, end = u(jnp.asarray(0.0)), u(jnp.asarray(0.5)), u(jnp.asarray(1.0))
    z, back = ravel_pytree(x.own)
    decay = ravel_pytree(_own_decay(plant, x, start, t).own)[0]
    push = _own_push(plant, x, start, t, reaction)

    def linear(y: Split, motion: float | Array, own: Array, above: Array) -> Split:
        """Apply a function of the linear part to y; `above` is its entry from internal states to speed."""
        q, v, z = y
        return motion * q, motion * v + jnp.sum(push * (above * z), axis=1), own * z

    def rest(y: Split, u: Array, t: Array) -> Split:
        q, v, z = y
        rate = _derivative(plant, State(q, v, back(jnp.asarray(z))), u, t, reaction)
        return v, rate.qd - jnp.sum(push * z, axis=1), ravel_pytree(rate.own)[0] - decay * z

    half = 0.5 * h
    e, p1, p2, *_ = phi(decay * half)
    over, add = (1.0, e, half * p1), (half, half * p1, half**2 * p2)
    e, p1, p2, p3, p4 = phi(decay * h)
    y0 = (x.q, x.qd, z)
    n0 = rest(y0, start, t)
    a = _sum(linear(y0, *over), linear(n0, *add))
    na = rest(a, middle, t + half)
    b = _sum(linear(y0, *over), linear(na, *add))
    nb = rest(b, middle, t + half)
    c = _sum(linear(a, *over), linear(jax.tree.map(lambda n, m: 2 * n - m, nb, n0), *add))
    nc = rest(c, end, t + h)
    q, v, z = _sum(
        linear(y0, 1.0, e, h * p1),
        linear(n0, h / 6, h * (p1 - 3 * p2 + 4 * p3), h**2 * (p2 - 3 * p3 + 4 * p4)),
        linear(_sum(na, nb), h / 3, h * (2 * p2 - 4 * p3), h**2 * (2 * p3 - 4 * p4)),
        linear(nc, h / 6, h * (4 * p3 - p2), h**2 * (4 * p4 - p3)),
    )
    return State(q, v, back(jnp.asarray(z)))


def _sum(*terms: Split) -> Split:
    return jax.tree.map(lambda *leaves: sum(leaves[1:], leaves[0]), *terms)


def _own_push(plant: Plant, x: State, u: Array, t: Array, reaction: Array | None) -> Float[Array, "n own"]:
    """Return the derivative of the accelerations with respect to the internal states."""
    flat, back = ravel_pytree(x.own)

    def acc(own: Array) -> Array:
        return acceleration(plant, State(x.q, x.qd, back(jnp.asarray(own))), u, t, reaction)

    return jax.jacfwd(acc)(flat)


def _classical_step(
    plant: Plant,
    x: State,
    u: Callable[[Array], Array],
    t: Array,
    h: Array,
    reaction: Array | None,
) -> State:
    def slope(q: Array, v: Array, part: Array, u: Array) -> Array:
        return acceleration(plant, State(q, v, x.own), u, t + part * h, reaction)

    parts = jnp.asarray([0.0, 0.5, 0.5, 1.0])
    forces = [u(part) for part in parts]
    if plant.coupled:
        return _rolled(slope, x, h, parts, jnp.stack(forces))
    q, v, half = x.q, x.qd, 0.5 * h
    a1 = slope(q, v, parts[0], forces[0])
    v2 = v + half * a1
    a2 = slope(q + half * v, v2, parts[1], forces[1])
    v3 = v + half * a2
    a3 = slope(q + half * v2, v3, parts[2], forces[2])
    v4 = v + h * a3
    a4 = slope(q + h * v3, v4, parts[3], forces[3])
    q = q + h / 6 * (v + 2 * v2 + 2 * v3 + v4)
    v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    return State(q, v, x.own)


def _rolled(slope: Callable[..., Array], x: State, h: Array, parts: Array, forces: Array) -> State:
    """Run the four stages as a loop: four copies of an arm compile four times as long."""

    def stage(carry: tuple, now: tuple) -> tuple[tuple, None]:
        v, a, q_sum, v_sum = carry
        part, weight, u = now
        q, v = x.q + part * h * v, x.qd + part * h * a
        a = slope(q, v, part, u)
        return (v, a, q_sum + weight * v, v_sum + weight * a), None

    zero = varying(jnp.zeros_like(x.qd), x.qd)
    weights = jnp.asarray([1.0, 2.0, 2.0, 1.0])
    (_, _, q, v), _ = jax.lax.scan(stage, (x.qd, zero, zero, zero), (parts, weights, forces))
    return State(x.q + h / 6 * q, x.qd + h / 6 * v, x.own)


def affine_flow(plant: Plant, x: State, u: tuple[Array, ...], t: Array, h: Array) -> Affine | None:
    """Return `step` under a given reaction as one matrix, if the plant's forces are affine.

    Args:
        plant: The plant with its effects.
        x: Any state, for its shape.
        u: Declared force at the ends of the step, as `hold_polynomial` takes it; for its shape.
        t: Any time: a force that depends on it is not affine.
        h: Length of the step [s].

    Returns:
        A function of state, that force and reaction for `set_valued_step`; or None.
    """

    def flow(x: State, u: tuple[Array, ...], reaction: Array, t: Array) -> State:
        return step(plant, x, hold_polynomial(u), t, h, reaction)

    return affine(flow, (x, u, jnp.zeros_like(plant.ports(x.q))), (t,))


def hold_polynomial(values: tuple[Array, ...]) -> Callable[[Array], Array]:
    """Interpolate over the fraction in [0, 1]: one value is held, two give a line, three a parabola."""
    if len(values) == 3:
        start, middle, end = values
        bend = 2.0 * (start - 2.0 * middle + end)
        return lambda s: start + s * (end - start + (s - 1.0) * bend)
    start, end = values[0], values[-1]
    return lambda s: start if len(values) == 1 else start + s * (end - start)


def picked(x: Array, ports: tuple[int, ...]) -> Array:
    """Return the values of some ports."""
    return x if len(ports) == x.size else jnp.stack([x[i] for i in ports])


def spread(x: Array, ports: tuple[int, ...], size: int) -> Array:
    """Spread the values of some ports among all; zero elsewhere."""
    if len(ports) == size:
        return x
    zero = jnp.zeros((), x.dtype)
    return jnp.stack([x[ports.index(i)] if i in ports else zero for i in range(size)])
