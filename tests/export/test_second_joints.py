"""Elastic transmissions and backlash in an exported MJCF: a second joint behind the motor's."""

import mujoco
import numpy as np
import pytest

from jaxid.commands.export import check_export, export
from tests.export.test_replayed import RATE, result_of
from tests.support.written_logs import write_csv

ROTOR, LOAD = 0.02, 0.05
TURRET = f"""<mujoco><compiler angle="radian"/><option timestep="0.0001"/>
  <default><joint axis="0 0 1"/>
    <default class="geared"><joint damping="0.2" range="-3 3"/></default></default>
  <worldbody>
    <!-- the turret -->
    <body><joint name="yaw" class="geared" armature="{ROTOR}"/>
      <inertial pos="0 0 0.1" mass="1" diaginertia="0.03 0.03 {LOAD}"/></body>
  </worldbody>
  <actuator><motor joint="yaw"/></actuator></mujoco>"""
FORCED = {"time": "t", "position": ["q"], "force": ["u"], "hold": "zero_order"}
SPRING = {"stiffness": 30.0, "damping": 0.01, "load_inertia": LOAD}


def forced(folder):
    """A log that only its forces matter of."""
    t = np.arange(500) / RATE
    u = 1.5 * np.sin(2 * np.pi * 1.1 * t) + 0.7 * np.sin(2 * np.pi * 3.7 * t)
    model = mujoco.MjModel.from_xml_string(TURRET)
    data, q = mujoco.MjData(model), np.zeros(len(t))
    for k, force in enumerate(u):
        q[k], data.ctrl[:] = data.qpos[0], force
        mujoco.mj_step(model, data, round(1 / RATE / model.opt.timestep))
    return write_csv(folder / "log.csv", {"t": t, "q": q, "u": u})


def elastic(folder, text=TURRET, **values):
    result = result_of(folder, text, text, FORCED)
    place = {"kind": "joint_flexibility", "joint": 1, "joint_name": "yaw", "name": "joint_flexibility[1]"}
    result["model"]["effects"].append(place | {"parameters": SPRING | values})
    return result


@pytest.mark.slow
@pytest.mark.parametrize(
    ("values", "name"),
    # MuJoCo has the damping inside the clearance too: without any, both are the same machine.
    [({}, "yaw_spring"), ({"gap": 0.1, "damping": 1e-6}, "yaw_backlash")],
)
def test_mujoco_moves_the_second_joint_as_jaxid_does(tmp_path, values, name):
    result = elastic(tmp_path, **values)
    file = export(result, "mjcf")
    found = check_export(result, "mjcf", file, forced(tmp_path))
    cost = next(sizes for what, sizes in found.costs if what == f"without the second joint '{name}'")
    assert cost[0] > 3e-3
    assert found.difference[0] < 0.01 * cost[0]


@pytest.mark.parametrize(("values", "name"), [({}, "yaw_spring"), ({"gap": 0.1}, "yaw_backlash")])
def test_the_second_joint_has_nothing_of_the_first_one_but_its_place(tmp_path, values, name):
    file = export(elastic(tmp_path, **values), "mjcf")
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    assert [model.joint(k).name for k in range(model.njnt)] == ["yaw", name]
    assert file.added == (name,)
    assert not file.lost
    assert b"<!-- the turret -->" in file.content
    first, second = model.joint("yaw"), model.joint(name)
    assert second.bodyid == first.bodyid
    assert second.axis == pytest.approx(first.axis)
    assert not model.jnt_limited[second.id]
    assert model.dof_armature[second.dofadr[0]] == 0
    assert model.dof_damping[second.dofadr[0]] == SPRING["damping"]
    assert any("damping inside the clearance" in note for note in file.notes) == bool(values)
    spring = (model.jnt_stiffness[second.id],) if not values else tuple(model.tendon_stiffness)
    assert spring == (SPRING["stiffness"],)
    if values:
        assert model.tendon_lengthspring.tolist() == [[-0.05, 0.05]]


def test_a_motor_before_a_spring_has_a_rotor(tmp_path):
    file = export(elastic(tmp_path, TURRET.replace(f'armature="{ROTOR}"', "")), "mjcf")
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    assert model.dof_armature[0] == pytest.approx(0.01 * LOAD)
    assert any("armature of joint 'yaw'" in note for note in file.notes)


def test_a_name_that_is_taken_is_not_given_again(tmp_path):
    more = '<body pos="1 0 0"><joint name="yaw_spring"/><geom size="0.1"/></body>\n  </worldbody>'
    file = export(elastic(tmp_path, TURRET.replace("</worldbody>", more)), "mjcf")
    assert file.added == ("yaw_spring2",)
