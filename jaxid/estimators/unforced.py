"""Logs of a loop without a force: starts for the fit of its position, and unknowns without a scale.

Only the simulated loop relates the unknowns to such a log. All forces, inertias and gains may be multiplied
by one factor if none of them is known: the motion is the same. One of them is then held at its guess, and
the others are given relative to it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.consistency.absent import without_scale
from jaxid.controllers.linear import PD, PID, CascadePD, FrictionCompensation
from jaxid.estimators.apart.joint import stands_apart
from jaxid.estimators.apart.whole import arm_steps, start_by_joints, whole_steps
from jaxid.estimators.coarse_starts import coarse_starts
from jaxid.estimators.effort import SCALE, Scale, scale_by_effort
from jaxid.estimators.estimate import Estimate, misfit
from jaxid.estimators.mean_readings import far_from_logs, fitted_with_noise, left_over_noise
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.servo_law import beside_other_law, leaves_law_open, with_law_of_log
from jaxid.estimators.servo_rate import leaves_course_open, leaves_rate_open, with_rate_of_log
from jaxid.estimators.several.parts import Part, parts_of
from jaxid.estimators.simulated_output import choose_numerics, position_jacobian
from jaxid.estimators.ticks import best_ticks, with_equal_ticks, with_std_of_ticks
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.lanes import Steps
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.replay import Numerics
from jaxid.simulation.sensor_noise import position_noise

if TYPE_CHECKING:
    from jaxid.session import Session

# Starts from which logs that are fitted together are fitted; each fit simulates all of them many times.
_STARTS_TOGETHER = 2
# Factor in RMS over the noise beyond which a fit without a scale is tried from starts that are further away.
_FAR = 2.0
# The same, from which mean readings of several logs are not fitted.
_INCOMPLETE = 6.0
# Keys of each law that give its command a scale; without one that is known, the scale is free.
_GAINS = {
    CascadePD: ("kv",),
    PD: ("kp", "kd"),
    PID: ("kp", "ki", "kd"),
    FrictionCompensation: ("kp", "kd", "coulomb", "viscous", "inertia"),
}


def unforced_steps(
    session: Session,
    *,
    numerics: Numerics | None = None,
    scaled: bool = False,
    near: bool = False,
    **options: Any,
) -> Steps[Estimate]:
    """Fit the positions of loops whose force was not logged, from several starts, to one log or to several.

    An arm of servos starts from fits of each joint alone, see `jaxid.estimators.apart`. What the derivative
    of the law acts on, and the rate of the loop, are chosen if the case does not state them; see
    `jaxid.estimators.servo_law` and `jaxid.estimators.servo_rate`. If the period is stated or chosen, no
    delay has a smaller standard deviation than that of a uniform error of one period.

    Args:
        session: Case and logs of the fit.
        numerics: Settings of the integration; None: chosen from machine and log.
        scaled: Whether an effort of known gain gives the scale, if nothing else does.
        near: Whether the guesses are those of a fit at another loop, from which that of an arm starts.
        options: Further arguments of `output_error_steps`.
    """

    def fitted(session: Session, *, without_noise: bool = False) -> Steps[Estimate]:
        return (yield from _fitted_steps(session, numerics, scaled, near, without_noise, **options))

    own_rate = numerics is None and (leaves_rate_open(session) or leaves_course_open(session))
    at_rate = partial(with_rate_of_log, fitted=fitted) if own_rate else fitted
    if leaves_law_open(session):
        result = yield from with_law_of_log(session, at_rate)
    else:
        result = yield from at_rate(session)
        result = yield from beside_other_law(session, at_rate, result)
    if own_rate:
        return with_std_of_ticks(result)
    controller = session.case.controller
    stated = controller is not None and controller.period is not None
    return with_std_of_ticks(result) if stated else result


def leaves_loop_open(session: Session) -> bool:
    """Check that a fit of servos chooses their law, their rate, or the command between two rows."""
    return leaves_law_open(session) or leaves_rate_open(session) or leaves_course_open(session)


def at_its_loop_steps(session: Session) -> Steps[Estimate]:
    """Fit servos with the law, the rate and the command of their machine, whatever the case leaves open."""
    return with_std_of_ticks((yield from _fitted_steps(session, None, False, False, False)))


def _fitted_steps(
    session: Session,
    numerics: Numerics | None,
    scaled: bool,
    near: bool,
    without_noise: bool,
    **options: Any,
) -> Steps[Estimate]:
    """Fit as `unforced_steps` does; `without_noise`: one run of the loop without noise, which is faster."""
    machine = session.machine
    if stands_apart(machine, parts_of(session)):
        options |= {"numerics": numerics, "near": near, "without_noise": without_noise}
        return (yield from arm_steps(machine, parts_of(session), **options))
    group = common_scale_group(machine, parts_of(session))
    base = base_of(machine, group) if group else None
    fitted = machine if base is None else without(machine, base)
    parts = parts_of(session.with_machine(fitted))
    chosen = [numerics or choose_numerics(part.machine, part.log) for part in parts]

    by_joints = yield from start_by_joints(fitted, parts)
    starts = coarse_starts(fitted, parts, chosen) if by_joints is None else [by_joints]
    if len(parts) > 1:
        starts = starts[:_STARTS_TOGETHER]
    fit = output_error_steps if by_joints is None or without_noise else whole_steps
    fit = partial(fit, fitted, parts, numerics=numerics, **options)
    result = yield from _best_of(fit, starts)
    if base is not None and by_joints is None and max(left_over_noise(parts, result)) > _FAR:
        ratios = [name for k, name in enumerate(machine.parameters.names) if k in group and k != base]
        others = coarse_starts(fitted, parts, chosen, ratios=ratios)
        others = [start for start in others if not np.array_equal(start, fitted.parameters.guess)]
        again = yield from _best_of(fit, others[: _STARTS_TOGETHER if len(parts) > 1 else None])
        result = min(result, again, key=_order)
    if result.converged and by_joints is None and not without_noise:
        result = yield from _by_mean_readings(fitted, parts, result, numerics=numerics, **options)
    if base is None:
        return result
    scale = scale_by_effort(session, parts, result) if scaled else None
    if scale is not None:
        return with_known_scale(result, machine, group, base, scale)
    return with_free_scale(result, machine, group, base)


def _best_of(
    fit: Callable[..., Steps[Estimate]], starts: Sequence[Float[np.ndarray, " p"]]
) -> Steps[Estimate]:
    """Return the best fit from several starts."""
    fits = []
    for start in starts:
        fits.append((yield from fit(start=start)))
    return min(fits, key=_order)


def _order(estimate: Estimate) -> tuple[bool, float]:
    """Return a key by which fits of the same logs compare, the least one that of the best fit."""
    return not estimate.converged, misfit(estimate)


def _by_mean_readings(
    machine: Machine, parts: Sequence[Part], plain: Estimate, **options: Any
) -> Steps[Estimate]:
    """Return the best fit of the mean readings, at the ticks of the delay near that of a fit without noise.

    The noise changes the misfit by more than one tick of the delay does, so that only mean readings show
    which is the best. If a model leaves far more of several logs than noise, they say no more than runs
    without noise do, and their fits take minutes.

    Args:
        machine: Machine of all logs.
        parts: The logs.
        plain: A fit without noise.
        options: Further arguments of `output_error_steps`.

    Returns:
        The fit; that without noise if nothing is known of the noise, or the model is far from several logs.
    """
    numerics = options.get("numerics")
    if len(parts) > 1 and far_from_logs(parts, plain, numerics, times=_INCOMPLETE):
        return plain
    at, *equal = (yield from best_ticks(machine, parts, plain.theta, numerics)) or [plain.theta]
    found = yield from fitted_with_noise(machine, parts, at, **options)
    return plain if found is None else with_equal_ticks(found, equal)


def common_scale_group(machine: Machine, parts: Sequence[Part]) -> tuple[int, ...]:
    """Return the unknowns that may all be multiplied by one factor in logs that are fitted together.

    Args:
        machine: Machine of all logs at its guesses.
        parts: The logs; what is known in one of them gives all of them their scale.
    """
    names: set[str] = set()
    for part in parts:
        own = [part.machine.parameters.names[k] for k in scale_group(part.machine, part.log)]
        if not own:
            return ()
        names |= set(own)
    return tuple(k for k, name in enumerate(machine.parameters.names) if name in names)


def scale_group(machine: Machine, log: Log) -> tuple[int, ...]:
    """Return the unknowns that may all be multiplied by one factor; empty if something known gives the scale.

    Args:
        machine: The machine at its guesses, with its controller.
        log: The log, for its positions.
    """
    law = machine.controller
    names = _gains(machine)
    if names is None or machine.disturbance is not None or machine.load is not None:
        # Another law is not linear in its gains; a disturbance and a load are known forces.
        return ()
    free = machine.parameters.free
    unknown = _of_controller(machine)
    known = stated_gains(machine)
    if law is None or (law.limit is not None and "limit" not in unknown):
        known.append("limit")
    forces = without_scale(machine, log)
    if known or not forces:
        return ()
    gains = {*names, "limit"} & unknown
    return tuple(
        k for k, f in enumerate(free) if f.name in forces or f.path[0] == CONTROLLER and f.path[1] in gains
    )


def stated_gains(machine: Machine) -> list[str]:
    """Return the keys of the gains that a case states as numbers, other than zero."""
    unknown = _of_controller(machine)
    names = _gains(machine) or ()
    return [n for n in names if n not in unknown and np.any(np.asarray(getattr(machine.controller, n)) != 0)]


def _gains(machine: Machine) -> tuple[str, ...] | None:
    """Return the keys that give the command of a machine's law a scale; None for a law of another kind."""
    return next((names for kind, names in _GAINS.items() if type(machine.controller) is kind), None)


