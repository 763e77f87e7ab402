"""First cases of joints whose position does not move as far as its reference."""

import numpy as np
import pytest

import jaxid
from jaxid.logs.rough_inertia import ratio_of_strokes

RATE = 500.0
T = np.arange(0.0, 12.0, 1 / RATE)


def followed(reference):
    """Return the position of a joint that follows with a loop of 4 Hz, and sticks below 1 % of the way."""
    omega, q, v = 2 * np.pi * 4.0, 0.0, 0.0
    out = np.zeros_like(reference)
    level = 0.01 * omega**2 * np.ptp(reference)
    for k, r in enumerate(reference):
        push = omega**2 * (r - q) - 1.4 * omega * v
        sliding = v + push / RATE
        brake = level / RATE
        v = np.sign(sliding) * max(abs(sliding) - brake, 0.0)
        q += v / RATE
        out[k] = q
    return out


def moves():
    """Return a motion of three sines that begins at rest [rad]."""
    ramp = np.minimum(T / 0.5, 1.0)
    return ramp * (0.5 * np.sin(1.9 * T) + 0.3 * np.sin(4.3 * T + 1.0) - 0.3 * np.sin(1.0))


def sine(hertz):
    """Return a motion of one sine [rad]."""
    return 0.5 * np.sin(2 * np.pi * hertz * T)


