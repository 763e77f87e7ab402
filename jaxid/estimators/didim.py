"""Direct and inverse dynamic identification (DIDIM) from measured forces and the simulated loop's motion.

A good loop moves a wrong model nearly like the machine: both motions follow the reference, and only
the forces differ. Inverse dynamics is therefore evaluated along the simulated
motion, which has no noise, and compared with the measured force.

At the solution the regressor along that motion is orthogonal to the residual force. Early steps
use the regressor as the slope of the simulated force, as if the motion did not change. This slope is
rough if the loop is loose, but converges from far off. Late steps and the precision
use the true slope, the derivative through plant and loop. For a joint without a drive the balance along a
simulated motion contains no information, so that a machine with such a joint always uses the true slope.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.rerun import Rerun, best_step, settled, span
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import force_precision, inverse_dynamics_steps
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.precision import Precision
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_size, sharpened
from jaxid.simulation.replay import Numerics, Replay

_MOST_STEPS = 30
_HALVINGS = 8
# Number of first steps with the regressor as slope; later steps use the true slope.
_ROUGH_STEPS = 8
# Number of first steps that choose the samples that count. Later the choice is fixed, because a sample that
# enters and leaves would keep the fit from converging.
_CHOOSING = 4
# A step is accepted unless the mean square grows by more than this factor: the regressor is not exactly the
# slope of the simulated force, and near the end a good step may increase the mean square a little.
_WORSE = 1.1
# Least number of moving samples per unknown.
_FEWEST = 5


def didim(machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None) -> Estimate:
    """Fit the unknowns to the measured force along the motion of the simulated loop.

    The measured position is used only for the start and for the choice of the filter; if a joint
    has no drive, also for a first estimate by inverse dynamics.

    Args:
        machine: The machine, with its controller.
        log: The log, with its reference.
        data: The prepared log; the simulated motion passes the same filters.
        numerics: Settings of the integration; None: chosen from machine and log.

    Returns:
        The estimate; its covariance accounts for a coloured residual.

    Raises:
        InputError: If the machine has no controller, or the log no reference.

    Source:
        Gautier, Janot & Vandanjon (2013), IEEE Trans. Control Syst. Technol. 21: DIDIM.
    """
    return run_alone(didim_steps(machine, log, data, numerics=numerics))


class _Look(NamedTuple):
    """Residual and derivatives along a simulated motion.

    Args:
        e: Residual force, (kept, n).
        regressor: Jacobian of the residual for a constant motion, (kept, n, p).
        slope: Jacobian of the simulated force through plant and loop; the regressor if that is not finite.
        rows: Mask of the samples that count, (kept, n).
        size: 2-norm of the measured force at these samples.
    """

    e: np.ndarray
    regressor: np.ndarray
    slope: np.ndarray
    rows: np.ndarray
    size: float

    @property
    def cost(self) -> float:
        return float(np.mean(self.e[self.rows] ** 2))

    @property
    def seen(self) -> np.ndarray:
        """Slope projected on the span of the regressor, for which the formulas of least squares hold."""
        basis = span(self.regressor[self.rows])
        out = np.zeros_like(self.slope)
        out[self.rows] = basis @ (basis.T @ self.slope[self.rows])
        return out


def didim_steps(
    machine: Machine, log: Log, data: Prepared, *, numerics: Numerics | None = None
) -> Steps[Estimate]:
    """Run `didim` as a generator of solve requests."""
    if machine.controller is None:
        raise InputError(
            "didim simulates the loop, and the controller is not known",
            where=log.source,
            hint="name it in [controller] and the reference's column in [log], or use inverse_dynamics",
        )
    plant, theta = sharpened(machine.plant, data), machine.parameters.guess
    held = len(plant.driven(log.position.shape[1])) == log.position.shape[1]
    if not held:
        first = yield from inverse_dynamics_steps(machine, data)
        theta = first.theta if first.all_identified else theta
    rerun = Rerun.of(machine.with_estimate(theta), log, data, numerics)
    look = yield from _look(rerun, plant, theta)
    if look is None:
        return _nothing(machine, log)
    message, step = f"no convergence within {_MOST_STEPS} steps", 0
    while step < _MOST_STEPS:
        step += 1
        columns = look.seen if held else look.slope
        columns = look.regressor if held and step <= _ROUGH_STEPS else columns
        e, columns = look.e[look.rows], columns[look.rows]
        change = best_step(machine.parameters, columns, e, theta)
        done = settled(columns @ change, e, look.size)
        for _ in range(_HALVINGS):
            rows = None if step <= _CHOOSING else look.rows
            tried = yield from _look(rerun, plant, theta + change, rows)
            if tried is not None and tried.cost <= _WORSE * look.cost:
                theta, look = theta + change, tried
                break
            change = 0.5 * change
        else:
            message = "no step lowers the residual, or the simulation diverges at every one"
            break
        if done:
            message = "converged"
            break
    used = "the start is used" if held else "the start, and inverse dynamics for a first guess, is used"
    columns = look.seen if held else look.slope
    return Estimate(
        method="didim",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=force_precision(machine, look.size, theta, look.e, columns, look.rows),
        converged=message == "converged",
        message=message,
        residual=np.where(look.rows, look.e, np.nan),
        samples=int(look.rows.sum()),
        steps=step,
        notes=(f"the motion is that of the simulated loop; of the measured position only {used}",),
    )


def _look(
    rerun: Rerun, plant: Plant, theta: np.ndarray, rows: np.ndarray | None = None
) -> Steps[_Look | None]:
    """Simulate at some values of the unknowns; return None if the run diverges or hardly moves.

    `rows` is the mask of samples that count, (kept, n); None: all moving samples of driven joints.
    """
    run = yield from rerun.steps(theta, own_command=False)
    if run is None or run.fitted.sum() < _FEWEST * len(theta):
        return None
    joints, places = run.q.shape[1], rerun.machine.parameters.places
    if rows is None:
        rows = run.fitted & np.isin(np.arange(joints), plant.driven(joints))
    arrays = ForceData.of(run, rows)
    e, regressor = yield SolveRequest(force_and_columns, (plant, places, arrays, theta))
    slope = yield SolveRequest(_slope, (rerun.replay, places, rerun.machine.plant, arrays, theta))
    size = yield SolveRequest(force_size, (plant, arrays))
    regressor, slope = np.asarray(regressor), np.asarray(slope)
    slope = slope if np.all(np.isfinite(slope)) else regressor
    return _Look(np.asarray(e), regressor, slope, rows, float(size))


@eqx.filter_jit
def _slope(
    replay: Replay, places: tuple, plant: Plant, data: ForceData, theta: Array
) -> Float[Array, "kept n p"]:
    """Return the derivative of the simulated loop's force by joint, with the filter of the logged force."""

    def force(theta: Array) -> Array:
        u = replay.drive.gain * replay(scatter(places, plant, theta)).command
        # The simulation already contains the delays of the plant, but not the lag of the held command.
        u = signals.delayed(u, jnp.zeros(()), data.period, hold=data.hold)
        return jax.vmap(lambda u: plant.applied(u, data.q.shape[1]))(data.decimator(u))

    return jax.jacfwd(force)(theta)


def _nothing(machine: Machine, log: Log) -> Estimate:
    """Build the estimate of a machine that cannot be simulated even at the guesses."""
    p = len(machine.parameters.free)
    blank = Precision(np.full((p, p), np.nan), np.zeros(p, bool), [], np.zeros(p))
    return Estimate(
        method="didim",
        machine=machine,
        theta=machine.parameters.guess,
        precision=blank,
        converged=False,
        message="the simulation diverged from these starting values, or does not move",
        residual=np.full(log.position.shape, np.nan),
        samples=0,
    )