def _of_controller(machine: Machine) -> set[str | int]:
    """Return the keys of the unknowns of the controller."""
    return {f.path[1] for f in machine.parameters.free if f.path[0] == CONTROLLER}


def base_of(machine: Machine, group: tuple[int, ...]) -> int:
    """Return the unknown to hold: an inertia if there is one, which a user may find elsewhere."""
    free = machine.parameters.free
    of_all = [k for k in group if free[k].log is None] or list(group)
    of_plant = [k for k in of_all if free[k].effect is None and free[k].path[0] != CONTROLLER]
    return (of_plant or of_all)[0]


def without(machine: Machine, base: int) -> Machine:
    """Return the machine with one unknown known at its guess."""
    unknown = machine.parameters
    return machine.with_plant(
        machine.plant, unknown.chosen([k for k in range(len(unknown.free)) if k != base])
    )


def with_free_scale(estimate: Estimate, machine: Machine, group: tuple[int, ...], base: int) -> Estimate:
    """Return an estimate that was made with one unknown held, as one in which the scale of a group is free.

    Args:
        estimate: Estimate with the base held.
        machine: The machine with all its unknowns.
        group: Unknowns that may all be multiplied by one factor.
        base: The one that was held.

    Returns:
        The estimate. Unknowns of the group are not identifiable; `details["relative"]` gives their ratios to
        the base.
    """
    free = machine.parameters.free
    guess = free[base].guess
    theta = np.insert(estimate.theta, base, guess)
    std = np.insert(estimate.std, base, 0.0)
    relative = {
        free[k].name: {
            "value": float(theta[k] / guess),
            "std": float(std[k] / guess) if np.isfinite(std[k]) else None,
            "unit": f"{free[k].unit}/({free[base].unit})",
        }
        for k in group
        if k != base
    }
    precision = free_precision(estimate.precision, machine, group, base)
    beside = estimate.std_misspecified
    if beside is not None:
        beside = np.insert(beside, base, np.nan)
        beside[list(group)] = np.nan
    names = ", ".join(free[k].name for k in group)
    note = (
        f"the log has no force, and nothing known gives one: {names} may all be multiplied by one factor; "
        "state one of them as a number (an inertia or weight that was measured, a gain of a data sheet), or "
        "fit a second log with a payload or gain that is known there, stated by set in its [[fit]]"
    )
    return replace(
        estimate,
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        std_misspecified=beside,
        notes=(*estimate.notes, note),
        details={**estimate.details, "relative": {"to": free[base].name, "values": relative}},
    )


