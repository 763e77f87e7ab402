"""Prediction error: maximum likelihood of the innovations of a Kalman filter on the plant's step.

Several logs have one likelihood, to which each adds its own with the noise of its force and readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.command_noise import Corrected, corrected_steps
from jaxid.estimators.common.best_bodies import NEAREST, nearest_bodies
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.common.shapes import shape_starts
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.force_timing import timing_steps
from jaxid.estimators.innovations import hessian_steps, profile_steps
from jaxid.estimators.joint_likelihood import (
    JointLikelihood,
    Maximum,
    Member,
)
from jaxid.estimators.likelihood import likelihood_of, needed_numerics
from jaxid.estimators.noise_floors import maximum_steps
from jaxid.estimators.several.parts import Part, by_log
from jaxid.estimators.several.sums import stacked
from jaxid.estimators.several.weights import disagreement
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.unknowns import Parameters
from jaxid.numerics.lanes import Steps, run_alone
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import FISHER, FULL_HESSIAN, Precision, hessian_notes
from jaxid.numerics.rows import Rows, assess_together
from jaxid.numerics.whiteness import LAGS, REJECTS, band_of_half_the_excess, whiteness
from jaxid.simulation.replay import Numerics
from jaxid.simulation.sensor_noise import force_noise

# Evaluations that show which start is the best one.
_SCREENING = 12


def prediction_error(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    rest_velocity: np.ndarray | None = None,
    command_noise: np.ndarray | None = None,
    alone: bool = False,
    hessian: bool = False,
    profile: Sequence[str] = (),
) -> Estimate:
    """Fit the unknowns, the noise of the force and the noise of the readings by maximum likelihood.

    An extended Kalman filter on the plant's step, driven by the logged command, predicts each reading from
    those before it. In open loop and in a loop the estimate is the same function of the log, because the
    command is measured. If the declared law explains the logged command but for white noise of its reading,
    the command of the law is used; if it has an integral, which began at an unknown value, that command has a
    constant error, whose distribution the filter takes into account.

    Args:
        machine: The machine. Its sensor gives the first values of the noise. If links must be those of real
            bodies, the fit is without this demand and ends at the nearest such bodies.
        log: The log.
        start: A start of the fit beside the guesses, for example from `inverse_dynamics`, (p,).
        numerics: Settings of the integration; None: exact sticking and the steps that the plant needs.
        rest_velocity: Speed below which a sample of a machine with dry friction does not count, unless the
            force is free of noise, (n,) [m/s or rad/s]; None: all samples count.
        command_noise: Standard deviation with which the command was read, (m,), whose bias is removed; None:
            it was logged exactly.
        alone: Whether `start` is the only start, because it is known to be near the optimum.
        hessian: Whether the covariance uses the observed information in place of Fisher's; see
            `jaxid.numerics.full_hessian.hessian_covariance`.
        profile: Names of the unknowns whose profile likelihood is computed; see
            `jaxid.estimators.common.profile`.

    Returns:
        The estimate. Its covariance is that of the likelihood, widened if the innovations are coloured. If
        the case states the true values, `least_std` of the details is the bound of Cramer and Rao there.

    Raises:
        InputError: If too few readings count, or a name in `profile` is not known.

    Source:
        Ljung (1999), System Identification, chapter 7; Astrom (1980), Automatica 16, for the innovations.
    """
    return run_alone(
        prediction_error_steps(
            machine,
            log,
            start=start,
            numerics=numerics,
            rest_velocity=rest_velocity,
            command_noise=command_noise,
            alone=alone,
            hessian=hessian,
            profile=profile,
        )
    )


def prediction_error_steps(
    machine: Machine,
    log: Log | Sequence[Part],
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    rest_velocity: np.ndarray | None = None,
    command_noise: np.ndarray | None = None,
    alone: bool = False,
    hessian: bool = False,
    profile: Sequence[str] = (),
    timing: bool = False,
) -> Steps[Estimate]:
    """Run `prediction_error` as a generator of solve requests.

    Args:
        machine: Machine of all logs, with their unknowns.
        log: The log, or the parts of several, whose `rest_velocity` and `command_noise` are those of each.
        start, numerics, rest_velocity, command_noise, alone, hessian, profile: See `prediction_error`.
        timing: Whether the delay of the force of one log is estimated, see `timing_steps`; it then stands
            under `force_delay` in the details.

    Raises:
        InputError: Those of `prediction_error`; or `hessian` or `profile` is asked for with several logs.
    """
    need_names(profile, machine.parameters.names)
    if isinstance(log, Log):
        settings = [(Part.alone(machine, log), rest_velocity, command_noise)]
    else:
        settings = [(p, np.asarray(p.data.recipe.rest_velocity), force_noise(p.machine, p.data)) for p in log]
    if len(settings) > 1 and (hessian or profile):
        what = "hessian" if hessian else "profile"
        raise InputError(f"{what} of innovations goes with one log", hint="leave it out, or name one log")

    fit = _joined(_without_bodies(machine), settings, start, numerics)
    theta, noises, screened = yield from _best_start(fit, start, alone=alone)
    logged = fit
    fit, end = yield from maximum_steps(logged, theta, noises)
    late = None
    if timing and len(settings) == 1:
        fit, end, late = yield from timing_steps(logged, fit, end)
    end = replace(end, steps=screened + end.steps)

    found = Corrected.not_at_all(end.theta, [m.drives for m in fit.members])
    if end.converged:
        found = yield from corrected_steps(fit, end)
    if machine.parameters.bodies:
        estimate = yield from _at_bodies(machine.parameters, fit, end, found)
    else:
        estimate = _estimate(fit, end, found)
    if estimate.converged:
        estimate = yield from _with_bound_at_truth(estimate, fit, end.noises)
    if hessian:
        estimate = yield from _by_hessian(estimate, fit, end, found)
    if profile:
        estimate = yield from _with_profiles(estimate, fit, end, found.theta, profile)
    return estimate if late is None else late.noted(estimate, settings[0][0].log.period)


def _without_bodies(machine: Machine) -> Machine:
    """Return the machine with links that need not be those of real bodies."""
    return machine.with_plant(machine.plant, machine.parameters.without_bodies)


def _at_bodies(
    parameters: Parameters,
    fit: JointLikelihood,
    end: Maximum,
    plain: Corrected,
) -> Steps[Estimate]:
    """Return the estimate at the real bodies nearest to a fit without them.

    Args:
        parameters: The unknowns, with their bodies.
        fit: The likelihood without bodies.
        end: Its maximum.
        plain: Estimates without bodies.
    """
    theta = plain.theta
    jacobian, _, counts = stacked(_rows(fit, end, theta))
    if not (end.converged and np.all(np.isfinite(jacobian[counts])) and np.all(np.isfinite(theta))):
        estimate = _estimate(fit, replace(end, converged=False), plain)
    else:
        theta, found = nearest_bodies(parameters, jacobian[counts], plain.theta)
        # The innovations are those before the correction of the bias, as without bodies.
        there = yield from fit.fit(end.theta + theta - plain.theta, end.noises, 1)
        there = replace(there, converged=found, steps=end.steps + 1)
        estimate = _estimate(fit, there, replace(plain, theta=theta))
    machine = estimate.machine.with_plant(estimate.machine.plant, parameters.with_guess(theta.tolist()))
    return replace(estimate, machine=machine, notes=(*estimate.notes, NEAREST))


def _best_start(
    fit: JointLikelihood, start: np.ndarray | None, *, alone: bool
) -> Steps[tuple[np.ndarray, list[np.ndarray], int]]:
    """Choose the best of several starts by a few steps of a fit from each.

    Args:
        fit: The likelihood.
        start: Start of another method, (p,); None: there is none.
        alone: Whether the guesses of shapes are taken as they are.

    Returns:
        The unknowns, (p,), the noises of each log, and the number of steps.
    """
    # Beside another method's start the guesses matter for shapes only, whose likelihood has several maxima.
    parameters, noises = fit.machine.parameters, [m.at.noise for m in fit.members]
    shapes = [] if alone else shape_starts(fit.machine, parameters.guess)
    starts = [parameters.guess, *shapes] if shapes or start is None else []
    if start is not None:
        starts.insert(0, np.clip(start, *parameters.bounds))
    if len(starts) == 1:
        return starts[0], noises, 0
    trials = []
    for at in starts:
        trials.append((yield from fit.fit(at, noises, _SCREENING)))
    best = min(trials, key=lambda trial: np.nan_to_num(trial.cost, nan=np.inf))
    return best.theta, best.noises, sum(trial.steps for trial in trials)


def _with_bound_at_truth(
    estimate: Estimate, fit: JointLikelihood, noises: list[np.ndarray]
) -> Steps[Estimate]:
    """Add the least standard deviations, by the information at the true values, if all are stated."""
    free = fit.machine.parameters.free
    true = [f.true for f in free]
    if not true or None in true:
        return estimate
    truth = np.array(true, dtype=np.float64)
    there = yield from fit.fit(truth, noises, 1)
    bound = _precision(fit, _rows(fit, there, truth), truth).std
    values = dict(zip(fit.machine.parameters.names, bound.tolist(), strict=True))
    return replace(estimate, details={**estimate.details, "least_std": values})


def _with_profiles(
    estimate: Estimate, fit: JointLikelihood, end: Maximum, theta: np.ndarray, names: Sequence[str]
) -> Steps[Estimate]:
    """Add the profile likelihoods of some unknowns of one log."""
    [member], [scored] = fit.members, end.scored
    profiles, notes = yield from profile_steps(
        member.problem, fit.machine, theta, scored, estimate.precision, names
    )
    return replace(
        estimate, notes=(*estimate.notes, *notes), details={**estimate.details, "profiles": profiles}
    )


def _joined(
    machine: Machine,
    settings: Sequence[tuple[Part, np.ndarray | None, np.ndarray | None]],
    start: np.ndarray | None,
    numerics: Numerics | None,
) -> JointLikelihood:
    """Return the likelihood of logs, each with its rest velocity and the noise of its command's reading.

    One number of steps serves all logs, so that they share compiled code.
    """
    settings = [(replace(p, machine=_without_bodies(p.machine)), rest, noise) for p, rest, noise in settings]
    own = [None if start is None else start[part.index] for part, *_ in settings]
    chosen = [
        needed_numerics(part.machine, part.log, at) if numerics is None else numerics
        for (part, *_), at in zip(settings, own, strict=True)
    ]
    most = max(n.substeps for n in chosen)
    members = []
    for (part, rest, noise), n in zip(settings, chosen, strict=True):
        made = likelihood_of(part.machine, part.log, numerics=replace(n, substeps=most), rest_velocity=rest)
        members.append(Member(part, made, made.problem, noise))
    return JointLikelihood(machine, tuple(members))


def _estimate(fit: JointLikelihood, end: Maximum, corrected: Corrected) -> Estimate:
    """Return the estimate of a fit, with its precision, its noise and a test of its innovations.

    Args:
        fit: The likelihood.
        end: Its maximum.
        corrected: Estimates without the bias by noise of the commands.
    """
    machine, several, theta = fit.machine, len(fit.members) > 1, corrected.theta
    rows = _rows(fit, end, theta)
    jacobian, z, counts = stacked(rows)
    finite = bool(np.all(np.isfinite(z[counts])) and np.all(np.isfinite(jacobian[counts])))
    plain = _precision(fit, rows, theta) if finite else Precision.unknown(machine.parameters.names)
    widened = widening(plain, jacobian, z, counts, [len(row.residual) for row in rows]) if finite else 1.0

    entries: list[dict[str, Any]] = []
    for member, row, noise, read in zip(fit.members, rows, end.noises, corrected.reads, strict=True):
        shown, drives = np.exp(noise), member.drives
        of_readings = "velocity" if member.problem.kalman.of_velocity else "position"
        sizes = {"force": shown[:drives], "force_reading": read, of_readings: shown[drives:]}
        p = [whiteness(e[c]) for e, c in zip(row.residual.T, row.counts.T, strict=True)]
        entries.append({"noise": sizes, "whiteness": {"lags": LAGS, "p": p}})

    each = " for each log," if several else ""
    notes = [f"noise of the force and of the readings was estimated{each} with the unknowns"]
    by_law = [m.part.name for m in fit.members if m.at.law is not None]
    if by_law:
        where = f" (in {', '.join(by_law)})" if several else ""
        notes.append(
            f"the command was computed by the declared law from the logged readings{where}: the logged one "
            "is the same but for white noise of its reading"
        )
    pairs = zip(fit.members, end.noises, strict=True)
    lowest = [m.part.name for m, noise in pairs if np.any(m.rests(noise, np.asarray(m.problem.low)))]
    if lowest:
        where = f" (in {', '.join(lowest)})" if several else ""
        notes.append(
            f"the noise of the force came to the lowest value that the filter allows{where}: if the true "
            "noise is smaller, the standard deviations are too large"
        )
    if min(min(entry["whiteness"]["p"]) for entry in entries) < REJECTS:
        notes.append(
            f"the innovations are not white{_bands(fit, rows)} (rounding, coloured noise or an incomplete "
            "model): the standard deviations are widened accordingly"
        )
    details = dict(entries[0])
    if several:
        notes += disagreement(rows, int(plain.identifiable.sum()))
        samples = [{"samples": int(row.counts.sum())} for row in rows]
        parts = [m.part for m in fit.members]
        details = by_log(parts, [s | entry for s, entry in zip(samples, entries, strict=True)])
    converged = end.converged and finite and bool(np.all(np.isfinite(theta)))
    precision = plain.widened(np.broadcast_to(widened, len(theta)))
    notes += corrected.notes(end.theta, precision)
    beside = std_under_misspecification(jacobian, z, counts) if finite else None
    return Estimate(
        method="prediction_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=corrected.widened(precision),
        converged=converged,
        message="converged" if converged else f"no convergence within {end.steps} steps",
        residual=np.where(counts, z, np.nan),
        std_misspecified=None if beside is None else np.hypot(beside, corrected.doubt),
        samples=int(counts.sum()),
        steps=end.steps,
        notes=tuple(notes),
        details={**details, "log_likelihood": -end.cost},
    )


def _bands(fit: JointLikelihood, rows: Sequence[Rows]) -> str:
    """Return in words where the innovations have most power beyond white noise; empty if in no one band."""
    bands = [
        band_of_half_the_excess(np.where(c, e, 0.0), 1 / member.part.log.period)
        for member, row in zip(fit.members, rows, strict=True)
        for e, c in zip(row.residual.T, row.counts.T, strict=True)
        if whiteness(e[c]) < REJECTS
    ]
    found = [band for band in bands if band is not None]
    if len(found) != 1:
        return ""
    low, high = found[0]
    return f", and half of what exceeds white noise lies from {low:.3g} to {high:.3g} Hz"


def _by_hessian(
    estimate: Estimate, fit: JointLikelihood, end: Maximum, corrected: Corrected
) -> Steps[Estimate]:
    """Replace Fisher's information in the covariance by the full Hessian, if that is positive definite.

    Args:
        estimate: Estimate with its precision by Fisher's information.
        fit: The likelihood of one log.
        end: Its maximum.
        corrected: Estimates without the bias by noise of the command.
    """
    [member], [scored] = fit.members, end.scored
    full = yield from hessian_steps(member.problem, scored)
    if full is None:
        precision = replace(estimate.precision, curvature=np.full(2, np.nan))
    else:
        rows = _rows(fit, end, estimate.theta)
        # Errors that outlast their colour's model widen both by the same factors.
        plain, curved = (_precision(fit, rows, estimate.theta, h) for h in (None, full))
        precision = corrected.widened(curved.widened(widening(plain, *stacked(rows))))
    notes = hessian_notes(precision, True, FISHER)
    return replace(estimate, precision=precision, notes=(*estimate.notes, *notes))


def _rows(fit: JointLikelihood, end: Maximum, theta: np.ndarray) -> list[Rows]:
    """Return the innovations of all logs as residuals, with natural sizes by the estimates."""
    scale = np.where(theta != 0, theta, 1.0)
    return [member.rows(scored, scale) for member, scored in zip(fit.members, end.scored, strict=True)]


def _precision(
    fit: JointLikelihood,
    rows: Sequence[Rows],
    theta: np.ndarray,
    hessian: Float[np.ndarray, "p p"] | None = None,
) -> Precision:
    """Return the precision by Fisher's information of the innovations, or by the observed one.

    Args:
        fit: The likelihood.
        rows: Its innovations.
        theta: Estimates, (p,).
        hessian: Observed information, which is used if it is positive definite, (p, p); None: not known.
    """
    scale = np.where(theta != 0, theta, 1.0)
    precision = assess_together(fit.machine.parameters.names, rows, scale, hessian)
    return replace(precision, kind=FULL_HESSIAN if precision.kind == FULL_HESSIAN else FISHER)
