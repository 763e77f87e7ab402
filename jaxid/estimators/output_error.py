"""Gradient-based fit of the simulated to the measured position, of one log or of several.

The simulation runs in closed loop if the controller is known, else in open loop over the whole log. If an
error would grow without bound, it runs in segments that restart from the log. Each log has its start and its
noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators.common.minimisers import Minimiser, minimiser_of
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.noisy_force import pushed_steps
from jaxid.estimators.output_fit import (
    NOISE_LIMITED,
    TOLERANCE,
    FitEnd,
    Output,
    OutputFit,
    measured_and_weight,
    output_residuals,
    outputs_of,
)
from jaxid.estimators.output_profile import profile_steps
from jaxid.estimators.round_the_loop import shift_steps, with_lasting_errors
from jaxid.estimators.several.parts import Part, by_log
from jaxid.estimators.several.sums import shares, stacked
from jaxid.estimators.several.weights import disagreement
from jaxid.estimators.simulated_output import (
    kept_delay,
    need_loop,
    need_output_force,
    notes_of,
)
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.unknowns import REFERENCE, in_loop
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import Precision, hessian_notes
from jaxid.numerics.rows import Rows, assess_together
from jaxid.simulation.noisy_loop import ReadingNoise
from jaxid.simulation.replay import (
    Numerics,
    from_rest,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise

# A freed start of a loop is kept if it lowers the cost by this many times what chance does.
_CLEARLY = 10.0
# Noise is no news that moves no estimate by this many standard deviations, nor widens one by this factor.
_LITTLE, _SLIGHTLY = 0.1, 1.1
_BEGUN_ELSEWHERE = (
    "the simulated loop diverged at the first values, so that the fit began at those of a simulation in open "
    "loop, in segments of the log"
)


def output_error(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
) -> Estimate:
    """Fit the unknowns so that the simulated position, or force, matches the measured one.

    Args:
        machine: The machine; its controller closes the loop.
        log: The log with the measured output.
        start: Start of the fit in place of the guesses, for example from `inverse_dynamics`, (p,).
        numerics: Settings of the integration; None: chosen from plant and log.
        hessian: Whether the covariance uses the full Hessian in place of Gauss-Newton's; see
            `jaxid.numerics.full_hessian.hessian_covariance`.
        profile: Names of the unknowns whose profile likelihood is computed; see
            `jaxid.estimators.common.profile`.
        on: One of `jaxid.names.OUTPUTS`. With "both" each column is divided by the standard deviation of its
            residual in a fit of position. A fit of the force needs a closed loop.
        minimiser: One of `jaxid.estimators.common.minimisers.MINIMISERS`, or a solver of optimistix; None:
            `jaxid.estimators.common.levenberg_marquardt`.

    Returns:
        The estimate; its covariance accounts for a coloured residual.

    Raises:
        InputError: If the force is fitted without a closed loop, or the minimiser or a name in `profile` is
            not known.
    """
    return run_alone(
        output_error_steps(
            machine,
            log,
            start=start,
            numerics=numerics,
            hessian=hessian,
            profile=profile,
            on=on,
            minimiser=minimiser,
        )
    )


def output_error_steps(
    machine: Machine,
    log: Log | Sequence[Part],
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    solver: str | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
    noise: Sequence[ReadingNoise | None] | None = None,
    command_noise: Sequence[np.ndarray] | None = None,
    tolerance: float = TOLERANCE,
) -> Steps[Estimate]:
    """Run `output_error` as a generator of solve requests.

    Args:
        machine: Machine of all logs, with their unknowns.
        log: The log, or the parts of several.
        start, numerics, hessian, profile, on, minimiser: See `output_error`.
        solver: One of `jaxid.names.SOLVERS` for the chosen settings of the integration; None: fixed steps.
        noise: Noise of the encoder that the loop of each log is simulated with, whose mean readings are then
            compared; None: it is simulated without noise.
        command_noise: Standard deviation of the logged force of each log, in units of the command, (m,) each,
            whose effect on an open loop is simulated; None: the force counts as exact.
        tolerance: Part of the cost by which a fit of several logs has converged.

    Raises:
        InputError: Those of `output_error`; or a profile or a minimiser is asked for with several logs.
    """
    parts = [Part.alone(machine, log)] if isinstance(log, Log) else list(log)
    need_names(profile, machine.parameters.names)
    if len(parts) > 1 and (minimiser_of(minimiser) is not None or profile):
        what = "minimiser" if minimiser_of(minimiser) is not None else "profile"
        raise InputError(f"{what} goes with one log", hint=f"leave {what} out, or name one log")
    if on != "position":
        for part in parts:
            need_loop(part.machine, part.log, f"output_error on {on}", "or fit position")
            need_output_force(part.machine, part.log, on)
    elif parts[0].log.integrated:
        on = "velocity"
    if start is not None:
        machine = machine.with_estimate(start)
        parts = [replace(part, machine=part.at(start)) for part in parts]

    first = "position" if on == "both" else on
    outputs = outputs_of(parts, first, numerics, solver, noise)
    fit = OutputFit(machine, outputs, first, minimiser, tolerance)
    theta = machine.parameters.guess
    if machine.unknown_reference is not None:
        # With a wrong reference the machine's parameters would diverge: fit the reference's unknowns first.
        end = yield from fit.steps(theta, active=_of_course(machine, fit.active))
        theta = end.theta
    end, notes = (yield from fit.steps(theta)), []
    if end.diverged and numerics is None and (begun := (yield from _along_segments(fit, theta))) is not None:
        fit = replace(fit, machine=machine.with_estimate(begun))
        end, notes = (yield from fit.steps(begun)), [_BEGUN_ELSEWHERE]
    while numerics is None and any(o.forgets(end.theta) for o in fit.outputs):
        # Beyond the past commands that are kept a longer delay has no effect: keep more, and go on.
        fit = fit.changed([o.with_longer_delay() for o in fit.outputs])
        end = yield from fit.steps(end.theta, end.starts, end.weights)
    if on == "both":
        fit = yield from _on_both(fit, end)
        end = yield from fit.steps(end.theta, end.starts)
    fit, end = yield from _with_starts(fit, end)
    result = yield from _estimate(fit, end, hessian, profile, command_noise)
    return replace(result, notes=(*result.notes, *notes))


def _along_segments(fit: OutputFit, theta: np.ndarray) -> Steps[np.ndarray | None]:
    """Fit the logs in open loop from some values, and return what was found; None if that cannot be done.

    Forces may give a small inertia with such an error that its sampled loop is unstable. Without the loop
    the logged force drives the simulation, in segments that restart from the log, so that it stays near the
    log at such values too.
    """
    unknown_loop = any(in_loop(path) for path, _ in fit.machine.parameters.places)
    if fit.unforced or unknown_loop or not all(o.looped for o in fit.outputs):
        return None
    machine = replace(fit.machine, controller=None)
    parts = [replace(o.part, machine=replace(o.part.machine, controller=None)) for o in fit.outputs]
    fitted = parts if len(parts) > 1 else parts[0].log
    found = yield from output_error_steps(machine, fitted, start=theta)
    return found.theta if found.converged and np.all(np.isfinite(found.theta)) else None


def _of_course(machine: Machine, active: np.ndarray) -> np.ndarray:
    """Return the mask of the unknowns of the reference."""
    own = np.zeros_like(active)
    own[: len(machine.parameters.free)] = [path[0] == REFERENCE for path, _ in machine.parameters.places]
    return own


def _on_both(fit: OutputFit, end: FitEnd) -> Steps[OutputFit]:
    """Return the fit of position and force, each over the spread of its residual."""
    outputs = []
    for output, place in zip(fit.outputs, fit.places, strict=True):
        measured, weight = measured_and_weight(output.part, "both")
        output = replace(output, measured=measured, weight=weight)
        arguments = (*output.arguments(end.theta, end.starts[place]), "both")
        e = np.asarray((yield SolveRequest(output_residuals, arguments)))
        spread = np.maximum(np.std(e, axis=0), 1e-12 * np.std(measured, axis=0))
        outputs.append(replace(output, weight=weight / spread))
    return replace(fit, outputs=tuple(outputs), on="both")


def _with_starts(fit: OutputFit, end: FitEnd) -> Steps[tuple[OutputFit, FitEnd]]:
    """Free the starts of the logs for which that is right, and fit again.

    In open loop the start of a log is refitted to the fitted plant, and free if the residual is no larger
    than noise. In a loop it is free on a short log if that explains clearly more than chance; a longer one
    may begin with a jerk from rest, so that its first readings give no velocity.
    """
    outputs = []
    for output, log in zip(fit.outputs, end.logs, strict=True):
        part = output.part
        if output.numerics.segment:
            outputs.append(output)
        elif not output.looped:
            replay = with_fitted_start(output.replay, part.at(end.theta).plant, part.log)
            rms = np.sqrt(np.mean(np.square(log.residual)))
            noise = np.max(position_noise(part.machine, part.log))
            outputs.append(replace(output, replay=replay, start=bool(rms <= NOISE_LIMITED * noise)))
        elif not output.stays:
            outputs.append(replace(output, start=True))
        else:
            shows = start_shows(log.residual[:, np.any(output.weight > 0, axis=0)])
            outputs.append(replace(output, replay=from_rest(output.replay)) if shows else output)
    if all(new is old for new, old in zip(outputs, fit.outputs, strict=True)):
        return fit, end

    freed, looped = fit.changed(outputs), any(o.looped for o in outputs)
    # A start that is free opens other valleys of a loop's cost: begin where the fit before did.
    again = looped and any(o.start for o in outputs)
    other = yield from freed.steps(end.begun if again else end.theta, end.starts, end.weights)
    if not looped:
        return freed, other

    # In a loop each log keeps what clearly explains it better.
    kept = []
    for old, new, before, after in zip(fit.outputs, outputs, end.logs, other.logs, strict=True):
        unknown = new.part.index.size + new.width
        spare = _CLEARLY * new.width / max(new.measured.size - unknown, 1) if new.start else 0.0
        better = np.sum(after.residual**2) * (1 + spare) < np.sum(before.residual**2)
        kept.append(new if better and other.converged else old)
    if all(a is b for a, b in zip(kept, outputs, strict=True)):
        return freed, other
    if all(a is b for a, b in zip(kept, fit.outputs, strict=True)):
        return fit, end
    fit = fit.changed(kept)
    starts = other.starts.copy()
    for output, place in zip(kept, fit.places, strict=True):
        starts[place] = starts[place] if output.start else 0.0
    return fit, (yield from fit.steps(other.theta, starts, other.weights))


def _estimate(
    fit: OutputFit,
    end: FitEnd,
    hessian: bool,
    profile: Sequence[str],
    command_noise: Sequence[np.ndarray] | None,
) -> Steps[Estimate]:
    machine, active, p = fit.machine, fit.active, fit.unknowns
    names = [*machine.parameters.names, *[f"start {i}" for i in range(active.size - p)]]
    names = [name for name, moves in zip(names, active, strict=True) if moves]
    moving = [replace(log, jacobian=log.jacobian[..., active]) for log in end.logs]
    values = np.concatenate([end.theta, end.starts])
    x, full = values[active], (yield from fit.hessian(end)) if hessian else None
    # Derivatives of a simulation that diverged may be too large for their squares; the estimate says so.
    how = "ignore" if end.diverged else "warn"
    with np.errstate(over=how, invalid=how):
        precision = assess_together(names, moving, np.where(x != 0, x, 1.0), full, crossed=fit.on == "both")
        if fit.unforced:
            # Mean readings of a coarse encoder are off at its steps: the residual has no one size.
            lengths = [len(log.residual) for log in moving]
            precision = precision.widened(widening(precision, *stacked(moving), lengths))
        lasting = std_under_misspecification(*stacked(moving))[:p]
    precision = precision.first(machine.parameters.names)

    details: dict[str, Any] = {}
    remarks = list(hessian_notes(precision, hessian))
    theta, more = end.theta, []
    if fit.shaken:
        precision, more = with_lasting_errors(precision, lasting)
    elif fit.pushed:
        theta, precision, more = yield from _pushed(fit, end, moving, precision, command_noise)
    elif len(moving) > 1 and not any(output.noise for output in fit.outputs):
        theta, precision, more = yield from _without_noise(fit, end, moving, precision)
    remarks += more
    if profile:
        count = int(np.sum(fit.outputs[0].weight > 0))
        found = (values, end.cost, count, fit.bounds, active)
        details["profiles"], more = yield from profile_steps(fit.alone_at, found, machine, precision, profile)
        remarks += more
    if len(moving) > 1:
        remarks += disagreement(moving, int(active.sum()))
        details |= by_log([o.part for o in fit.outputs], shares(end.logs))
    first = fit.outputs[0]
    notes = notes_of(first.part.machine, first.numerics, first.part.log, fit.on, fit.minimiser)
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=end.converged,
        message="converged" if end.converged else end.failure,
        residual=np.concatenate([np.where(log.counts, log.residual, np.nan) for log in end.logs]),
        samples=sum(int(log.counts.sum()) for log in end.logs),
        steps=end.steps,
        notes=(*notes, *remarks),
        details=details | kept_delay(first.part.machine, first.numerics),
        std_misspecified=lasting,
    )


def _without_noise(
    fit: OutputFit, end: FitEnd, moving: Sequence[Rows], precision: Precision
) -> Steps[tuple[np.ndarray, Precision, list[str]]]:
    """Remove the bias by noise that goes round the loop, and return estimates, precision and notes.

    The bias is a small part of the deviations of a log alone. Beside another log, in which something is known
    to differ, it is several of them in the directions that the difference separates. Noise that dithers dry
    friction scatters the estimates by more than follows from the colour of the residual.

    Args:
        fit, end: The fit and its end.
        moving: Residual of each log, with the columns of the unknowns that move.
        precision: Precision of the unknowns.
    """
    noise = [_noise_of(output, log) for output, log in zip(fit.outputs, end.logs, strict=True)]
    if fit.unforced and not fit.noise_limited(end.logs):
        # Errors of the model move the estimates more, and hide how the noise does.
        return end.theta, precision, []
    looped = all(o.looped for o in fit.outputs) and not any(o.part.log.integrated for o in fit.outputs)
    if not looped or not end.converged or not any(np.any(std > 0) for std in noise):
        return end.theta, precision, []
    arguments = [o.arguments(end.theta, end.starts[p]) for o, p in zip(fit.outputs, fit.places, strict=True)]
    shift = yield from shift_steps(list(zip(arguments, noise, moving, strict=True)), fit.on)
    p, seen = fit.unknowns, precision.identifiable
    if not np.all(np.isfinite(shift.step)) or not np.any(seen):
        return end.theta, precision, []
    step = np.where(seen, shift.step[:p], 0.0)
    theta = np.clip(end.theta + step, *fit.machine.parameters.bounds)
    whole = replace(precision, covariance=precision.covariance + shift.covariance[:p, :p])
    whole = whole.with_at_least(shift.scatter[:p, :p])
    most = float(np.max(np.abs(step[seen]) / whole.std[seen]))
    wider = float(np.max(whole.std[seen] / precision.std[seen]))
    if most < _LITTLE and wider < _SLIGHTLY:
        return theta, whole, []
    note = (
        "the noise of the readings goes round the loop: its effect on the estimates was simulated; a bias "
        f"of at most {most:.2g} standard deviations was taken off, and these are up to {wider:.2g} times as "
        "large"
    )
    return theta, whole, [note]


def _noise_of(output: Output, rows: Rows) -> np.ndarray:
    """Return the standard deviation of a log's readings: no more than readings and residual show, (n,)."""
    part, n = output.part, output.part.log.position.shape[1]
    # A joint without an encoder has no readings, and no noise.
    noise = np.fmin(position_noise(part.machine, part.log), signals.high_band_std(part.log.readings))
    if rows.residual.shape[1] != n:
        return noise
    # In a slow log motion reaches the highest frequencies, and counts as noise there.
    counts = np.maximum(rows.counts.sum(axis=0), 1)
    left = np.sqrt(np.sum(np.where(rows.counts, rows.residual, 0.0) ** 2, axis=0) / counts)
    return np.fmin(noise, left)


