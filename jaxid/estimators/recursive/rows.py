"""Rows of a linear regression along a log: the Jacobian of the plant's balance in its unknowns.

The right-hand side is what is left where all unknowns are zero. It is the residual at the load, not over the
drive's gain as in `inverse_dynamics`, so that a gain enters in proportion. Whether all unknowns do so
together is tested on the log itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.dynamics.residuals import balance_along
from jaxid.errors import InputError
from jaxid.logs.prepare import Prepared, smeared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters, scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.simulation.force_balance import ForceData, measured_force, sharpened, whole_motion

# Part of itself by which a column may differ elsewhere among the unknowns: of rounding.
_LINEAR = 1e-6


@dataclass(frozen=True)
class Rows:
    """A linear regression, by sample.

    Args:
        rows: Y, (kept, m, p).
        target: r, (kept, m) [N or N m at the load].
        counts: Which rows count, (kept, m).
        force: Force of the drives in each row, (kept, m): how large a residual is, is seen beside it.
    """

    rows: Float[np.ndarray, "kept m p"]
    target: Float[np.ndarray, "kept m"]
    counts: Bool[np.ndarray, "kept m"]
    force: Float[np.ndarray, "kept m"]

    @property
    def summed(self) -> Rows:
        """One row a sample: the sum of those that count."""
        rows = np.sum(np.where(self.counts[..., None], self.rows, 0.0), axis=1, keepdims=True)
        target, force = (
            np.sum(np.where(self.counts, x, 0.0), axis=1, keepdims=True) for x in (self.target, self.force)
        )
        return Rows(rows, target, self.moved[:, None], force)

    @property
    def moved(self) -> Bool[np.ndarray, " kept"]:
        """Samples of which any row counts."""
        return self.counts.any(axis=1)


@eqx.filter_jit
def load_columns(
    plant: Plant, places: tuple, data: ForceData, theta: Array
) -> tuple[Float[Array, "kept n"], Float[Array, "kept n p"]]:
    """Residual of the balance at the load and its Jacobian in the unknowns, filtered and decimated."""

    def residual(theta: Array) -> tuple[Array, Array]:
        moved = scatter(places, plant, theta)
        delays = moved.command_delays(data.force.shape[1])
        u = signals.delayed(data.force, delays, data.period, hold=data.hold)
        e = data.decimator(balance_along(moved, *whole_motion(moved, data, u), u, data.period, data.start)[0])
        return e, e

    jacobian, e = jax.jacfwd(residual, has_aux=True)(jnp.asarray(theta))
    return e, jacobian


def rows_steps(machine: Machine, data: Prepared, gates: tuple[np.ndarray, np.ndarray] | None) -> Steps[Rows]:
    """Rows of a log.

    Args:
        machine: The machine.
        data: The log, prepared.
        gates: Velocity and acceleration, by joint, one of which a sample must exceed; None: the samples
            that `inverse_dynamics` fits.

    Raises:
        InputError: If the unknowns do not enter the balance in proportion.
    """
    plant, names, places = sharpened(machine.plant, data), machine.parameters.names, machine.parameters.places
    arrays, guess = ForceData.of(data, data.fitted), machine.parameters.guess
    e, columns = yield SolveRequest(load_columns, (plant, places, arrays, guess))
    _, there = yield SolveRequest(load_columns, (plant, places, arrays, elsewhere(guess)))
    e, columns = np.asarray(e), np.asarray(columns)
    check_proportion(names, columns, np.asarray(there))
    force = yield SolveRequest(_measured_force, (plant, arrays))
    counts = data.fitted if gates is None else gated(data, *gates)
    target = columns @ guess - e
    return Rows(columns, target, counts, np.asarray(force))


def elsewhere(guess: np.ndarray) -> np.ndarray:
    """Other values of all unknowns, to see whether the columns are the same there."""
    return 1.5 * np.where(guess == 0, 1.0, guess)


def check_proportion(names: list[str], columns: np.ndarray, there: np.ndarray) -> None:
    """Refuse unknowns whose columns depend on the unknowns; (..., p) at two places.

    Raises:
        InputError: If there are any.
    """
    odd = _out_of_proportion(columns, there)
    if odd.any():
        several = " and ".join(n for n, o in zip(names, odd, strict=True) if o)
        raise InputError(
            f"the balance is not in proportion to {several}",
            where="recursive",
            hint=f"declare {'one of them' if odd.sum() > 1 else 'it'} known, or use inverse_dynamics",
        )


def _out_of_proportion(columns: np.ndarray, there: np.ndarray) -> Bool[np.ndarray, " p"]:
    rows = tuple(range(columns.ndim - 1))
    return np.abs(there - columns).max(axis=rows) > _LINEAR * np.abs(columns).max(axis=rows)


def in_proportion_steps(machine: Machine, data: Prepared) -> Steps[Machine]:
    """The machine with only those unknowns that enter the balance in proportion; the rest at their guesses.

    Args:
        machine: The machine.
        data: The log, prepared.
    """
    free, guess = machine.parameters.free, machine.parameters.guess
    args = (sharpened(machine.plant, data), machine.parameters.places, ForceData.of(data, data.fitted))
    _, columns = yield SolveRequest(load_columns, (*args, guess))
    _, there = yield SolveRequest(load_columns, (*args, elsewhere(guess)))
    odd = _out_of_proportion(np.asarray(columns), np.asarray(there))
    kept = tuple(f for f, o in zip(free, odd, strict=True) if not o)
    return machine.with_plant(machine.plant, Parameters(kept))


_measured_force = eqx.filter_jit(measured_force)


def gated(data: Prepared, velocity: np.ndarray, acceleration: np.ndarray) -> Bool[np.ndarray, "kept n"]:
    """Kept samples that are fast, or speed up or slow down; not what filters smear of the others.

    Args:
        data: The log, prepared.
        velocity, acceleration: Of which a sample must exceed one, by joint [m/s, m/s^2 or in rad].
    """
    stuck = (np.abs(data.qd) <= velocity) & (np.abs(data.qdd) <= acceleration)
    return ~smeared(stuck, data.recipe.decimator.reach)[data.kept] & data.measured
