"""Reversals of coupled joints: an unknown friction at one of them moves the others too."""

import mujoco
import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.logs.log import Log
from jaxid.simulation.kalman import make_filter
from jaxid.simulation.replay import exact_numerics
from tests.support.mjcf_robots import PENDULUM_ON_CART, pendulum_log
from tests.support.written_logs import write_csv


def test_a_jolt_at_one_joint_moves_the_others_as_in_mujoco(tmp_path):
    xml = PENDULUM_ON_CART.format(slide="", swing='armature="0.01"')
    (tmp_path / "robot.xml").write_text(xml)
    t = np.arange(60) / 100
    log = Log(time=t, position=np.column_stack([0.1 * t, np.sin(5 * t)]), force=np.cos(9 * t)[:, None])
    plant = {"kind": "tree", "mjcf": str(tmp_path / "robot.xml")}
    columns = {"time": "t", "position": ["x", "a"], "force": "u"}
    machine = build_machine(load_case({"plant": plant, "log": columns}), period=log.period)
    slow = np.zeros((60, 2), bool)
    slow[20, 0] = slow[40, 1] = True
    kalman = make_filter(machine, log, exact_numerics(machine, log, 1), slow)
    jolts = np.asarray(kalman._jolts(machine.plant))

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    for sample, joint in ((20, 0), (40, 1)):
        data.qpos[:] = log.position[sample]
        mujoco.mj_forward(model, data)
        push = np.zeros((1, 2))
        mujoco.mj_solveM(model, data, push, np.eye(2)[joint : joint + 1])
        change = push[0] * kalman.kicks[sample, joint] / push[0, joint]
        assert abs(change[1 - joint]) > 0.01 * abs(change[joint])
        np.testing.assert_allclose(jolts[sample], np.outer(change, change), rtol=1e-9)
    assert not np.delete(jolts, [20, 40], axis=0).any()


@pytest.mark.slow
def test_soft_friction_of_a_cart_leaves_the_pendulum_right(tmp_path):
    """MuJoCo's friction creeps, by default over 1 cm/s: what is wrong at reversals stays there."""
    (tmp_path / "robot.xml").write_text(PENDULUM_ON_CART.format(slide="", swing=""))
    friction = 'damping="4" frictionloss="1.5"', 'damping="0.004"'
    log = write_csv(tmp_path / "log.csv", pendulum_log(*friction))
    found = jaxid.identify(tmp_path / "robot.xml", log)
    assert found.estimate.method == "prediction_error"
    assert found.estimate.converged
    assert found.judgement.model_complete
    true = {"first_moment_y[2]": 0.075, "inertia_zz[2]": 0.007 + 0.3 * 0.25**2}
    true |= {"viscous_friction[1].coefficient": 4.0, "coulomb_friction[1].level": 1.5}
    true |= {"viscous_friction[2].coefficient": 0.004}
    for name, value in true.items():
        assert found.value(name) == pytest.approx(value, rel=0.01), name
    p = found.parameters
    for name in ("first_moment_y[2]", "inertia_zz[2]", "viscous_friction[2].coefficient"):
        assert abs(p[name].value - true[name]) < 4 * p[name].std, name
