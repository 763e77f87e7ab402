"""Polynomials in Bernstein form over one stretch of time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.references.family import Family, Grid, is_number_list, number_list
from jaxid.schema import Key, flag, number

if TYPE_CHECKING:
    from jaxtyping import Float

# Two points stand for a move from rest to rest: five control points at the start and six at the
# end, which is z^5 (252 - 1050 z + 1800 z^2 - 1575 z^3 + 700 z^4 - 126 z^5), the profile of
# flatness-based control: derivatives up to the fourth vanish at the start, the fifth at the end.
_AT_START, _AT_END = 5, 6


def bezier_curve(
    points: Float[np.ndarray, " points"], z: Float[np.ndarray, " samples"]
) -> Float[np.ndarray, " samples"]:
    """Evaluate a Bezier curve by de Casteljau's scheme, which stays accurate at any order.

    Args:
        points: Control points, one more than the order [position].
        z: Normalised time from 0 to 1.

    Returns:
        The curve [position].
    """
    levels = [np.full_like(z, point) for point in points]
    while len(levels) > 1:
        levels = [(1.0 - z) * one + z * other for one, other in zip(levels[:-1], levels[1:], strict=True)]
    return levels[0]


def rest_to_rest(start: float, end: float) -> Float[np.ndarray, " points"]:
    """Return the control points of a move from rest to rest."""
    return np.repeat([start, end], [_AT_START, _AT_END])


def _sample(values: dict[str, Any], grid: Grid) -> np.ndarray:
    points = values["points"]
    if len(points) == 2:
        points = rest_to_rest(*points)
    rest = grid.duration - values["start_time"]
    if rest <= 0:
        hint = f"start before {grid.duration:g} s"
        raise grid.fault(f"start_time = {values['start_time']:g} s is past the end", hint)
    duration = values["duration"] or rest
    z = (grid.time - values["start_time"]) / duration
    if values["repeat"]:
        # The return move is the same curve, backwards in time.
        z = np.where(z > 0, 1.0 - np.abs(1.0 - np.mod(z, 2.0)), 0.0)
    return bezier_curve(points, np.clip(z, 0.0, 1.0))


BEZIER = Family(
    kind="bezier",
    doc="a Bezier polynomial; between two points a move from rest to rest",
    keys={
        "points": Key(
            number_list(2), "control points, the order plus one", True, "position", single=is_number_list
        ),
        "duration": Key(number("positive"), "duration of the curve", unit="s", note="to the end"),
        "start_time": Key(number("nonnegative"), "rest before it", unit="s", default=0.0),
        "repeat": Key(flag, "run it to and fro until the end", default=False),
    },
    sample=_sample,
)
