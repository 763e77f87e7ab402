"""On-line algebraic identification: the iterated integrals of the balance as a recursion.

Over a window that starts at t0 the balance of each joint is multiplied by (t - t0)^2 and integrated
twice up to every sample. Integration by parts removes the derivatives of the measurement from all terms
that are linear in it with constant coefficients, and the initial conditions vanish. Each sample adds one row
per joint to a least-squares problem in the unknowns; the integrals are causal and of fourth order.

A joint's window restarts when it leaves rest: the force that holds a stuck joint is not in the
balance. A force that is held between samples jumps at each of them, and a quadrature of the position loses
its order there. Held terms are therefore integrated twice exactly, and that double integral then passes the
same quadrature as the position, so that the errors at the jumps cancel.

The coefficients of acceleration and velocity, and the columns of the unknowns, are derivatives of the
plant's balance, which is stated nowhere else.
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

# Adams-Moulton weights of the newest sample and up to three before it, by the number of earlier samples.
_WEIGHTS = np.array(
    [[0.0, 0.0, 0.0, 0.0], [1 / 2, 1 / 2, 0.0, 0.0], [5 / 12, 8 / 12, -1 / 12, 0.0],
     [9 / 24, 19 / 24, -5 / 24, 1 / 24]]
)  # fmt: skip
# Samples after the start of a window before its rows count: the first ones hold almost no information.
_FEWEST = 5
# Least rest velocity, as a fraction of the joint's largest velocity.
_LEAST = 1e-6
# An eigenvalue of the scaled normal matrix below this, relative to the largest, is a rounding error.
_ROUNDING = 1e-14


class Integral(eqx.Module):
    """A running integral of a sampled function, of fourth order from the fourth sample on.

    Args:
        value: Integral up to the last sample.
        past: Values of the function at the last three samples, the newest first, (3, ...).
    """

    value: Array
    past: Array

    @classmethod
    def zero(cls, like: Array) -> Integral:
        """Return an integral of zero, before the first sample."""
        return cls(jnp.zeros_like(like), jnp.zeros((3, *like.shape)))

    def next(self, f: Array, since: Array, period: float) -> Integral:
        """Return the integral up to one more sample.

        Args:
            f: The function at the new sample; its first axis is the joints.
            since: Number of samples since the start of each joint's window, (n,).
            period: Sampling time [s].
        """
        weights = jnp.asarray(_WEIGHTS)[jnp.minimum(since, 3)]
        shape = (-1, *[1] * (f.ndim - 1))
        grown = weights[:, 0].reshape(shape) * f
        for k in range(3):
            grown = grown + weights[:, k + 1].reshape(shape) * self.past[k]
        past = jnp.concatenate([f[None], self.past[:2]])
        return Integral(self.value + period * grown, past)


class OnlineMemory(eqx.Module):
    """State of the recursion between samples.

    Args:
        since: Number of samples since the start of each joint's window, (n,).
        position: The last measured position, (n,) [m or rad].
        single: Integrals of q, t q, t^2 q (n, n each: first the joint whose window counts t, then the
            coordinate), of t^2 times the smooth part of the balance (n, c + 1), and of p and t p.
        double: Integrals of the first, second, fourth and fifth of these.
        held: Single and double integral of the terms that are held between samples, exact; the double
            integral is p, (n, c + 1) each.
        normal: Sum of the outer products of each joint's rows, (n, c + 1, c + 1).
    """

    since: Array
    position: Array
    single: tuple[Integral, ...]
    double: tuple[Integral, ...]
    held: tuple[Array, Array]
    normal: Array


class OnlineEstimate(eqx.Module):
    """Least-squares estimate from the rows so far.

    Args:
        theta: Values of the unknowns, (p,).
        relative: Bound on the relative error of each unknown: the change that the residual of the fit
            would cause if it were the same in all rows. It is no standard deviation, but it goes to zero
            for an unknown that the rows identify, (p,).
        trusted: Mask of the unknowns that are identifiable with a bound below the tolerance, (p,).
    """

    theta: Float[Array, " p"]
    relative: Float[Array, " p"]
    trusted: Bool[Array, " p"]


class Online(eqx.Module):
    """On-line algebraic estimator of a machine's unknowns; `update` may stand in a scan.

    Args:
        plant: The plant, its smoothed sign as sharp as `rest_velocity` allows.
        places: Paths of the unknowns in the plant.
        guess: Any values of the unknowns, (p,): the balance is linear, and they only fix the origin.
        gain: Declared force per unit of command, by drive, (m,).
        period: Sampling time [s].
        rest_velocity: Velocity below which a joint counts as at rest, (n,) [m/s or rad/s].
        fast: Velocity at which the slope of the forces is taken for the linear part, (n,) [m/s or rad/s].
        owner: Index of the unknown of each of the c columns of a joint's row, p for none, (n, c).
        seeds: Seeds of the columns, (p, c): unknowns of the balances of different joints share a column.
        tolerance: Value of `OnlineEstimate.relative` below which an estimate is trusted.
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
        """Build the estimator of a machine.

        Args:
            machine: The machine whose unknowns are estimated.
            period: Sampling time [s].
            rest_velocity: Velocity below which a joint counts as at rest, (n,) [m/s or rad/s].
            fast: Largest velocity of each joint, (n,) [m/s or rad/s].
            tolerance: Value of `OnlineEstimate.relative` below which an estimate is trusted.

        Raises:
            InputError: If the balance is not linear in an unknown, or an effect has an internal state,
                delays the command or changes with time. Such machines need `inverse_dynamics`.
        """
        check_linear(machine)
        # A joint that never moves takes the velocity of the fastest.
        fast = np.where(fast > 0, fast, np.max(fast))
        rest_velocity = np.maximum(rest_velocity, _LEAST * fast)
        plant = machine.plant.smoothed(
            np.asarray(1 / 3), typical_velocity(machine.plant, rest_velocity[None], np.min)
        )
        enters = _enters(plant, machine.parameters, len(fast), machine.gain.size)

        # Unknowns that never stand in the same balance share a column.
        numbers = colours(enters)
        owner = np.full((len(fast), max(numbers, default=-1) + 1), len(numbers))
        for k, number in enumerate(numbers):
            owner[enters[:, k], number] = k
        return cls(
            plant=plant,
            places=machine.parameters.places,
            guess=np.asarray(machine.parameters.guess),
            gain=machine.gain,
            period=period,
            rest_velocity=rest_velocity,
            fast=fast,
            owner=owner,
            seeds=seeds(numbers),
            tolerance=tolerance,
        )

    def start(self, position: Float[Array, " n"]) -> OnlineMemory:
        """Return the memory after the first measured position."""
        n, c = self.owner.shape
        square, wide = jnp.zeros((n, n)), jnp.zeros((n, c + 1))
        first = self._smooth(position)
        zero = jnp.zeros(n, int)
        functions = self._functions(position, jnp.zeros(n), first, wide)
        single = tuple(Integral.zero(f).next(f, zero, self.period) for f in functions)
        double = tuple(Integral.zero(x).next(x, zero, self.period) for x in (square, square, wide, wide))
        normal = jnp.zeros((n, c + 1, c + 1))
        return OnlineMemory(
            since=zero,
            position=position,
            single=single,
            double=double,
            held=(wide, wide),
            normal=normal,
        )

    def update(
        self,
        memory: OnlineMemory,
        position: Float[Array, " n"],
        command: Float[Array, " m"],
        restart: Bool[Array, " n"] | None = None,
    ) -> tuple[OnlineMemory, Float[Array, "n c1"]]:
        """Add one sample.

        Args:
            memory: The memory so far.
            position: The new measured position, (n,) [m or rad].
            command: The command held since the last sample, by drive, (m,).
            restart: Mask of the joints whose window starts at this sample; absent: those at rest.

        Returns:
            The new memory and the joints' rows, (n, c + 1): the balance times (t - t0)^2, integrated twice
            and over (t - t0)^2, as its derivatives in the unknowns of `owner`, followed by its value for
            unknowns of zero. Rows that do not count are zero.
        """
        h = self.period

        # Terms that are held since the last sample, integrated exactly.
        velocity = (position - memory.position) / h
        smooth = self._smooth(position)
        held = self._held(0.5 * (position + memory.position), velocity, self.gain * command)
        since = memory.since + 1
        t1 = h * since
        slope, twofold = memory.held
        twofold, slope = twofold + h * slope + 0.5 * h**2 * held, slope + h * held

        # Iterated integrals by quadrature, and the balance from them by parts.
        functions = self._functions(position, t1, smooth, twofold)
        once = tuple(i.next(f, since, h) for i, f in zip(memory.single, functions, strict=True))
        picked = tuple(once[k].value for k in (0, 1, 3, 4))
        twice = tuple(i.next(x, since, h) for i, x in zip(memory.double, picked, strict=True))
        second = second_by_parts(t1[:, None], position, once[1].value, twice[0].value)
        first = first_by_parts(once[2].value, twice[1].value)
        forced = second_by_parts(t1[:, None], twofold, once[5].value, twice[3].value)
        rows = self._motion(position, second, first) + twice[2].value + forced

        # A joint at rest starts a new window.
        resting = jnp.abs(velocity) < self.rest_velocity if restart is None else restart
        counts = (since >= _FEWEST) & ~resting
        rows = jnp.where(counts[:, None], rows / t1[:, None] ** 2, 0.0)
        fresh = self.start(position)

        def restarted(new: Array, started: Array) -> Array:
            return jnp.where(resting.reshape(-1, *[1] * (new.ndim - 1)), started, new)

        def restarted_integral(new: Integral, started: Integral) -> Integral:
            return Integral(restarted(new.value, started.value), jax.vmap(restarted)(new.past, started.past))

        grown = OnlineMemory(
            since=restarted(since, fresh.since),
            position=position,
            single=tuple(restarted_integral(a, b) for a, b in zip(once, fresh.single, strict=True)),
            double=tuple(restarted_integral(a, b) for a, b in zip(twice, fresh.double, strict=True)),
            held=(restarted(slope, fresh.held[0]), restarted(twofold, fresh.held[1])),
            normal=memory.normal + rows[:, :, None] * rows[:, None, :],
        )
        return grown, rows

    def estimate(self, memory: OnlineMemory) -> OnlineEstimate:
        """Solve the least-squares problem of the rows so far; compiles, but is not meant for a fast loop."""
        p = self.guess.size

        # Assemble the normal matrix of all unknowns; the last but one row is the value, and columns without
        # an unknown go into the last.
        at = jnp.where(self.owner == p, p + 1, self.owner)
        at = jnp.concatenate([at, jnp.full((len(at), 1), p)], axis=1)
        whole = jnp.zeros((p + 2, p + 2)).at[at[:, :, None], at[:, None, :]].add(memory.normal)
        normal = whole[: p + 1, : p + 1]

        # Scale it to a diagonal of one. Unknowns without effect are excluded.
        scale = jnp.sqrt(jnp.diagonal(normal)[:p])
        active = scale > 1e-9 * jnp.max(scale * jnp.abs(jnp.where(self.guess == 0, 1.0, self.guess)))
        scale = jnp.where(active, scale, 1.0)
        matrix = jnp.where(jnp.outer(active, active), normal[:p, :p] / jnp.outer(scale, scale), 0.0)
        values, vectors = jnp.linalg.eigh(matrix)
        good = values > _ROUNDING * values[-1]
        inverse = (vectors * jnp.where(good, 1 / jnp.where(good, values, 1.0), 0.0)) @ vectors.T
        theta = -inverse @ (normal[:p, p] / scale) / scale

        # Bound the error by the residual; unidentifiable unknowns have none.
        squares = normal[p, p] + 2 * theta @ normal[:p, p] + theta @ normal[:p, :p] @ theta
        moved = jnp.sqrt(jnp.maximum(squares, 0.0) * jnp.diagonal(inverse)) / scale
        unidentifiable = jnp.any((jnp.abs(vectors) > 0.1) & ~good, axis=1) | ~active
        relative = jnp.where(unidentifiable, jnp.inf, moved / jnp.maximum(jnp.abs(theta), 1e-300))
        return OnlineEstimate(theta, relative, relative < self.tolerance)

    def _functions(self, q: Array, t: Array, smooth: Array, twofold: Array) -> tuple[Array, ...]:
        """Return the functions that are integrated once, with the time of each joint's window."""
        t = t[:, None]
        every = jnp.broadcast_to(q, (q.size, q.size))
        return every, t * every, t**2 * every, t**2 * smooth, twofold, t * twofold

    def _columns(self, f: Callable[[Plant], Array]) -> Float[Array, "n c1"]:
        """Return a balance that is linear in the unknowns as its derivatives and its value at zero."""
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
        """Return the columns of the balance at rest."""
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)
        return self._columns(lambda plant: self._residual(plant, q, zero, zero, none))

    def _held(self, q: Array, v: Array, u: Array) -> Array:
        """Return the columns of the terms that jump: the drive, and forces nonlinear in the velocity."""
        zero, none = jnp.zeros_like(q), jnp.zeros_like(u)

        def beside(plant: Plant) -> Array:
            whole = self._residual(plant, q, v, zero, u)
            return whole - self._residual(plant, q, zero, zero, none) - self._damping(plant, q) @ v

        return self._columns(beside)

    def _damping(self, plant: Plant, q: Array) -> Array:
        """Return the coefficients of the velocity: the mean slope at plus and minus `fast`, (n, n)."""
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)
        slope = jax.jacfwd(lambda v: self._residual(plant, q, v, zero, none))
        return 0.5 * (slope(jnp.asarray(self.fast)) + slope(-jnp.asarray(self.fast)))

    def _motion(self, q: Array, second: Array, first: Array) -> Array:
        """Return the columns of the terms linear in acceleration and velocity, integrated by parts."""
        zero, none = jnp.zeros_like(q), jnp.zeros(self.gain.size)

        def linear(plant: Plant) -> Array:
            mass = jax.jacfwd(lambda a: self._residual(plant, q, zero, a, none))(zero)
            damping = self._damping(plant, q)
            return jnp.sum(mass * second, axis=1) + jnp.sum(damping * first, axis=1)

        return self._columns(linear)


