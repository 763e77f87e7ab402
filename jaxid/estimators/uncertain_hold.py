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


def with_uncertain_hold(
    steps: Callable[..., Steps[Estimate]], session: Session, **options: Any
) -> Steps[Estimate]:
    """Fit, and add what the uncertainty of the time for which each force acts means for the values.

    The time is estimated from the log. It shifts the force by half of it, which moves the gains of drives and
    the friction most. The fit is repeated with the time one standard deviation longer: the change of the
    values is one more error.

    Args:
        steps: The estimator.
        session: Case and logs of the fit.
        options: Keyword arguments of the estimator.

    Returns:
        The estimate with the larger covariance; unchanged if the second fit does not converge.
    """
    estimate = yield from steps(session, **options)
    if not (estimate.converged and estimate.identifiable.any()):
        return estimate
    runs = [replace(run, data=run.data.with_longer_hold()) for run in session.fits]
    longer = replace(session, fit=runs[0], more=tuple(runs[1:]))
    other = yield from steps(longer, **options)
    if not other.converged:
        return estimate

    change = np.where(estimate.identifiable, other.theta - estimate.theta, 0.0)
    beside = estimate.std_misspecified
    return replace(
        estimate,
        precision=estimate.precision.with_error(change),
        std_misspecified=None if beside is None else np.hypot(beside, change),
    )
