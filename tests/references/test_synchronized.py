"""Motions of all joints together: bounds kept and used, least time against linear programs, targets drawn."""

import numpy as np
import pytest
import scipy.interpolate
import scipy.optimize
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxid.commands.simulate import simulate
from jaxid.errors import InputError
from jaxid.references import make_reference
from jaxid.references.s_curve import MotionBounds, plan_s_curve
from jaxid.references.synchronized import plan_line
from truth.arm.two_links_case import written

RATE = 4000.0
# Table 3 of the five-bar's paper, in degrees: 210/s, 1680/s^2, 25200/s^3, lower bounds negative.
TABLE_3 = {k: float(np.deg2rad(v)) for k, v in {"velocity": 210, "acceleration": 1680, "jerk": 25200}.items()}
SQUARE = [[0.0, 0.0], [1.0, 0.0], [1.0, 0.5], [0.0, 0.5]]
RANDOM = {"kind": "synchronized", "polygon": SQUARE, **TABLE_3}
POINTS = {"kind": "synchronized", "points": [[1.0, 0.2], [0.0, 0.0]], **TABLE_3}


def furthest(duration, velocity, acceleration, jerk, way, pieces=120):
    """Largest part of a way that any jerk, constant over so many pieces, covers from rest to rest."""
    h = duration / pieces
    k = np.arange(1, pieces + 1)[:, None]
    later = k - np.arange(1, pieces + 1)[None]
    past = later >= 0
    a = h * past
    v = h**2 * np.where(past, later + 0.5, 0.0)
    s = h**3 * np.where(past, later**2 / 2 + later / 2 + 1 / 6, 0.0)[-1]
    rows, limits = [], []
    for w, vb, ab in zip(way, velocity, acceleration, strict=True):
        for matrix, bound in ((v, vb), (a, ab)):
            rows += [w * matrix, -w * matrix]
            limits += [np.full(pieces, bound[1]), np.full(pieces, -bound[0])]
    j = np.array([sorted(np.array(b) / w) for w, b in zip(way, jerk, strict=True)])
    found = scipy.optimize.linprog(
        -s,
        np.vstack(rows),
        np.concatenate(limits),
        np.stack([a[-1], v[-1]]),
        [0.0, 0.0],
        bounds=(j[:, 0].max(), j[:, 1].min()),
        method="highs",
    )
    assert found.status == 0
    return -found.fun


def random_bounds(rng, low, high, joints):
    return np.stack([-rng.uniform(low, high, joints), rng.uniform(low, high, joints)], axis=1)


@pytest.mark.parametrize("seed", range(8))
def test_least_time_against_a_linear_program(seed):
    """Lines of two joints under bounds of unlike signs: 1 % less time, and no jerk covers the way."""
    rng = np.random.default_rng(seed)
    bounds = [random_bounds(rng, *size, 2) for size in ((0.5, 3.0), (2.0, 20.0), (20.0, 200.0))]
    way = rng.choice([-1, 1], 2) * 10 ** rng.uniform(-2, 0.7, 2)
    curve = plan_line(way, *bounds)
    assert furthest(0.99 * curve.duration, *bounds, way) < 1.0
    # Pieces of a given length do not meet the switches: a percent of time for that.
    assert furthest(1.01 * curve.duration, *bounds, way) > 1.0


def test_every_case_of_the_limits_is_met():
    """Whether the limits of velocity, and of acceleration both ways, are reached: all that can be."""
    bounds, met = MotionBounds(2.0, 3.0, 7.0, 60.0, 40.0), set()
    for distance in np.geomspace(1e-4, 10.0, 200):
        t = plan_s_curve(distance, bounds).durations
        met.add((t[3] > 0, t[1] > 1e-12, t[5] > 1e-12))
    assert met == {(False, False, False), (False, True, False), (False, True, True), (True, True, True)}
    slow = plan_s_curve(1.0, bounds._replace(speed=0.05)).durations
    assert slow[3] > 0
    assert slow[1] == slow[5] == 0


