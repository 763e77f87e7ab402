"""Shapes of effects: a velocity, a lag, a period, which do not enter the balance linearly."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.estimate import Estimate
from jaxid.machine import Machine
from jaxid.model.effect import carries_force
from jaxid.model.parameter import parameters_of

# Factors of a shape in the starts that differ by it.
_FACTORS = (0.3, 3.0)
# Changes of the guess of a phase for additional starts [rad].
_THIRDS = (2 * np.pi / 3, 4 * np.pi / 3)
# Numbers of turns over the stroke by which a ripple is changed for additional starts.
_TURNS = (1, 2, 3)
# Dimensions of parameters of which such factors are no sizes.
_NO_SIZES = ("1", "angle")


def shapes(machine: Machine) -> Bool[np.ndarray, " p"]:
    """Return the mask of the unknowns that are a shape of an effect."""
    found = []
    for free in machine.parameters.free:
        number = free.effect
        if number is None:
            found.append(False)
            continue
        info = parameters_of(type(machine.plant.effects[number]))[str(free.path[-1])]
        found.append(not carries_force(info) and info.dimension not in _NO_SIZES)

    return np.asarray(found, dtype=bool)


def other_starts(
    machine: Machine, theta: Float[np.ndarray, " p"], position: Float[np.ndarray, "time n"]
) -> list[np.ndarray]:
    """Return the starts beside one of a fit that has several optima: by phase, by turns and by shape.

    Args:
        machine: The machine.
        theta: Values of the unknowns at the one start, (p,).
        position: Positions of the joints, (time, n) [m or rad].
    """
    return [
        *phase_starts(machine, theta),
        *turn_starts(machine, theta, position),
        *shape_starts(machine, theta),
    ]


def shape_starts(machine: Machine, theta: Float[np.ndarray, " p"]) -> list[np.ndarray]:
    """Return a start with each shape smaller, and one with it larger.

    Linear unknowns are solved in one step from any start. But if a shape starts far off, the strength of its
    effect may fall to zero, and the shape then has no slope.
    """
    out: list[np.ndarray] = []
    for k in np.flatnonzero(shapes(machine) & (theta > 0)):
        out += [np.where(np.arange(len(theta)) == k, factor * theta, theta) for factor in _FACTORS]
    return out


def phase_starts(machine: Machine, theta: Float[np.ndarray, " p"]) -> list[np.ndarray]:
    """Return starts with each phase moved by a third and by two thirds of a turn.

    Along many periods the cost has a narrow valley around the true one. A start at that period whose phase is
    wrong by more than a quarter turn lowers the amplitude first, and then leaves the valley.
    """
    out: list[np.ndarray] = []
    for k, f in enumerate(machine.parameters.free):
        if f.effect is None:
            continue
        info = parameters_of(type(machine.plant.effects[f.effect]))[str(f.path[-1])]
        if info.dimension == "angle":
            out += [np.where(np.arange(len(theta)) == k, theta + turn, theta) for turn in _THIRDS]
    return out


def turn_starts(
    machine: Machine, theta: Float[np.ndarray, " p"], position: Float[np.ndarray, "time n"]
) -> list[np.ndarray]:
    """Return starts with a few turns more or less of each ripple over the stroke of its joint.

    A joint is slow where it turns back, at the ends of its stroke, and the ripple of a fast motion lies
    beyond the band of the filter. A ripple with a turn too many over the stroke is then right at both ends,
    and nearly as good.

    Args:
        machine: The machine.
        theta: Values of the unknowns, (p,).
        position: Positions of the joints, (time, n) [m or rad].
    """
    free, out = machine.parameters.free, []
    low, stroke = np.min(position, axis=0), np.ptp(position, axis=0)
    for period, phase in _ripples(machine):
        effect = free[period].effect
        assert effect is not None, "a ripple is an effect"
        joint = int(machine.plant.effects[effect].port)
        if joint >= len(stroke) or not (stroke[joint] > 0 and theta[period] > 0):
            continue
        turns = stroke[joint] / theta[period]
        for more in (m for k in _TURNS for m in (k, -k) if turns + m > 1):
            at = theta.copy()
            at[period] = stroke[joint] / (turns + more)
            at[phase] += 2 * np.pi * low[joint] * (1 / theta[period] - 1 / at[period])
            out.append(at)
    return out


def _ripples(machine: Machine) -> list[tuple[int, int]]:
    """Return the indices of period and phase of each effect in which both are unknown."""
    of_effect: dict[int, dict[str, int]] = {}
    for k, (f, shape) in enumerate(zip(machine.parameters.free, shapes(machine), strict=True)):
        if f.effect is None:
            continue
        info = parameters_of(type(machine.plant.effects[f.effect]))[str(f.path[-1])]
        if info.dimension == "angle" or (shape and info.dimension == "position"):
            of_effect.setdefault(f.effect, {})[info.dimension] = k
    return [(e["position"], e["angle"]) for e in of_effect.values() if len(e) == 2]


def without_unseen_shapes(estimate: Estimate) -> Estimate:
    """Return the estimate with the unknowns of an effect not identifiable if its shape is not.

    A shape that the log does not show ends anywhere. The standard deviation of the strength then holds for
    that value of the shape only. So it does where the deviation of a positive shape is as large as its value.
    """
    free, identifiable = estimate.machine.parameters.free, estimate.identifiable
    shape = shapes(estimate.machine)
    if not shape.any():
        return estimate

    # Behind a spring a small clearance is as good as none.
    springs = [f.effect is not None and estimate.machine.plant.effects[f.effect].adds_spring for f in free]
    vague = shape & identifiable & np.asarray([f.sign == "positive" for f in free]) & ~np.asarray(springs)
    vague &= ~(np.nan_to_num(estimate.std) < np.abs(estimate.theta))
    unseen = {f.effect for f, b in zip(free, vague | (shape & ~identifiable), strict=True) if b}
    # A shape without a strength, as the time constant of a lag, needs no other value.
    unseen &= {f.effect for f, s, ok in zip(free, shape, identifiable, strict=True) if ok and not s}
    depends = np.asarray(
        [
            ok and f.effect in unseen and (v or not s)
            for f, s, v, ok in zip(free, shape, vague, identifiable, strict=True)
        ]
    )
    if not depends.any():
        return estimate

    precision = estimate.precision
    covariance = precision.covariance.copy()
    covariance[depends], covariance[:, depends] = np.nan, np.nan
    names = [f.name for f, d in zip(free, depends, strict=True) if d]
    precision = replace(
        precision,
        covariance=covariance,
        identifiable=identifiable & ~depends,
        unidentifiable=[*precision.unidentifiable, *({name: 1.0} for name in names)],
    )
    how = "which the log does not show"
    if vague[depends].any():
        how = "whose standard deviation is as large as the shape"
    note = f"{', '.join(names)}: not identifiable without the shape of the effect, {how}"
    return replace(estimate, precision=precision, notes=(*estimate.notes, note))


def seen_shapes(
    steps: Generator[Any, Any, Estimate], guess: Float[np.ndarray, " p"]
) -> Generator[Any, Any, Estimate]:
    """Run the steps of a fit; apply `without_unseen_shapes` and `within_a_turn` to its estimate."""
    return within_a_turn(without_unseen_shapes((yield from steps)), guess)


def within_a_turn(estimate: Estimate, guess: Float[np.ndarray, " p"]) -> Estimate:
    """Take whole turns off the phases of an estimate, so that each is within half a turn of its guess.

    A ripple is the same after a turn of its phase. A step of a fit may go over many of them.

    Args:
        estimate: The estimate.
        guess: Guesses of the case, (p,).
    """
    machine, theta = estimate.machine, estimate.theta.copy()
    for k, free in enumerate(machine.parameters.free):
        if free.effect is None or not np.isfinite(theta[k]):
            continue
        info = parameters_of(type(machine.plant.effects[free.effect]))[str(free.path[-1])]
        turns = np.round((theta[k] - guess[k]) / (2 * np.pi))
        moved = theta[k] - 2 * np.pi * turns
        if info.dimension == "angle" and free.lower <= moved <= free.upper:
            theta[k] = moved
    if np.array_equal(theta, estimate.theta, equal_nan=True):
        return estimate
    return replace(estimate, theta=theta, machine=machine.with_estimate(theta))