def _enters(plant: Plant, parameters: Parameters, joints: int, drives: int) -> Bool[np.ndarray, "n p"]:
    """Return the mask of the unknowns in the balance of each joint, by its derivatives at random motion."""
    random = np.random.default_rng(0)
    motion, u = random.uniform(0.5, 1.5, (3, joints)), random.uniform(0.5, 1.5, drives)
    guess = np.where(parameters.guess == 0, 1.0, parameters.guess)
    return np.asarray(slopes(plant, parameters.places, guess, motion, u)) != 0


@eqx.filter_jit
def slopes(plant: Plant, places: tuple, theta: Array, motion: Array, u: Array) -> Float[Array, "n p"]:
    """Return the derivative of the balance in the unknowns at one instant.

    Args:
        plant: The plant.
        places: Paths of the unknowns in it.
        theta: Values of the unknowns, (p,).
        motion: Position, velocity and acceleration, (3, n).
        u: Declared force of each drive, (m,) [N or N m].
    """

    def residual(theta: Array) -> Array:
        moved = scatter(places, plant, theta)
        q, qd, qdd = motion
        return moved.balance(q, qd, qdd, u, jnp.zeros(()), moved.initial_states(u)).residual

    return jax.jacfwd(residual)(jnp.asarray(theta))


def check_linear(machine: Machine) -> None:
    """Check that the recursion can represent a machine.

    Raises:
        InputError: If an effect has an internal state, delays the command or changes with time, or if the
            balance is not linear in an unknown.
    """
    where = "algebraic, over one window"
    check_instant(machine, where)
    nonlinear = [machine.parameters.names[k] for k in np.flatnonzero(~linear_unknowns(machine))]
    if nonlinear:
        raise InputError(
            f"the balance is not linear in {nonlinear[0]}",
            where=where,
            hint="declare it known, state friction by its level, or use inverse_dynamics",
        )


