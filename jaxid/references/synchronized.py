"""Motions of all joints together, along straight lines of joint space, as fast as bounds allow.

Along a line every joint moves in proportion to one path parameter, which runs from 0 to 1: all start and end
together. Each bound of that parameter is the tightest of all joints: the joint that is slowest by
velocity, acceleration or jerk is at its bound, and the others move in proportion to their distances. That
is the shortest time along the line, at least that of the slowest joint alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.references.family import Family, Grid, about_zero, for_all_joints, is_about_zero, point_list
from jaxid.references.s_curve import MotionBounds, SCurve, plan_s_curve
from jaxid.schema import Key, choice, flag, number, whole

if TYPE_CHECKING:
    from jaxtyping import Float


def plan_line(
    way: Float[np.ndarray, " n"],
    velocity: Float[np.ndarray, "n 2"],
    acceleration: Float[np.ndarray, "n 2"],
    jerk: Float[np.ndarray, "n 2"],
) -> SCurve:
    """Plan the path parameter, from 0 to 1, of the fastest motion along a straight line.

    Args:
        way: Distance of each joint, with its sign [position].
        velocity, acceleration, jerk: Lowest (negative) and highest of each joint [position/s and so on].
    """
    lowest, highest = zip(*(_tightest(way, b) for b in (velocity, acceleration, jerk)), strict=True)
    return plan_s_curve(1.0, MotionBounds(highest[0], highest[1], lowest[1], highest[2], lowest[2]))


def _tightest(way: np.ndarray, bounds: np.ndarray) -> tuple[float, float]:
    """Return the lowest and highest path parameter that all joints allow."""
    moved = way != 0
    ends = bounds[moved] / way[moved, None]
    return float(-ends.min(axis=1).max()), float(ends.max(axis=1).min())


def _sample(joints: list[dict[str, Any]], grid: Grid) -> Float[np.ndarray, "samples joints"]:
    values, time = joints[0], grid.time
    bounds = [np.stack([j[k] for j in joints]) for k in ("velocity", "acceleration", "jerk")]
    here, now = np.array([j["start"] for j in joints]), values["onset"]
    out = np.full((grid.samples, len(joints)), here)
    still = 0
    for target in _targets(values, grid):
        if now >= time[-1]:
            break
        if np.any(target != here):
            curve = plan_line(target - here, *bounds)
            first, last = np.searchsorted(time, (now, now + curve.duration))
            out[first:last] = here + np.outer(curve.position(time[first:last] - now), target - here)
            out[last:] = target
            if curve.duration + values["dwell"] < 2.0 / grid.rate_hz:
                hint = "move further, more slowly, or raise the sampling rate"
                raise grid.fault("a motion takes less than two samples", hint)
            now, here, still = now + curve.duration, target, 0
        elif values["dwell"] == 0:
            # A round of targets without any distance would never end.
            still += 1
            if values["points"] is not None and still >= len(values["points"]):
                break
        now += values["dwell"]
    return out


def _targets(values: dict[str, Any], grid: Grid) -> Iterator[np.ndarray]:
    """Yield points of joint space, one after the other."""
    points, polygon = values["points"], values["polygon"]
    if (points is None) == (polygon is None):
        what = "neither points nor polygon" if points is None else "both points and polygon"
        raise grid.fault(what, "give points to visit in turn, or the corners of a polygon to draw them from")
    if polygon is not None:
        for drawn in _drawn(polygon, values["seed"], grid):
            yield _at_joints(drawn, values, grid)
    at = [_at_joints(p, values, grid) for p in points]
    yield from at
    while values["repeat"]:
        yield from at


def _drawn(polygon: np.ndarray, seed: int, grid: Grid) -> Iterator[np.ndarray]:
    """Yield random points, uniform in a convex polygon (a polytope for more than two joints), without end."""
    corners = _simplices(polygon, grid)
    sizes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))
    edges, rng = np.cumsum(sizes) / sizes.sum(), np.random.default_rng(seed)
    while True:
        corner = corners[min(int(np.searchsorted(edges, rng.random(), side="right")), len(corners) - 1)]
        # Exponential numbers over their sum are uniform on a simplex.
        weights = rng.exponential(size=len(corner))
        yield weights @ corner / weights.sum()


def _simplices(polygon: np.ndarray, grid: Grid) -> Float[np.ndarray, "k n1 n"]:
    """Split a polygon into triangles, and return their corners."""
    import scipy.spatial  # a third of a second, which no other kind of reference needs

    n = polygon.shape[1]
    if n == 1:
        if len(polygon) != 2 or polygon[0] == polygon[1]:
            raise grid.fault("polygon of one joint is no range", "give its two ends")
        return polygon[None]
    if len(polygon) <= n:
        what = f"polygon has {len(polygon)} corners"
        raise grid.fault(what, f"give at least {n + 1}, for {n} joints")
    try:
        hull = scipy.spatial.ConvexHull(polygon)
        triangles = scipy.spatial.Delaunay(polygon).simplices
    except scipy.spatial.QhullError as error:
        raise grid.fault("polygon has no area", "give corners that do not lie on a line") from error
    inner = sorted(set(range(len(polygon))) - set(hull.vertices.tolist()))
    if inner:
        what = f"corner {inner[0] + 1} of polygon lies within the others, or on an edge"
        raise grid.fault(what, "a straight line between targets must stay inside: give a convex polygon")
    return polygon[triangles]


def _at_joints(point: np.ndarray, values: dict[str, Any], grid: Grid) -> np.ndarray:
    """Return a point in joint space."""
    if values["coordinates"] == "joint":
        return point
    q = None if grid.plant is None else grid.plant.joint_positions(point)
    if q is None:
        kind = "this plant" if grid.plant is None else f"kind = '{grid.plant.kind}'"
        what = f"{kind} has no inverse kinematics"
        raise grid.fault(what, "give points or polygon by joint: coordinates = 'joint'")
    if not np.all(np.isfinite(q)):
        raise grid.fault(f"the tool does not reach {point.tolist()}", "give points within the workspace")
    return np.asarray(q, dtype=float)


def _lowest_and_highest(unit: str) -> Key:
    return Key(about_zero, "lowest and highest, or one number for both", True, unit, single=is_about_zero)


SYNCHRONIZED = Family(
    kind="synchronized",
    doc="time-optimal motions of all joints together along straight lines, limited in jerk",
    keys={
        "start": Key(number(), "position at time zero", unit="position", default=0.0),
        "points": Key(
            point_list(),
            "points to visit in turn, one number a joint",
            unit="position",
            single=for_all_joints,
        ),
        "polygon": Key(
            point_list(),
            "corners of a convex region; targets are drawn from it",
            unit="position",
            single=for_all_joints,
        ),
        "coordinates": Key(
            choice(("joint", "task")),
            "coordinates of points and corners: those of the joints, or of the tool",
            default="joint",
        ),
        "velocity": _lowest_and_highest("position/s"),
        "acceleration": _lowest_and_highest("position/s^2"),
        "jerk": _lowest_and_highest("position/s^3"),
        "onset": Key(number("nonnegative"), "rest before the first motion", unit="s", default=0.0),
        "dwell": Key(number("nonnegative"), "rest at each target", unit="s", default=0.0),
        "seed": Key(whole(0), "seed of the targets", default=0),
        "repeat": Key(flag, "visit the points anew until the end", default=True),
    },
    sample=_sample,
    together=True,
)
