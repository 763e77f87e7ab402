"""The hold of the force, chosen again where a missing effect had hidden which one is right."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from jaxid.gap import force_gap
from jaxid.session import open_session
from jaxid.session.holds import session_of_faster_loop, session_under_better_hold
from truth.axis.cases import case_text
from truth.axis.machines import moves
from truth.axis.slow_logs import robot_joint, with_hidden
from truth.axis.stepper import Loop, Machine, Sensor, simulate

# A turntable in a loop of 1 kHz, of which one tick in four is logged.
FRICTION = {"viscous_friction": {"coefficient": 0.05}, "coulomb_friction": {"level": 0.3}}
COGGING = {"amplitude": 0.2, "period": 2 * np.pi / 12, "phase": 0.4}


@pytest.fixture(scope="module")
def log() -> dict[str, np.ndarray]:
    t = np.arange(10000) / 1000.0
    reference = moves(t, [0.0, 3.0, -2.0, 5.0], [2.0, 1.0, 3.0, 4.0], 15.0, 0.2)
    loop = Loop("pid", reference=reference, kp=80.0, kd=2.0, ki=50.0, derivative_filter=0.002)
    run = simulate(
        Machine(0.02, {**FRICTION, "cogging": COGGING}),
        loop,
        Sensor(2 * np.pi / 65536, 1e-5, 0.01),
        rate=1000.0,
        duration=10.0,
        seed=2,
        log_rate=250.0,
    )
    return {"t": run["t"], "q": run["position"], "u": run["force"]}


def case(*, cogging: bool = False) -> dict:
    effects = [
        {"kind": "viscous_friction", "coefficient": {"guess": 0.15}},
        {"kind": "coulomb_friction", "level": {"guess": 0.1}},
    ]
    if cogging:
        effects.append({"kind": "cogging", **{name: {"guess": value} for name, value in COGGING.items()}})
    return {
        "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 0.012}}},
        "effects": effects,
        "log": {"time": "t", "position": "q", "force": "u"},
    }


@pytest.fixture
def shows_no_tick(monkeypatch):
    """Make the log one that does not show that its loop is faster."""
    monkeypatch.setattr("jaxid.session.against_case.faster_tick", lambda *_, **__: None)
    monkeypatch.setattr("jaxid.session.holds.faster_tick", lambda *_, **__: None)


@pytest.mark.usefixtures("shows_no_tick")
def test_what_was_missing_had_hidden_the_hold(log):
    session = open_session(case(), log, align_hold=True, method="discover")
    assert session.fit.log.hold == "zero_order"
    whole = jaxid.identify(case(cogging=True), log, method="inverse_dynamics").estimate.machine
    other = session_under_better_hold(session, whole)
    assert other is not None
    assert other.machine.hold == other.fit.log.hold == "linear"
    assert other.settings["hold"]["value"] == "linear"
    assert other.findings[-1].what.startswith("hold is not stated, and 'linear' is used")
    # A hold that the case states stays.
    assert session_under_better_hold(replace(session, chooses_hold=False), whole) is None


@pytest.mark.usefixtures("shows_no_tick")
def test_an_effect_in_time_gives_way_to_the_other_hold_if_that_leaves_less(log):
    """Without the ripple neither hold is clearly better: what the shift leaves decides."""
    session = open_session(case(), log, align_hold=True, method="discover")
    declared = jaxid.identify(case(), log, method="inverse_dynamics").estimate.machine
    gap = force_gap(declared, session.fit.data).rms
    assert session_under_better_hold(session, declared) is None
    assert session_under_better_hold(session, declared, rival=0.5 * gap) is None
    other = session_under_better_hold(session, declared, rival=2.0 * gap)
    assert other is not None
    assert other.fit.log.hold == "linear"


@pytest.mark.slow
def test_a_search_names_no_effect_that_only_shifts_the_force(log):
    """Under the default hold a joint_flexibility that is not there follows the ripple."""
    found = jaxid.discover(case(), log)
    assert found.kinds == ["cogging"]
    assert found.session.fit.log.hold == "linear"
    for name, true in {"inertia": 0.02, "coulomb_friction.level": 0.3, "cogging.amplitude": 0.2}.items():
        value = found.parameters[name]
        assert abs(value.value - true) < 3 * value.std


def joint_without_its_curve(*, declared: bool = False) -> tuple[dict, dict[str, np.ndarray]]:
    """Return the case of a joint, which may lack its Stribeck friction, and a log of every other tick."""
    setup, rate = robot_joint(4)
    known = tuple(setup.machine.effects.items())
    setup = with_hidden(setup, "stribeck_friction")
    known = tuple(setup.machine.effects.items()) if declared else known
    run = setup.run(log_rate=rate)
    tables = tomllib.loads(case_text(setup, known, motion="rotary", sensor=False, closed=False))
    return tables, {"t": run["t"], "q": run["position"], "u": run["force"]}


def test_what_was_missing_had_hidden_the_tick():
    tables, log = joint_without_its_curve()
    session = open_session(tables, log, align_hold=True, method="discover")
    assert "tick" not in session.settings
    assert session_of_faster_loop(session, session.machine) is None
    whole, _ = joint_without_its_curve(declared=True)
    machine = jaxid.identify(whole, log, method="inverse_dynamics").estimate.machine
    other = session_of_faster_loop(session, machine)
    assert other is not None
    assert other.fit.data.hold == pytest.approx(1e-3)
    assert other.fit.data.faster_loop
    assert other.fit.log.hold == "linear"
    assert "tick" in other.settings
    assert session_of_faster_loop(other, machine) is None
    # Nor is a loop of the log's rate taken for a faster one.
    every = robot_joint(4)[0].run()
    of_rate = {"t": every["t"], "q": every["position"], "u": every["force"]}
    declared = open_session(tables, of_rate, align_hold=True, method="discover")
    fitted = jaxid.identify(tables, of_rate, method="inverse_dynamics").estimate.machine
    assert session_of_faster_loop(declared, fitted) is None
    # A hold that the case states stays.
    assert session_of_faster_loop(replace(session, chooses_hold=False), machine) is None


@pytest.mark.slow
def test_no_spring_is_named_where_the_loop_is_faster():
    """A joint_flexibility of 158 nats had stood beside the friction."""
    tables, log = joint_without_its_curve()
    result = jaxid.discover(tables, log)
    assert result.kinds == ["stribeck_friction"]
    assert result.model_complete
