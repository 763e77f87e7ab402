"""The hold of the force, chosen again where a missing effect had hidden which one is right."""

from dataclasses import replace

import numpy as np
import pytest

import jaxid
from jaxid.gap import force_gap
from jaxid.session import open_session
from jaxid.session.holds import session_under_better_hold
from truth.axis.machines import moves
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
