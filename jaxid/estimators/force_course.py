"""Course of the force between samples, and its delay, by the likelihood of the innovations.

Force gaps show whether a force is held. They do not show whether a force that is not held follows lines or a
smooth curve, which shifts a fit by (angular frequency x period)^2 / 12 of the force. A held force that was
logged late looks as one of lines does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxid.consistency.hold import EVIDENCE, under_smooth_force, without_lines
from jaxid.consistency.timing import SEEMS
from jaxid.estimators import steps_of
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.force_timing import timing_finding
from jaxid.numerics.lanes import Steps
from jaxid.session import Session
from jaxid.session.holds import session_under_hold
from jaxid.session.timing import session_with_force_at

_LINES, _SMOOTH, _STEPS = "linear", "band_limited", "zero_order"
_WORDS = {_LINES: "lines", _SMOOTH: "a smooth curve", _STEPS: "steps"}


def with_force_course(
    session: Session, method: str, estimate: Estimate, options: Mapping[str, Any]
) -> Steps[tuple[Session, Estimate]]:
    """Return the fit under the course of the force between samples that explains a log best.

    Args:
        session: Case and logs of the fit.
        method: The method of the fit. Only `prediction_error` compares, because only it has the likelihood.
        estimate: The fit.
        options: Further arguments of `steps_of`.

    Returns:
        The session under the best course, with the force at the time at which it acts, and the fit.
    """
    if method != "prediction_error" or not estimate.converged:
        return session, estimate
    if session.settings.get("hold", {}).get("value") == _LINES:
        session, estimate = yield from _of_best_course(session, method, estimate, options)
    delay = estimate.details.get("force_delay")
    if delay is None:
        return session, estimate
    finding = timing_finding(delay, session.fit.log.source)
    others = tuple(f for f in session.findings if not f.what.startswith(SEEMS))
    session = replace(session, findings=others)
    if delay["used"]:
        return session_with_force_at(session, delay["value"], finding), estimate
    return replace(session, findings=(*session.findings, finding)), estimate


def _of_best_course(
    session: Session, method: str, estimate: Estimate, options: Mapping[str, Any]
) -> Steps[tuple[Session, Estimate]]:
    """Fit again under other courses where the log chose lines, and return the best fit.

    Lines stay unless another course is clearly better. Standard deviations are widened so that the 95 %
    intervals hold the values under every course that is nearly as good.
    """
    tried = {_LINES: (session, estimate)}
    late = "force_delay" in estimate.details
    for hold in (_SMOOTH, _STEPS) if late else (_SMOOTH,):
        other = session_under_hold(session, hold)
        again = yield from steps_of(method, other, start=estimate.theta, **options)
        if again.converged:
            tried[hold] = (other, again)

    # All count the same samples, unless one of them knows when the machine sticks.
    gains = {
        hold: again.details["log_likelihood"] - estimate.details["log_likelihood"]
        if again.samples == estimate.samples
        else 0.0
        for hold, (_, again) in tried.items()
    }
    best = max(gains, key=lambda hold: gains[hold])
    taken = _LINES if gains[best] < EVIDENCE else best
    close = [hold for hold in tried if hold != taken and abs(gains[hold] - gains[taken]) < EVIDENCE]

    found, fit = tried[taken]
    if taken != _LINES:
        before = session.settings["hold"]["reason"]
        findings, reason = (
            under_smooth_force(session.findings, before, gains[taken])
            if taken == _SMOOTH
            else without_lines(session.findings, gains[taken])
        )
        settings = {**session.settings, "hold": {"value": taken, "reason": reason}}
        found = replace(found, findings=findings, settings=settings)
    if close:
        *first, last = (_WORDS[hold] for hold in (taken, *close))
        note = f"whether the force follows {', '.join(first)} or {last} between samples is not known: the "
        note += f"95 % intervals hold the values of {'both' if len(close) == 1 else 'all'}"
        wider = fit.holding(*[tried[hold][1].theta for hold in close])
        fit = replace(wider, notes=(*fit.notes, note))
    return found, fit
