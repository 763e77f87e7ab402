"""The fit of an arm's servos joint by joint, and the joints' estimates as one of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxid.estimators.apart.joint import JointAlone, joints_alone
from jaxid.estimators.apart.start import is_stable, starts_by_balance
from jaxid.estimators.coarse_starts import costs_along
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import position_jacobian
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps, solved_together
from jaxid.numerics.precision import Precision, assess
from jaxid.simulation.replay import Numerics
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import needed_steps

# Part of the cost by which several logs have converged: what servos leave is far more than noise.
TOLERANCE = 1e-7
# Part of the squared residual of the start by balance below which another start is taken.
_CLEARLY = 0.7
# Starts in a compiled call.
_LANES = 8
_NOTE = (
    "each joint is fitted alone, with the links' forces along the measured motion of all joints; "
    "the gap is that of the whole arm in simulation"
)


def apart_steps(
    machine: Machine, parts: Sequence[Part], *, numerics: Numerics | None = None, **options: Any
) -> Steps[Estimate]:
    """Fit the servos of an arm joint by joint.

    Args:
        machine: Machine of all logs, which `jaxid.estimators.apart.joint.stands_apart`.
        parts: The logs.
        numerics: Settings of the integration; None: one step between ticks of the servo, or as many as the
            stiffest joint needs.
        options: Further arguments of `output_error_steps`.
    """
    every = joints_alone(machine, parts)
    moving = [alone for alone in every if alone.moves]
    found = yield from joint_fits(moving, numerics=numerics, **options)
    return of_arm(machine, parts, every, dict(zip([a.joint for a in moving], found, strict=True)))


def joint_fits(
    joints: Sequence[JointAlone],
    *,
    numerics: Numerics | None = None,
    profile: Sequence[str] = (),
    **options: Any,
) -> Steps[list[Estimate]]:
    """Fit joints of an arm, each alone and all at once.

    Args:
        joints: The joints; the reference of each moves.
        numerics, options: See `apart_steps`.
        profile: Names of unknowns of the arm whose profile is computed.
    """
    numerics = numerics or common_numerics(joints)
    fits = [
        output_error_steps(
            alone.machine,
            alone.parts,
            start=_start(alone, numerics),
            numerics=numerics,
            profile=[name for name in profile if name in alone.machine.parameters.names],
            tolerance=TOLERANCE,
            **options,
        )
        for alone in joints
    ]
    return (yield from side_by_side(fits))


def common_numerics(joints: Sequence[JointAlone]) -> Numerics:
    """Return the settings of the integration that serve all joints, so that they share compiled code.

    At the ticks of a servo a step is so short that the error at a reversal is far below a reading's noise.
    """
    steps = [needed_steps(part.machine, part.log) for alone in joints for part in alone.parts]
    return Numerics(substeps=max(steps, default=1))


def side_by_side(many: Sequence[Steps[Any]]) -> Steps[list[Any]]:
    """Run several fits of one run at once, equal requests in one compiled call; return their results."""
    ended: dict[int, Any] = {}
    answers: dict[int, Any] = dict.fromkeys(range(len(many)))
    while len(ended) < len(many):
        asked: dict[int, SolveRequest] = {}
        for k, answer in answers.items():
            try:
                request = many[k].send(answer)
                while not isinstance(request, SolveRequest):
                    request = many[k].send((yield request))
                asked[k] = request
            except StopIteration as end:
                ended[k] = end.value
        solved = yield from solved_together(list(asked.values()))
        answers = dict(zip(asked, solved, strict=True))
    return [ended[k] for k in range(len(many))]


def precision_apart(machine: Machine, parts: Sequence[Part]) -> Precision:
    """Return the precision that logs without a force allow at best, joint by joint, at the guesses.

    Args:
        machine: Machine of all logs at its guesses, which `jaxid.estimators.apart.joint.stands_apart`.
        parts: The logs, whose encoders have white noise.
    """
    every, found = joints_alone(machine, parts), {}
    numerics = common_numerics(every)
    for alone in every:
        jacobian, noise, signal = [], [], 0.0
        for part in alone.parts:
            own = position_jacobian(part.machine, part.log, numerics)
            jacobian.append(part.widened(own, len(alone.index)))
            white = np.random.default_rng(0).standard_normal(part.log.filled.shape)
            noise.append(white * position_noise(part.machine, part.log))
            signal += float(np.sum(np.square(part.log.filled - part.log.filled.mean(axis=0))))
        rows, guess = np.concatenate(noise), alone.machine.parameters.guess
        found[alone.joint] = assess(
            alone.machine.parameters.names,
            np.concatenate(jacobian),
            rows,
            np.ones(rows.shape, bool),
            float(np.sqrt(signal)),
            np.where(guess != 0, guess, 1.0),
        )
    return _precision(machine, every, found)


def _start(alone: JointAlone, numerics: Numerics) -> np.ndarray:
    """Return the start of a joint's fit: that by balance, or one that is clearly better in simulation.

    A model that lacks much leaves about as much at very different gains, and the highest ones only say that a
    joint goes to its command.
    """
    guess, found = alone.machine.parameters.guess, starts_by_balance(alone)
    points = np.stack([guess, *found] if is_stable(alone.machine) or not found else found)
    if len(points) == 1:
        return points[0]
    fastest = max(alone.parts, key=lambda part: float(np.std(np.diff(part.log.filled, axis=0))))
    # A gain that is unknown in another log only stays at its guess here.
    costs = costs_along(fastest, numerics, points, _LANES)
    best, usual = int(np.argmin(costs)), len(points) - len(found)
    return points[best if not costs[best] > _CLEARLY * costs[usual] else usual]


def of_arm(
    machine: Machine, parts: Sequence[Part], every: Sequence[JointAlone], found: dict[int, Estimate]
) -> Estimate:
    """Return the estimates of joints as one of the arm; a joint that was not fitted keeps its guesses.

    Args:
        machine: Machine of all logs.
        parts: The logs.
        every: All joints with unknowns.
        found: Estimates by joint.
    """
    theta, beside = machine.parameters.guess, np.full(len(machine.parameters.free), np.nan)
    rows = sum(part.log.samples for part in parts)
    residual = np.full((rows, machine.plant.joints), np.nan)
    notes, still, failed = [], [], []
    for alone in every:
        name = f"joint {alone.joint + 1}"
        estimate = found.get(alone.joint)
        if estimate is None:
            still.append(name)
            continue
        theta[alone.index] = alone.of_arm(estimate.theta)
        residual[:, alone.joint] = _residual(parts, alone, estimate)
        if estimate.std_misspecified is not None:
            beside[alone.index] = estimate.std_misspecified * alone.slope
        notes += [f"{name}: {note}" for note in estimate.notes[1:]]
        if not estimate.converged:
            failed.append(f"{name}: {estimate.message}")
    first = next(iter(found.values()), None)
    if still:
        notes.append(f"the reference of {', '.join(still)} does not move: the guesses stay")
    profiles = {k: v for e in found.values() for k, v in e.details.get("profiles", {}).items()}
    precision = _precision(machine, every, {joint: e.precision for joint, e in found.items()})
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=bool(found) and not failed,
        message="; ".join(failed) or ("converged" if found else "no joint moves"),
        residual=residual,
        samples=sum(e.samples for e in found.values()),
        steps=max((e.steps for e in found.values()), default=0),
        notes=(_NOTE, *(() if first is None else first.notes[:1]), *notes),
        details={"profiles": profiles} if profiles else {},
        std_misspecified=beside,
    )


def _residual(parts: Sequence[Part], alone: JointAlone, estimate: Estimate) -> np.ndarray:
    """Return the residual of a joint along all logs of its arm; NaN along logs that it does not have."""
    names, ends = [part.name for part in alone.parts], np.cumsum([p.log.samples for p in alone.parts])
    own = dict(zip(names, np.split(estimate.residual[:, 0], ends[:-1]), strict=True))
    return np.concatenate([own.get(p.name, np.full(p.log.samples, np.nan)) for p in parts])


def _precision(machine: Machine, every: Sequence[JointAlone], found: dict[int, Precision]) -> Precision:
    """Return the precision of all unknowns of an arm from those of its joints."""
    p = len(machine.parameters.free)
    covariance, white = np.zeros((p, p)), np.full(p, np.nan)
    identifiable, unidentifiable, information, kinds = np.zeros(p, bool), [], [], []
    for alone in every:
        own = found.get(alone.joint) or Precision.unknown(alone.machine.parameters.names)
        at = np.ix_(alone.index, alone.index)
        covariance[at] = own.covariance * np.outer(alone.slope, alone.slope)
        identifiable[alone.index] = own.identifiable
        unidentifiable += own.unidentifiable
        information.append(own.information)
        kinds.append(own.kind)
        if own.equivalent_variance is not None:
            white[alone.index] = own.equivalent_variance * np.square(alone.slope)
    covariance[~identifiable], covariance[:, ~identifiable] = np.nan, np.nan
    return replace(
        Precision.unknown(machine.parameters.names),
        covariance=covariance,
        identifiable=identifiable,
        unidentifiable=unidentifiable,
        information=np.sort(np.concatenate(information)),
        kind=next((kind for kind in kinds if kind), ""),
        equivalent_variance=white,
    )
