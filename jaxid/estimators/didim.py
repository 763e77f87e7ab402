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

from collections.abc import Sequence
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
from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps as of_one
from jaxid.estimators.several.force import inverse_dynamics_steps as of_several
from jaxid.estimators.several.parts import Part, by_log
from jaxid.estimators.several.sums import counted, projected, shares
from jaxid.estimators.several.weights import disagreement, start_weights, weighted_steps
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.precision import Precision
from jaxid.numerics.rows import Rows, assess_together
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
    return run_alone(didim_steps(machine, [Part.alone(machine, log, data)], numerics=numerics))


class _Look(NamedTuple):
    """Residual and derivatives along the simulated motion of each log.

    Args:
        e: Residual force, (kept, n).
        regressor: Jacobian of the residual for a constant motion, (kept, n, p).
        slope: Jacobian of the simulated force through plant and loop; the regressor if that is not finite.
        rows: Mask of the samples that count, (kept, n).
        size: 2-norm of the measured force at these samples.
        weights: Weight of each log.
    """

    e: list[np.ndarray]
    regressor: list[np.ndarray]
    slope: list[np.ndarray]
    rows: list[np.ndarray]
    size: list[float]
    weights: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Residuals that count, of all logs."""
        return counted(self.e, self.rows, self.weights)

    @property
    def cost(self) -> float:
        return float(np.mean(self.residual**2))

    @property
    def signal(self) -> float:
        """2-norm of the measured forces of all logs."""
        return float(np.sqrt(np.sum(self.weights * np.square(self.size))))

    @property
    def on_regressor(self) -> list[np.ndarray]:
        """Slope projected on the span of the regressor, for which the formulas of least squares hold."""
        bases = [span(x[mask]) for x, mask in zip(self.regressor, self.rows, strict=True)]
        return projected(self.slope, bases, self.rows)

    def logs(self, held: bool) -> list[Rows]:
        """Return the residual of each log with the Jacobian that gives the precision."""
        columns = self.on_regressor if held else self.slope
        return [
            Rows(x, e, rows, size, float(weight))
            for x, e, rows, size, weight in zip(
                columns, self.e, self.rows, self.size, self.weights, strict=True
            )
        ]


class _Found(NamedTuple):
    """Result of the search for the estimate.

    Args:
        theta: Estimates of the unknowns, (p,).
        look: Residual and derivatives there; None if the start cannot be simulated.
        message: "converged", or the reason why the search stopped.
        steps: Number of steps taken.
    """

    theta: np.ndarray
    look: _Look | None
    message: str
    steps: int


def didim_steps(
    machine: Machine, parts: Sequence[Part], *, numerics: Numerics | None = None
) -> Steps[Estimate]:
    """Run `didim` on one log or several as a generator of solve requests.

    Residuals of several logs count over the variance of their noise.

    Args:
        machine: Machine of all logs, with their unknowns.
        parts: The logs.
        numerics: See `didim`.
    """
    for part in parts:
        if part.machine.controller is None:
            raise InputError(
                "didim simulates the loop, and the controller is not known",
                where=part.log.source,
                hint="name it in [controller] and the reference's column in [log], or use inverse_dynamics",
            )
    several, theta, joints = len(parts) > 1, machine.parameters.guess, parts[0].log.position.shape[1]
    held = len(machine.plant.driven(joints)) == joints
    if not held:
        first = yield from of_several(machine, parts) if several else of_one(machine, parts[0].data)
        theta = first.theta if first.all_identified else theta
    reruns = [Rerun.of(part.at(theta), part.log, part.data, numerics) for part in parts]
    weights = np.ones(1)
    if several:
        sizes = []
        for part in parts:
            arguments = (sharpened(part.machine.plant, part.data), ForceData.of(part.data, part.data.fitted))
            sizes.append(float((yield SolveRequest(force_size, arguments))))
        weights = start_weights(sizes, [int(part.data.fitted.sum()) for part in parts])

    fit = lambda theta, weights: _search(machine, parts, reruns, theta, weights, held)
    sound = lambda found: found.look.logs(held) if found.look and found.message == "converged" else None
    found, _ = yield from weighted_steps(fit, sound, lambda found: found.theta, theta, weights)
    if found.look is None:
        return _nothing(machine, parts[0].log)

    theta, logs, guess = found.theta, found.look.logs(held), machine.parameters.guess
    precision = assess_together(machine.parameters.names, logs, np.where(guess != 0, guess, 1.0))
    used = "the start is used" if held else "the start, and inverse dynamics for a first guess, is used"
    notes = [f"the motion is that of the simulated loop; of the measured position only {used}"]
    if several:
        notes += disagreement(logs, int(precision.identifiable.sum()))
    return Estimate(
        method="didim",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=found.message == "converged",
        message=found.message,
        residual=np.concatenate([np.where(log.counts, log.residual, np.nan) for log in logs]),
        samples=sum(int(log.counts.sum()) for log in logs),
        steps=found.steps,
        notes=tuple(notes),
        details=by_log(parts, shares(logs)) if several else {},
    )


def _search(
    machine: Machine,
    parts: Sequence[Part],
    reruns: Sequence[Rerun],
    theta: np.ndarray,
    weights: np.ndarray,
    held: bool,
) -> Steps[_Found]:
    """Step until the simulated forces match the measured ones, each log with its weight.

    Args:
        machine: Machine of all logs.
        parts, reruns: The logs and their simulations.
        theta: Start, (p,).
        weights: Weight of each log.
        held: Whether every joint has a drive.
    """

    def look_at(theta: np.ndarray, rows: list[np.ndarray] | None = None) -> Steps[_Look | None]:
        found = []
        for k, (part, rerun) in enumerate(zip(parts, reruns, strict=True)):
            one = yield from _look(part, rerun, theta, None if rows is None else rows[k])
            if one is None:
                return None
            found.append(one)
        e, regressor, slope, masks, sizes = (list(x) for x in zip(*found, strict=True))
        return _Look(e, regressor, slope, masks, sizes, weights)

    look = yield from look_at(theta)
    if look is None:
        return _Found(theta, None, "", 0)
    message, step = f"no convergence within {_MOST_STEPS} steps", 0
    while step < _MOST_STEPS:
        step += 1
        columns = look.on_regressor if held else look.slope
        columns = look.regressor if held and step <= _ROUGH_STEPS else columns
        e, jacobian = look.residual, counted(columns, look.rows, weights)
        change = best_step(machine.parameters, jacobian, e, theta)
        done = settled(jacobian @ change, e, look.signal)
        for _ in range(_HALVINGS):
            rows = None if step <= _CHOOSING else look.rows
            tried = yield from look_at(theta + change, rows)
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
    return _Found(theta, look, message, step)


def _look(
    part: Part, rerun: Rerun, theta: np.ndarray, rows: np.ndarray | None = None
) -> Steps[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float] | None]:
    """Simulate one log, and return the entries of `_Look`; None if the run diverges or hardly moves.

    Args:
        part: The log.
        rerun: Its simulation.
        theta: Values of the unknowns of all logs, (p,).
        rows: Mask of the samples that count, (kept, n); None: all moving samples of driven joints.
    """
    own, plant = theta[part.index], sharpened(part.machine.plant, part.data)
    run = yield from rerun.steps(own, own_command=False)
    if run is None or run.fitted.sum() < _FEWEST * len(own):
        return None
    joints, places = run.q.shape[1], rerun.machine.parameters.places
    if rows is None:
        rows = run.fitted & np.isin(np.arange(joints), plant.driven(joints))
    arrays = ForceData.of(run, rows)
    e, regressor = yield SolveRequest(force_and_columns, (plant, places, arrays, own))
    slope = yield SolveRequest(_slope, (rerun.replay, places, rerun.machine.plant, arrays, own))
    size = yield SolveRequest(force_size, (plant, arrays))
    regressor, slope = np.asarray(regressor), np.asarray(slope)
    slope = slope if np.all(np.isfinite(slope)) else regressor
    regressor, slope = (part.widened(x, theta.size) for x in (regressor, slope))
    return np.asarray(e), regressor, slope, rows, float(size)


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
