"""The fit of an arm as a whole: all servos at once, in the simulated loop of the arm.

Fits of each joint alone are near enough to begin there, although gains of the case may be far off. But the
measured motion, from which they take the forces of the links, lacks the jerks between two rows and holds the
noise of the encoders. Their values are off by several percent, which their standard deviations do not show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.apart.joint import (
    is_arm_of_servos,
    joints_alone,
    unknowns_of_joints,
    unknowns_of_links,
)
from jaxid.estimators.apart.links import links_by_balance
from jaxid.estimators.apart.loads import with_simulated_loads
from jaxid.estimators.apart.start import starts_beside
from jaxid.estimators.apart.steps import TOLERANCE, apart_steps, common_numerics, joint_fits, side_by_side
from jaxid.estimators.estimate import Estimate, misfit
from jaxid.estimators.mean_readings import fitted_with_noise
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.ticks import at_ticks, best_ticks_of_joints
from jaxid.machine import Machine
from jaxid.numerics.lanes import Steps
from jaxid.simulation.replay import Numerics
from jaxid.simulation.sensor_noise import position_noise

# Largest work of a Jacobian of the whole arm: steps of integration times columns times entries of the mass
# matrix. Two joints over 6 s at 1 kHz have 3e5, and a fit takes seconds; with this much it takes minutes.
_WORK = 1e7
# Factors in RMS over the noise: beyond the first a fit is tried again; up to the second the mean readings are
# fitted, because the noise in the loop leaves so much.
_FAR, _NEAR = 1.2, 2.0
# Most times that it is, and the part of its misfit that another time must gain to call for the next.
_RENEWALS, _NEWS = 3, 0.01
_NOTE = (
    "all joints were fitted at once, in the simulated loop of the whole arm, from fits of each joint alone"
)


def arm_steps(
    machine: Machine,
    parts: Sequence[Part],
    *,
    numerics: Numerics | None = None,
    profile: Sequence[str] = (),
    near: bool = False,
    without_noise: bool = False,
    **options: Any,
) -> Steps[Estimate]:
    """Fit the servos of an arm joint by joint, and then all at once unless that would take too long.

    Args:
        machine: Machine of all logs, which `jaxid.estimators.apart.joint.stands_apart`.
        parts: The logs.
        numerics: Settings of the integration; None: chosen from machine and log.
        profile: Names of unknowns of the arm whose profile is computed.
        near: Whether the whole arm is fitted from the guesses of the machine, and joints alone only if that
            does not converge.
        without_noise: Whether one fit of the whole arm is enough, without noise in its loops.
        options: Further arguments of `output_error_steps`.

    Returns:
        The estimate of the whole arm. It is that of the joints alone, with the reason in a note, if the whole
        arm would take too long, if a joint never moves, or if the fit of the whole arm does not converge.
    """
    refused = why_not_whole(machine, parts, numerics)
    fit = _to_ticks if without_noise else whole_steps
    of_whole = {"numerics": numerics, "profile": profile, **options}
    if near and not refused:
        whole = yield from fit(machine, parts, start=machine.parameters.guess, **of_whole)
        if whole.converged:
            return whole
    own = profile if refused else ()
    alone = yield from apart_steps(machine, parts, numerics=numerics, profile=own, **options)
    if refused:
        return replace(alone, notes=(*alone.notes, refused))
    whole = yield from fit(machine, parts, start=alone.theta, **of_whole)
    if whole.converged or not alone.converged:
        return whole
    return replace(alone, notes=(*alone.notes, f"a fit of the whole arm from there failed: {whole.message}"))


def whole_steps(
    machine: Machine, parts: Sequence[Part], *, start: Float[np.ndarray, " p"], **options: Any
) -> Steps[Estimate]:
    """Fit all unknowns of an arm at once, from some values and from better ones that the fit leads to.

    These are the ticks nearest to its delays, because between two ticks dry friction may hold a fit; while
    more than noise is left, fits of the joints alone under the forces of the arm in simulation; and the ticks
    beside them. Where little more than noise is left, the mean readings of the loop with this noise are then
    fitted.

    Args:
        machine: Machine of all logs.
        parts: The logs.
        start: Values of the unknowns, (p,).
        options: Further arguments of `output_error_steps`.

    Returns:
        The best fit.
    """
    options |= {"tolerance": TOLERANCE} if len(parts) > 1 else {}
    best = yield from _to_ticks(machine, parts, start, **options)
    for _ in range(_RENEWALS):
        if not _leaves_more_than_noise(best, parts, _FAR):
            break
        again = yield from _by_simulated_loads(machine, parts, best.theta)
        new = yield from _to_ticks(machine, parts, again, **options)
        gained = misfit(best) - misfit(new)
        best = min(best, new, key=_rank)
        if not gained > _NEWS * abs(misfit(best)):
            break
    if not best.converged:
        return replace(best, notes=(_NOTE, *best.notes))
    ticks = yield from best_ticks_of_joints(machine, parts, best.theta, options.get("numerics"))
    best = min(best, (yield from output_error_steps(machine, parts, start=ticks, **options)), key=_rank)
    if _leaves_more_than_noise(best, parts, _NEAR):
        return replace(best, notes=(_NOTE, *best.notes))
    # One run without noise, shifted: the noise of every joint in each run takes ten times as long.
    noisy = yield from fitted_with_noise(machine, parts, best.theta, follows=False, **options)
    best = noisy or best
    return replace(best, notes=(_NOTE, *best.notes))


def _rank(fit: Estimate) -> tuple[bool, float]:
    return not fit.converged, misfit(fit)


def _to_ticks(
    machine: Machine, parts: Sequence[Part], start: Float[np.ndarray, " p"], **options: Any
) -> Steps[Estimate]:
    """Return the better of a fit from some values, and one from the ticks next to its delays."""
    first = yield from output_error_steps(machine, parts, start=start, **options)
    ticks = at_ticks(machine, first.theta)
    if np.array_equal(ticks, first.theta):
        return first
    return min(first, (yield from output_error_steps(machine, parts, start=ticks, **options)), key=_rank)


def _leaves_more_than_noise(fit: Estimate, parts: Sequence[Part], factor: float) -> bool:
    """Check whether a fit leaves more than the noise of an encoder times a factor in any log."""
    ends = np.cumsum([part.log.samples for part in parts])[:-1]
    for rows, part in zip(np.split(fit.residual, ends), parts, strict=True):
        floor = position_noise(part.machine, part.log)
        # A constant reading has no noise that could be estimated.
        left = np.sqrt(np.nanmean(np.square(rows), axis=0))[floor > 0]
        if np.any(left > factor * floor[floor > 0]):
            return True
    return False


def _by_simulated_loads(
    machine: Machine, parts: Sequence[Part], theta: Float[np.ndarray, " p"]
) -> Steps[Float[np.ndarray, " p"]]:
    """Return values with those of the servos by fits of each joint under the loads of the simulated arm.

    A joint begins at its balance, and at the balances with the neighbouring delays; its best fit counts.
    """
    own = unknowns_of_joints(machine)
    at = [replace(part, machine=part.at(theta)) for part in parts]
    alone, of_joints = _of_joints(machine.with_estimate(theta), at, own)
    joints = with_simulated_loads(joints_alone(alone, of_joints), alone.parameters.guess, of_joints)
    found = yield from joint_fits(joints)
    numerics = common_numerics(joints)
    beside = [(k, start) for k, joint in enumerate(joints) for start in starts_beside(joint)]
    fits = [
        output_error_steps(
            joints[k].machine, joints[k].parts, start=start, numerics=numerics, tolerance=TOLERANCE
        )
        for k, start in beside
    ]
    more = yield from side_by_side(fits)
    new = theta[own]
    for k, joint in enumerate(joints):
        own_fits = [found[k], *(fit for (n, _), fit in zip(beside, more, strict=True) if n == k)]
        new[joint.index] = joint.of_arm(min(own_fits, key=_rank).theta)
    theta = theta.copy()
    theta[own] = np.where(np.isfinite(new), new, theta[own])
    return theta


def _of_joints(machine: Machine, parts: Sequence[Part], own: Sequence[int]) -> tuple[Machine, list[Part]]:
    """Return an arm and its logs with some of their unknowns, the others known at their guesses."""

    def chosen(machine: Machine, kept: Sequence[int]) -> Machine:
        return machine.with_plant(machine.plant, machine.parameters.chosen(kept))

    new = {k: n for n, k in enumerate(own)}
    out = []
    for part in parts:
        kept = [n for n, k in enumerate(part.index.tolist()) if k in new]
        index = np.array([new[part.index[n]] for n in kept], int)
        out.append(replace(part, machine=chosen(part.machine, kept), index=index))
    return chosen(machine, own), out


def start_by_joints(machine: Machine, parts: Sequence[Part]) -> Steps[Float[np.ndarray, " p"] | None]:
    """Return values of an arm's unknowns: of its links by the balance, of its servos by fits of each alone.

    Args:
        machine: Machine of all logs.
        parts: The logs, which have no force.

    Returns:
        The values, (p,); None if the machine is no arm of servos, or no such fit converged.
    """
    own = unknowns_of_joints(machine)
    if not own or not is_arm_of_servos(machine, parts):
        return None
    theta, links = machine.parameters.guess, unknowns_of_links(machine)
    if links:
        theta = links_by_balance(machine, parts, links)
    at = [replace(part, machine=part.at(theta)) for part in parts]
    alone, of_joints = _of_joints(machine.with_estimate(theta), at, own)
    fit = yield from apart_steps(alone, of_joints)
    if not fit.converged:
        return None
    theta[own] = fit.theta
    return theta


def why_not_whole(machine: Machine, parts: Sequence[Part], numerics: Numerics | None) -> str:
    """Return why an arm is not fitted as a whole; empty if it is."""
    given = [part.log.reference for part in parts if part.log.reference is not None]
    if not np.all(np.any([np.ptp(one, axis=0) > 0 for one in given], axis=0)):
        return "the whole arm was not fitted at once: the command of a joint never moves"
    columns, work = len(machine.parameters.free) + 1, 0.0
    for part in parts:
        chosen = numerics or choose_numerics(part.machine, part.log)
        law = part.machine.controller
        assert law is not None, "checked by stands_apart"
        ticks = (part.log.time[-1] - part.log.time[0]) / law.period
        work += ticks * chosen.substeps * columns * machine.plant.joints**2
    if work <= _WORK:
        return ""
    return "the whole arm was not fitted at once: its logs are so long that this would take many minutes"
