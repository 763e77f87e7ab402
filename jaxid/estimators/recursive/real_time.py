"""The method `recursive` in real time, one measured sample after the other.

Velocity and acceleration come from sensors (a gyroscope, an accelerometer) or from filters of the user;
nothing is filtered here.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.algebraic.online import check_instant, slopes
from jaxid.estimators.recursive.estimate import gains_of, start_of
from jaxid.estimators.recursive.recursion import Recursion, RecursiveEstimate, RecursiveMemory, column_squares
from jaxid.estimators.recursive.rows import check_linearity, elsewhere
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.model.unknowns import scatter


class RealTime(eqx.Module):
    """Recursive estimator of a machine's unknowns; `update` may also stand in a scan.

        live = RealTime.of(machine, 1e-3, noise=2.0, spread=[20.0, 200.0, 20.0], gate_velocity=1e-3)
        memory = live.memory()
        memory = live.update(memory, q, qd, qdd, command)    # every millisecond
        live.estimate(memory).theta

    A memory is a tree of arrays. It can be saved and given to `update` again, and the run continues bit for
    bit.

    Args:
        plant: The plant, its smoothed sign as sharp as the gate allows.
        places: Paths of the unknowns in the plant.
        guess: Any values of the unknowns, (p,): the balance is linear, and they only fix the origin.
        gain: Known force per unit of command, by drive, (m,).
        gate_velocity, gate_acceleration: Gates, one of which a joint must exceed for its row to count, (n,)
            [m/s, m/s^2 or in rad].
        recursion: The recursive least squares.
    """

    plant: Plant
    places: tuple = eqx.field(static=True)
    guess: Float[Array, " p"]
    gain: Float[Array, " m"]
    gate_velocity: Float[Array, " n"]
    gate_acceleration: Float[Array, " n"]
    recursion: Recursion

    @classmethod
    def of(
        cls,
        machine: Machine,
        period: float,
        *,
        noise: float,
        spread: np.ndarray,
        gate_velocity: float | np.ndarray,
        gate_acceleration: float | np.ndarray = np.inf,
        half_life: float = np.inf,
        summed: bool = False,
        instrument: bool = False,
        start: np.ndarray | None = None,
    ) -> RealTime:
        """Build the estimator of a machine.

        Args:
            machine: The machine whose unknowns are estimated.
            period: Sampling time [s].
            noise: Standard deviation of the force's noise, errors of the model included [N or N m].
            spread: Standard deviation of the start, (p,) [units of the unknowns].
            gate_velocity, gate_acceleration: Gates, see `RealTime`; one for all joints, or one each.
            half_life: Time in which the weight of a sample halves [s of motion].
            summed: Whether the rows of a sample are summed to one.
            instrument: Whether the measured force is so noisy that its gain needs an instrument.
            start: Start of the estimate, (p,); absent: one for gains, zero for forces, the plant's guesses.

        Raises:
            InputError: If a number is out of range, an effect has an internal state, delays the command or
                changes with time, or the balance is not linear in an unknown.
        """
        n, names, places = machine.plant.joints, machine.parameters.names, machine.parameters.places
        _need_positive(
            period=period, noise=noise, spread=spread, half_life=half_life, gate_velocity=gate_velocity
        )
        # A negative gate would let samples at rest through.
        if not np.all(np.asarray(gate_acceleration, float) >= 0):
            what = f"gate_acceleration = {gate_acceleration} is negative"
            raise InputError(what, where="RealTime", hint="it must be >= 0")
        _need_value_each(names, spread=spread, start=spread if start is None else start)
        velocity = _by_joint("gate_velocity", gate_velocity, n)
        acceleration = _by_joint("gate_acceleration", gate_acceleration, n)

        check_instant(machine, "RealTime")
        plant = machine.plant.smoothed(
            np.asarray(1 / 3), typical_velocity(machine.plant, velocity[None], np.min)
        )

        # Linearity in the unknowns is checked at one random instant of motion.
        random, guess = np.random.default_rng(0), machine.parameters.guess
        motion, u = plant.any_motion(random), random.uniform(0.5, 1.5, machine.gain.size)
        here, there = (np.asarray(slopes(plant, places, x, motion, u)) for x in (guess, elsewhere(guess)))
        check_linearity(names, here, there)

        recursion = Recursion(
            start=start_of(machine) if start is None else np.asarray(start, float),
            information=np.square(noise / np.asarray(spread, float)),
            forgetting=np.asarray(2.0 ** (-period / half_life)),
            summed=summed,
            gains=gains_of(machine),
            instrument=instrument,
        )
        return cls(
            plant=plant,
            places=places,
            guess=guess,
            gain=machine.gain,
            gate_velocity=velocity,
            gate_acceleration=acceleration,
            recursion=recursion,
        )

    def memory(self) -> RecursiveMemory:
        """Return the memory before the first sample."""
        return self.recursion.memory()

    def rows(
        self,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        qdd: Float[Array, " n"],
        command: Float[Array, " m"],
    ) -> tuple[Float[Array, "n p"], Float[Array, " n"], Bool[Array, " n"]]:
        """Return rows, right-hand side and the mask of the rows that count, of one sample.

        Args:
            q, qd, qdd: Measured motion of all joints, (n,) each [m, m/s, m/s^2 or in rad].
            command: Measured command by drive, in the command's unit, (m,).
        """
        u, guess = self.gain * command, jnp.asarray(self.guess)

        def residual(theta: Array) -> tuple[Array, Array]:
            plant = scatter(self.places, self.plant, theta)
            e = plant.balance(q, qd, qdd, u, jnp.zeros(()), plant.initial_states(u)).residual
            return e, e

        rows, e = jax.jacfwd(residual, has_aux=True)(guess)
        counts = (jnp.abs(qd) > self.gate_velocity) | (jnp.abs(qdd) > self.gate_acceleration)
        return rows, rows @ guess - e, counts

    def sizes(
        self, rows: Float[Array, "time n p"], counts: Bool[Array, "time n"], force: Float[Array, "time n"]
    ) -> tuple[Float[Array, " p"], Float[Array, ""]]:
        """Return the mean square of each column, and the root mean square of the force.

        Args:
            rows: Rows of many samples, (time, n, p).
            counts: Mask of the rows that count, (time, n).
            force: Force of the drives in each row, (time, n) [N or N m].
        """
        natural = jnp.where(self.guess == 0, 1.0, jnp.asarray(self.guess))
        square, force = column_squares(rows, counts, force, natural)
        return square, jnp.sqrt(force)

    @eqx.filter_jit
    def update(
        self,
        memory: RecursiveMemory,
        q: Float[Array, " n"],
        qd: Float[Array, " n"],
        qdd: Float[Array, " n"],
        command: Float[Array, " m"],
    ) -> RecursiveMemory:
        """Add one sample.

        Args:
            memory: The memory so far.
            q, qd, qdd: Measured motion of all joints, (n,) each [m, m/s, m/s^2 or in rad].
            command: Measured command by drive, in the command's unit, (m,).
        """
        return self.recursion.update(memory, *self.rows(q, qd, qdd, command))[0]

    @eqx.filter_jit
    def estimate(self, memory: RecursiveMemory) -> RecursiveEstimate:
        """Return estimate and precision from the samples so far."""
        return self.recursion.estimate(memory)

    def told(self, memory: RecursiveMemory) -> RecursiveEstimate:
        """Return `estimate(memory)`; the name of version 0.1."""
        return self.estimate(memory)


def _need_positive(**values: float | np.ndarray) -> None:
    for name, value in values.items():
        if not np.all(np.asarray(value, float) > 0):
            raise InputError(f"{name} = {value} is not positive", where="RealTime", hint="it must be > 0")


def _need_value_each(names: Sequence[str], **values: np.ndarray) -> None:
    """Refuse arrays that do not have one value for each unknown."""
    for name, value in values.items():
        if np.shape(value) != (len(names),):
            hint = f"give one value for each of {', '.join(names)}"
            raise InputError(f"{name} has shape {np.shape(value)}", where="RealTime", hint=hint)


def _by_joint(name: str, value: float | np.ndarray, joints: int) -> Float[np.ndarray, " n"]:
    """Return a value for each joint, from one for all of them or one each."""
    if np.shape(value) not in ((), (1,), (joints,)):
        hint = f"give one value for all joints, or {joints}"
        raise InputError(f"{name} has shape {np.shape(value)}", where="RealTime", hint=hint)
    return np.broadcast_to(np.asarray(value, float), (joints,))
