"""Fit of the simulated to the measured outputs of several logs, each with its start and noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.minimisers import minimiser_of
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import (
    CLEARLY,
    NOISE_LIMITED,
    choose_numerics,
    forgets,
    kept_delay,
    measured_output,
    need_loop,
    notes_of,
    output_residual,
)
from jaxid.estimators.several.descent import Descent, Model, descent_steps
from jaxid.estimators.several.force import shares, stacked, summed
from jaxid.estimators.several.parts import Part, Scale, by_log, parts_of
from jaxid.estimators.several.weights import disagreement, start_weights, weighted_steps
from jaxid.gap import SHORT
from jaxid.model.plant import Plant
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.misspecified import std_under_misspecification
from jaxid.numerics.precision import Precision, Rows, assess_together, full_hessian, hessian_notes
from jaxid.session import Session
from jaxid.simulation.replay import (
    Numerics,
    Replay,
    from_rest,
    make_replay,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise

# Part of the cost by which a fit has converged, and most evaluations, as of the fit to one log.
_TOLERANCE, _MOST = 1e-12, 60


@eqx.filter_jit
def _linearised(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> tuple[Array, Array]:
    """Return the weighted residual of the output, (time, k), and its Jacobian, (time, k, unknowns)."""
    residual = output_residual(replay, places, plant, measured, weight, on)

    def both(theta: Array) -> tuple[Array, Array]:
        e = residual(theta)
        return e, e

    jacobian, e = jax.jacfwd(both, has_aux=True)(theta)
    return e, jacobian


@eqx.filter_jit
def _hessian(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    return full_hessian(output_residual(replay, places, plant, measured, weight, on), theta)


@dataclass(frozen=True)
class _Output:
    """Output of one log that is compared with its simulation.

    Args:
        part: The log with its machine.
        numerics: Settings of the integration.
        replay: The simulation.
        measured: Measured output, (time, k).
        weight: Factor of each residual, zero where it does not count, (time, k).
        start: Whether changes of the start are among the unknowns.
    """

    part: Part
    numerics: Numerics
    replay: Replay
    measured: np.ndarray
    weight: np.ndarray
    start: bool = False

    @property
    def width(self) -> int:
        """Number of changes of the start, which are unknowns or zero."""
        return 2 * self.part.run.log.position.shape[1]

    @property
    def counts(self) -> np.ndarray:
        """Mask of the outputs that count, (time, k)."""
        return self.weight > 0

    @property
    def signal(self) -> float:
        """2-norm of the measured output about its mean."""
        return float(np.linalg.norm(self.weight * (self.measured - self.measured.mean(axis=0))))

    def arguments(self, theta: np.ndarray, start: np.ndarray, on: str) -> tuple:
        """Return the arguments of compiled code at values of all unknowns, and of the start."""
        machine = self.part.machine
        own = np.concatenate([theta[self.part.index], start])
        return self.replay, machine.parameters.places, machine.plant, self.measured, self.weight, own, on


@dataclass(frozen=True)
class _End:
    """End of a fit.

    Args:
        theta: Physical values, (p,).
        starts: Changes of all starts.
        descent: The last descent, whose content are the residuals.
        weights: Weight of each log.
    """

    theta: np.ndarray
    starts: np.ndarray
    descent: Descent
    weights: np.ndarray

    @property
    def logs(self) -> list[Rows]:
        """Residuals of the logs."""
        return self.descent.model.content


@dataclass(frozen=True)
class _Fit:
    """A fit of all logs.

    Args:
        session: Case and logs.
        outputs: The outputs that are compared.
        on: Kind of the outputs, one of `jaxid.names.OUTPUTS`.
    """

    session: Session
    outputs: tuple[_Output, ...]
    on: str

    @property
    def scale(self) -> Scale:
        return Scale.of(self.session.machine, more=sum(o.width for o in self.outputs))

    @property
    def active(self) -> np.ndarray:
        """Mask of the unknowns that move, with the changes of the starts behind the others."""
        p = len(self.session.machine.parameters.free)
        return np.concatenate([np.ones(p, bool), *(np.full(o.width, o.start) for o in self.outputs)])

    def places(self) -> list[slice]:
        """Return the places of each log's start among the changes of all starts."""
        ends = np.cumsum([o.width for o in self.outputs])
        return [slice(end - o.width, end) for end, o in zip(ends.tolist(), self.outputs, strict=True)]

    def steps(self, theta: np.ndarray, starts: np.ndarray | None = None, weights: Any = None) -> Steps[_End]:
        """Fit from some values; the weights of the logs follow from their residuals."""
        scale, signals = self.scale, [o.signal for o in self.outputs]
        if weights is None:
            weights = start_weights(signals, [int(o.counts.sum()) for o in self.outputs])

        def fit(x: np.ndarray, weights: np.ndarray) -> Steps[Descent]:
            def evaluate(x: np.ndarray) -> Steps[Model]:
                theta, starts = scale.outward(x)
                logs = yield from self._rows(theta, starts, signals, weights)
                return summed(logs, scale.slope(theta))

            options = {"tolerance": (_TOLERANCE, 0.0), "max_steps": _MOST, "active": self.active}
            return (yield from descent_steps(evaluate, x, scale.bounds, **options))

        x = scale.inward(theta, starts)
        found, weights = yield from weighted_steps(fit, lambda end: end.model.content, x, weights)
        return _End(*scale.outward(found.x), found, weights)

    def _rows(
        self, theta: np.ndarray, starts: np.ndarray, signals: Sequence[float], weights: np.ndarray
    ) -> Steps[list[Rows]]:
        logs, p, q = [], theta.size, theta.size + starts.size
        for output, place, signal, weight in zip(self.outputs, self.places(), signals, weights, strict=True):
            arguments = output.arguments(theta, starts[place], self.on)
            e, jacobian = (np.asarray(x) for x in (yield SolveRequest(_linearised, arguments)))
            wide = np.zeros((*e.shape, q))
            own = output.part.index.size
            wide[..., output.part.index] = jacobian[..., :own]
            wide[..., p + place.start : p + place.stop] = jacobian[..., own:]
            logs.append(Rows(wide, e, output.counts, signal, float(weight)))
        return logs

    def changed(self, outputs: Sequence[_Output]) -> _Fit:
        """Return the fit with other outputs."""
        return replace(self, outputs=tuple(outputs))

    def hessian(self, end: _End) -> Steps[np.ndarray]:
        """Compute the full Hessian of half the weighted sum of squares by the active unknowns."""
        p, q = end.theta.size, self.active.size
        out = np.zeros((q, q))
        for output, place, weight in zip(self.outputs, self.places(), end.weights, strict=True):
            arguments = output.arguments(end.theta, end.starts[place], self.on)
            own = np.asarray((yield SolveRequest(_hessian, arguments)))
            index = np.concatenate([output.part.index, p + np.arange(place.start, place.stop)])
            out[np.ix_(index, index)] += float(weight) * own
        return out[np.ix_(self.active, self.active)]


