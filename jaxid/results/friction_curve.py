"""Friction of each joint over its velocity, as the model has it and as the log shows it, with a band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.model.effect import Action, Effect, Signals
from jaxid.results.report.curves import thinned
from jaxid.results.report.data import FrictionView, LogView

if TYPE_CHECKING:
    from jaxid.estimators.estimate import Estimate
    from jaxid.machine import Machine
    from jaxid.model.plant import Plant
    from jaxid.session import Session

# Half the width of a 95 % interval, in standard deviations.
_INTERVAL = 1.96
# Velocities of each direction at which the curve is computed, and the ratio of the largest to the least.
_POINTS, _RANGE = 60, 200.0
# Most samples of the log that are drawn.
_SAMPLES = 1500
# Step of a difference quotient, as a part of the standard deviation.
_STEP = 1e-2


def friction_views(
    session: Session, estimate: Estimate, views: Sequence[LogView], *, incomplete: bool
) -> tuple[FrictionView, ...]:
    """Return the friction curve of every joint that has friction in the model.

    Effects count that depend on the velocity and on nothing else, without memory.

    Args:
        session: Case and logs.
        estimate: The estimate.
        views: The joints of the fitted log as they are drawn.
        incomplete: Whether the model is incomplete, so that the band is that of the values that fit best.
    """
    machine = session.fit.machine(estimate.machine)
    out = []
    for view in views:
        curve = _curve(machine, estimate, view, incomplete)
        out += [] if curve is None else [curve]
    return tuple(out)


def _curve(machine: Machine, estimate: Estimate, view: LogView, incomplete: bool) -> FrictionView | None:
    velocity = view.velocity if len(view.velocity) else _velocities(view)
    fastest = float(np.max(np.abs(velocity), initial=0.0))
    grid = np.geomspace(fastest / _RANGE, fastest, _POINTS) if fastest > 0 else np.zeros(0)
    grid = np.concatenate([-grid[::-1], grid])
    effects = _friction_of(machine.plant, view.joint, grid)
    if not effects:
        return None

    force = _friction(machine.plant, effects, grid)
    half = _half_width(machine, estimate, effects, grid, incomplete)
    some = thinned(len(view.velocity), _SAMPLES)
    at, left = view.velocity[some], view.residual_after
    measured = None if left is None or not len(at) else left[some] + _friction(machine.plant, effects, at)
    return FrictionView(
        name=view.name,
        joint=view.joint,
        velocity=grid,
        force=force,
        low=None if half is None else force - half,
        high=None if half is None else force + half,
        velocity_measured=None if measured is None else at,
        force_measured=measured,
        units=view.units,
    )


def _velocities(view: LogView) -> np.ndarray:
    """Return the velocity of a log without a force, by differences of its position."""
    if view.steady or len(view.time) < 3:
        return np.zeros(0)
    return np.gradient(view.position_measured, view.time)


def _friction_of(plant: Plant, joint: int, velocity: np.ndarray) -> list[int]:
    """Return the numbers of the effects at a joint that are friction: a force that depends on velocity."""
    if not velocity.size:
        return []
    out = []
    for k, effect in enumerate(plant.effects):
        if effect.port != joint or effect.in_drive or effect.initial_state(np.zeros(())) is not None:
            continue
        force = _friction_by(plant, effect, velocity)
        if np.all(np.isfinite(force)) and np.ptp(force) > 0:
            out.append(k)
    return out


def _friction(plant: Plant, effects: Sequence[int], velocity: np.ndarray) -> np.ndarray:
    """Return the force against the motion, summed over some effects [N or N m]."""
    return sum((_friction_by(plant, plant.effects[k], velocity) for k in effects), np.zeros_like(velocity))


def _friction_by(plant: Plant, effect: Effect, velocity: np.ndarray) -> np.ndarray:
    """Return the force of one effect against the motion at rest's position, without acceleration or drive."""
    zero, none = np.zeros_like(velocity), np.zeros(plant.joints)
    normal = float(np.ravel(np.asarray(plant.port_normal(none)))[effect.port])
    signals = Signals(
        y=zero,
        yd=velocity,
        ydd=zero,
        u=zero,
        t=zero,
        # The smoothed sign of these speeds is exact.
        width=np.asarray(1e-9 * float(np.max(np.abs(velocity), initial=1.0))),
        dry_scale=np.ones(()),
        gravity=np.zeros(()),
        normal=np.asarray(normal),
        stiffness=np.zeros(()),
        damping=np.zeros(()),
    )
    action: Action = effect.act(signals, None)
    dry, force = (np.broadcast_to(np.asarray(x, float), velocity.shape) for x in (action.dry, action.force))
    return dry * np.sign(velocity) - force


def _half_width(
    machine: Machine,
    estimate: Estimate,
    effects: Sequence[int],
    velocity: Float[np.ndarray, " k"],
    incomplete: bool,
) -> Float[np.ndarray, " k"] | None:
    """Return half the width of the 95 % band, to first order in the parameters; None if it is not known.

    For an incomplete model the deviations are those of the values that fit best, and the correlations those
    of the covariance.
    """
    free, theta = estimate.machine.parameters.free, np.asarray(estimate.theta, float)
    used = [k for k, f in enumerate(free) if f.effect in effects]
    if not used:
        return None
    std = np.asarray(estimate.std, float)
    if any(free[k].log is not None for k in used) or not np.all(np.isfinite(std[used])):
        return None
    slopes = []
    for k in used:
        step = np.zeros_like(theta)
        step[k] = _STEP * std[k]
        ends = [
            _friction(estimate.machine.parameters.insert(machine.plant, theta + s * step), effects, velocity)
            for s in (1.0, -1.0)
        ]
        slopes.append((ends[0] - ends[1]) / (2 * step[k]))
    jacobian = np.stack(slopes, axis=1)
    covariance = np.array(estimate.precision.covariance)[np.ix_(used, used)]
    beside: Any = estimate.std_misspecified if incomplete else None
    if beside is not None and np.all(np.isfinite(np.asarray(beside)[used])):
        scale = np.asarray(beside)[used] / std[used]
        covariance = covariance * np.outer(scale, scale)
    variance = np.einsum("ki,ij,kj->k", jacobian, covariance, jacobian)
    return _INTERVAL * np.sqrt(np.maximum(variance, 0.0))
