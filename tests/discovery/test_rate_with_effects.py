"""The rate of a servo's loop in a search, which a model without the hidden effect does not show."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_arms import arm
from benchmarks.unforced_machines import Servo
from jaxid.discovery.in_loop import unforced
from jaxid.session import open_session

RATE, EVERY, SECONDS = 1000.0, 20, 12.0
COUNT = 2 * np.pi / 4096
TRUE = {
    "viscous_friction.coefficient": 0.02,
    "coulomb_friction.level": 0.12,
    "controller.kp": 6.0,
    "controller.kd": 0.12,
    "controller.delay": 0.024,
    "stribeck_friction.level": 0.1,
    "stribeck_friction.velocity": 0.2,
}
CASE = {
    "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": 4e-3}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 0.05}},
        {"kind": "coulomb_friction", "level": {"guess": 0.05}},
    ],
    "controller": {"kind": "pd", "kp": {"guess": 3.0}, "kd": {"guess": 0.3}, "delay": {"guess": 0.01}},
    "sensor": {"position_resolution": COUNT, "position_noise": 0.0},
    "log": {"time": "t", "position": "q", "reference": "r"},
}


@dataclass(frozen=True)
class FakeFit:
    """What a search takes of a fit."""

    machine: Any
    notes: tuple[str, ...] = ()
    details: dict = field(default_factory=dict)


@pytest.fixture
def searched(monkeypatch):
    """Searches whose first one ends at a loop of some period, and what they were asked for."""
    t = 0.02 * np.arange(300)
    session = open_session(CASE, {"t": t, "q": np.sin(t), "r": np.sin(t)})

    def at(period: float) -> FakeFit:
        machine = session.machine
        settings = {"period": {"value": f"{period} s", "reason": "it leaves least"}}
        law = replace(machine.controller, period=period)
        return FakeFit(replace(machine, controller=law), details={"settings": settings})

    def search(period: float, left: set[int], effects: bool = True):
        calls: list[tuple[float, Any]] = []
        rival = SimpleNamespace(candidate=SimpleNamespace(kind="load_friction"))
        named = SimpleNamespace(kind="stribeck_friction", alternatives=(rival,))

        def explored(session, before, *, among=None, **more):
            calls.append((session.machine.controller.period, among))
            return SimpleNamespace(effects=(named,) * effects, after=at(period), gaps_after=())

        def steps(value):
            return value
            yield

        monkeypatch.setattr(unforced, "explored_from", explored)
        monkeypatch.setattr(unforced, "open_joints", lambda *a: left)
        monkeypatch.setattr(unforced, "steps_of", lambda *a: steps(at(0.005)))
        monkeypatch.setattr(unforced, "at_its_loop_steps", lambda session: steps(FakeFit(session.machine)))
        unforced.explore_unforced(session, max_effects=3, progress=lambda text: None)
        return calls

    return search


def test_a_search_ends_where_what_was_found_keeps_the_loop(searched):
    assert searched(0.005, {0}) == [(0.02, None)]
    assert searched(0.001, {0}, effects=False) == [(0.02, None)]


def test_a_search_runs_again_at_the_loop_that_what_was_found_shows(searched):
    assert searched(0.001, {0}) == [(0.02, None), (0.001, None)]


def test_the_second_search_is_among_what_was_found_and_its_rivals_if_that_leaves_noise(searched):
    assert searched(0.001, set()) == [
        (0.02, None),
        (0.001, frozenset({"stribeck_friction", "load_friction"})),
    ]


@pytest.mark.slow
def test_the_rate_is_chosen_again_with_what_was_found():
    """It stayed 5 ms for 1 ms, that of the incomplete model: friction and gain were 4 to 5 sigma off."""
    t = np.arange(0, SECONDS, EVERY / RATE)
    waves = [(0.6, 0.31, 0), (0.35, 0.83, 1), (0.15, 1.7, 0)]
    command = np.clip(t, 0, 1) * sum(a * np.sin(2 * np.pi * f * t + p) for a, f, p in waves)
    command = np.round(command / COUNT) * COUNT
    effects = {
        "viscous_friction": {"coefficient": TRUE["viscous_friction.coefficient"]},
        "coulomb_friction": {"level": TRUE["coulomb_friction.level"]},
        "stribeck_friction": {
            "level": TRUE["stribeck_friction.level"],
            "velocity": TRUE["stribeck_friction.velocity"],
        },
        "command_delay": {"delay": TRUE["controller.delay"]},
    }
    log = Servo(1, RATE, EVERY, 4e-3, TRUE["controller.kp"], TRUE["controller.kd"], effects, command).run()
    position = np.round(log["position"].ravel() / COUNT) * COUNT

    found = jaxid.discover(CASE, {"t": t, "q": position, "r": command})
    assert [effect.kind for effect in found.effects] == ["stribeck_friction"]
    assert found.model_complete is True
    assert float(found.settings["period"]["value"].split()[0]) <= 2.01 / RATE
    for name, true in TRUE.items():
        value = found.parameters[name]
        assert abs(value.value - true) < 3.5 * value.std, name


@pytest.mark.slow
def test_the_rate_of_an_arm_is_chosen_again_with_what_was_found():
    """The incomplete model shows 4 ms for 5 ms, with which friction and rotors are up to 20 sigma off."""
    drawn = arm(2, "stribeck_friction", 1)
    case = drawn.case()
    del case["controller"]["period"], case["log"]["reference_hold"]
    found = jaxid.discover(case, drawn.columns())
    assert [effect.label for effect in found.effects] == ["stribeck_friction[2]"]
    assert found.model_complete is True
    assert found.settings["period"]["value"] == "0.005 s"
    for name, true in drawn.truth().items():
        value = found.parameters[name]
        assert abs(value.value - true) < 3.5 * value.std, name
