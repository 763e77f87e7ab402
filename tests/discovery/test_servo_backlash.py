"""Backlash of a servo without a force, between a motor with its encoder and its load: exact stepper."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import servo
from jaxid.cli import main
from jaxid.discovery.in_loop.unforced import _not_asked, searched
from jaxid.effects.coupling import Backlash, BacklashOfJoint, JointFlexibility
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.model.effect import Signals
from jaxid.session import open_session
from jaxid.simulation.noisy_loop import estimated_noise
from jaxid.simulation.replay import make_replay
from truth.axis.hidden_effects import SEARCH_CASES
from truth.axis.stepper import write_csv

VALUES = {"stiffness": 60.0, "damping": 0.2, "load_inertia": 3e-3, "gap": 0.03}
SPRING = {"kind": "joint_flexibility", **VALUES}


def session(**changes):
    drawn = servo(1)
    return open_session(drawn.case() | changes, drawn.columns())


def test_it_is_the_flexible_joint_with_a_gap():
    state, given = np.array([0.4, 0.7]), dict.fromkeys((f.name for f in fields(Signals)), 0.3)
    one, other = (cls(**VALUES).act(Signals(**given), state) for cls in (BacklashOfJoint, JointFlexibility))
    assert one.force == other.force
    assert np.array_equal(one.rate, other.rate)


def test_a_search_without_a_force_tries_it_on_request_at_joints_without_a_spring():
    plain = session()
    assert BacklashOfJoint not in searched(plain, plain.machine)
    asked = session(discover={"candidates": ["backlash"]})
    assert BacklashOfJoint in searched(asked, asked.machine)
    assert Backlash not in searched(asked, asked.machine)

    sprung = session(effects=[SPRING], discover={"candidates": ["backlash"]})
    assert BacklashOfJoint not in searched(sprung, sprung.machine)


def test_what_was_not_tried_is_named():
    (note,) = _not_asked(session())
    assert note.startswith("not tried: backlash and voltage_limit; name them in candidates")
    (note,) = _not_asked(session(discover={"candidates": ["voltage_limit"]}))
    assert note.startswith("not tried: backlash; name")
    assert _not_asked(session(discover={"candidates": ["voltage_limit", "backlash"]})) == []


def test_noise_in_a_loop_that_diverges_has_no_start():
    """It ended in a traceback of the decomposition."""
    one = session()
    machine = one.machine
    wild = replace(machine, controller=replace(machine.controller, kp=np.full(1, 1e9), kd=np.zeros(1)))
    replay = make_replay(wild, one.fit.log, choose_numerics(wild, one.fit.log))
    noise = estimated_noise(wild, one.fit.log, replay, follows=False)
    assert noise is None or not np.all(np.isfinite(noise.shift))


def test_it_can_be_asked_for_alone():
    asked = session(discover={"kinds": ["backlash"]})
    assert searched(asked, asked.machine) == [BacklashOfJoint]


@pytest.mark.slow
def test_backlash_is_named_alone_with_its_gap(tmp_path):
    drawn = servo(1, "backlash")
    found = jaxid.discover(drawn.case() | {"discover": {"candidates": ["backlash"]}}, drawn.columns())
    assert found.kinds == ["backlash"]
    assert not found.effects[0].alternatives
    true = drawn.effects["backlash"]
    for name in ("gap", "load_inertia", "stiffness"):
        assert found.parameters[f"backlash.{name}"].value == pytest.approx(true[name], rel=0.05)

    found.save(tmp_path / "out")
    content = json.loads((tmp_path / "out/discovery.json").read_text())
    assert content["effects"][0]["kind"] == "backlash"
    again = jaxid.load_case(tmp_path / "out/case.toml")
    (effect,) = [e for e in again.effects if e.cls is JointFlexibility]
    assert set(effect.parameters) == set(VALUES)


def test_a_search_with_a_force_refuses_it_in_one_line(tmp_path, monkeypatch, capsys):
    """By the command, which reads a case without the classes of the effects: it ended in a traceback."""
    monkeypatch.chdir(tmp_path)
    row = replace(SEARCH_CASES["quadratic_drag"], duration=3.0)
    write_csv(row.setup(1).run(), "log.csv")
    Path("case.toml").write_text(row.text() + '[discover]\ncandidates = ["backlash"]\n')
    assert main(["discover", "case.toml", "log.csv", "-o", "out"]) == 2
    message = capsys.readouterr().err
    assert "backlash of a joint without a spring is searched for only in a log without a force" in message
    assert "Traceback" not in message
    assert not Path("out").exists()
