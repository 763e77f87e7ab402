"""Least squares on equations of several logs: balances of forces or energy, and their iterated integrals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse

from jaxid.estimators.algebraic.windows import kernels_of as algebraic_kernels
from jaxid.estimators.algebraic.windows import windows_and_columns, windows_without_rest
from jaxid.estimators.common.best_bodies import best_bodies
from jaxid.estimators.common.joint_weights import joint_weights
from jaxid.estimators.common.shapes import other_starts
from jaxid.estimators.common.windowed import Kernels, row_covariance_steps, weights_of_rows
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale
from jaxid.estimators.power import kernels_of as power_kernels
from jaxid.estimators.power import power_and_columns, windows_of
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.parts import Part, Scale, by_log
from jaxid.estimators.several.sums import shares, stacked, summed
from jaxid.estimators.several.weights import descended_steps, disagreement, start_weights
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.rows import Rows, assess_together
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_size, sharpened

# Part of the cost by which a fit has converged, and most evaluations, as of the fit to one log.
_TOLERANCE, _MOST = 1e-12, 60


@dataclass(frozen=True)
class Equations:
    """Equations of one log that are solved by least squares.

    Args:
        function: Compiled function of `arguments` and the unknowns of the log that returns the residual,
            (rows, n), and its Jacobian, (rows, n, own).
        arguments: Its first arguments.
        counts: Mask of the rows that count, (rows, n).
        signal: 2-norm of the measured signal that the residual belongs to.
        kernels: Weights of the force in the rows that count, if they are integrals over windows.
        factor: Weight of each row, (rows, n); None: one for those that count.
        covariance: Covariance of the weighted rows that count; None: not known.
    """

    function: Callable
    arguments: tuple
    counts: np.ndarray
    signal: float
    kernels: Kernels | None = None
    factor: np.ndarray | None = None
    covariance: scipy.sparse.csr_array | None = None

    def rows(self, part: Part, e: np.ndarray, columns: np.ndarray, width: int, weight: float) -> Rows:
        """Return the weighted rows of a log, with the columns of `width` unknowns of all logs."""
        factor = np.where(self.counts, 1.0 if self.factor is None else self.factor, 0.0)
        e = np.where(self.counts, np.asarray(e) * factor, 0.0)
        columns = np.where(self.counts[..., None], np.asarray(columns) * factor[..., None], 0.0)
        wide = part.widened(columns, width)
        return Rows(wide, e, self.counts, self.signal, weight, self.covariance)

    def weighed_steps(self, part: Part, theta: np.ndarray, rows: Rows) -> Steps[Equations]:
        """Return the equations weighed by the variance of each row at values of the unknowns of all logs.

        Balances of forces count by joint. The signal of their rows is then that of the weighted rows.
        """
        if self.kernels is None:
            return (yield from self._by_joint_steps(part, rows))
        covariance = yield from row_covariance_steps(part.at(theta), part.data, self.kernels, part.log)
        if not np.all(np.isfinite(covariance.data)):
            return self
        factor, covariance = weights_of_rows(rows, covariance)
        return replace(self, factor=factor, covariance=covariance)

    def _by_joint_steps(self, part: Part, rows: Rows) -> Steps[Equations]:
        plant = self.arguments[0]
        weights = joint_weights(plant, rows.residual, self.counts)
        if weights is None:
            return self
        factor = self.counts * weights
        arrays = replace(ForceData.of(part.data, self.counts), weight=factor)
        signal = float((yield SolveRequest(force_size, (plant, arrays))))
        return replace(self, factor=factor, signal=signal)


def inverse_dynamics_steps(machine: Machine, parts: Sequence[Part]) -> Steps[Estimate]:
    """Fit the unknowns to several logs by least squares on the balance of forces, as `inverse_dynamics`."""
    equations = []
    whole = all(all(part.data.measured) for part in parts)
    for part in parts:
        data = part.data
        arrays, plant = ForceData.of(data, data.fitted), sharpened(part.machine.plant, data)
        size = float((yield SolveRequest(force_size, (plant, arrays))))
        arguments = (plant, part.machine.parameters.places, arrays)
        equations.append(Equations(force_and_columns, arguments, data.fitted, size))
    return (yield from least_squares_steps(machine, "inverse_dynamics", parts, equations, whole=whole))


def power_steps(machine: Machine, parts: Sequence[Part]) -> Steps[Estimate]:
    """Fit the unknowns to balances of energy over windows of several logs, as `power`."""
    equations = []
    for part in parts:
        part.log.need_every_encoder("power")
        plant = sharpened(part.machine.plant, part.data)
        windows, unit = windows_of(part.machine, part.data)
        counts = np.asarray(windows.weight > 0)
        arguments = (plant, part.machine.parameters.places, windows)
        signal = float(unit * np.sqrt(counts.sum()))
        kernels = power_kernels(windows)
        equations.append(Equations(power_and_columns, arguments, counts, signal, kernels))
    return (yield from least_squares_steps(machine, "power", parts, equations))


def algebraic_steps(machine: Machine, parts: Sequence[Part]) -> Steps[Estimate]:
    """Fit the unknowns to windows of iterated integrals of several logs, as `algebraic`."""
    equations = []
    for part in parts:
        part.log.need_every_encoder("algebraic")
        length, counts = windows_without_rest(part.machine, part.log, part.data)
        plant, data = sharpened(part.machine.plant, part.data), part.data
        arguments = (plant, part.machine.parameters.places, ForceData.of(data), part.log.position, length)
        force = float(np.sqrt(np.mean((data.force - data.force.mean(axis=0)) ** 2)))
        signal, kernels = force * np.sqrt(counts.sum()), algebraic_kernels(length, counts, data.period)
        equations.append(Equations(windows_and_columns, arguments, counts, signal, kernels))
    return (yield from least_squares_steps(machine, "algebraic", parts, equations))


def least_squares_steps(
    machine: Machine, method: str, parts: Sequence[Part], equations: list[Equations], *, whole: bool = True
) -> Steps[Estimate]:
    """Solve the equations of several logs by least squares, each log weighed by its noise.

    Args:
        machine: Machine of all logs, with their unknowns.
        method: Name of the method, for the estimate.
        parts: The logs.
        equations: The equations of each.
        whole: Whether every joint has an encoder.
    """
    transform, damping = linear_scale(machine, whole)
    scale, p = Scale.of(machine, transform), len(machine.parameters.free)

    def fit(x: np.ndarray, weights: np.ndarray) -> Steps[Descent]:
        def evaluate(x: np.ndarray) -> Steps[Model]:
            theta, _ = scale.outward(x)
            logs = []
            for part, own, weight in zip(parts, equations, weights, strict=True):
                arguments = (*own.arguments, theta[part.index])
                e, columns = yield SolveRequest(own.function, arguments)
                logs.append(own.rows(part, e, columns, p, float(weight)))
            return summed(logs, lambda columns: scale.inner(columns, theta))

        if transform.affine:
            return (yield from _bodies_steps(machine, scale, evaluate, x))
        options = {**scale.limits(_TOLERANCE, _MOST), "damping": damping}
        return (yield from descent_steps(evaluate, x, scale.bounds, **options))

    first = start_weights([own.signal for own in equations], [int(own.counts.sum()) for own in equations])
    theta = machine.parameters.guess
    ends = []
    position = np.concatenate([part.data.q for part in parts])
    for at in [theta, *other_starts(machine, theta, position)]:
        ends.append((yield from fit(scale.inward(at), first)))
    best = min(ends, key=lambda end: np.nan_to_num(end.model.cost, nan=np.inf))
    found, weights = yield from descended_steps(fit, best.x, first)
    if found.model.finite:
        at, logs = scale.outward(found.x)[0], found.model.content
        for k, (part, own, rows) in enumerate(zip(parts, list(equations), logs, strict=True)):
            equations[k] = yield from own.weighed_steps(part, at, rows)
        found, _ = yield from descended_steps(fit, found.x, weights)
    factors = [own.counts if own.factor is None else own.factor for own in equations]
    return _estimate(machine, method, parts, scale, found, factors)


def _bodies_steps(
    machine: Machine, scale: Scale, evaluate: Callable[[np.ndarray], Steps[Model]], x: np.ndarray
) -> Steps[Descent]:
    """Minimise over real bodies at once: the residual of every log is affine in the unknowns."""
    at = yield from evaluate(x)
    if not at.finite:
        return Descent(x, at, False, 1)
    jacobian, e, counts = stacked(at.content)
    theta, converged = best_bodies(machine.parameters, jacobian[counts], e[counts], scale.outward(x)[0])
    x = scale.inward(theta)
    return Descent(x, (yield from evaluate(x)), converged, 2)


def _estimate(
    machine: Machine,
    method: str,
    parts: Sequence[Part],
    scale: Scale,
    found: Descent,
    factors: Sequence[np.ndarray],
) -> Estimate:
    logs = found.model.content
    theta, guess = scale.outward(found.x)[0], machine.parameters.guess
    natural = np.where(guess != 0, guess, 1.0)
    precision = assess_together(machine.parameters.names, logs, natural)
    if any(part.data.faster_loop for part in parts) and found.model.finite:
        lengths = [len(log.residual) for log in logs]
        precision = precision.widened(widening(precision, *stacked(logs), lengths))
    converged = found.converged and bool(np.all(np.isfinite(theta)))
    residual = [
        np.where(log.counts, log.residual / np.where(log.counts, factor, 1.0), np.nan)
        for log, factor in zip(logs, factors, strict=True)
    ]
    return Estimate(
        method=method,
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else f"no convergence within {found.steps} steps",
        residual=np.concatenate(residual),
        samples=sum(int(log.counts.sum()) for log in logs),
        steps=found.steps,
        notes=tuple(disagreement(logs, int(precision.identifiable.sum()))),
        details=by_log(parts, shares(logs)),
        std_misspecified=std_under_misspecification(*stacked(logs)),
    )
