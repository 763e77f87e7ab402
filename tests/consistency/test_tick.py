"""Tick of a loop that is faster than its log, on exact logs of every tick, and of every second or third."""

import dataclasses
import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.session import Session, open_session
from truth.axis.cases import case_text
from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor

RATE, SECONDS = 1000.0, 20.0
TIME = np.arange(round(RATE * SECONDS)) / RATE
EFFECTS = {"viscous_friction": {"coefficient": 2.0}, "coulomb_friction": {"level": 3.0}}
COUNT = 2 * np.pi / 2**18
# A robot's joint: 0.8 kg m^2, 10 N m/A behind its gear.
REFERENCE = moves(TIME, [0.0, 0.1, -0.2, 0.7, -0.6], [0.1, 0.4, 0.9, 1.2, 0.8], 4.0, rest=0.1)
SETUP = Setup(
    Machine(0.8, EFFECTS, actuator_gain=10.0),
    Loop(kind="cascade_pd", kp=25.0, kv=3.0, velocity_average=2, limit=20.0, reference=REFERENCE),
    Sensor(COUNT, 0.5 * COUNT, 0.005),
    RATE,
    SECONDS,
    5,
)


def opened(every: int, of: Setup = SETUP, more: str = "") -> Session:
    run = of.run()
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    text = case_text(of, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    text = text.replace("[log]\n", f"[log]\n{more}")
    return open_session(tomllib.loads(text), {name: x[::every] for name, x in log.items()})


@pytest.mark.parametrize("every", [2, 3, 10])
def test_a_log_of_some_ticks_shows_that_its_loop_is_faster(every):
    session = opened(every)
    assert session.fit.data.hold == pytest.approx(1 / RATE, rel=0.5 if every < 10 else 2.0)
    assert session.fit.data.faster_loop
    assert session.settings["tick"]["value"].endswith(" s")
    assert any("the loop is faster than the log" in f.what for f in session.findings)


def test_a_log_of_every_tick_has_none():
    session = opened(1)
    assert session.fit.data.hold == pytest.approx(1 / RATE)
    assert not session.fit.data.faster_loop
    assert "tick" not in session.settings


def test_a_stated_hold_is_kept():
    session = opened(2, more='hold = "zero_order"\n')
    assert session.fit.data.hold == pytest.approx(2 / RATE)
    assert "tick" not in session.settings


def test_what_is_missing_is_no_tick():
    """A rough model leaves a residual in which any shift in time may help."""
    weak = {**EFFECTS, "stribeck_friction": {"level": 2.0, "velocity": 0.06}}
    session = opened(2, dataclasses.replace(SETUP, machine=Machine(0.8, weak, actuator_gain=10.0)))
    assert "tick" not in session.settings


def test_values_of_every_second_tick_hold_and_nothing_is_missing():
    run = SETUP.run()
    text = case_text(SETUP, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    case = tomllib.loads(text)
    found = jaxid.identify(case, {name: x[::2] for name, x in log.items()})
    assert found.estimate.method == "inverse_dynamics"
    assert any("faster than the log" in note for note in found.estimate.notes)
    fit = found.estimate
    assert tuple(fit.names) == ("inertia", "viscous_friction.coefficient", "coulomb_friction.level")
    assert np.all(np.abs(fit.theta - [0.8, 2.0, 3.0]) < 3 * fit.std)
