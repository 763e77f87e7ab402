"""Test of an estimate by inverse dynamics: whether noise in its loop biases it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators.common.endogeneity import Endogeneity, endogeneity
from jaxid.estimators.common.rerun import Rerun, best_step, lost, span
from jaxid.estimators.estimate import Estimate
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.simulation.force_balance import ForceData, force_and_columns, sharpened

if TYPE_CHECKING:
    from jaxid.session import Session


def with_loop_noise(session: Session, estimate: Estimate) -> Steps[Estimate]:
    """Return an estimate of inverse dynamics with the Durbin-Wu-Hausman test beside it.

    Args:
        session: Case and logs of the fit.
        estimate: Estimate by inverse dynamics.

    Returns:
        The estimate; unchanged if the controller is not declared or the reference not logged, a joint has no
        encoder, the fit has not identified all unknowns or keeps links physically consistent, or the
        simulated loop departs from the log.
    """
    machine, log = session.machine, session.fit.log
    looped = machine.controller is not None and log.reference is not None and all(log.measured)
    consistent = session.case.identification.physically_consistent
    if not looped or not estimate.all_identified or consistent:
        return estimate
    try:
        test = yield from _test(machine, log, session.fit.data, estimate.theta)
    except InputError:  # a loop that cannot be simulated gives no instruments
        test = None
    if test is None:
        return estimate
    names = machine.parameters.names
    return replace(
        estimate,
        notes=(*estimate.notes, test.text(names)),
        details={**estimate.details, "durbin_wu_hausman": test.json(names)},
    )


def _test(machine: Machine, log: Log, data: Prepared, theta: np.ndarray) -> Steps[Endogeneity | None]:
    """Return the test with instruments along the loop simulated at the estimate; None without instruments.

    One step from least squares is the estimate by these instruments, to first order in its size; for linear
    unknowns it is exact.
    """
    plant, rows, places = sharpened(machine.plant, data), data.fitted, machine.parameters.places
    rerun = Rerun.of(machine.with_estimate(theta), log, data)
    run = yield from rerun.steps(theta, own_command=True)
    if run is None or lost(run, log):
        return None
    arrays = ForceData.of(data, rows)
    _, simulated = yield SolveRequest(force_and_columns, (plant, places, ForceData.of(run, rows), theta))
    e, columns = yield SolveRequest(force_and_columns, (plant, places, arrays, theta))
    basis = span(np.asarray(simulated)[rows])
    step = best_step(
        machine.parameters, basis.T @ np.asarray(columns)[rows], basis.T @ np.asarray(e)[rows], theta
    )
    e, columns = yield SolveRequest(force_and_columns, (plant, places, arrays, theta + step))
    return endogeneity(np.asarray(e), np.asarray(columns), basis, rows)
