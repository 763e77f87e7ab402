"""Choice of the signal that a servo's derivative gain acts on, for logs without a force.

Some servos differentiate the error of the position, others the position alone, which acts as viscous friction
does. A law that is taken for the other one moves nearly alike with other gains, friction and delay.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from jaxid.consistency.hold import clearly_smaller
from jaxid.controllers.linear import PD
from jaxid.estimators.estimate import Estimate, misfit, rms_left
from jaxid.model.unknowns import CONTROLLER
from jaxid.names import LAW_DERIVATIVES
from jaxid.numerics.lanes import Steps
from jaxid.simulation.sensor_noise import position_noise

if TYPE_CHECKING:
    from jaxid.session import Session

# Standard deviations from zero beyond which the gain on the slope of the reference acts.
_ACTS = 10.0
# RMS that a fit leaves, over the noise of the readings, up to which it counts as noise; and beyond which the
# model is incomplete.
_NEAR, _FAR = 1.3, 2.0


class Fitted(Protocol):
    """A function that fits a session, with the noise of the encoder in the loop or without."""

    def __call__(self, session: Session, *, without_noise: bool = False) -> Steps[Estimate]:
        """Fit a session."""
        ...


def leaves_law_open(session: Session) -> bool:
    """Check that a case does not state what the derivative of its PD law acts on."""
    table = session.case.controller
    return table is not None and "derivative" not in table.law and isinstance(session.machine.controller, PD)


def with_law_of_log(session: Session, fitted: Fitted) -> Steps[Estimate]:
    """Fit a loop with a derivative of the error, and unless that acts clearly with one of the velocity.

    Without its part of the reference, a derivative of the error is one of the velocity, and that is viscous
    friction but for the ticks and the counts of the loop.

    Args:
        session: Case and logs; the case `leaves_law_open`.
        fitted: Function that fits a session.

    Returns:
        The fit of the error, if that of the velocity leaves more than noise; else the one that leaves clearly
        less. If there is none, it is that of the velocity, whose 95 % intervals hold the other values too.
    """
    machine = session.machine
    assert isinstance(machine.controller, PD), "asked of a PD law"
    law = machine.controller
    first, other = (replace(machine, controller=replace(law, derivative=name)) for name in LAW_DERIVATIVES)
    by_error = yield from fitted(session.with_machine(first))
    if by_error.converged and _derivative_acts(by_error):
        return by_error

    if leaves_far_more_than_noise(session, by_error):
        # A fit with noise takes ten times as long, and this law may be no better.
        plain = yield from fitted(session.with_machine(other), without_noise=True)
        if not plain.converged or misfit(plain) > misfit(by_error):
            return by_error
    by_velocity = yield from fitted(session.with_machine(other))
    if not by_velocity.converged or not _near_noise(session, by_velocity):
        # An incomplete model shows no law: it may lack what either of them would pass for.
        return by_error

    left = [rms_left(by_error), rms_left(by_velocity)]
    sizes = f"{left[0]:.3g} with one of the error, {left[1]:.3g} with one of the velocity"
    reason = f"RMS that the fitted loops leave with a derivative: {sizes}"
    if by_error.converged and leaves_clearly_less(by_error, by_velocity):
        return _said(by_error, "error", reason)
    if by_error.converged and not leaves_clearly_less(by_velocity, by_error):
        # This fit does not tell its gain from viscous friction, and says so.
        by_velocity = by_velocity.holding(by_error.theta)
        reason += "; that is about equal, and the 95 % intervals hold the values of both"
    return _said(by_velocity, "velocity", reason)


def beside_other_law(session: Session, fitted: Fitted, estimate: Estimate) -> Steps[Estimate]:
    """Add to a fit the name of the other law, if that explains the logs clearly better than the stated one.

    The other law is fitted only where the stated one leaves more than the noise of the readings. It is named
    in `details["other_law"]`, and nothing else is changed.

    Args:
        session: Case and logs.
        fitted: Function that fits a session.
        estimate: The fit with the law of the case.
    """
    law = session.machine.controller
    if not isinstance(law, PD) or leaves_law_open(session) or _near_noise(session, estimate):
        return estimate
    [name] = [n for n in LAW_DERIVATIVES if n != law.derivative]
    other = replace(session.machine, controller=replace(law, derivative=name))
    found = yield from fitted(session.with_machine(other))
    if not found.converged or not leaves_clearly_less(found, estimate):
        return estimate
    clearly = {
        "derivative": name,
        "rms": rms_left(found),
        "stated": law.derivative,
        "rms_stated": rms_left(estimate),
    }
    return replace(estimate, details={**estimate.details, "other_law": clearly})


def leaves_far_more_than_noise(session: Session, estimate: Estimate) -> bool:
    """Check that a fit leaves far more than the noise of the readings of a log: its model is incomplete."""
    return _over_noise(session, estimate) > _FAR


def _near_noise(session: Session, estimate: Estimate) -> bool:
    """Check that a fit leaves about the noise of the readings of every log."""
    return _over_noise(session, estimate) <= _NEAR


def _over_noise(session: Session, estimate: Estimate) -> float:
    """Return the largest RMS that a fit leaves of a measured position, over the noise of its readings."""
    ends = np.cumsum([run.log.samples for run in session.fits])[:-1]
    largest = 0.0
    for rows, run in zip(np.split(estimate.residual, ends), session.fits, strict=True):
        floor = np.maximum(position_noise(run.machine(session.machine), run.log), 1e-300)
        # A joint at rest has no residual.
        counts = np.isfinite(rows)
        squares = np.sum(np.where(counts, np.square(rows), 0.0), axis=0)
        rms = np.sqrt(squares / np.maximum(np.sum(counts, axis=0), 1))
        largest = max(largest, float(np.max((rms / floor)[list(run.log.measured)])))
    return largest


def leaves_clearly_less(best: Estimate, other: Estimate) -> bool:
    """Check that a fit leaves clearly less of the logs than another one."""
    counts = np.isfinite(best.residual) & np.isfinite(other.residual)
    scale = max(float(np.sqrt(np.mean(np.square(best.residual[counts])))), 1e-300)
    less, more = (np.where(counts, e.residual, 0.0) / scale for e in (best, other))
    return clearly_smaller(less, more, counts)


def _derivative_acts(estimate: Estimate) -> bool:
    """Check that the gain on the slope of the reference is unknown, and clearly not zero."""
    relative = estimate.details.get("relative")
    for k, unknown in enumerate(estimate.machine.parameters.free):
        if unknown.path[:2] != (CONTROLLER, "kd"):
            continue
        value, std = estimate.theta[k], estimate.std[k]
        if relative is not None and unknown.name in relative["values"]:
            ratio = relative["values"][unknown.name]
            value, std = ratio["value"], ratio["std"] or np.nan
        if value > _ACTS * std:
            return True
    return False


def _said(estimate: Estimate, derivative: str, reason: str) -> Estimate:
    """Return a fit with the choice of its law among its settings and notes."""
    note = (
        f"the law of [controller] does not state its derivative: {derivative!r} is taken; {reason}; state "
        "derivative if the servo's manual gives it"
    )
    settings = {"derivative": {"value": derivative, "reason": reason}}
    return replace(
        estimate,
        notes=(*estimate.notes, note),
        details={
            **estimate.details,
            "settings": {**estimate.details.get("settings", {}), **settings},
        },
    )
