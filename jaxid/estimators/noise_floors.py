"""Maximum of the likelihood of the innovations under falling floors of the noise.

The likelihood of a machine without noise is a narrow curved valley, in which a fit from afar would stop.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.estimators.innovations import STEPS
from jaxid.estimators.joint_likelihood import JointLikelihood, Maximum
from jaxid.numerics.lanes import Steps


def maximum_steps(
    fit: JointLikelihood, theta: np.ndarray, noises: list[np.ndarray]
) -> Steps[tuple[JointLikelihood, Maximum]]:
    """Maximise the likelihood, and count the samples at rest where it is known when a joint sticks.

    Args:
        fit: The likelihood.
        theta: Unknowns at the start, (p,).
        noises: Logarithms of the noise of each log at the start.

    Returns:
        The likelihood under the last floor, and its maximum with the steps of all.
    """
    fit, lowest = yield from _by_floors(fit, theta, noises)
    return (yield from _with_samples_at_rest(fit, lowest))


def _by_floors(
    fit: JointLikelihood, theta: np.ndarray, noises: list[np.ndarray]
) -> Steps[tuple[JointLikelihood, Maximum]]:
    """Maximise under one floor of the noise after the other, until the noise is above its floor.

    Returns:
        The likelihood under the last floor, and its maximum with the steps of all.
    """
    end, steps = None, 0
    for floor in range(len(fit.members[0].at.floors)):
        fit = fit.at_floor(floor)
        end = yield from fit.fit(theta, noises, STEPS)
        theta, noises, steps = end.theta, end.noises, steps + end.steps
        if fit.above(floor, end) or not np.isfinite(end.cost):
            break
    assert end is not None, "there is at least one floor"
    return fit, replace(end, steps=steps)


def _with_samples_at_rest(fit: JointLikelihood, end: Maximum) -> Steps[tuple[JointLikelihood, Maximum]]:
    """Count the samples at rest too, in the logs in which it is known when a joint sticks.

    It is known without noise of the force. If the noise rises with these samples, it holds the error of the
    steps in which a joint comes to rest: then they do not count.
    """
    steps, sure = end.steps, fit.sticks_surely(end.noises)
    while any(sure):
        rested = fit.at_rest_too(sure)
        other = yield from rested.fit(end.theta, end.noises, STEPS)
        steps += other.steps
        still = [s and after for s, after in zip(sure, fit.sticks_surely(other.noises), strict=True)]
        if still == sure:
            return (yield from _quieter(rested, replace(other, steps=steps)))
        sure = still
    return fit, replace(end, steps=steps)


def _quieter(fit: JointLikelihood, end: Maximum) -> Steps[tuple[JointLikelihood, Maximum]]:
    """Return a fit whose noise of the force came to its floor with a lower one, if it converges there too.

    The standard deviations are those of the noise at the floor, and too large by as much as it is too high.
    """
    quiet = fit.at_quietest()
    if quiet is None or not end.converged or fit.above(-1, end):
        return fit, end
    other = yield from quiet.fit(end.theta, end.noises, STEPS)
    steps = end.steps + other.steps
    if not other.converged:
        return fit, replace(end, steps=steps)
    return quiet, replace(other, steps=steps)