def _pushed(
    fit: OutputFit,
    end: FitEnd,
    moving: Sequence[Rows],
    precision: Precision,
    noise: Sequence[np.ndarray] | None,
) -> Steps[tuple[np.ndarray, Precision, list[str]]]:
    """Add the noise of the logged forces, which an open loop takes as exact, to estimates and precision.

    Args:
        fit, end: The fit and its end.
        moving: Residual of each log, with the columns of the unknowns that move.
        precision: Precision of the unknowns.
        noise: Standard deviation of the forces of each log, in units of the command, (m,) each.
    """
    unchanged = end.theta, precision, []
    if noise is None or not end.converged or not any(np.any(std > 0) for std in noise):
        return unchanged
    sizes = ", ".join(f"{x:.2g}" for x in np.max(noise, axis=0))
    exact = f"an open-loop simulation takes the logged force as exact, but it holds noise of about {sizes}"
    too_small = f"{exact}: the standard deviations are too small, use prediction_error"
    if any(o.numerics.segment for o in fit.outputs):
        # A restart adds the noise of its state, of which the size is not known.
        return end.theta, precision, [too_small]
    arguments = [o.arguments(end.theta, end.starts[p]) for o, p in zip(fit.outputs, fit.places, strict=True)]
    readings = [_noise_of(output, log) for output, log in zip(fit.outputs, end.logs, strict=True)]
    logs = list(zip(arguments, noise, readings, moving, strict=True))
    pushed = yield from pushed_steps(logs, fit.on)
    p, seen = fit.unknowns, precision.identifiable
    if not np.any(seen):
        return unchanged
    if not np.all(np.isfinite(pushed.covariance)):
        return end.theta, precision, [too_small]
    theta = np.clip(end.theta + np.where(seen, pushed.bias[:p], 0.0), *fit.machine.parameters.bounds)
    whole = precision.with_at_least(pushed.covariance[:p, :p])
    if np.all(whole.std[seen] <= _SLIGHTLY * precision.std[seen]):
        return theta, whole, []
    note = (
        f"{exact}: its effect on the estimates was simulated, and is in the standard deviations; "
        "prediction_error is more precise"
    )
    return theta, whole, [note]