def with_known_scale(
    estimate: Estimate, machine: Machine, group: tuple[int, ...], base: int, scale: Scale
) -> Estimate:
    """Return an estimate that was made with one unknown held, as one whose scale an effort gives.

    Args:
        estimate: Estimate with the base held.
        machine: The machine with all its unknowns.
        group: Unknowns that are multiplied by the factor.
        base: The one that was held.
        scale: The factor; its derivatives are by the unknowns of the estimate.
    """
    free = machine.parameters.free
    held = np.insert(estimate.theta, base, free[base].guess)
    scaled = np.isin(np.arange(held.size), group)
    theta = np.where(scaled, scale.factor * held, held)

    # Each value of the group is the factor times that of the fit, and the factor depends on the fit.
    others = np.delete(np.arange(held.size), base)
    by_fit = np.diag(np.where(scaled, scale.factor, 1.0))[:, others]
    by_fit += np.where(scaled, held, 0.0)[:, None] * scale.slopes
    known = estimate.identifiable
    by_fit, own = by_fit[:, known], estimate.precision.covariance[np.ix_(known, known)]
    by_factor = np.where(scaled, held, 0.0)
    covariance = by_fit @ own @ by_fit.T + scale.std**2 * np.outer(by_factor, by_factor)
    identifiable = np.insert(known, base, True)
    covariance[~identifiable], covariance[:, ~identifiable] = np.nan, np.nan

    beside = estimate.std_misspecified
    if beside is not None:
        beside = np.insert(beside, base, 0.0)
        beside = np.where(scaled, np.hypot(scale.factor * beside, scale.std * held), beside)
    precision = replace(
        estimate.precision,
        covariance=covariance,
        identifiable=identifiable,
        information=np.append(estimate.precision.information, 1.0),
        equivalent_variance=_with_gap(estimate.precision.equivalent_variance, base),
    )
    return replace(
        estimate,
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        std_misspecified=beside,
        details={**estimate.details, SCALE: {"from": "effort", "relative_std": scale.std / scale.factor}},
    )


