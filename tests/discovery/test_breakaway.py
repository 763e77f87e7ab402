"""Break-away friction read off starts from rest, on logs of an independent simulator."""

from dataclasses import replace

import numpy as np
import pytest

from jaxid.discovery.at_rest.break_away import break_away
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.session import open_session
from tests.support.axis_log import log_of
from truth.axis import machines
from truth.axis.cases import case_text, write_case

PRESETS = {
    "emps_like": (machines.emps_like, "linear", 8.0),
    "servo": (machines.servo, "rotary", 4e-3),
    "heavy_slide": (machines.heavy_slide, "linear", 100.0),
}


def found(name, folder, level, seed=0, duration=8.0):
    preset, motion, _ = PRESETS[name]
    setup = preset(seed, 1.0, duration)
    text = case_text(setup, [*setup.machine.effects.items()], motion=motion)
    hidden = setup.with_effect("static_friction", level=level) if level else setup
    session = open_session(write_case(folder, text), log_of(hidden), align_hold=True)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    return break_away(estimate, session.runs)[0]


@pytest.mark.parametrize("name", PRESETS)
def test_level_is_read_off_the_starts(name, tmp_path):
    level = PRESETS[name][2]
    b = found(name, tmp_path, level)
    assert b.evidence > b.threshold
    assert b.level == pytest.approx(level, rel=0.15)
    assert b.holds
    assert b.count >= 3


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("seed", [0, 3])
def test_nothing_is_seen_where_there_is_none(name, seed, tmp_path):
    b = found(name, tmp_path, 0.0, seed)
    # The log is looked at, not refused: it has starts enough.
    assert not isinstance(b, str), b
    assert b.count >= 3
    assert b.evidence < b.threshold
    assert not b.holds


def test_noise_of_the_force_is_no_break_away(tmp_path, monkeypatch):
    """The simulation of a start leaves at the first noisy reading above the level, the machine later."""
    setup = machines.emps_like(0, 1.0, 16.0)
    text = case_text(setup, [*setup.machine.effects.items()], closed=False)
    log = log_of(setup)
    noise = 2.0 / setup.machine.actuator_gain * np.random.default_rng(1).standard_normal(log.force.shape)
    noisy = replace(log, force=log.force + noise)
    session = open_session(write_case(tmp_path, text), noisy, align_hold=True)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    # As if the log had more starts: with these the evidence is 1.9 nats.
    monkeypatch.setattr("jaxid.discovery.at_rest.break_away._FALSE_POSITIVE", 0.5)
    b = break_away(estimate, session.runs)[0]
    assert isinstance(b, str), f"{b.level} N at {b.evidence} nats"
    assert b.startswith("noise of the logged force, which reaches")


def test_a_log_without_a_start_from_rest_says_nothing(tmp_path):
    setup = machines.emps_like(0, 1.0, 0.6)
    text = case_text(setup, [*setup.machine.effects.items()])
    session = open_session(write_case(tmp_path, text), log_of(setup), align_hold=True)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    assert break_away(estimate, session.runs)[0].startswith("there are fewer than")


def test_times_are_those_of_the_starts(tmp_path):
    setup = machines.heavy_slide(0, 1.0, 8.0).with_effect("static_friction", level=100.0)
    run = setup.run()
    b = found("heavy_slide", tmp_path, 100.0)
    still = run["true_velocity"] == 0.0
    leaves = run["t"][np.flatnonzero(still[:-1] & ~still[1:])]
    assert all(np.min(np.abs(leaves - t)) < 0.01 for t in b.times)
