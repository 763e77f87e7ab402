"""Sequences of moves from rest to rest: trapezoids of velocity and S-curves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.references.family import Family, Grid, is_number_list, number_list
from jaxid.references.s_curve import MotionBounds, SCurve, plan_s_curve
from jaxid.schema import Key, flag, number

if TYPE_CHECKING:
    from jaxtyping import Float

_NO_TIME = 1e-300


@dataclass(frozen=True)
class Move:
    """A time-optimal move from rest to rest under limits of speed and acceleration: a trapezoid of velocity.

    Times and distance may be JAX's, for positions that can be differentiated in them.

    Attributes:
        distance: Distance of the move, with its sign [position].
        ramp_time: Time from rest to the peak speed [s].
        cruise_time: Time at the peak speed [s].
    """

    distance: float
    ramp_time: float
    cruise_time: float

    @property
    def duration(self) -> float:
        """Length of the move [s]."""
        return 2.0 * self.ramp_time + self.cruise_time

    def position(self, time: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " samples"]:
        """Return the distance covered [position] at instants from the start of the move [s]; rest outside."""
        xp = time.__array_namespace__()
        # A move over zero distance takes no time.
        peak = self.distance / xp.maximum(self.ramp_time + self.cruise_time, _NO_TIME)
        clipped = xp.clip(time, 0.0, self.duration)
        # Later than half time the move is itself, reversed in time and direction.
        early = xp.minimum(clipped, self.duration - clipped)
        covered = peak / xp.maximum(self.ramp_time, _NO_TIME) * xp.minimum(early, self.ramp_time) ** 2 / 2.0
        covered = covered + peak * xp.maximum(early - self.ramp_time, 0.0)
        return xp.where(clipped <= self.duration / 2.0, covered, self.distance - covered)


def plan_move(distance: float, speed: float, acceleration: float, jerk: float = math.inf) -> Move | SCurve:
    """Find the fastest move from rest to rest within limits that are the same in both directions.

    Args:
        distance: Distance of the move, with its sign [position].
        speed: Limit of the speed [position/s].
        acceleration: Limit of the acceleration [position/s^2].
        jerk: Limit of the jerk [position/s^3]; infinite for a trapezoid of velocity.
    """
    if math.isinf(jerk):
        return plan_trapezoid(distance, speed, acceleration)
    curve = plan_s_curve(abs(distance), MotionBounds(speed, acceleration, acceleration, jerk, jerk))
    return curve if distance >= 0 else replace(curve, distance=distance, jerks=-curve.jerks)


def plan_trapezoid(distance: float, speed: Any, acceleration: Any, xp: Any = np) -> Move:
    """Plan a move without a limit of jerk; the limits may be JAX arrays if `xp` is jax.numpy."""
    way = abs(distance)
    ramp_time = xp.minimum(speed / acceleration, xp.sqrt(way / acceleration))
    return Move(distance, ramp_time, xp.maximum(way / speed - ramp_time, 0.0))


def string_moves(
    start: float, targets: list[float], limits: dict[str, float], values: dict[str, Any], grid: Grid
) -> Float[np.ndarray, " samples"]:
    """Visit targets one after the other.

    Args:
        start: Position at time zero [position].
        targets: Positions to visit in turn [position].
        limits: Speed, acceleration and perhaps jerk, for `plan_move`.
        values: Holds `onset` [s] of the first move, `dwell` [s] at each target and `repeat`: whether the
            targets are visited anew until the grid ends, or the last one is held.
        grid: The instants wanted.

    Returns:
        The position at each instant.

    Raises:
        InputError: If the moves are too short for the sampling rate to show.
    """
    time, position = grid.time, np.full(grid.samples, start)
    now, here, turn, round_start = values["onset"], start, 0, values["onset"]
    while now < time[-1] and (values["repeat"] or turn < len(targets)):
        target = targets[turn % len(targets)]
        move = plan_move(target - here, **limits)
        first = int(np.searchsorted(time, now))
        last = int(np.searchsorted(time, now + move.duration, side="right"))
        position[first:last] = here + move.position(time[first:last] - now)
        position[last:] = target
        now, here, turn = now + move.duration + values["dwell"], target, turn + 1
        if turn % len(targets) == 0:
            if now == round_start:
                break  # The joint is already at its only target.
            if now - round_start < 2.0 / grid.rate_hz:
                hint = "move further, more slowly, or raise the sampling rate"
                raise grid.fault("a round of the targets takes less than two samples", hint)
            round_start = now
    return position


def _trapezoid(values: dict[str, Any], grid: Grid) -> np.ndarray:
    limits = {name: values[name] for name in ("speed", "acceleration")}
    return string_moves(values["start"], list(values["targets"]), limits, values, grid)


def _followed(values: Mapping[str, Any], time: Any) -> Any:
    """Sample a trapezoid that visits its targets once: a sum of moves, differentiable in its times."""
    xp, now, here = time.__array_namespace__(), values["onset"], values["start"]
    position = xp.full(time.shape, here)
    for target in values["targets"]:
        if target != here:
            move = plan_trapezoid(target - here, values["speed"], values["acceleration"], xp)
            position = position + move.position(time - now)
            now, here = now + move.duration, target
        now = now + values["dwell"]
    return position


def _point_to_point(values: dict[str, Any], grid: Grid) -> np.ndarray:
    start, end = values["start"], values["end"]
    if start == end:
        raise grid.fault(f"start and end are both {start:g}", "give two different points")
    limits = {name: values[name] for name in ("speed", "acceleration", "jerk")}
    return string_moves(start, [end, start] if values["repeat"] else [end], limits, values, grid)


_START = Key(number(), "position at time zero", unit="position", default=0.0)
_SPEED = Key(number("positive"), "limit of speed", True, "position/s")
_ACCELERATION = Key(number("positive"), "limit of acceleration", True, "position/s^2")
_ONSET = Key(number(), "rest before the first move", unit="s", default=0.0)
_DWELL = Key(number("nonnegative"), "rest at each target", unit="s", default=0.0)

TRAPEZOID = Family(
    kind="trapezoid",
    doc="from target to target with trapezoids of velocity",
    keys={
        "start": _START,
        "targets": Key(number_list(1), "positions to visit in turn", True, "position", single=is_number_list),
        "speed": _SPEED,
        "acceleration": _ACCELERATION,
        "onset": _ONSET,
        "dwell": _DWELL,
        "repeat": Key(flag, "visit the targets anew until the end", default=True),
    },
    sample=_trapezoid,
    unknown=("onset", "speed", "acceleration"),
    follow=_followed,
)
POINT_TO_POINT = Family(
    kind="point_to_point",
    doc="time-optimal moves between two points, limited in jerk (S-curve)",
    keys={
        "start": _START,
        "end": Key(number(), "the other point", True, "position"),
        "speed": _SPEED,
        "acceleration": _ACCELERATION,
        "jerk": Key(number("positive"), "limit of jerk", True, "position/s^3"),
        "onset": _ONSET,
        "dwell": _DWELL,
        "repeat": Key(flag, "go to and fro until the end", default=True),
    },
    sample=_point_to_point,
)
