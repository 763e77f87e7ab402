"""Friction that fades just above rest, beside break-away friction: both delay a start from rest."""

import numpy as np
import pytest

import jaxid
from jaxid.discovery.at_rest import fading
from tests.support.hidden_effect import search_hidden
from truth.axis.machines import moves
from truth.axis.stepper import Loop, Machine, Sensor, simulate

# A lift of 60 kg, half of its weight balanced; its current is logged, 120 N/A.
GAIN = 120.0
FRICTION = {"viscous_friction": {"coefficient": 350.0}, "coulomb_friction": {"level": 45.0}}


def found(**hidden: dict[str, float]) -> jaxid.Discovery:
    """Search a log of the exact stepper for what is hidden in it."""
    t = np.arange(12000) / 1000.0
    reference = moves(t, [0.0, 0.1, 0.3, 0.05], [0.1, 0.25, 0.05, 0.2], 2.0, 0.2)
    loop = Loop("pid", reference=reference, kp=2e4, kd=180.0, ki=2e4, derivative_filter=0.002)
    machine = Machine(60.0, {**FRICTION, **hidden}, actuator_gain=GAIN, gravity_force=-60 * 9.81 * 0.5)
    run = simulate(machine, loop, Sensor(1e-6, 3e-7, 0.01), rate=1000.0, duration=12.0, seed=1)
    case = {
        "plant": {"kind": "axis", "motion": "linear", "parameters": {"inertia": {"guess": 50.0}}},
        "effects": [
            {"kind": "viscous_friction", "coefficient": {"guess": 400.0}},
            {"kind": "coulomb_friction", "level": {"guess": 35.0}},
            {"kind": "constant_force", "level": {"guess": -250.0}},
        ],
        "actuator": {"gain": GAIN},
        "log": {"time": "t", "position": "q", "force": "u"},
    }
    return jaxid.discover(case, {"t": run["t"], "q": run["position"], "u": run["force"]})


@pytest.mark.slow
def test_a_friction_that_fades_at_a_centimetre_a_second_is_named_with_its_values():
    """The samples that move say nothing of it: a search in forces leaves out those around a rest."""
    d = found(stribeck_friction={"level": 25.0, "velocity": 0.01})
    assert d.kinds == ["stribeck_friction"]
    for name, true in {"level": 25.0, "velocity": 0.01}.items():
        value = d.parameters[f"stribeck_friction.{name}"]
        assert abs(value.value - true) < 3 * value.std
        assert value.std < 0.1 * true
    assert not any("found at the starts from rest" in note for note in d.after.notes)


@pytest.mark.slow
def test_a_break_away_friction_stays_one():
    d = found(static_friction={"level": 25.0})
    assert d.kinds == ["static_friction"]
    assert d.parameters["static_friction.level"].value == pytest.approx(25.0, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("certain", [False, True])
def test_a_break_away_friction_that_a_fading_one_imitates_stays_one(tmp_path, monkeypatch, certain):
    """On a servo with little noise the fading friction gains 914 nats; the level of that fit is not certain.

    It would not be named if it were: the true friction gains as much.
    """
    if certain:
        monkeypatch.setattr(fading, "_is_clear", lambda found: True)
    d, truth = search_hidden(tmp_path, "static_friction", "servo", 0.3, 18021)
    assert d.kinds == ["static_friction"]
    value = d.parameters["static_friction.level"]
    assert abs(value.value - truth["static_friction.level"]) < 3 * value.std


@pytest.mark.slow
def test_neither_is_named_where_there_is_none():
    assert found().kinds == []
