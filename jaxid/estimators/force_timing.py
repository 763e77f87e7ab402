"""Delay between a logged force and the motion, by the likelihood of the innovations.

A logger may read the force a part of a sample before or after it acts. A viscous friction takes such a delay
up, without a trace in the size of the residual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxid.consistency.hold import EVIDENCE
from jaxid.consistency.timing import SEEMS
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.innovations import STEPS
from jaxid.estimators.joint_likelihood import JointLikelihood, Maximum
from jaxid.estimators.noise_floors import maximum_steps
from jaxid.logs.finding import Finding
from jaxid.logs.late import earlier
from jaxid.numerics.lanes import Steps
from jaxid.numerics.whiteness import REJECTS, whiteness

# Largest delay that counts as timing, in samples; more is an effect of the drive.
MOST = 1.0
# Samples to either side over which slopes are differences: over less the slope of a held force has corners.
_ASIDE = 0.5
# Newton steps in the delay, the largest in samples, and the one that ends them in standard deviations.
_ROUNDS, _LARGEST, _CLOSE = 8, 1.0, 0.2


@dataclass(frozen=True)
class Timing:
    """A delay of the logged force.

    Args:
        samples: Samples by which the force was logged after it acted; below zero: before.
        std: Standard deviation of it.
        gain: Log-likelihood that it gains [nats].
        slope: Change of the estimates by one sample more, (p,).
    """

    samples: float
    std: float
    gain: float
    slope: Float[np.ndarray, " p"]

    @property
    def is_timing(self) -> bool:
        """True if the delay may be that of a logger: at most one sample."""
        return abs(self.samples) - 2 * self.std <= MOST

    def noted(self, estimate: Estimate, period: float) -> Estimate:
        """Return an estimate with this delay in its details; a timing widens its standard deviations.

        Args:
            estimate: The estimate, at this delay if that is timing.
            period: Sampling time of the log [s].
        """
        delay = {"value": self.samples * period, "std": self.std * period, "samples": self.samples}
        details = {**estimate.details, "force_delay": {**delay, "gain": self.gain, "used": self.is_timing}}
        if not self.is_timing:
            return replace(estimate, details=details)
        factor = np.hypot(1.0, np.abs(self.slope) * self.std / estimate.std)
        return replace(estimate.wider(np.where(np.isfinite(factor), factor, 1.0)), details=details)


class _Force(NamedTuple):
    """A force as logged: at the rows of its log, (time, m), and at the ticks of the filter, (ticks, m)."""

    rows: Float[np.ndarray, "time m"]
    ticks: Float[np.ndarray, "ticks m"]


def timing_steps(
    logged: JointLikelihood, fit: JointLikelihood, end: Maximum
) -> Steps[tuple[JointLikelihood, Maximum, Timing | None]]:
    """Estimate the delay of the force of one log, if it makes the innovations white.

    Newton's method in the delay alone, each time with a fit of the unknowns and the noise. The slope of the
    innovations is a difference, without the part that the unknowns explain.

    Args:
        logged: The likelihood of one log, whose fits begin at the highest floor of the noise.
        fit: That under its last floor, see `maximum_steps`.
        end: Its maximum.

    Returns:
        The likelihood with the force at the time at which it acts, its maximum, and the delay. If a delay
        gains too little, or leaves innovations that are not white, `fit`, `end` and None; if it is too long
        for a timing, these and the delay.
    """
    [member] = fit.members
    if not end.converged or member.at.law is not None:
        return fit, end, None

    force = _Force(member.part.log.force, np.asarray(member.problem.kalman.command))
    first = yield from _newton(fit, end, force, 0.0)
    if first.gain < EVIDENCE:
        return fit, end, None
    moved, here, timing = yield from _descent(fit, end, force, first, 0.0)
    steps, gain = end.steps + here.steps, end.cost - here.cost
    if gain < EVIDENCE:
        return fit, replace(end, steps=steps), None

    # The noise had come to rest at a floor, if it held the delay.
    moved, here = yield from maximum_steps(
        _with_force_at(logged, force, timing.samples), here.theta, here.noises
    )
    steps += here.steps
    if not here.converged or not _white(here, np.asarray(moved.members[0].problem.counts)):
        return fit, replace(end, steps=steps), None
    at = timing.samples
    timing = yield from _newton(moved, here, force, at)
    moved, here, timing = yield from _descent(moved, here, force, timing, at)
    timing = replace(timing, gain=gain)
    if not timing.is_timing:
        return fit, replace(end, steps=steps), timing
    return moved, replace(here, steps=steps + here.steps), timing


def _descent(
    fit: JointLikelihood, end: Maximum, force: _Force, timing: Timing, at: float
) -> Steps[tuple[JointLikelihood, Maximum, Timing]]:
    """Maximise the likelihood by the delay from its maximum at one.

    Args:
        fit: The likelihood.
        end: Its maximum.
        force: The force as logged.
        timing: The delay to which the first step leads.
        at: The delay of `fit` in samples.

    Returns:
        The likelihood, its maximum with the steps from `end` on, and the delay there.
    """
    steps = 0
    for _ in range(_ROUNDS):
        step = float(np.clip(timing.samples - at, -_LARGEST, _LARGEST))
        if abs(step) < _CLOSE * timing.std:
            break
        further = _with_force_at(fit, force, at + step)
        there = yield from further.fit(end.theta, end.noises, STEPS)
        steps += there.steps
        if not (there.converged and there.cost < end.cost):
            break
        fit, end, at = further, there, at + step
        timing = yield from _newton(fit, end, force, at)
    return fit, replace(end, steps=steps), replace(timing, samples=at)


def _with_force_at(fit: JointLikelihood, force: _Force, samples: float) -> JointLikelihood:
    """Return a likelihood under a force that was logged so many samples late."""
    [member] = fit.members
    kalman, log = member.problem.kalman, member.part.log
    delay = samples * log.period
    moved = replace(log, force=earlier(log.time, force.rows, delay, log.hold))
    ticks = log.period / kalman.every * np.arange(len(force.ticks))
    kalman = replace(kalman, command=earlier(ticks, force.ticks, delay, log.hold))
    of_moved = replace(member, part=replace(member.part, log=moved), at=replace(member.at, log=moved))
    return replace(fit, members=(replace(of_moved, problem=member.problem._replace(kalman=kalman)),))


def _newton(fit: JointLikelihood, end: Maximum, force: _Force, at: float) -> Steps[Timing]:
    """Return the delay of a Newton step from a fit at a delay, with its precision and the gain of the step.

    Args:
        fit: The likelihood at the delay.
        end: Its maximum.
        force: The force as logged.
        at: The delay in samples.
    """
    [member], [scored] = fit.members, end.scored
    beside = []
    for samples in (at - _ASIDE, at + _ASIDE):
        there = yield from _with_force_at(fit, force, samples).fit(end.theta, end.noises, 1)
        beside.append(np.asarray(there.scored[0].z).ravel())
    slope = (beside[1] - beside[0]) / (2 * _ASIDE)
    z, jacobian = np.asarray(scored.z).ravel(), member.slopes(scored).reshape(slope.size, -1)

    # Columns of one size: unknowns have different units.
    size = np.linalg.norm(jacobian, axis=0)
    size = np.where(size > 0, size, 1.0)
    explained = np.linalg.lstsq(jacobian / size, slope)[0] / size
    alone = slope - jacobian @ explained
    information = float(alone @ alone)
    if not np.isfinite(information) or information <= 0.0:
        return Timing(at, np.inf, 0.0, np.zeros(fit.unknowns))
    step = -float(alone @ z) / information
    change = np.zeros(fit.unknowns)
    change[member.part.index] = -explained
    return Timing(at + step, information**-0.5, 0.5 * step**2 * information, change)


def _white(end: Maximum, counts: np.ndarray) -> bool:
    """Check that the innovations of one log pass the test of whiteness."""
    [scored] = end.scored
    return all(whiteness(e[c]) >= REJECTS for e, c in zip(np.asarray(scored.z).T, counts.T, strict=True))


def timing_finding(delay: Mapping[str, Any], source: str) -> Finding:
    """Return the warning that a force acts earlier or later than it was logged.

    Args:
        delay: Entry `force_delay` of the details.
        source: The log, for messages.
    """
    how, hint = delay_words(delay), "if the drive acts so late, declare the effect input_delay"
    if delay["value"] > 0:
        hint = f"state delay = {{ force = {delay['value']:.3g} }} in [log]"
    hint += " to confirm it" if delay["used"] else ", if the log was recorded so"
    head = "the force is taken as logged" if delay["used"] else SEEMS
    what = f"{head} {how}: it raises the log-likelihood by {delay['gain']:.3g}"
    return Finding("warning", what, f"{source}, force", hint)


def delay_words(delay: Mapping[str, Any]) -> str:
    """Return the size of a delay of the force in words."""
    side = "late" if delay["value"] > 0 else "early"
    samples = f"{abs(delay['samples']):.2f} ± {delay['std'] / delay['value'] * delay['samples']:.1g} samples"
    return f"{1e3 * abs(delay['value']):.3g} ms {side} ({samples})"
