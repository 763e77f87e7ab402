"""Algebraic identification sample by sample: the balance's iterated integrals as a recursion.

Over a window that starts at t0 the balance of each joint is multiplied by (t - t0)^2 and integrated
twice up to every sample. By parts no derivative of the measurement is left where the balance is
linear in it, its coefficients constant, and the initial conditions vanish. Each sample adds one row
a joint to a least-squares problem in the unknowns; integrals are of fourth order, from samples that
have been.

A joint's window begins anew when it leaves rest: the force that holds a stuck joint is not in the
balance. A held force bends the motion at every sample, where a quadrature of the position loses its
order. So what is held is integrated twice exactly, and that double integral then passes the same
quadrature as the position, whose corners it cancels.

Nothing here is written down a second time: coefficients of acceleration and velocity, and
the columns of the unknowns, are derivatives of the plant's own balance.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.algebraic.windows import first_by_parts, second_by_parts
from jaxid.estimators.inverse_dynamics import linear_unknowns
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.model.unknowns import Parameters, colours, scatter, seeds

# Adams-Moulton weights on the newest sample and up to three before it, by how many there are.
_WEIGHTS = np.array(
    [[0.0, 0.0, 0.0, 0.0], [1 / 2, 1 / 2, 0.0, 0.0], [5 / 12, 8 / 12, -1 / 12, 0.0],
     [9 / 24, 19 / 24, -5 / 24, 1 / 24]]
)  # fmt: skip
# Samples after the start of a window before its rows count: so many hold next to nothing.
_FEWEST = 5
# Part of a joint's largest velocity below which it rests, at least.
_LEAST = 1e-6
# Relative to the largest, below this an eigenvalue of the scaled normal matrix is rounding.
_ROUNDING = 1e-14


class Integral(eqx.Module):
    """A running integral of a sampled function, fourth order once four samples have been.

    Args:
        value: Up to the last sample.
        past: The function at the last three samples, the newest first, (3, ...).
    """

    value: Array
    past: Array

    @classmethod
    def zero(cls, like: Array) -> Integral:
        """Nothing integrated yet."""
        return cls(jnp.zeros_like(like), jnp.zeros((3, *like.shape)))

    def next(self, f: Array, since: Array, period: float) -> Integral:
        """With one sample more; `since` counts the samples before it, by joint (first axis)."""
        weights = jnp.asarray(_WEIGHTS)[jnp.minimum(since, 3)]
        shape = (-1, *[1] * (f.ndim - 1))
        grown = weights[:, 0].reshape(shape) * f
        for k in range(3):
            grown = grown + weights[:, k + 1].reshape(shape) * self.past[k]
        past = jnp.concatenate([f[None], self.past[:2]])
        return Integral(self.value + period * grown, past)


class OnlineMemory(eqx.Module):
    """What is kept from sample to sample.

    Args:
        since: Samples since the start of each joint's window, (n,).
        position: The last reading, (n,).
        single: Integrals of q, t q, t^2 q (n, n each: the clock's joint, then the coordinate), of t^2
            times the smooth part of the balance (n, c + 1), and of p and t p.
        double: Integrals of the first, second, fourth and fifth of these.
        held: Single integral of what is held between samples, and the double one, p; exact.
        normal: Sum of the outer products of each joint's rows, (n, c + 1, c + 1).
    """

    since: Array
    position: Array
    single: tuple[Integral, ...]
    double: tuple[Integral, ...]
    held: tuple[Array, Array]
    normal: Array


class OnlineEstimate(eqx.Module):
    """What the rows so far say.

    Args:
        theta: The unknowns, (p,).
        relative: How far the fit's own residual would move each, over its value, were it the same
            in all rows: no standard deviation, but it goes to zero where the rows tell an unknown.
        trusted: Where that is below the tolerance and the rows tell the unknown at all.
    """

    theta: Float[Array, " p"]
    relative: Float[Array, " p"]
    trusted: Bool[Array, " p"]


class Online(eqx.Module):
    """On-line algebraic estimator of a machine's unknowns; `update` may stand in a scan.

    Args:
        plant: The plant, its sign as sharp as `rest_velocity` allows.
        places: Of the unknowns.
        guess: Any values of them: the balance is linear, they only fix the origin.
        gain: Declared force per unit of command, by drive.
        period: Sampling time [s].
        rest_velocity: Below it a joint counts as at rest, (n,).
        fast: Velocity at which the slope of the forces is taken for the linear part, (n,).
        owner: Which unknown each of the c columns of a joint's row is of, (n, c); p where of none.
        seeds: Of the columns: unknowns that share one stand in different joints' balances, (p, c).
        tolerance: Of `OnlineEstimate.relative`, where an estimate may be trusted.
    """

    plant: Plant
    places: tuple = eqx.field(static=True)
    guess: Float[Array, " p"]
    gain: Float[Array, " m"]
    period: float = eqx.field(static=True)
    rest_velocity: Float[Array, " n"]
    fast: Float[Array, " n"]
    owner: Int[np.ndarray, "n c"]
    seeds: Float[np.ndarray, "p c"]
    tolerance: float = eqx.field(static=True, default=0.05)

    @classmethod
    def of(
        cls,
        machine: Machine,
        period: float,
        rest_velocity: np.ndarray,
        fast: np.ndarray,
        tolerance: float = 0.05,
    ) -> Online:
        """The estimator of a machine.

        Raises:
            InputError: If an unknown does not enter the balance in proportion, or an effect has a
                memory of its own, delays the command or changes with time: that asks for
                `inverse_dynamics`.
        """
        check_linear(machine)
        # A joint that never moves has no velocity of its own.
        fast = np.where(fast > 0, fast, np.max(fast))
        rest_velocity = np.maximum(rest_velocity, _LEAST * fast)
        plant = machine.plant.smoothed(
            np.asarray(1 / 3), typical_velocity(machine.plant, rest_velocity[None], np.min)
        )
        enters = _enters(plant, machine.parameters, len(fast), machine.gain.size)
        numbers = colours(enters)
        owner = np.full((len(fast), max(numbers, default=-1) + 1), len(numbers))
        for k, number in enumerate(numbers):
            owner[enters[:, k], number] = k
        return cls(
            plant,
            machine.parameters.places,
            np.asarray(machine.parameters.guess),
            machine.gain,
            period,
            rest_velocity,
            fast,
            owner,
            seeds(numbers),
            tolerance,
        )

    def start(self, position: Float[Array, " n"]) -> OnlineMemory:
        """Memory at the first reading."""
        n, c = self.owner.shape
        square, wide = jnp.zeros((n, n)), jnp.zeros((n, c + 1))
        first = self._smooth(position)
        zero = jnp.zeros(n, int)
        functions = self._functions(position, jnp.zeros(n), first, wide)
        single = tuple(Integral.zero(f).next(f, zero, self.period) for f in functions)
        double = tuple(Integral.zero(x).next(x, zero, self.period) for x in (square, square, wide, wide))
        normal = jnp.zeros((n, c + 1, c + 1))
        return OnlineMemory(zero, position, single, double, (wide, wide), normal)

    def update(
        self,
        memory: OnlineMemory,
        position: Float[Array, " n"],
        command: Float[Array, " m"],
        restart: Bool[Array, " n"] | None = None,
    ) -> tuple[OnlineMemory, Float[Array, "n c1"]]:
        """Take one reading more.

        Args:
            memory: So far.
            position: The new reading.
            command: Held since the last one.
            restart: Joints whose window begins at this reading; absent: those at rest.

        Returns:
            The new memory and the joints' rows: the balance, times (t - t0)^2, integrated twice and
            over (t - t0)^2, as its derivatives in the unknowns of `owner` and, last, its value where
            all are zero. Rows that do not count are zero.
        """
        h = self.period
        velocity = (position - memory.position) / h
        smooth = self._smooth(position)
        held = self._held(0.5 * (position + memory.position), velocity, self.gain * command)
        since = memory.since + 1
        t1 = h * since
        slope, twofold = memory.held
        twofold, slope = twofold + h * slope + 0.5 * h**2 * held, slope + h * held
        functions = self._functions(position, t1, smooth, twofold)
        once = tuple(i.next(f, since, h) for i, f in zip(memory.single, functions, strict=True))
        picked = tuple(once[k].value for k in (0, 1, 3, 4))
        twice = tuple(i.next(x, since, h) for i, x in zip(memory.double, picked, strict=True))
        second = second_by_parts(t1[:, None], position, once[1].value, twice[0].value)
        first = first_by_parts(once[2].value, twice[1].value)
        forced = second_by_parts(t1[:, None], twofold, once[5].value, twice[3].value)
        rows = self._motion(position, second, first) + twice[2].value + forced
        resting = jnp.abs(velocity) < self.rest_velocity if restart is None else restart
        counts = (since >= _FEWEST) & ~resting
        rows = jnp.where(counts[:, None], rows / t1[:, None] ** 2, 0.0)
        fresh = self.start(position)
        joints = lambda new, old: jnp.where(resting.reshape(-1, *[1] * (new.ndim - 1)), old, new)
        past = lambda new, old: jax.vmap(joints)(new, old)
        mix = lambda new, old: Integral(joints(new.value, old.value), past(new.past, old.past))
        grown = OnlineMemory(
            joints(since, fresh.since),
            position,
            tuple(mix(a, b) for a, b in zip(once, fresh.single, strict=True)),
            tuple(mix(a, b) for a, b in zip(twice, fresh.double, strict=True)),
            tuple(joints(a, b) for a, b in zip((slope, twofold), fresh.held, strict=True)),
            memory.normal + rows[:, :, None] * rows[:, None, :],
        )
        return grown, rows

    def estimate(self, memory: OnlineMemory) -> OnlineEstimate:
        """What the rows so far say; compiles, but is no part of a fast loop."""
        p = self.guess.size
        # Of all unknowns and, last but one, the value; what is of no unknown goes into the last.
        at = jnp.where(self.owner == p, p + 1, self.owner)
        at = jnp.concatenate([at, jnp.full((len(at), 1), p)], axis=1)
        whole = jnp.zeros((p + 2, p + 2)).at[at[:, :, None], at[:, None, :]].add(memory.normal)
        normal = whole[: p + 1, : p + 1]
        scale = jnp.sqrt(jnp.diagonal(normal)[:p])
        seen = scale > 1e-9 * jnp.max(scale * jnp.abs(jnp.where(self.guess == 0, 1.0, self.guess)))
        scale = jnp.where(seen, scale, 1.0)
        matrix = jnp.where(jnp.outer(seen, seen), normal[:p, :p] / jnp.outer(scale, scale), 0.0)
        values, vectors = jnp.linalg.eigh(matrix)
        good = values > _ROUNDING * values[-1]
        inverse = (vectors * jnp.where(good, 1 / jnp.where(good, values, 1.0), 0.0)) @ vectors.T
        theta = -inverse @ (normal[:p, p] / scale) / scale
        left = normal[p, p] + 2 * theta @ normal[:p, p] + theta @ normal[:p, :p] @ theta
        moved = jnp.sqrt(jnp.maximum(left, 0.0) * jnp.diagonal(inverse)) / scale
        blind = jnp.any((jnp.abs(vectors) > 0.1) & ~good, axis=1) | ~seen
        relative = jnp.where(blind, jnp.inf, moved / jnp.maximum(jnp.abs(theta), 1e-300))
        return OnlineEstimate(theta, relative, relative < self.tolerance)

    def _functions(self, q: Array, t: Array, smooth: Array, twofold: Array) -> tuple[Array, ...]:
        """What is integrated once: by the clock of each joint."""
        t = t[:, None]
        every = jnp.broadcast_to(q, (q.size, q.size))
        return every, t * every, t**2 * every, t**2 * smooth, twofold, t * twofold

    def _columns(self, f: Callable[[Plant], Array]) -> Float[Array, "n c1"]:
        """A balance that is linear in the unknowns as its derivatives and its value at zero."""
        guess = jnp.asarray(self.guess)

        def residual(step: Array) -> tuple[Array, Array]:
            e = f(scatter(self.places, self.plant, guess + self.seeds @ step))
            return e, e

        jacobian, e = jax.jacfwd(residual, has_aux=True)(jnp.zeros(self.seeds.shape[1]))
        here = jnp.concatenate([guess, jnp.zeros(1)])[self.owner]
        return jnp.concatenate([jacobian, (e - jnp.sum(jacobian * here, axis=1))[:, None]], axis=1)

    def _residual(self, plant: Plant, q: Array, v: Array, a: Array, u: Array) -> Array:
        return plant.balance(q, v, a, u, jnp.zeros(()), plant.initial_states(u)).residual

    def _smooth(self, q: Array) -> Array:
        """Columns of the balance at rest."""
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)
        return self._columns(lambda plant: self._residual(plant, q, zero, zero, none))

    def _held(self, q: Array, v: Array, u: Array) -> Array:
        """Columns of what jumps: the drive, and of velocity what is not linear."""
        zero, none = jnp.zeros_like(q), jnp.zeros_like(u)

        def beside(plant: Plant) -> Array:
            whole = self._residual(plant, q, v, zero, u)
            return whole - self._residual(plant, q, zero, zero, none) - self._damping(plant, q) @ v

        return self._columns(beside)

    def _damping(self, plant: Plant, q: Array) -> Array:
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)
        slope = jax.jacfwd(lambda v: self._residual(plant, q, v, zero, none))
        return 0.5 * (slope(jnp.asarray(self.fast)) + slope(-jnp.asarray(self.fast)))

    def _motion(self, q: Array, second: Array, first: Array) -> Array:
        """Columns of what is linear in acceleration and velocity, by parts."""
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)

        def linear(plant: Plant) -> Array:
            mass = jax.jacfwd(lambda a: self._residual(plant, q, zero, a, none))(zero)
            damping = self._damping(plant, q)
            return jnp.sum(mass * second, axis=1) + jnp.sum(damping * first, axis=1)

        return self._columns(linear)


def _enters(plant: Plant, parameters: Parameters, joints: int, drives: int) -> Bool[np.ndarray, "n p"]:
    """Which unknowns stand in the balance of which joints, by its derivatives along random motion."""
    random = np.random.default_rng(0)
    motion, u = random.uniform(0.5, 1.5, (3, joints)), random.uniform(0.5, 1.5, drives)
    guess = np.where(parameters.guess == 0, 1.0, parameters.guess)
    return np.asarray(slopes(plant, parameters.places, guess, motion, u)) != 0


@eqx.filter_jit
def slopes(plant: Plant, places: tuple, theta: Array, motion: Array, u: Array) -> Float[Array, "n p"]:
    """Derivative of the balance in the unknowns at one instant of a motion, (3, n)."""

    def residual(theta: Array) -> Array:
        moved = scatter(places, plant, theta)
        return moved.balance(*motion, u, jnp.zeros(()), moved.initial_states(u)).residual

    return jax.jacfwd(residual)(jnp.asarray(theta))


def check_linear(machine: Machine) -> None:
    """Refuse what the recursion cannot hold.

    Raises:
        InputError: If an effect remembers, delays or changes with time, or an unknown does not enter in
            proportion.
    """
    where = "algebraic, over one window"
    check_instant(machine, where)
    odd = [machine.parameters.names[k] for k in np.flatnonzero(~linear_unknowns(machine))]
    if odd:
        raise InputError(
            f"{odd[0]} does not enter the balance in proportion",
            where=where,
            hint="declare it known, friction by its level, or use inverse_dynamics",
        )


def check_instant(machine: Machine, where: str) -> None:
    """Refuse a balance that one sample does not hold.

    Raises:
        InputError: If an effect remembers, delays or changes with time.
    """
    for e in machine.plant.effects:
        if e.initial_state(jnp.zeros(())) is not None or not isinstance(e.command_delay(), float):
            hint = "leave it out, or use inverse_dynamics"
            raise InputError(f"{e.kind} has a memory or a delay", where=where, hint=hint)
    if _ages(machine):
        raise InputError(
            "the balance changes with time",
            where=where,
            hint="leave out what does (friction_drift), or use inverse_dynamics",
        )


def _ages(machine: Machine) -> bool:
    """Whether time stands in the balance, by its value along random motion now and later."""
    plant, parameters, random = machine.plant, machine.parameters, np.random.default_rng(0)
    theta = np.where(parameters.guess == 0, 1.0, parameters.guess)
    motion, u = plant.any_motion(random), random.uniform(0.5, 1.5, machine.gain.size)
    early, late = (_value(plant, parameters.places, theta, motion, u, np.asarray(t)) for t in (0.0, 1.0))
    return bool(np.any(np.asarray(early) != np.asarray(late)))


@eqx.filter_jit
def _value(
    plant: Plant, places: tuple, theta: Array, motion: Array, u: Array, t: Array
) -> Float[Array, " n"]:
    plant = scatter(places, plant, jnp.asarray(theta))
    return plant.balance(*motion, u, t, plant.initial_states(u)).residual


@eqx.filter_jit
def window_rows(
    online: Online,
    position: Float[Array, "time n"],
    command: Float[Array, "time m"],
    restart: Bool[Array, "time n"],
) -> tuple[OnlineMemory, Float[Array, "time n c1"]]:
    """All rows of a log whose windows begin where `restart` says, and the memory at its end."""

    def step(memory: OnlineMemory, now: tuple) -> tuple[OnlineMemory, Array]:
        return online.update(memory, *now)

    start = online.start(position[0])
    memory, rows = jax.lax.scan(step, start, (position[1:], command[:-1], restart[1:]))
    return memory, jnp.concatenate([jnp.zeros((1, *rows.shape[1:])), rows])
