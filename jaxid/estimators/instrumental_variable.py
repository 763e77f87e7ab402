"""Instrumental variables: a simulated regressor as instruments for the measured one.

Noise of a measured position is both in the regressor and in the residual, so that least
squares is biased, towards zero if the noise is large. The same columns along a simulated motion
are correlated with the true ones and not with the noise. If the residual is orthogonal to them, the
estimates are consistent.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators.common.endogeneity import endogeneity
from jaxid.estimators.common.rerun import Rerun, best_step, lost, settled, span
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import force_precision, inverse_dynamics_steps
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_size, sharpened
from jaxid.simulation.replay import Numerics

_MOST_STEPS = 30
_HALVINGS = 8


def instrumental_variable(
    machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None
) -> Estimate:
    """Fit the unknowns so that the residual force is orthogonal to a simulated regressor.

    Args:
        machine: The machine. Instruments come from its loop; without a controller, or a reference
            in the log, from the measured force in open loop. The instruments then contain noise of the
            force sensor, but none of the position.
        log: The log with the measured motion and force.
        data: The prepared log; the simulated motion passes the same filters.
        numerics: Settings of the integration; None: chosen from machine and log.

    Returns:
        The estimate; its covariance accounts for a coloured residual. The fit starts from
        inverse dynamics if all unknowns are identifiable by it. If the loop is simulated,
        `details["durbin_wu_hausman"]` says whether noise biases least squares.

    Raises:
        InputError: If the simulation in open loop departs too far from the log.

    Source:
        Janot, Vandanjon & Gautier (2014), IEEE Trans. Control Syst. Technol. 22: IDIM-IV. Nonlinear
        unknowns are linearised again at every step.
    """
    return run_alone(instrumental_variable_steps(machine, log, data, numerics=numerics))


def instrumental_variable_steps(
    machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None
) -> Steps[Estimate]:
    """Run `instrumental_variable` as a generator of solve requests."""
    first = yield from inverse_dynamics_steps(machine, data)
    # Unidentifiable combinations of physically consistent links are those of a body, and have no effect.
    within = bool(machine.parameters.bodies) and first.converged
    theta = first.theta if first.all_identified or within else machine.parameters.guess
    if log.reference is None:
        machine = replace(machine, controller=None)
    rerun = Rerun.of(machine.with_estimate(theta), log, data, numerics)
    plant, rows, places = sharpened(machine.plant, data), data.fitted, machine.parameters.places
    arrays = ForceData.of(data, rows)
    size = yield SolveRequest(force_size, (plant, arrays))
    found = yield from _search(rerun, plant, arrays, rows, machine.parameters, theta, float(size))
    theta, e, columns, basis = found.theta, found.e, found.columns, found.basis
    # With the columns projected on the instruments, the formulas of least squares give the IV covariance.
    seen = np.zeros((*rows.shape, len(places)))
    seen[rows] = columns[rows] if basis is None else basis @ (basis.T @ columns[rows])
    precision = force_precision(machine, size, theta, e, seen, rows)
    how = "in its loop" if rerun.looped else "in open loop from the measured force"
    # In open loop the instruments hold the noise of the force, which is in the residual too.
    valid = rerun.looped and basis is not None and found.message == "converged"
    test = endogeneity(e, columns, basis, rows) if valid and basis is not None else None
    notes = [f"instruments: the regressor along the motion simulated {how}"]
    return Estimate(
        method="instrumental_variable",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=found.message == "converged",
        message=found.message,
        residual=np.where(rows, e, np.nan),
        samples=int(rows.sum()),
        steps=found.steps,
        notes=(*notes, *([] if test is None else [test.text(machine.parameters.names)])),
        details={} if test is None else {"durbin_wu_hausman": test.json(machine.parameters.names)},
    )


@dataclass(frozen=True)
class _Found:
    """Result of the search for the estimate.

    Args:
        theta: Estimates of the unknowns, (p,).
        e, columns: Residual and Jacobian at the estimates, (kept, n) and (kept, n, p).
        basis: Orthonormal basis of the instruments' span, (rows, r); None if every simulation failed.
        message: "converged", or the reason why the search stopped.
        steps: Number of steps taken.
    """

    theta: np.ndarray
    e: np.ndarray
    columns: np.ndarray
    basis: np.ndarray | None
    message: str
    steps: int


def _search(
    rerun: Rerun,
    plant: Plant,
    arrays: ForceData,
    rows: np.ndarray,
    unknown: Parameters,
    theta: np.ndarray,
    size: float,
) -> Steps[_Found]:
    """Alternate until convergence between instruments at the estimate and an estimate with them."""
    places = unknown.places

    def along(data: ForceData, theta: np.ndarray) -> Steps[tuple[np.ndarray, np.ndarray]]:
        e, columns = yield SolveRequest(force_and_columns, (plant, places, data, theta))
        return np.asarray(e), np.asarray(columns)

    e, columns = yield from along(arrays, theta)
    basis = None
    for step in range(1, _MOST_STEPS + 1):
        run = yield from rerun.steps(theta, own_command=True)
        if not rerun.looped and (run is None or lost(run, rerun.log)) and step == 1:
            raise InputError(
                "the simulation from the measured force loses the log, and makes no instruments",
                where=rerun.log.source,
                hint="name the controller in [controller] and the reference's "
                "column in [log], or use inverse_dynamics",
            )
        # If the simulation diverges, the instruments of the step before remain valid.
        if run is not None:
            _, simulated = yield from along(ForceData.of(run, rows), theta)
            basis = span(simulated[rows])
        if basis is None:
            return _Found(theta, e, columns, None, "the simulation diverged from these starting values", step)
        change = best_step(unknown, basis.T @ columns[rows], basis.T @ e[rows], theta)
        was = float(np.linalg.norm(basis.T @ e[rows]))
        done = settled(basis.T @ columns[rows] @ change, e[rows], size)
        for _ in range(_HALVINGS):
            tried = yield from along(arrays, theta + change)
            if np.linalg.norm(basis.T @ tried[0][rows]) <= was:
                theta, (e, columns) = theta + change, tried
                break
            change = 0.5 * change
        if done:
            return _Found(theta, e, columns, basis, "converged", step)
    return _Found(theta, e, columns, basis, f"no convergence within {_MOST_STEPS} steps", _MOST_STEPS)