def output_error_steps(
    session: Session,
    *,
    start: np.ndarray | None = None,
    solver: str | None = None,
    minimiser: Any = None,
    on: str = "position",
    hessian: bool = False,
) -> Steps[Estimate]:
    """Fit the unknowns so that the simulated outputs of several logs match the measured ones.

    Args:
        session: Case and logs.
        start: Start of the fit in place of the guesses, (p,).
        solver: One of `jaxid.names.SOLVERS`; None: fixed steps.
        minimiser: Not available for several logs: None.
        on: One of `jaxid.names.OUTPUTS`.
        hessian: Whether the covariance uses the full Hessian.

    Raises:
        InputError: If a minimiser is named, or the force is fitted without a loop.
    """
    if minimiser_of(minimiser) is not None:
        hint = "leave minimiser out"
        raise InputError("several logs are fitted by jaxid's minimiser", where=session.case.where, hint=hint)
    if on != "position":
        need_loop(session.machine, session.fit.log, f"output_error on {on}", "or fit position")
    theta = session.machine.parameters.guess if start is None else start
    outputs = _outputs(parts_of(session), theta, solver, "position" if on == "both" else on)
    fit = _Fit(session, outputs, "position" if on == "both" else on)

    end = yield from fit.steps(theta)
    while any(forgets(o.part.machine, o.numerics, end.theta[o.part.index]) for o in fit.outputs):
        fit = fit.changed([_with_longer_delay(o) for o in fit.outputs])
        end = yield from fit.steps(end.theta, end.starts, end.weights)
    if on == "both":
        fit = yield from _on_both(fit, end)
        end = yield from fit.steps(end.theta, end.starts)
    fit, end = yield from _with_starts(fit, end)
    return (yield from _estimate(fit, end, on, hessian))


def _outputs(parts: Sequence[Part], theta: np.ndarray, solver: str | None, on: str) -> tuple[_Output, ...]:
    """Return the outputs of all logs; one number of steps serves them, so that they share compiled code."""
    chosen = [choose_numerics(part.at(theta), part.run.log, solver=solver) for part in parts]
    most = max(n.substeps for n in chosen)
    out = []
    for part, numerics in zip(parts, chosen, strict=True):
        numerics = replace(numerics, substeps=most)
        replay = make_replay(part.machine, part.run.log, numerics)
        replay = with_fitted_start(replay, part.machine.plant, part.run.log)
        out.append(_Output(part, numerics, replay, *_measured(part, on)))
    return tuple(out)


