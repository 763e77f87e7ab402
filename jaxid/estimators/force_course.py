"""Choice of the force's course between samples by the likelihood of the innovations.

Force gaps show whether a force is held. They do not show whether a force that is not held follows lines or a
smooth curve, which shifts a fit by (angular frequency x period)^2 / 12 of the force.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxid.consistency.hold import EVIDENCE, under_smooth_force
from jaxid.estimators import steps_of
from jaxid.estimators.estimate import Estimate
from jaxid.numerics.lanes import Steps
from jaxid.session import Session
from jaxid.session.holds import session_under_hold

_LINES, _SMOOTH = "linear", "band_limited"


def with_force_course(
    session: Session, method: str, estimate: Estimate, options: Mapping[str, Any]
) -> Steps[tuple[Session, Estimate]]:
    """Fit again under a smooth force where the log chose lines, and return the fit that explains it better.

    Args:
        session: Case and logs of the fit.
        method: The method of the fit. Only `prediction_error` compares, because only it has the likelihood.
        estimate: The fit.
        options: Further arguments of `steps_of`.

    Returns:
        The session under the better course, and its fit. If neither is clearly better, those of the fit,
        with standard deviations widened so that the 95 % intervals hold the values of the other one.
    """
    chosen = session.settings.get("hold", {}).get("value") == _LINES
    if method != "prediction_error" or not chosen or not estimate.converged:
        return session, estimate
    other = session_under_hold(session, _SMOOTH)
    again = yield from steps_of(method, other, start=estimate.theta, **options)
    if not again.converged:
        return session, estimate

    # Both count the same samples, unless one of them knows when the machine sticks.
    gain = again.details["log_likelihood"] - estimate.details["log_likelihood"]
    if again.samples != estimate.samples or abs(gain) < EVIDENCE:
        note = "whether the force follows lines or a smooth curve between samples is not known: the 95 % "
        note += "intervals hold the values of both"
        wider = estimate.holding(again.theta)
        return session, replace(wider, notes=(*estimate.notes, note))
    if gain < 0:
        return session, estimate
    found, reason = under_smooth_force(session.findings, session.settings["hold"]["reason"], gain)
    settings = {**session.settings, "hold": {"value": _SMOOTH, "reason": reason}}
    return replace(other, findings=found, settings=settings), again