def free_precision(old: Precision, machine: Machine, group: tuple[int, ...], base: int) -> Precision:
    """Return a precision with one unknown held as one in which the scale of a group is free."""
    covariance = np.insert(np.insert(old.covariance, base, np.nan, axis=0), base, np.nan, axis=1)
    identifiable = np.insert(old.identifiable, base, False)
    for k in group:
        identifiable[k] = False
        covariance[k], covariance[:, k] = np.nan, np.nan
    # Relative to their values all of the group move by the same part.
    weight = 1 / np.sqrt(len(group))
    combination = {machine.parameters.free[k].name: weight for k in group}
    return replace(
        old,
        covariance=covariance,
        identifiable=identifiable,
        unidentifiable=[*old.unidentifiable, combination],
        information=np.append(0.0, old.information),
        equivalent_variance=_with_gap(old.equivalent_variance, base),
    )


def _with_gap(values: np.ndarray | None, base: int) -> np.ndarray | None:
    """Return values of all unknowns, with NaN for the one that was held."""
    return None if values is None else np.insert(values, base, np.nan)


def precision_at_guesses(machine: Machine, log: Log) -> Precision:
    """Return the precision that a log without a force allows at best, by its simulated loop at the guesses.

    Args:
        machine: The machine at its guesses.
        log: The log, whose encoders have white noise.
    """
    group = scale_group(machine, log)
    base = base_of(machine, group) if group else None
    fitted = machine if base is None else without(machine, base)
    jacobian = position_jacobian(fitted, log, choose_numerics(fitted, log))
    noise = np.random.default_rng(0).standard_normal(log.filled.shape) * position_noise(machine, log)
    guess = fitted.parameters.guess
    precision = assess(
        fitted.parameters.names,
        jacobian,
        noise,
        np.broadcast_to(np.array(log.measured), noise.shape),
        float(np.linalg.norm(log.filled - log.filled.mean(axis=0))),
        np.where(guess != 0, guess, 1.0),
    )
    return precision if base is None else free_precision(precision, machine, group, base)