def _measured(part: Part, on: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured output of a log, and the factors of its residuals."""
    measured, counts = measured_output(part.machine, part.run.log, on)
    return measured, np.tile(counts.astype(float), (len(measured), 1))


def _with_longer_delay(output: _Output) -> _Output:
    """Return the output with a simulation that keeps twice as many past commands."""
    numerics = replace(output.numerics, longest_delay=2 * output.numerics.longest_delay)
    replay = make_replay(output.part.machine, output.part.run.log, numerics)
    return replace(output, numerics=numerics, replay=replay)


def _on_both(fit: _Fit, end: _End) -> Steps[_Fit]:
    """Return the fit of position and force, each over the spread of its residual."""
    outputs = []
    for output, place in zip(fit.outputs, fit.places(), strict=True):
        measured, weight = _measured(output.part, "both")
        output = replace(output, measured=measured, weight=weight)
        arguments = output.arguments(end.theta, end.starts[place], "both")
        e = np.asarray((yield SolveRequest(_linearised, arguments))[0])
        spread = np.maximum(np.std(e, axis=0), 1e-12 * np.std(measured, axis=0))
        outputs.append(replace(output, weight=weight / spread))
    return replace(fit, outputs=tuple(outputs), on="both")


def _with_starts(fit: _Fit, end: _End) -> Steps[tuple[_Fit, _End]]:
    """Free the starts of the logs for which that is right, and fit again.

    In open loop the start of a log is refitted to the fitted plant, and free if the residual is no larger
    than noise. In a loop it is free on a short log if that explains clearly more than chance; on a longer one
    the log may begin from rest.
    """
    outputs, tried = [], False
    for output, log in zip(fit.outputs, end.logs, strict=True):
        part, looped = output.part, output.replay.controller is not None
        if output.numerics.segment:
            outputs.append(output)
        elif not looped:
            machine = part.at(end.theta)
            replay = with_fitted_start(output.replay, machine.plant, part.run.log)
            rms = np.sqrt(np.mean(np.square(log.residual)))
            noise = np.max(position_noise(machine, part.run.log))
            outputs.append(replace(output, replay=replay, start=bool(rms <= NOISE_LIMITED * noise)))
            tried = True
        elif part.run.log.samples > SHORT:
            shows = start_shows(log.residual[:, np.any(output.weight > 0, axis=0)])
            outputs.append(replace(output, replay=from_rest(output.replay)) if shows else output)
            tried |= shows
        else:
            outputs.append(replace(output, start=True))
            tried = True
    if not tried:
        return fit, end
    freed = fit.changed(outputs)
    other = yield from freed.steps(end.theta, end.starts, end.weights)

    # In a loop each log keeps what clearly explains it better.
    kept = []
    for old, new, before, after in zip(fit.outputs, outputs, end.logs, other.logs, strict=True):
        looped = old.replay.controller is not None
        spare = CLEARLY * new.width / max(before.counts.sum() - new.width, 1) if new.start else 0.0
        better = np.sum(after.residual**2) * (1 + spare) < np.sum(before.residual**2)
        kept.append(new if better or not looped else old)
    if all(a is b for a, b in zip(kept, outputs, strict=True)):
        return freed, other
    if all(a is b for a, b in zip(kept, fit.outputs, strict=True)):
        return fit, end
    fit = fit.changed(kept)
    starts = other.starts.copy()
    for output, place in zip(kept, fit.places(), strict=True):
        starts[place] = starts[place] if output.start else 0.0
    return fit, (yield from fit.steps(other.theta, starts, other.weights))


def _estimate(fit: _Fit, end: _End, on: str, hessian: bool) -> Steps[Estimate]:
    machine, active, logs = fit.session.machine, fit.active, end.logs
    p = end.theta.size
    names = [*machine.parameters.names, *[f"start {i}" for i in range(active.size - p)]]
    names = [name for name, moves in zip(names, active, strict=True) if moves]
    moving = [replace(log, jacobian=log.jacobian[..., active]) for log in logs]
    x = np.concatenate([end.theta, end.starts])[active]
    full = (yield from fit.hessian(end)) if hessian else None
    precision: Precision = assess_together(names, moving, np.where(x != 0, x, 1.0), full)
    precision = precision.first(machine.parameters.names)
    finite = bool(np.isfinite(end.descent.model.cost))
    converged = end.descent.converged and finite
    failed = f"no convergence within {end.descent.steps} steps" if finite else "the simulation diverged"
    first = fit.outputs[0]
    notes = notes_of(first.part.machine, first.numerics, first.part.run.log, on)
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(end.theta),
        theta=end.theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else failed,
        residual=np.concatenate([np.where(log.counts, log.residual, np.nan) for log in logs]),
        samples=sum(int(log.counts.sum()) for log in logs),
        steps=end.descent.steps,
        notes=(*notes, *hessian_notes(precision, hessian), *disagreement(moving, int(active.sum()))),
        details=by_log([o.part for o in fit.outputs], shares(logs))
        | kept_delay(first.part.machine, first.numerics),
        std_misspecified=std_under_misspecification(*stacked(moving))[:p],
    )
