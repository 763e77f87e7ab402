"""Uncertainty of the time for which each force acts, in the log of a loop that is faster than its rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.estimators.estimate import Estimate
from jaxid.numerics.lanes import Steps

if TYPE_CHECKING:
    from jaxid.session import Session

# Step of the time, as a part of a row. It is the same for all logs of one rate: code that is compiled for one
# serves the others.
_STEP = 0.05
# Standard deviation of the time, as a part of a row, that does not count.
_NONE = 1e-3


def with_uncertain_hold(
    steps: Callable[..., Steps[Estimate]], session: Session, **options: Any
) -> Steps[Estimate]:
    """Fit, and add the error that an uncertain time of action of each force causes.

    The time is estimated from the log. The force acts half of it after its row, which moves the gains of
    drives and the friction most. The fit is repeated with a longer time. The change of the values for one
    standard deviation of the time is one more error.

    Args:
        steps: The estimator.
        session: Case and logs of the fit.
        options: Keyword arguments of the estimator.

    Returns:
        The estimate with the larger covariance; unchanged if the time is known. If the second fit does not
        converge, a note says that the deviations are too small.
    """
    estimate = yield from steps(session, **options)
    data = session.fit.data
    part = data.hold_std / data.period
    if part < _NONE or not (estimate.converged and estimate.identifiable.any()):
        return estimate
    other = yield from steps(_with_longer_hold(session, _STEP * data.period), **options)
    seen = estimate.identifiable & other.identifiable & np.isfinite(other.theta)
    if not other.converged or not seen.any():
        note = (
            "the standard deviations are too small: they do not count how uncertain the tick of the loop is"
        )
        return replace(estimate, notes=(*estimate.notes, note))

    change = np.where(seen, other.theta - estimate.theta, 0.0) * part / _STEP
    beside = estimate.std_misspecified
    return replace(
        estimate,
        precision=estimate.precision.with_error(change),
        std_misspecified=None if beside is None else np.hypot(beside, change),
    )


def _with_longer_hold(session: Session, step: float) -> Session:
    """Return a session in whose logs each force acts for a longer time; logs of a known time keep it."""
    runs = [
        replace(run, data=replace(run.data, hold=run.data.hold + step)) if run.data.hold_std else run
        for run in session.fits
    ]
    return replace(session, fit=runs[0], more=tuple(runs[1:]))
