"""An estimator: Huber's robust least squares on the balance of forces, for logs with outliers."""

from __future__ import annotations

import equinox as eqx
import numpy as np
from jax import Array

from jaxid.errors import InputError
from jaxid.estimators import register_method
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_unknowns
from jaxid.model import Plant
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import assess
from jaxid.session import Session
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_size, sharpened

# Residuals beyond so many standard deviations count in proportion, not squared. With normal noise the
# variance is then 5 % larger than that of least squares.
_CORNER = 1.345
_MOST_ROUNDS = 100
_CONVERGED = 1e-10


@eqx.filter_jit
def _balance(plant: Plant, places: tuple, data: ForceData, theta: Array) -> tuple[Array, Array, Array]:
    """Return the force residual at theta, its Jacobian, and the 2-norm of the measured force."""
    residual, jacobian = force_and_columns(plant, places, data, theta)
    return residual, jacobian, force_size(plant, data)


def huber_steps(session: Session) -> Steps[Estimate]:
    """Fit the unknowns by least squares on the balance of forces, with Huber's weights.

    Args:
        session: Case, machine at its guesses, and logs, checked and prepared.

    Raises:
        InputError: If an unknown does not enter the balance in proportion.

    Source:
        Huber (1964), "Robust estimation of a location parameter", Ann. Math. Statist. 35; iteratively
        reweighted least squares with the scale from the median absolute residual.
    """
    machine, data = session.machine, session.fit.data
    parameters, rows = machine.parameters, data.fitted
    if not np.all(linear_unknowns(machine)):
        raise InputError(
            "huber needs unknowns that enter the balance in proportion",
            where=str(session.case.path),
            hint="give widths, delays and periods as known, or use inverse_dynamics",
        )

    # The compiled part goes out as a request: a study solves those of many runs in one call.
    plant, arrays = sharpened(machine.plant, data), ForceData.of(data, rows)
    answer = yield SolveRequest(_balance, (plant, parameters.places, arrays, parameters.guess))
    residual, jacobian, size = (np.asarray(x) for x in answer)

    step, root_weight, converged = np.zeros(len(parameters.guess)), np.ones(rows.shape), False
    for _ in range(_MOST_ROUNDS):
        weighted = root_weight[..., None] * jacobian
        new = np.linalg.lstsq(weighted[rows], -(root_weight * residual)[rows])[0]
        converged = bool(np.linalg.norm(new - step) <= _CONVERGED * np.linalg.norm(new))
        step = new
        if converged:
            break
        error = np.abs(residual + jacobian @ step)
        scale = 1.4826 * np.median(error[rows])
        root_weight = np.sqrt(np.minimum(1.0, _CORNER * scale / np.maximum(error, 1e-300)))

    theta, error = parameters.guess + step, residual + jacobian @ step
    sizes = np.where(parameters.guess != 0, np.abs(parameters.guess), 1.0)
    weighted = root_weight[..., None] * jacobian
    return Estimate(
        method="huber",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=assess(parameters.names, weighted, root_weight * error, rows, float(size), sizes),
        converged=converged,
        message="converged" if converged else f"no convergence within {_MOST_ROUNDS} rounds",
        residual=np.where(rows, error, np.nan),
        samples=int(rows.sum()),
    )


register_method("huber", huber_steps)
