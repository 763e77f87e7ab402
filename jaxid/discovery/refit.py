"""The refit in simulation of a model that was fitted in the force domain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxid.estimators.choice import choose_method
from jaxid.estimators.common.consistency import linked
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error, output_error_steps
from jaxid.estimators.prediction_error import prediction_error, prediction_error_steps
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.gap import Gap, force_gap, gaps
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session
from jaxid.simulation.sensor_noise import force_noise
from jaxid.simulation.step_size import TooStiffError

# A refit in simulation may raise the force residual by this factor. Beyond it the fit has bent the
# parameters around another error, such as a reference that is not known between samples.
_WORSE = 1.5


@dataclass(frozen=True)
class Refitted:
    """A fit in the force domain, and what a refit in simulation made of it.

    Args:
        in_force: Fit in the force domain.
        estimate: Fit that is kept: the refit, or the former.
        gaps: Gaps of the latter, by log.
    """

    in_force: Estimate
    estimate: Estimate
    gaps: tuple[Gap, ...]


def in_simulation(session: Session, start: Estimate, refit: bool) -> Refitted:
    """Refit a model in simulation if that is wanted, and compute its gaps.

    Args:
        session: Case and logs.
        start: The model's fit in the force domain.
        refit: Whether it is refitted; if not, the estimate is `start`.

    Returns:
        Both fits, and the gap of the one that is kept on each log.
    """
    estimate = refit_of(session.with_machine(start.machine), start) if refit else start
    if start.machine.parameters.bodies:
        estimate = linked(estimate, session)
    return Refitted(start, estimate, gaps(estimate.machine, session.runs))


def refit_of(session: Session, start: Estimate) -> Estimate:
    """Refit from the force-domain fit by the method that suits; keep the former if the fit fails."""
    blind = not bool(np.all(start.identifiable))
    if session.more:
        return start if blind else _refit_together(session, start)
    method = "" if blind else choose_method(session).method
    if method == "prediction_error":
        return _refit_innovations(session, start)
    if method == "inverse_dynamics" and session.machine.controller is None:
        note = "not refitted in simulation: without a controller any error of a force drives it from the log"
        return replace(start, notes=(*start.notes, note))
    if blind or session.fit.log.reference is None and session.machine.controller is not None:
        return start
    try:
        stated, log = session.case.output_error, session.fit.log
        numerics = choose_numerics(session.machine, log, solver=stated.solver)
        estimate = output_error(session.machine, log, numerics=numerics, minimiser=stated.minimiser)
    except TooStiffError as error:
        return replace(start, notes=(*start.notes, f"not refitted in simulation: {error}"))
    except np.linalg.LinAlgError:
        # An arm that stands upright falls without its loop: the baseline of a search may run off the log.
        note = "not refitted in simulation: the simulated motion runs away from the log"
        return replace(start, notes=(*start.notes, note))
    if not estimate.converged or not np.all(np.isfinite(estimate.theta)):
        note = f"output error: {estimate.message}; the parameters are those of inverse dynamics"
        return replace(start, notes=(*start.notes, note))
    old, new = (gaps(e.machine, (session.fit,))[0] for e in (start, estimate))
    worse = np.any(new.force.rms > _WORSE * old.force.rms)
    nearer = old.simulation is None or _length(new) < _length(old)
    if new.simulation is None or worse or not nearer:
        note = "output error did not reduce the simulation gap; the parameters are those of inverse dynamics"
        return replace(start, notes=(*start.notes, note))
    return estimate


def _refit_together(session: Session, start: Estimate) -> Estimate:
    """Refit several logs by the method that suits; keep the force-domain fit if the force gap grows."""
    method = choose_method(session).method
    if method == "inverse_dynamics" or (method == "output_error" and session.machine.controller is None):
        return start
    fit = {
        "prediction_error": prediction_error_steps,
        "output_error": output_error_steps,
    }[method]
    try:
        estimate = run_alone(fit(session.machine, parts_of(session), start=start.theta))
    except TooStiffError as error:
        return replace(start, notes=(*start.notes, f"not refitted in simulation: {error}"))
    what = method.replace("_", " ")
    if not estimate.converged or not np.all(np.isfinite(estimate.theta)):
        note = f"{what}: {estimate.message}; the parameters are those of inverse dynamics"
        return replace(start, notes=(*start.notes, note))
    for run in session.fits:
        old, new = (force_gap(run.machine(e.machine), run.data).rms for e in (start, estimate))
        if np.any(new > _WORSE * old):
            note = f"{what} did not reduce the force gap; the parameters are those of inverse dynamics"
            return replace(start, notes=(*start.notes, note))
    return estimate


def _refit_innovations(session: Session, start: Estimate) -> Estimate:
    """Refit by prediction error from the force-domain fit; keep the latter if the force gap grows."""
    machine, run = session.machine, session.fit
    rest = np.asarray(run.data.recipe.rest_velocity)
    estimate = prediction_error(
        machine,
        run.log,
        start=start.theta,
        rest_velocity=rest,
        command_noise=force_noise(machine, run.data),
        alone=True,
    )
    if not estimate.converged:
        note = f"prediction error: {estimate.message}; the parameters are those of inverse dynamics"
        return replace(start, notes=(*start.notes, note))
    old, new = (force_gap(e.machine, run.data).rms for e in (start, estimate))
    if np.any(new > _WORSE * old):
        note = "prediction error did not reduce the force gap; the parameters are those of inverse dynamics"
        return replace(start, notes=(*start.notes, note))
    return estimate


def _length(gap: Gap) -> float:
    assert gap.simulation is not None, "the simulation of this gap has run"
    return float(np.sqrt(np.nansum(gap.simulation.rms**2)))
