"""Instrumental variables: a simulated regressor as instruments for the measured one.

Noise of a measured position is both in the regressor and in the residual, so that least
squares is biased, towards zero if the noise is large. The same columns along a simulated motion
are correlated with the true ones and not with the noise. If the residual is orthogonal to them, the
estimates are consistent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg

from jaxid.errors import InputError
from jaxid.estimators.common.endogeneity import endogeneity
from jaxid.estimators.common.joint_weights import joint_weights
from jaxid.estimators.common.rerun import Rerun, best_step, lost, settled, span
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import inverse_dynamics_steps as of_one
from jaxid.estimators.several.force import inverse_dynamics_steps as of_several
from jaxid.estimators.several.parts import Part, by_log
from jaxid.estimators.several.sums import counted, projected, shares, stacked
from jaxid.estimators.several.weights import disagreement, start_weights, weighted_steps
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Parameters
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.rows import Rows, assess_together
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
    part = Part.alone(machine, log, data)
    return run_alone(instrumental_variable_steps(machine, [part], numerics=numerics))


@dataclass(frozen=True)
class _Balance:
    """Balance of forces of one log, with the simulation that gives its instruments.

    Args:
        part: The log with its machine.
        rerun: The simulation.
        plant: The plant with the friction of the log's speeds.
        arrays: The prepared log.
        size: 2-norm of the weighted measured force.
        weight: Weight of each joint by what least squares leaves of it, (n,).
    """

    part: Part
    rerun: Rerun
    plant: Plant
    arrays: ForceData
    size: float
    weight: np.ndarray

    @classmethod
    def steps(cls, part: Part, theta: np.ndarray, numerics: Numerics | None) -> Steps[_Balance]:
        """Prepare a log for values of the unknowns of all logs, (p,)."""
        if part.log.reference is None:
            part = replace(part, machine=replace(part.machine, controller=None))
        rerun = Rerun.of(part.at(theta), part.log, part.data, numerics)
        plant, arrays = sharpened(part.machine.plant, part.data), ForceData.of(part.data, part.data.fitted)
        rows, own = part.data.fitted, theta[part.index]
        e, _ = yield SolveRequest(force_and_columns, (plant, part.machine.parameters.places, arrays, own))
        weight = joint_weights(plant, np.where(rows, np.asarray(e), 0.0), rows)
        weight = np.ones(rows.shape[1]) if weight is None else weight
        size = yield SolveRequest(force_size, (plant, replace(arrays, weight=rows * weight)))
        return cls(part, rerun, plant, arrays, float(size), weight)

    @property
    def rows(self) -> np.ndarray:
        """Mask of the samples that count, (kept, n)."""
        return self.part.data.fitted

    def along(self, data: ForceData, theta: np.ndarray) -> Steps[tuple[np.ndarray, np.ndarray]]:
        """Compute the weighted residual force along a motion, and its Jacobian by all unknowns."""
        own, places = theta[self.part.index], self.part.machine.parameters.places
        e, columns = yield SolveRequest(force_and_columns, (self.plant, places, data, own))
        wide = self.part.widened(np.asarray(columns), theta.size)
        return np.asarray(e) * self.weight, wide * self.weight[:, None]


def instrumental_variable_steps(
    machine: Machine, parts: Sequence[Part], *, numerics: Numerics | None = None
) -> Steps[Estimate]:
    """Run `instrumental_variable` on one log or several as a generator of solve requests.

    The equations of several logs are added, each over the variance of its log's noise. Those of each joint
    are weighted as in `inverse_dynamics`.

    Args:
        machine: Machine of all logs, with their unknowns.
        parts: The logs.
        numerics: See `instrumental_variable`.
    """
    several = len(parts) > 1
    first = yield from of_several(machine, parts) if several else of_one(machine, parts[0].data)
    # Unidentifiable combinations of physically consistent links are those of a body, and have no effect.
    within = bool(machine.parameters.bodies) and first.converged
    theta = first.theta if first.all_identified or within else machine.parameters.guess
    if parts[0].log.reference is None:
        machine = replace(machine, controller=None)
    logs = []
    for part in parts:
        logs.append((yield from _Balance.steps(part, theta, numerics)))
    weights = np.ones(1)
    if several:
        weights = start_weights([log.size for log in logs], [int(log.rows.sum()) for log in logs])

    fit = lambda theta, weights: _search(logs, machine.parameters, theta, weights)
    sound = lambda found: found.on_instruments if found.message == "converged" else None
    found, _ = yield from weighted_steps(fit, sound, lambda found: found.theta, theta, weights)

    guess, on_instruments = machine.parameters.guess, found.on_instruments
    precision = assess_together(machine.parameters.names, on_instruments, np.where(guess != 0, guess, 1.0))
    looped, converged = all(log.rerun.looped for log in logs), found.message == "converged"
    how = "in its loop" if looped else "in open loop from the measured force"
    notes = [f"instruments: the regressor along the motion simulated {how}"]
    details = by_log(parts, shares(on_instruments)) if several else {}
    # In open loop the instruments hold the noise of the force, which is in the residual too.
    if looped and found.bases is not None and converged:
        columns = [replace(row, jacobian=x) for row, x in zip(on_instruments, found.columns, strict=True)]
        jacobian, e, counts = stacked(columns)
        test = endogeneity(e, jacobian, np.asarray(scipy.linalg.block_diag(*found.bases)), counts)
        if test is not None:
            names = machine.parameters.names
            notes, details = [*notes, test.text(names)], details | {"durbin_wu_hausman": test.json(names)}
    if several:
        notes += disagreement(on_instruments, int(precision.identifiable.sum()))
    return Estimate(
        method="instrumental_variable",
        machine=machine.with_estimate(found.theta),
        theta=found.theta,
        precision=precision,
        converged=converged,
        message=found.message,
        residual=np.concatenate(
            [
                np.where(row.counts, row.residual / log.weight, np.nan)
                for row, log in zip(on_instruments, logs, strict=True)
            ]
        ),
        samples=sum(int(row.counts.sum()) for row in on_instruments),
        steps=found.steps,
        notes=tuple(notes),
        details=details,
    )


@dataclass(frozen=True)
class _Found:
    """Result of the search for the estimate.

    Args:
        theta: Estimates of the unknowns, (p,).
        on_instruments: Residual of each log, with its Jacobian projected on the instruments. The formulas of
            least squares then give the covariance.
        columns: Jacobian of each log, (kept, n, p).
        bases: Orthonormal basis of the span of each log's instruments, (rows, r); None if a run failed.
        message: "converged", or the reason why the search stopped.
        steps: Number of steps taken.
    """

    theta: np.ndarray
    on_instruments: list[Rows]
    columns: list[np.ndarray]
    bases: list[np.ndarray] | None
    message: str
    steps: int

    @classmethod
    def of(
        cls,
        logs: Sequence[_Balance],
        weights: np.ndarray,
        theta: np.ndarray,
        balance: Sequence[tuple[np.ndarray, np.ndarray]],
        bases: list[np.ndarray] | None,
        message: str,
        steps: int,
    ) -> _Found:
        """Return the result from residual and Jacobian of each log."""
        masks, columns = [log.rows for log in logs], [columns for _, columns in balance]
        inside = columns if bases is None else projected(columns, bases, masks)
        on_instruments = [
            Rows(x, e, log.rows, log.size, float(weight))
            for x, (e, _), log, weight in zip(inside, balance, logs, weights, strict=True)
        ]
        return cls(theta, on_instruments, columns, bases, message, steps)


def _search(
    logs: Sequence[_Balance], unknown: Parameters, theta: np.ndarray, weights: np.ndarray
) -> Steps[_Found]:
    """Alternate until convergence between instruments at the estimate and an estimate with them."""
    masks, roots = [log.rows for log in logs], np.sqrt(weights)
    size = float(np.sqrt(np.sum(weights * np.square([log.size for log in logs]))))

    def along(theta: np.ndarray) -> Steps[list[tuple[np.ndarray, np.ndarray]]]:
        out = []
        for log in logs:
            out.append((yield from log.along(log.arrays, theta)))
        return out

    def by_instruments(bases: Sequence[np.ndarray], values: Sequence[np.ndarray]) -> np.ndarray:
        each = zip(roots, bases, values, masks, strict=True)
        return np.concatenate([root * (basis.T @ x[mask]) for root, basis, x, mask in each])

    def ended(message: str, steps: int) -> _Found:
        return _Found.of(logs, weights, theta, balance, bases, message, steps)

    balance, bases = (yield from along(theta)), None
    simulated: list[np.ndarray | None] = [None] * len(logs)
    for step in range(1, _MOST_STEPS + 1):
        for k, log in enumerate(logs):
            run = yield from log.rerun.steps(theta[log.part.index], own_command=True)
            _need_found(log, run, step)
            # If the simulation diverges, the instruments of the step before remain valid.
            if run is not None:
                _, columns = yield from log.along(ForceData.of(run, log.rows), theta)
                simulated[k] = span(columns[log.rows])
        bases = [basis for basis in simulated if basis is not None]
        if len(bases) < len(logs):
            bases = None
            return ended("the simulation diverged from these starting values", step)
        e, jacobian = ([each[k] for each in balance] for k in (0, 1))
        left, slope = by_instruments(bases, e), by_instruments(bases, jacobian)
        change = best_step(unknown, slope, left, theta)
        was = float(np.linalg.norm(left))
        done = settled(slope @ change, counted(e, masks, weights), size)
        for _ in range(_HALVINGS):
            tried = yield from along(theta + change)
            if np.linalg.norm(by_instruments(bases, [e for e, _ in tried])) <= was:
                theta, balance = theta + change, tried
                break
            change = 0.5 * change
        if done:
            return ended("converged", step)
    return ended(f"no convergence within {_MOST_STEPS} steps", _MOST_STEPS)


def _need_found(log: _Balance, run: Prepared | None, step: int) -> None:
    """Refuse a simulation from the measured force that loses the log at once.

    Raises:
        InputError: If it does.
    """
    if not log.rerun.looped and step == 1 and (run is None or lost(run, log.part.log)):
        raise InputError(
            "the simulation from the measured force loses the log, and makes no instruments",
            where=log.part.log.source,
            hint="name the controller in [controller] and the reference's "
            "column in [log], or use inverse_dynamics",
        )
