"""Rough values of inertia, friction, weight and spring of one joint, by least squares along a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from jaxid.logs.rough_inertia import Signal, smooth, windows

# Part of the force that the plain model leaves, from which a weight or a spring is tried; the part of it that
# one of them may leave at most.
_INCOMPLETE, _TAKEN = 0.1, 0.6
# Part of the best window's explanation that another one must have; two windows agree within the second.
_NEARLY, _AGREE = 0.98, 1.25
# Part of the force's deviation beyond which an offset counts.
_OFFSET = 0.5
# Velocity below which a sample counts as at rest, over the largest one; and the part of the samples that must
# move the other way for dry friction and an offset to be two things.
_REST, _REVERSED = 0.02, 0.02
# Deviation of a force over its mean below which it is one level, whose motion shows the rest.
_LEVEL = 0.05
# Part of a force's variance that a balance of forces with a direction must explain, and the part that it may
# leave of what a balance of magnitudes leaves.
_DIRECTED, _CLEARLY_LESS = 0.9, 0.25
# Part of a force that dry friction is taken to be if the motion does not reverse.
_DRY = 0.05


@dataclass(frozen=True)
class RoughBalance:
    """Least-squares values of a joint's force: inertia, friction and what depends on the position.

    Attributes:
        inertia: Coefficient of the acceleration.
        viscous, coulomb: Coefficients of the velocity and of its sign.
        offset: Constant force.
        weight: Coefficients of sin q and cos q [force]; None: not taken.
        spring: Coefficient of the position; None: not taken.
        explained: Part of the force's variance that this explains.
        speed: RMS velocity.
        force: Standard deviation of the force.
    """

    inertia: float
    viscous: float
    coulomb: float
    offset: float
    weight: tuple[float, float] | None = None
    spring: float | None = None
    explained: float = 0.0
    speed: float = field(default=0.0, kw_only=True)
    force: float = field(default=0.0, kw_only=True)

    @property
    def braked(self) -> bool:
        """True if the force as logged brakes its motion: inertia and friction come out negative together."""
        return self.explained > 0.8 and self.inertia < 0 and self.viscous + self.coulomb < 0

    @property
    def has_offset(self) -> bool:
        """True if a constant force is a large part of the force."""
        return abs(self.offset) > _OFFSET * self.force


def rough_balance(
    force: Signal,
    motion: Signal,
    period: float,
    *,
    rotary: bool,
    of_velocity: bool = False,
    others: Sequence[Signal] = (),
) -> RoughBalance:
    """Estimate a joint's balance roughly, without knowledge of the machine.

    Force and motion pass through the same running means. Of their windows the first one is taken whose
    inertia the next confirms, among those that explain the force nearly best.

    Args:
        force: Force at the load, or the logged command.
        motion: Position [m or rad], or velocity.
        period: Sampling period [s].
        rotary: Whether a weight turns with the joint.
        of_velocity: Whether `motion` is a velocity.
        others: Positions of other joints, whose sines and cosines may be in the force as weights.
    """
    if of_velocity:
        velocity, acceleration = motion[1:-1], (motion[2:] - motion[:-2]) / (2.0 * period)
        position = np.zeros_like(velocity)
    else:
        velocity = (motion[2:] - motion[:-2]) / (2.0 * period)
        acceleration = (motion[2:] - 2.0 * motion[1:-1] + motion[:-2]) / period**2
        position = motion[1:-1]
    if force.std() < _LEVEL * abs(force.mean()):
        return _of_level(
            float(force.mean()), acceleration, velocity, position, rotary=rotary and not of_velocity
        )
    found = []
    for window in windows(velocity.size):
        signals = (force[1:-1], acceleration, velocity, position, *(other[1:-1] for other in others))
        f, a, v, q, *x = (smooth(s, window) for s in signals)
        if f.size > 20 and f.std() > 0 and v.std() > 0:
            # At rest dry friction holds any force.
            moves = _signs(v) != 0
            f, a, v, q, *x = (s[moves] for s in (f, a, v, q, *x))
            weights = [w for y in x for w in (np.sin(y), np.cos(y))]
            if f.size > 20 and f.std() > 0:
                found.append(_one(f, a, v, None if of_velocity else q, rotary, weights))
    if not found:
        return RoughBalance(0.0, 0.0, 0.0, 0.0)
    best = max(r.explained for r in found)
    good = [r for r in found if r.explained >= _NEARLY * best] if best > 0 else found
    for one, other in zip(good, good[1:], strict=False):
        if one.inertia * other.inertia > 0 and 1 / _AGREE < one.inertia / other.inertia < _AGREE:
            return other
    return max(found, key=lambda r: r.explained)


def has_direction(force: Signal, position: Signal) -> bool:
    """Check whether a column that is never negative pushes in one direction, and is no magnitude.

    Inertia and friction act along the motion. In a force that always holds a weight they change their sign
    with the motion; in a magnitude they do not. Both are tried beside a weight, which is a parabola of the
    position here, and of all running means the one that explains most decides.
    """
    velocity = (position[2:] - position[:-2]) / 2.0
    acceleration = position[2:] - 2.0 * position[1:-1] + position[:-2]
    best, magnitude = 0.0, 0.0
    for window in windows(velocity.size):
        f, a, v, q = (smooth(s, window) for s in (force[1:-1], acceleration, velocity, position[1:-1]))
        moves = _signs(v) != 0
        f, a, v, q = (s[moves] for s in (f, a, v, q))
        if f.size <= 20 or f.std() == 0 or not _reverses(v):
            continue
        sign, weight = np.sign(v), [np.ones_like(f), q, q**2]
        _, left = _solve([a, v, sign, *weight], f)
        _, left_of_magnitude = _solve([a * sign, np.abs(v), *weight], f)
        explained = 1.0 - left / float(np.var(f))
        if explained > best:
            best, magnitude = explained, 1.0 - left_of_magnitude / float(np.var(f))
    return best > _DIRECTED and 1.0 - best < _CLEARLY_LESS * (1.0 - magnitude)


def _one(
    f: Signal, a: Signal, v: Signal, q: Signal | None, rotary: bool, weights: Sequence[Signal]
) -> RoughBalance:
    """Fit the plain balance, and with a weight or a spring if that leaves clearly less."""
    sign = _signs(v)
    # Without a reversal an offset looks like dry friction.
    offset = np.ones_like(f) if _reverses(v) else np.zeros_like(f)
    plain = [a, v, sign, offset, *weights]
    theta, left = _solve(plain, f)
    total = float(np.var(f)) or 1.0
    speed, size = float(np.sqrt(np.mean(v**2))), float(f.std())
    weight = spring = None
    if q is not None and not weights and left > _INCOMPLETE**2 * total:
        options = [("spring", [*plain, q])]
        if rotary:
            options = [("weight", [*plain, np.sin(q), np.cos(q)]), *options]
        tried = [(kind, *_solve(columns, f)) for kind, columns in options]
        kind, values, after = min(tried, key=lambda t: t[2] * (0.9 if t[0] == "weight" else 1.0))
        pulls = kind == "weight" or values[4] * values[0] > 0
        if after < _TAKEN**2 * left and pulls:
            theta, left = values, after
            weight = (float(values[4]), float(values[5])) if kind == "weight" else None
            spring = float(values[4]) if kind == "spring" else None
    inertia, viscous, coulomb, offset = (float(x) for x in theta[:4])
    explained = 1.0 - left / total
    return RoughBalance(inertia, viscous, coulomb, offset, weight, spring, explained, speed=speed, force=size)


def _signs(v: Signal) -> Signal:
    return np.where(np.abs(v) < _REST * np.abs(v).max(), 0.0, np.sign(v))


def _reverses(v: Signal) -> bool:
    """Check whether a joint moves both ways."""
    signs = _signs(v)
    moving = max(np.count_nonzero(signs), 1)
    return bool(min(np.sum(signs > 0), np.sum(signs < 0)) > _REVERSED * moving)


def _of_level(force: float, a: Signal, v: Signal, q: Signal, *, rotary: bool) -> RoughBalance:
    """Return the balance under a force of one level, by least squares on the acceleration that it leaves."""
    best = RoughBalance(0.0, 0.0, 0.0, 0.0)
    both = _reverses(v)
    turns = both and rotary
    for window in windows(v.size):
        x, y, z = (smooth(s, window) for s in (a, v, q))
        if x.size < 20 or x.std() == 0:
            continue
        columns = [np.full_like(x, force), y]
        columns += [_signs(y)] if both else []
        # The zero is taken to be where a weight hangs: its cosine looks like the force.
        columns += [np.sin(z)] if turns else []
        theta, left = _solve(columns, x)
        explained = 1.0 - left / float(np.var(x))
        if theta[0] == 0 or explained <= best.explained:
            continue
        inertia = 1.0 / float(theta[0])
        inertia, dry = (inertia, -float(theta[2]) * inertia) if both else (inertia * (1 - _DRY), _DRY * force)
        weight = (-float(theta[3]) * inertia, 0.0) if turns else None
        best = RoughBalance(
            inertia,
            -float(theta[1]) * inertia,
            abs(dry),
            0.0,
            weight,
            None,
            explained,
            speed=float(np.sqrt(np.mean(y**2))),
            force=abs(force),
        )
    return best


def _solve(columns: Sequence[Signal], f: Signal) -> tuple[Float[np.ndarray, " columns"], float]:
    """Return coefficients and the mean square that they leave."""
    matrix = np.stack(columns, axis=1)
    scale = np.sqrt(np.mean(matrix**2, axis=0))
    scale[scale == 0] = 1.0
    theta = np.linalg.lstsq(matrix / scale, f, rcond=1e-8)[0]
    left = f - (matrix / scale) @ theta
    return theta / scale, float(np.mean(left**2))


@dataclass(frozen=True)
class FreeSwing:
    """Rough values of a swing without a drive, over its largest weight m g c.

    Attributes:
        inertia: Inertia over m g c [s^2/rad^2 per N m].
        viscous, coulomb: Friction over m g c.
        rest: Position at which it hangs [rad].
        explained: Part of the acceleration's variance that this explains.
    """

    inertia: float
    viscous: float
    coulomb: float
    rest: float
    explained: float


def free_swing(position: Signal, period: float) -> FreeSwing | None:
    """Estimate a pendulum's free swing: a = -(s sin q - c cos q) - d v - e sign v.

    Returns:
        Values over the weight; None if the log is no swing about a point of rest.
    """
    velocity = (position[2:] - position[:-2]) / (2.0 * period)
    acceleration = (position[2:] - 2.0 * position[1:-1] + position[:-2]) / period**2
    best: FreeSwing | None = None
    for window in windows(velocity.size):
        a, v, q = (smooth(s, window) for s in (acceleration, velocity, position[1:-1]))
        if a.size < 20 or a.std() == 0:
            continue
        if not _reverses(v):
            return None
        moves = np.abs(v) > _REST * np.abs(v).max()
        columns = [x[moves] for x in (np.sin(q), np.cos(q), v, np.sign(v))]
        theta, left = _solve(columns, a[moves])
        stiff = float(np.hypot(theta[0], theta[1]))
        explained = 1.0 - left / float(np.var(a[moves]))
        if best is None or explained > best.explained:
            rest = float(np.arctan2(theta[1], -theta[0]))
            best = FreeSwing(1 / stiff, -theta[2] / stiff, -theta[3] / stiff, rest, explained)
    return best if best is not None and best.explained > 0.5 else None
