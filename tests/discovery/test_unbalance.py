"""The weight of a joint that turns: tried by default in a log with a force, its phase within half a turn."""

import numpy as np
import pytest

from jaxid.case.case import load_case
from jaxid.commands.discover import start_search
from jaxid.discovery.final import machine_with
from jaxid.session import open_session
from truth.axis.cases import case_text, write_case
from truth.axis.slow_logs import robot_joint

SETUP, _ = robot_joint(0, duration=4.0)
DECLARED = tuple(SETUP.machine.effects.items())
LINK = {"joint": "revolute", "alpha": 0.0, "a": 0.0, "mass": 1.0, "first_moment": [0.0, 0.0, 0.0]}
LINK["inertia"] = [0.0, 0.0, 0.0, 0.0, 0.0, {"guess": 1.0}]
ARM = {"plant": {"kind": "serial_arm", "links": [LINK]}}


def searched(case: dict) -> set[str]:
    return {cls.kind for cls in load_case(case).searched}


def test_a_search_of_an_axis_tries_it_and_one_of_an_arm_on_request():
    axis = {"plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": {"guess": 1.0}}}}
    assert "unbalance" in searched(axis)
    assert "unbalance" not in searched(ARM)
    assert "unbalance" in searched({**ARM, "discover": {"candidates": ["unbalance"]}})


@pytest.mark.parametrize(("found", "shown"), [(6.58, 6.58 - 2 * np.pi), (-4.0, 2 * np.pi - 4.0), (0.3, 0.3)])
def test_a_phase_lies_within_half_a_turn_of_zero(tmp_path, found, shown):
    run = SETUP.run()
    text = case_text(SETUP, DECLARED, motion="rotary", sensor=False, closed=False)
    session = open_session(
        write_case(tmp_path, text), {"t": run["t"], "q": run["position"], "u": run["force"]}
    )
    search = start_search(session)[1]
    (unbalance,) = (c for c in search.superset.candidates if c.kind == "unbalance")
    theta = search.theta.copy()
    theta[unbalance.index] = [0.2, found]
    machine, names = machine_with(session.machine, search.superset, [unbalance], theta)
    assert names == [("unbalance.moment", "unbalance.phase")]
    assert float(machine.plant.effects[-1].phase) == pytest.approx(shown)