positive = st.floats(0.05, 20.0)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    distance=st.floats(1e-4, 20.0),
    speed=positive,
    gain=positive,
    loss=positive,
    rise=st.floats(0.5, 1e3),
    fall=st.floats(0.5, 1e3),
)
def test_curves_keep_their_limits_and_arrive(distance, speed, gain, loss, rise, fall):
    bounds = MotionBounds(speed, gain, loss, rise, fall)
    curve = plan_s_curve(distance, bounds)
    v = a = s = 0.0
    for h, j in zip(curve.durations, curve.jerks, strict=True):
        assert h >= 0
        s, v, a = s + h * (v + h * (a / 2 + h * j / 6)), v + h * (a + h * j / 2), a + h * j
        assert -loss * (1 + 1e-9) <= a <= gain * (1 + 1e-9)
        assert -1e-9 * speed <= v <= speed * (1 + 1e-9)
    # The last segment's end: rest, at the end of the way.
    assert s == pytest.approx(distance, rel=1e-9)
    assert abs(v) < 1e-7 * speed
    assert abs(a) < 1e-7 * min(gain, loss)
    # And what is sampled is its jerk, integrated three times.
    lasts = curve.durations > 1e-12
    breaks = np.concatenate([[0.0], np.cumsum(curve.durations[lasts])])
    way = scipy.interpolate.PPoly(curve.jerks[lasts][None], breaks).antiderivative(3)
    t = np.linspace(0, breaks[-1], 777)
    np.testing.assert_allclose(curve.position(t), way(t), rtol=1e-8, atol=1e-12 * distance)
    ends = curve.position(np.array([-1.0, curve.duration, 1e3]))
    np.testing.assert_array_equal(ends, [0, distance, distance])


def test_joints_go_straight_start_and_end_together():
    q = make_reference({**POINTS, "dwell": 0.1, "repeat": False}, RATE, 2.0)
    assert q.shape == (8000, 2)
    np.testing.assert_allclose(q[:, 1], 0.2 * q[:, 0], atol=1e-15)
    # Joint 1 alone sets the time: 1 rad at 210 deg/s, 1680 deg/s^2, 25200 deg/s^3.
    way = plan_s_curve(
        1.0, MotionBounds(*(TABLE_3[k] for k in ("velocity", *["acceleration"] * 2, *["jerk"] * 2)))
    )
    end = way.duration * RATE
    assert q[int(end), 0] < 1.0 == q[int(end) + 1, 0]
    leaves = int((way.duration + 0.1) * RATE)
    np.testing.assert_array_equal(q[int(end) + 1 : leaves, 0], 1.0)
    assert q[leaves + 3, 0] < 1.0
    np.testing.assert_array_equal(q[-10:], 0.0)
    again = make_reference({**POINTS, "dwell": 0.1}, RATE, 2.0)
    np.testing.assert_array_equal(again[:leaves], q[:leaves])
    assert np.ptp(again[4000:]) > 0.1


def test_each_joint_has_its_own_bounds_by_sign():
    bounds = {"velocity": [[-0.2, 3.0], 3.0], "acceleration": [[-5.0, 9.0], [-8.0, 8.0]], "jerk": 200.0}
    q = make_reference({**POINTS, **bounds}, RATE, 20.0)
    v = np.diff(q, axis=0) * RATE
    assert v[:, 0].min() == pytest.approx(-0.2, rel=1e-6)
    assert 1.0 < v[:, 0].max() <= 3.0
    a = np.diff(q, 2, axis=0) * RATE**2
    assert a[:, 0].min() >= -5.0 - 1e-6
    assert a[:, 0].max() <= 9.0 + 1e-6
    # Two joints, each with one number for both signs.
    q = make_reference({**POINTS, "velocity": [0.5, 0.01], "acceleration": 5.0, "jerk": 200.0}, RATE, 30.0)
    assert np.abs(np.diff(q, axis=0)).max(axis=0) * RATE == pytest.approx([0.05, 0.01], rel=1e-6)


def visited(table, duration=200.0):
    """Return the targets of a reference, at which it rests."""
    q = make_reference({**table, "dwell": 0.05}, 500.0, duration)
    still = np.all(np.diff(q, axis=0) == 0, axis=1)
    return q[1:][still & ~np.roll(still, 1)][1:]


