"""Angles and counts that start anew after a turn: refused by that name, or joined on request."""

import numpy as np
import pytest

from jaxid.logs.log import Log, read_log
from jaxid.logs.soundness import check_log
from jaxid.logs.wrap import find_wrap
from tests.support.written_logs import COLUMNS, write_csv

TIME = np.arange(4000) / 1000.0
TURNS = {"2 pi": 2 * np.pi, "360": 360.0, "2^12": 4096.0, "2^16": 65536.0}


def angle(turn: float) -> np.ndarray:
    """Three turns to and fro, off zero so that it crosses the ends in both directions."""
    return turn * (0.37 + 1.5 * np.sin(3.0 * TIME))


def wrapped(turn: float, low: float = 0.0) -> np.ndarray:
    return (angle(turn) - low) % turn + low


@pytest.mark.parametrize("name", TURNS)
@pytest.mark.parametrize("low", [0.0, -0.5])
def test_a_turn_is_found_by_name(name, low):
    turn = TURNS[name]
    found = find_wrap(wrapped(turn, low * turn))
    assert found is not None
    assert (found.turn, found.name) == (turn, name)


def test_a_log_that_wraps_is_refused_with_the_key_to_set():
    log = Log(time=TIME, position=wrapped(2 * np.pi), force=np.cos(7 * TIME))
    errors = [f for f in check_log(log, motion="rotary") if f.severity == "error"]
    assert errors[0].what.startswith("the position jumps by a turn (2 pi) in ")
    assert errors[0].hint == "set unwrap = true in [log]"


def test_a_turn_of_any_size_is_found_from_three_jumps_on():
    found = find_wrap(wrapped(1440.0))
    assert found is not None
    assert found.name == ""
    assert found.turn == pytest.approx(1440.0, rel=0.01)


@pytest.mark.parametrize(
    "q",
    [
        angle(2 * np.pi),
        np.where(TIME > 2.0, 6.283, 0.0) + 0.01 * np.sin(5 * TIME),
        np.where(TIME == 2.0, 6.283, 0.0) + 0.01 * np.sin(5 * TIME),
        np.random.default_rng(0).standard_normal(4000),
        np.sign(np.sin(20 * TIME + 0.1)),
    ],
    ids=["no turn", "a step", "an outlier", "noise", "a square wave"],
)
def test_other_courses_are_no_turns(q):
    assert find_wrap(q) is None


@pytest.mark.parametrize("unwrap", [True, 2 * np.pi])
def test_positions_and_references_are_joined(tmp_path, unwrap):
    turn = 2 * np.pi
    reference = (angle(turn) + 0.1) % turn
    table = {"t": TIME, "q": wrapped(turn), "u": np.cos(7 * TIME), "r": reference}
    path = write_csv(tmp_path / "log.csv", table)
    log = read_log(path, COLUMNS | {"reference": "r", "unwrap": unwrap})
    np.testing.assert_allclose(np.diff(log.position[:, 0]), np.diff(angle(turn)), atol=1e-9)
    np.testing.assert_allclose(log.reference - log.position, 0.1, atol=1e-9)


def test_whole_milliseconds_beside_foreign_units_are_refused():
    log = Log(time=1000 * TIME, position=100 * np.sin(3 * TIME), force=np.cos(7 * TIME))
    errors = [f for f in check_log(log, units={"position": "count"}) if f.severity == "error"]
    assert "time looks like milliseconds or rows" in errors[0].what
