"""Rows of a linear regression along a log: the Jacobian of the plant's balance in its unknowns.

The right-hand side is minus the residual for unknowns of zero. The residual is taken at the load and not
divided by the drive's gain as in `inverse_dynamics`, so that it is linear in the gain. The linearity in all
unknowns together is checked on the log itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

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

# Relative difference of a column between two values of the unknowns that is a rounding error.
_LINEAR = 1e-6


@dataclass(frozen=True)
class Rows:
    """A linear regression, by sample.

    Args:
        rows: Rows Y, (kept, m, p).
        target: Right-hand side r, (kept, m) [N or N m at the load].
        counts: Mask of the rows that count, (kept, m).
        force: Force of the drives in each row, to which residuals are compared, (kept, m) [N or N m].
    """

    rows: Float[np.ndarray, "kept m p"]
    target: Float[np.ndarray, "kept m"]
    counts: Bool[np.ndarray, "kept m"]
    force: Float[np.ndarray, "kept m"]

    @property
    def summed(self) -> Rows:
        """The regression with one row per sample, the sum of the rows that count."""
        rows = np.sum(np.where(self.counts[..., None], self.rows, 0.0), axis=1, keepdims=True)
        target, force = (
            np.sum(np.where(self.counts, x, 0.0), axis=1, keepdims=True) for x in (self.target, self.force)
        )
        return Rows(rows, target, np.asarray(self.moved)[:, None], force)

    def widened(self, index: Int[np.ndarray, " own"], width: int) -> Rows:
        """Return the rows by `width` unknowns of all logs, of which these are the ones with some numbers."""
        rows = np.zeros((*self.rows.shape[:-1], width))
        rows[..., index] = self.rows
        return replace(self, rows=rows)

    def scaled(self, factor: float) -> Rows:
        """Return the regression times a factor."""
        return Rows(factor * self.rows, factor * self.target, self.counts, factor * self.force)

    @classmethod
    def joined(cls, logs: Sequence[Rows]) -> Rows:
        """Return the regressions of logs, one behind the other."""
        fields = ("rows", "target", "counts", "force")
        return cls(*(np.concatenate([getattr(rows, name) for rows in logs]) for name in fields))

    @property
    def size(self) -> float:
        """2-norm of the force in the rows that count."""
        return float(np.linalg.norm(np.where(self.counts, self.force, 0.0)))

    @property
    def moved(self) -> Bool[np.ndarray, " kept"]:
        """Mask of the samples of which any row counts."""
        return np.any(self.counts, axis=1)


@eqx.filter_jit
def load_columns(
    plant: Plant, places: tuple, data: ForceData, theta: Array
) -> tuple[Float[Array, "kept n"], Float[Array, "kept n p"]]:
    """Return the residual of the balance at the load and its Jacobian, filtered and decimated.

    Args:
        plant: The plant.
        places: Paths of the unknowns in it.
        data: The filtered log.
        theta: Values of the unknowns, (p,).
    """

    def residual(theta: Array) -> tuple[Array, Array]:
        moved = scatter(places, plant, theta)
        delays = moved.command_delays(data.force.shape[1])
        u = signals.delayed(data.force, delays, data.period, hold=data.hold)
        e = data.decimator(balance_along(moved, *whole_motion(moved, data, u), u, data.period, data.start)[0])
        return e, e

    jacobian, e = jax.jacfwd(residual, has_aux=True)(jnp.asarray(theta))
    return e, jacobian


def rows_steps(machine: Machine, data: Prepared, gates: tuple[np.ndarray, np.ndarray] | None) -> Steps[Rows]:
    """Compute the rows of a log.

    Args:
        machine: The machine whose unknowns are estimated.
        data: The filtered log.
        gates: Velocity and acceleration, by joint, one of which a sample must exceed; None: the samples
            that `inverse_dynamics` fits.

    Raises:
        InputError: If the balance is not linear in the unknowns.
    """
    plant, names, places = sharpened(machine.plant, data), machine.parameters.names, machine.parameters.places
    arrays, guess = ForceData.of(data, data.fitted), machine.parameters.guess
    e, columns = yield SolveRequest(load_columns, (plant, places, arrays, guess))
    _, there = yield SolveRequest(load_columns, (plant, places, arrays, elsewhere(guess)))
    e, columns = np.asarray(e), np.asarray(columns)
    check_linearity(names, columns, np.asarray(there))
    force = yield SolveRequest(_measured_force, (plant, arrays))
    counts = data.fitted if gates is None else gated(data, *gates)
    target = columns @ guess - e
    return Rows(columns, target, counts, np.asarray(force))


def elsewhere(guess: np.ndarray) -> np.ndarray:
    """Return other values of all unknowns, at which the columns of a linear balance are the same."""
    return 1.5 * np.where(guess == 0, 1.0, guess)


def check_linearity(names: list[str], columns: np.ndarray, there: np.ndarray) -> None:
    """Check that the balance is linear in the unknowns: its columns do not depend on them.

    Args:
        names: Names of the unknowns.
        columns: Columns of the unknowns, (..., p).
        there: Columns at other values of the unknowns, (..., p).

    Raises:
        InputError: If any column depends on the unknowns.
    """
    nonlinear = _nonlinear(columns, there)
    if nonlinear.any():
        several = " and ".join(n for n, o in zip(names, nonlinear, strict=True) if o)
        raise InputError(
            f"the balance is not linear in {several}",
            where="recursive",
            hint=f"declare {'one of them' if nonlinear.sum() > 1 else 'it'} known, or use inverse_dynamics",
        )


def _nonlinear(columns: np.ndarray, there: np.ndarray) -> Bool[np.ndarray, " p"]:
    """Return the mask of the unknowns whose columns differ between two values of the unknowns."""
    rows = tuple(range(columns.ndim - 1))
    return np.abs(there - columns).max(axis=rows) > _LINEAR * np.abs(columns).max(axis=rows)


def keep_linear_steps(machine: Machine, data: Prepared) -> Steps[Machine]:
    """Keep the unknowns in which the balance is linear, and fix the others at their guesses.

    Args:
        machine: The machine whose unknowns are checked.
        data: The filtered log.
    """
    free, guess = machine.parameters.free, machine.parameters.guess
    args = (sharpened(machine.plant, data), machine.parameters.places, ForceData.of(data, data.fitted))
    _, columns = yield SolveRequest(load_columns, (*args, guess))
    _, there = yield SolveRequest(load_columns, (*args, elsewhere(guess)))
    nonlinear = _nonlinear(np.asarray(columns), np.asarray(there))
    kept = tuple(f for f, o in zip(free, nonlinear, strict=True) if not o)
    return machine.with_plant(machine.plant, Parameters(kept))


_measured_force = eqx.filter_jit(measured_force)


def gated(data: Prepared, velocity: np.ndarray, acceleration: np.ndarray) -> Bool[np.ndarray, "kept n"]:
    """Return the mask of the kept samples that exceed a gate, beyond the reach of the filters.

    Args:
        data: The filtered log.
        velocity, acceleration: Gates by joint, one of which a sample must exceed [m/s, m/s^2 or in rad].
    """
    stuck = (np.abs(data.qd) <= velocity) & (np.abs(data.qdd) <= acceleration)
    return ~smeared(stuck, data.recipe.decimator.reach)[data.kept] & np.asarray(data.measured)