def test_targets_are_uniform_in_the_polygon_and_repeat_by_seed():
    targets = visited(RANDOM)
    assert len(targets) > 300
    for column, size in zip(targets.T, (1.0, 0.5), strict=True):
        assert scipy.stats.kstest(column / size, "uniform").pvalue > 0.01
    assert abs(np.corrcoef(targets.T)[0, 1]) < 0.15
    np.testing.assert_array_equal(visited(RANDOM, 20.0), targets[: len(visited(RANDOM, 20.0))])
    assert not np.allclose(visited({**RANDOM, "seed": 1}, 20.0)[0], targets[0])
    # Unlike triangles: the density is that of the area.
    kite = visited({**RANDOM, "polygon": [[0.0, 0.0], [0.1, -0.2], [1.0, 0.0], [0.1, 0.2]]})
    assert np.mean(kite[:, 0] < 0.1) == pytest.approx(0.1, abs=0.05)
    # Where a line of three dimensions, or of one, is the region.
    lone = visited({**RANDOM, "polygon": [[-0.5], [0.5]]}, 100.0)
    assert scipy.stats.kstest(lone[:, 0] + 0.5, "uniform").pvalue > 0.01
    corners = np.vstack([np.zeros(3), np.eye(3)])
    solid = visited({**RANDOM, "polygon": corners.tolist()})
    assert solid.min() >= 0
    assert solid.sum(axis=1).max() <= 1
    np.testing.assert_allclose(solid.mean(axis=0), 0.25, atol=0.03)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"polygon": None}, "polygon = None is not a list of points"),
        ({"polygon": [[0.0, 0.0], [1.0, 0.0]]}, "polygon has 2 corners; give at least 3, for 2 joints"),
        ({"polygon": [[0, 0], [1, 1], [2, 2]]}, "polygon has no area"),
        ({"polygon": [*SQUARE, [0.5, 0.2]]}, "corner 5 of polygon lies within the others"),
        (
            {"polygon": [[0, 0], [1, 1], [2]]},
            "points of different lengths; give each one number a joint",
        ),
        ({"polygon": [[0, "x"]]}, r"polygon\[1\]\[2\] = \"x\" is not a number"),
        ({"points": [[0.0, 1.0]]}, "both points and polygon"),
        ({"points": [[0.0, 1.0, 2.0]]}, "has . joints"),
        ({"coordinates": "tool"}, 'coordinates = "tool" is unknown'),
        ({"coordinates": "task"}, "this plant has no inverse kinematics"),
        ({"velocity": -1.0}, "velocity = -1.0 is not a range about zero; give .lower, upper."),
        ({"velocity": [1.0, 2.0, 3.0]}, "has . joints; .* as in the longest list"),
        ({"jerk": [-1.0, 0.0]}, "jerk = .* is not a range about zero"),
        ({"acceleration": "fast"}, 'acceleration = "fast" is not a range about zero'),
        ({"dwell": -1.0}, "dwell = -1.0 is negative; it must be >= 0"),
        ({"velocity": 1e9, "acceleration": 1e12, "jerk": 1e15}, "less than two samples"),
    ],
)
def test_refuses(change, match):
    with pytest.raises(InputError, match=match) as caught:
        make_reference({**RANDOM, **change}, RATE, 1.0)
    assert "\n" not in str(caught.value)


def test_neither_points_nor_polygon():
    with pytest.raises(InputError, match="neither points nor polygon"):
        make_reference({"kind": "synchronized", **TABLE_3}, RATE, 1.0)
    # Nowhere to go, without a rest: it stands.
    table = {**POINTS, "points": [[0.0, 0.0]]}
    np.testing.assert_array_equal(make_reference(table, RATE, 1.0), 0.0)


def test_what_cannot_be_made_is_told_with_its_file(tmp_path):
    case = written(tmp_path, **{"polygon = [[0.3, 0.2], [1.6, 0.2], [1.6, 1.2], [0.3, 1.2]]\n": ""})
    with pytest.raises(InputError, match=r"case\.toml, \[reference\].*: neither points nor polygon"):
        simulate(case)
