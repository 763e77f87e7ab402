"""Searches on exact logs of a flexible joint with two encoders, whose loop is faster than its log."""

import numpy as np
import pytest

import jaxid
from jaxid.discovery.at_rest.break_away import BreakAway
from jaxid.discovery.at_rest.holding_force import force_at_rest, was_held
from jaxid.session import open_session
from truth.chain.flexible_joints import case, flexible_joint


def searched(seed: int, rate: float, hidden: str | None = None):
    joint = flexible_joint(seed)
    joint = joint if hidden is None else joint.hiding(hidden)
    return jaxid.discover(case(), joint.log(rate))


def level(value: float, times: np.ndarray) -> BreakAway:
    return BreakAway(value, 0.01, 30.0, 7.6, 0.9, times, len(times))


def of_rests(joint):
    """Return the machine at the truth without break-away friction, a log, and when its load leaves rests."""
    session = open_session(case(), joint.log(1000.0))
    machine = session.machine.with_estimate([joint.true[name] for name in session.machine.parameters.names])
    q, still = session.fit.log.position[:, 1], 20
    agree = np.ptp(np.lib.stride_tricks.sliding_window_view(q, still), axis=1) < 1.3e-4
    leaves = np.flatnonzero(agree[:-1] & ~agree[1:]) + still - 1
    moved = np.abs(q[np.minimum(leaves + 40, len(q) - 1)] - q[leaves]) > 3e-4
    return machine, session.fit.data, leaves[moved] / 1000.0


@pytest.mark.slow
def test_the_coupling_shows_what_held_a_load():
    """Its torque reaches the level of 0.1 N m above sliding friction in the joint that has it alone."""
    joint = flexible_joint(1)
    sliding = joint.true["coulomb_friction[2].level"]
    machine, data, times = of_rests(joint)
    sticking, of_sticking, later = of_rests(joint.hiding("static_friction"))
    assert np.median(force_at_rest(machine, data, times, 1)) < sliding + 0.1
    assert np.median(force_at_rest(sticking, of_sticking, later, 1)) > sliding + 0.1
    assert not was_held(machine, data, level(0.1, times), 1)
    assert was_held(sticking, of_sticking, level(0.1, later), 1)
    # A drive's force says more of the joint that it drives.
    assert was_held(machine, data, level(0.1, times), 0)


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.slow
def test_friction_of_the_motor_is_no_break_away_of_the_load(seed):
    """A motor that starts late makes its load start late."""
    result = searched(seed, 200.0, "stribeck_friction")
    assert result.verdict == "found"
    assert not any(effect.label.endswith("[2]") for effect in result.effects)


@pytest.mark.slow
def test_break_away_friction_of_a_load_is_found():
    result = searched(1, 1000.0, "static_friction")
    assert [effect.label for effect in result.effects] == ["static_friction[2]"]


@pytest.mark.slow
def test_a_complete_flexible_joint_misses_nothing():
    """With the noise of the force taken for zero its residual was called unexplained."""
    for rate in (1000.0, 200.0):
        result = searched(1, rate)
        assert result.verdict == "nothing_missing"
        assert result.model_complete


@pytest.mark.slow
def test_the_tick_of_a_faster_loop_is_found_with_the_missing_effect():
    """While the drag was missing no tick was clear, and a delay of half of one was named beside the drag."""
    result = searched(1, 200.0, "quadratic_drag")
    assert [effect.label for effect in result.effects] == ["quadratic_drag[2]"]
    tick = float(result.session.settings["tick"]["value"].removesuffix(" s"))
    assert 0.5e-3 < tick < 2e-3, "the loop has 1 ms, the log rows of 5 ms"
    assert result.model_complete