def check_instant(machine: Machine, where: str) -> None:
    """Check that the balance depends on one instant only.

    Args:
        machine: The machine.
        where: Place that the error message names.

    Raises:
        InputError: If an effect has an internal state, delays the command or changes with time.
    """
    for e in machine.plant.effects:
        if e.initial_state(jnp.zeros(())) is not None or not isinstance(e.command_delay(), float):
            hint = "leave it out, or use inverse_dynamics"
            raise InputError(f"{e.kind} has an internal state or a delay", where=where, hint=hint)
    if _depends_on_time(machine):
        raise InputError(
            "the balance changes with time",
            where=where,
            hint="leave out the effect that changes (friction_drift), or use inverse_dynamics",
        )


def _depends_on_time(machine: Machine) -> bool:
    """Tell whether the balance depends on time, by its value at random motion at two times."""
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
    q, qd, qdd = motion
    return plant.balance(q, qd, qdd, u, t, plant.initial_states(u)).residual


@eqx.filter_jit
def window_rows(
    online: Online,
    position: Float[Array, "time n"],
    command: Float[Array, "time m"],
    restart: Bool[Array, "time n"],
) -> tuple[OnlineMemory, Float[Array, "time n c1"]]:
    """Compute all rows of a log, and the memory at its end.

    Args:
        online: The estimator.
        position: Measured positions, (time, n) [m or rad].
        command: Logged commands, (time, m).
        restart: Mask of the samples at which each joint's window starts, (time, n).
    """

    def step(memory: OnlineMemory, now: tuple) -> tuple[OnlineMemory, Array]:
        return online.update(memory, *now)

    start = online.start(position[0])
    memory, rows = jax.lax.scan(step, start, (position[1:], command[:-1], restart[1:]))
    return memory, jnp.concatenate([jnp.zeros((1, *rows.shape[1:])), rows])