def steps():
    """Return a motion of steps [rad]."""
    return np.repeat(np.random.default_rng(3).uniform(-0.8, 0.8, 8), T.size // 8)


@pytest.mark.parametrize("reference", [moves(), sine(0.5), steps()], ids=["sines", "sine", "steps"])
def test_a_motor_in_front_of_a_gear_is_brought_to_the_joint_of_its_command(reference):
    joint = followed(reference)
    table = {"t": T, "command": reference, "position": 50.0 * joint}
    case = jaxid.init(table)
    units = case.tables["log"]["units"]
    assert units["reference"] == "rad"
    size, unit = units["position"].split()
    assert unit == "rad"
    assert float(size) == pytest.approx(0.02, rel=0.02)
    assert any("times as far as 'command'" in line for line in case.assumed)
    assert any("the ratio of the gear" in line for line in case.questions)


@pytest.mark.parametrize("factor", [50.0, np.rad2deg(1.0)], ids=["gear", "degrees"])
def test_the_velocity_goes_with_its_position(factor):
    joint = factor * followed(moves())
    table = {"t": T, "command": moves(), "position": joint, "velocity": np.gradient(joint, T)}
    case = jaxid.init(table)
    units = case.tables["log"]["units"]
    assert units["velocity"] == f"{units['position']}/s"
    assert jaxid.check(case.case(), table).warnings == []


def test_beside_a_force_the_reference_is_brought_to_the_position():
    joint = followed(moves())
    table = {"t": T, "command": moves(), "position": 50.0 * joint, "torque": np.sin(T)}
    [(quantity, text)] = jaxid.init(table).tables["log"]["units"].items()
    size, unit = text.split()
    assert (quantity, unit) == ("reference", "rad")
    assert float(size) == pytest.approx(50.0, rel=0.01)


@pytest.mark.parametrize(("counts", "error"), [(4096, 0.0), (10_000, 0.01)])
def test_counts_beside_a_command_give_their_size(counts, error):
    """A power of two is found; friction moves any other number by a part of a percent."""
    joint = followed(moves())
    table = {"t": T, "command [deg]": np.rad2deg(moves()), "position": np.round(joint * counts / (2 * np.pi))}
    log = jaxid.init(table).tables["log"]
    assert log["units"] == {"position": "count", "reference": "deg"}
    assert log["counts_per_revolution"] == pytest.approx(counts, rel=error)


def test_degrees_beside_radians_are_units_and_no_gear():
    table = {"t": T, "command": moves(), "position": np.rad2deg(followed(moves()))}
    case = jaxid.init(table)
    assert case.tables["log"]["units"] == {"position": "deg", "reference": "rad"}


def test_counts_of_a_slide_have_the_size_of_a_length():
    table = {"t": T, "command [mm]": 100 * moves(), "position": np.round(followed(moves()) * 40_960)}
    case = jaxid.init(table)
    assert case.tables["plant"]["motion"] == "linear"
    size, unit = case.tables["log"]["units"]["position"].split()
    assert unit == "m"
    assert float(size) == pytest.approx(0.1 / 40_960, rel=0.01)
    jaxid.open_session(case.case(), table)


def test_units_decide_a_motion_that_was_guessed_by_its_size():
    case = jaxid.init({"t": T, "command": 0.3 * moves(), "position": 300.0 * followed(moves())})
    assert case.tables["plant"]["motion"] == "linear"
    assert case.tables["log"]["units"] == {"position": "mm", "reference": "m"}
    assert not any(
        "taken to be" in line or "no axis has" in line for line in case.assumed if "loop" not in line
    )


@pytest.mark.parametrize("hertz", [0.3, 0.5, 1.0])
def test_a_single_sine_shows_the_ratio_by_its_amplitude(hertz):
    """Its acceleration is its position: a fit that has both shares the ratio out between them."""
    strokes = ratio_of_strokes(50.0 * followed(sine(hertz)) + 25.0, sine(hertz))
    assert strokes.ratio == pytest.approx(50.0, rel=0.01)
    assert strokes.offset == pytest.approx(25.0, abs=0.2)


def test_a_ramp_shows_the_ratio_and_the_zero_but_for_its_lag():
    """Its velocity is a constant: a fit that has both shares the zero out between them."""
    strokes = ratio_of_strokes(50.0 * followed(0.2 * T) + 25.0, 0.2 * T)
    lag = 50.0 * 0.2 * 1.4 / (2 * np.pi * 4.0)
    stuck = 50.0 * 0.01 * np.ptp(0.2 * T)
    assert strokes.ratio == pytest.approx(50.0, rel=1e-3)
    assert strokes.offset == pytest.approx(25.0 - lag - stuck, abs=0.1)


def test_a_motion_beyond_the_bandwidth_has_no_gear_and_no_sign():
    """The position lags by more than a quarter of a turn."""
    table = {"t": T, "command": sine(9.0), "position": followed(sine(9.0))}
    assert np.corrcoef(table["command"], table["position"])[0, 1] < -0.5
    assert not {"units", "sign"} & {*jaxid.init(table).tables["log"]}


def test_a_position_that_moves_against_its_command_has_the_sign_of_this_turned():
    joint = followed(moves())
    table = {"t": T, "command": moves(), "position": -joint}
    case = jaxid.init(table)
    assert case.tables["log"]["sign"] == {"reference": -1}
    read = jaxid.open_session(case.case(), table).fits[0].log
    assert read.reference is not None
    assert np.allclose(read.reference[:, 0], -moves())


def test_a_position_that_follows_its_command_keeps_its_units():
    tables = jaxid.init({"t": T, "command": moves(), "position": followed(moves())}).tables
    assert not {"units", "sign"} & {*tables["log"]}


def test_a_column_that_is_not_followed_says_nothing_of_units():
    """A reference that another joint follows."""
    other = np.random.default_rng(0).standard_normal(T.size).cumsum()
    case = jaxid.init({"t": T, "command": 100.0 * other, "position": followed(moves())})
    assert "units" not in case.tables["log"]


@pytest.mark.parametrize(("ratio", "sign"), [(1.0, 1), (50.0, 1), (1.0, -1)])
def test_a_position_with_another_zero_than_its_command_moves_the_zero_of_this(ratio, sign):
    joint = followed(moves())
    table = {"t": T, "command": sign * moves() + 0.2, "position": ratio * (joint + 0.7)}
    case = jaxid.init(table)
    assert "constant_force" in [effect["kind"] for effect in case.tables["effects"]]
    assert any("different zeros" in line for line in case.questions)
    read = jaxid.open_session(case.case(), table).fits[0].log
    assert read.reference is not None
    off = float(np.mean(read.reference - read.position))
    assert abs(off) < 0.01 * np.ptp(joint)


def test_beside_a_force_no_zero_is_moved():
    table = {"t": T, "command": moves() + 0.7, "position": followed(moves()), "torque": np.sin(T)}
    assert "offset" not in jaxid.init(table).tables["log"]
