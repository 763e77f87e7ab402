"""Fits of an arm joint by joint, along logs of MuJoCo without a force."""

from dataclasses import replace

import numpy as np
import pytest

from jaxid.commands.check import check
from jaxid.commands.identify import identify
from jaxid.estimators.apart.joint import joints_alone, stands_apart
from jaxid.estimators.apart.start import is_stable, starts_by_balance
from jaxid.estimators.several.parts import parts_of
from jaxid.gap import simulation_of_log
from jaxid.session import open_session
from tests.export.test_replayed import SERVOS, TRUE, logged, text
from tests.support.written_logs import write_csv

UNKNOWN = ["damping", "frictionloss", "kp", "kv"]
COLUMNS = {"time": "t", "position": ["qa", "qb"], "reference": ["ra", "rb"], "reference_hold": "zero_order"}
# Both dampings of a joint act alike: this is their sum.
TRUTH = {"controller.kp[1]": 60.0, "controller.kp[2]": 20.0, "coulomb_friction[1].level": 0.3}
DAMPING = (2.0 + 0.5, 0.5 + 0.3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("apart")
    write_csv(path / "log.csv", logged(text(SERVOS, kp=60, **TRUE), seconds=4.0))
    (path / "true.xml").write_text(text(SERVOS, kp=60, **TRUE))
    # A gain that is wrong by a factor of fifty, and no dry friction; the links are those of the arm.
    (path / "robot.xml").write_text(text(SERVOS, kp=3000, mass=1.4))
    return path


def session_of(folder, file="robot.xml", unknown=UNKNOWN, **plant):
    tables = {
        "plant": {"kind": "tree", "mjcf": str(folder / file), "unknown": unknown, **plant},
        "log": COLUMNS,
    }
    return open_session(tables, str(folder / "log.csv"))


def test_a_joint_with_its_load_moves_as_mujoco_moves_it(folder):
    session = session_of(folder, "true.xml")
    every = joints_alone(session.machine, parts_of(session))
    assert [alone.joint for alone in every] == [0, 1]
    for alone in every:
        [part] = alone.parts
        off = simulation_of_log(part.machine, part.log).rms[0]
        assert off < 5e-4
        # The weight and the other joint's motion matter.
        bare = replace(part.machine, load=np.zeros_like(part.machine.load))
        assert simulation_of_log(bare, part.log).rms[0] > 10 * off


@pytest.fixture(scope="module")
def geared(folder):
    """A log whose first joint rubs more under load: MuJoCo's friction follows the force of the servo."""
    holding = 'frictionloss="0.3" solreffriction="0.0005 1" solimpfriction="0.9999 0.9999"'
    content = text(SERVOS, kp=60, mass=TRUE["mass"], rub=holding)
    write_csv(folder / "geared.csv", logged(content, seconds=4.0, gear=(0.1, 0.0)))
    return folder / "geared.csv"


def geared_case(folder, coefficient, unknown=UNKNOWN, file="robot.xml"):
    effect = {"kind": "load_friction", "joint": 1, "coefficient": coefficient}
    plant = {"kind": "tree", "mjcf": str(folder / file), "unknown": unknown}
    return {"plant": plant, "effects": [effect], "log": COLUMNS}


def test_friction_of_a_gear_knows_the_force_of_the_links(folder, geared):
    off = {}
    for coefficient in (0.1, 0.0):
        session = open_session(geared_case(folder, coefficient, file="true.xml"), str(geared))
        assert stands_apart(session.machine, parts_of(session))
        first = joints_alone(session.machine, parts_of(session))[0]
        off[coefficient] = simulation_of_log(first.parts[0].machine, first.parts[0].log).rms[0]
    assert off[0.1] < 1e-3
    assert off[0.0] > 10 * off[0.1]


def test_the_start_is_near_although_the_file_is_far_off(folder):
    session = session_of(folder)
    first, second = joints_alone(session.machine, parts_of(session))
    values = dict(zip(first.machine.parameters.names, starts_by_balance(first)[0], strict=True))
    assert values["controller.kp[1]"] == pytest.approx(60.0, rel=0.2)
    assert values["controller.kd[1]"] + values["viscous_friction[1].coefficient"] == pytest.approx(
        2.5, rel=0.2
    )
    assert starts_by_balance(second)[0][second.machine.parameters.names.index("controller.kp[2]")] > 10.0


def test_a_gain_that_the_period_of_the_servo_does_not_allow_is_no_start(folder):
    machine = joints_alone(session_of(folder).machine, parts_of(session_of(folder)))[1].machine
    at = machine.parameters.names.index("controller.kp[2]")
    for gain, stable in ((20.0, True), (1e5, False)):
        theta = machine.parameters.guess
        theta[at] = gain
        assert is_stable(machine.with_estimate(theta)) == stable


def test_only_an_arm_of_servos_without_unknown_links_stands_apart(folder):
    session = session_of(folder)
    machine, parts = session.machine, parts_of(session)
    assert stands_apart(machine, parts)
    assert stands_apart(*_opened(folder, [*UNKNOWN, "armature", "delay"]))
    assert not stands_apart(*_opened(folder, [*UNKNOWN, "base"]))
    assert not stands_apart(machine, [replace(parts[0], log=replace(parts[0].log, force=np.ones((1000, 2))))])


def _opened(folder, unknown):
    session = session_of(folder, unknown=unknown)
    return session.machine, parts_of(session)


@pytest.mark.slow
def test_friction_of_a_gear_is_found_from_commands_and_positions(folder, geared):
    unknown = [word for word in UNKNOWN if word != "damping"]
    result = identify(geared_case(folder, {"guess": 0.05}, unknown), str(geared))
    assert result.converged
    assert result.parameters["load_friction[1].coefficient"].value == pytest.approx(0.1, rel=0.05)
    assert result.parameters["coulomb_friction[1].level"].value == pytest.approx(0.3, rel=0.05)


@pytest.mark.slow
def test_gains_and_friction_of_all_joints_are_found_from_commands_and_positions(folder):
    tables = {
        "plant": {"kind": "tree", "mjcf": str(folder / "robot.xml"), "unknown": UNKNOWN},
        "log": COLUMNS,
    }
    sure = check(tables, str(folder / "log.csv"))
    assert sure.precision.identifiable[sure.session.machine.parameters.names.index("controller.kp[1]")]
    result = identify(tables, str(folder / "log.csv"))
    assert result.converged
    for name, true in TRUTH.items():
        assert result.estimate.value(name) == pytest.approx(true, rel=0.02), name
    for k, true in enumerate(DAMPING, start=1):
        parts = (f"controller.kd[{k}]", f"viscous_friction[{k}].coefficient")
        assert sum(map(result.estimate.value, parts)) == pytest.approx(true, rel=0.02)
    # The whole arm in its loop, from its commands alone.
    assert np.all(result.gaps[0].simulation.rms < 1e-3)
