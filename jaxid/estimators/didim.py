"""Direct and inverse dynamic identification: forces alone, the motion is that of the simulated loop.

A good loop moves a wrong model nearly as the machine: its motion follows the reference, and only
the forces that this takes tell the two apart. The regressor is then taken along the simulated
motion, which has no noise, and compared with the measured force.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators.inverse_dynamics import (
    ForceData,
    force_and_columns,
    force_precision,
    force_size,
    sharpened,
)
from jaxid.estimators.rerun import Rerun, bounded_step, settled
from jaxid.estimators.result import Estimate
from jaxid.estimators.steps import Solve, Steps, alone
from jaxid.io.log import Log
from jaxid.machine import Machine
from jaxid.model import Plant
from jaxid.precision import Precision
from jaxid.preprocess import Prepared
from jaxid.replay import Numerics

_MOST_STEPS = 30
_HALVINGS = 8
# After so many, the samples that count stay: one that comes and goes would keep a fit from settling.
_CHOOSING = 4
# A step is taken unless the mean square rises by more than this: the regressor is not quite the
# slope of the simulated force, and near the end a good step may raise it a little.
_WORSE = 1.1
# Moving samples that a step asks for, by unknown.
_FEWEST = 5


def didim(machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None) -> Estimate:
    """Fit the unknowns to the measured force along the motion of the simulated loop.

    Of the measured position only the start is used, and what the filter was chosen by.

    Args:
        machine: The machine, with its controller.
        log: The log, with its reference.
        data: The same, prepared; the simulated motion passes the same filters.
        numerics: How to integrate; absent: as machine and log ask.

    Returns:
        The estimate; its covariance takes the residual's colour into account.

    Raises:
        InputError: If the machine has no controller, or the log no reference.

    Source:
        Gautier, Janot & Vandanjon (2013), IEEE Trans. Control Syst. Technol. 21: DIDIM.
    """
    return alone(didim_steps(machine, log, data, numerics=numerics))


class _Look(NamedTuple):
    """Residual and its Jacobian along a simulated motion: of what moves there, and all of it."""

    e: np.ndarray
    columns: np.ndarray
    rows: np.ndarray
    arrays: ForceData

    @property
    def cost(self) -> float:
        return float(np.mean(self.e[self.rows] ** 2))


def didim_steps(
    machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None
) -> Steps[Estimate]:
    """`didim`, one solve at a time."""
    if machine.controller is None:
        raise InputError(
            "didim simulates the loop, and the controller is not known", where=log.source,
            mend="name it in [controller] and the reference's column in [log], or use inverse_dynamics",
        )
    rerun, theta = Rerun.of(machine, log, data, numerics), machine.parameters.guess
    plant, bounds = sharpened(machine.plant, data), machine.parameters.bounds
    seen = yield from _look(rerun, plant, theta)
    if seen is None:
        return _nothing(machine, log)
    message, step = f"no convergence within {_MOST_STEPS} steps", 0
    while step < _MOST_STEPS:
        step += 1
        e, columns = seen.e[seen.rows], seen.columns[seen.rows]
        change = bounded_step(columns, e, theta, bounds)
        size = yield Solve(force_size, (plant, seen.arrays))
        done = settled(columns @ change, e, float(size))
        for _ in range(_HALVINGS):
            tried = yield from _look(rerun, plant, theta + change, None if step <= _CHOOSING else seen.rows)
            if tried is not None and tried.cost <= _WORSE * seen.cost:
                theta, seen = theta + change, tried
                break
            change = 0.5 * change
        else:
            message = "no step lowers the residual, or the simulation diverges at every one"
            break
        if done:
            message = "converged"
            break
    size = yield Solve(force_size, (plant, seen.arrays))
    return Estimate(
        method="didim", machine=machine.with_estimate(theta), theta=theta,
        precision=force_precision(machine, size, theta, seen.e, seen.columns, seen.rows),
        converged=message == "converged", message=message,
        residual=np.where(seen.rows, seen.e, np.nan), samples=int(seen.rows.sum()), steps=step,
        notes=("the motion is that of the simulated loop; of the measured position only the start is used",),
    )


def _look(
    rerun: Rerun, plant: Plant, theta: np.ndarray, rows: np.ndarray | None = None
) -> Steps[_Look | None]:
    """Simulate at some values; None where that diverges, or hardly moves.

    `rows` are the samples that count, (kept, n); absent: those that move.
    """
    run = yield from rerun.steps(theta, own_command=False)
    if run is None or run.fitted.sum() < _FEWEST * len(theta):
        return None
    rows = run.fitted if rows is None else rows
    arrays = ForceData.of(run, rows)
    places = rerun.machine.parameters.places
    e, columns = yield Solve(force_and_columns, (plant, places, arrays, theta))
    return _Look(np.asarray(e), np.asarray(columns), rows, arrays)


def _nothing(machine: Machine, log: Log) -> Estimate:
    """What is said where not even the guesses can be simulated."""
    p = len(machine.parameters.free)
    blank = Precision(np.full((p, p), np.nan), np.zeros(p, bool), [], np.zeros(p))
    return Estimate(
        method="didim", machine=machine, theta=machine.parameters.guess, precision=blank,
        converged=False, message="the simulation diverged from these starting values, or does not move",
        residual=np.full(log.position.shape, np.nan), samples=0,
    )
