"""Robots from MJCF files: every force is MuJoCo's, and what is not taken over is named."""

import os
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import load_case, read_case
from jaxid.case.mjcf import read_mjcf
from jaxid.errors import InputError
from jaxid.model.parameter import as_array
from jaxid.plants import LinkTree
from tests.support.mjcf_robots import BRANCHED

PLANT = {"kind": "tree", "mjcf": "robot.xml"}
# The joint that follows, and by how much of which.
FREE, RATIO, OFFSET = ["yaw", "pitch", "lift", "grip", "swing"], -1.5, 0.05


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "robot.xml").write_text(BRANCHED)
    return tmp_path


def machine_of(folder, **plant):
    case = read_case({"plant": PLANT | plant}, None, folder)
    return case, build_machine(case)


def forces_of_mujoco(q, qd, qdd, ctrl, text=BRANCHED):
    """M qdd + bias - passive - actuators, projected on the free joints; equalities and limits are off."""
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY | mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(model)
    order = [model.joint(k).name for k in range(model.njnt)]
    g = np.zeros((model.nv, len(FREE)))
    for k, name in enumerate(order):
        g[k, FREE.index("grip" if name == "copy" else name)] = RATIO if name == "copy" else 1.0
    data.qpos[:] = g @ q + np.where(np.array(order) == "copy", OFFSET, 0.0)
    data.qvel[:], data.ctrl[:] = g @ qd, ctrl
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    return g.T @ (mass @ g @ qdd + data.qfrc_bias - data.qfrc_passive - data.qfrc_actuator)


def test_every_force_is_mujocos(folder):
    case, machine = machine_of(folder)
    assert case.plant.names == tuple(FREE)
    assert machine.plant.actuated is None
    rng, size = np.random.default_rng(3), 0.0
    states = rng.uniform(-1.5, 1.5, (20, 4, len(FREE)))
    none = machine.plant.initial_states(jnp.zeros(len(FREE)))

    @jax.jit
    @jax.vmap
    def ours(q, qd, qdd, ctrl):
        u = as_array(machine.gain.tolist()) * ctrl
        return machine.plant.balance(q, qd, qdd, u, jnp.zeros(()), none).residual

    found = np.asarray(ours(*states.transpose(1, 0, 2)))
    wanted = np.array([forces_of_mujoco(*s) for s in states])
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.max(np.abs(found - wanted) / size) < 1e-10


def test_gains_rotors_and_ranges_are_those_of_the_file(folder):
    case, machine = machine_of(folder)
    np.testing.assert_allclose(machine.gain, [20.0, 6.0, 30 * 0.05 / 2, 4.0, -1.0])
    rotors = [0.3 + 20**2 * 0.001, 0.02, 0.02, 0.02 * (1 + RATIO**2), 0.02]
    np.testing.assert_allclose(machine.plant.rotor_inertia, rotors)
    # Two joints have a range, three have none: bounds of an experiment stay open.
    assert case.limits.stroke is None
    whole = {joint.name: joint for joint in read_mjcf(folder / "robot.xml").joints}
    assert whole["lift"].range == (-0.3, 0.5)
    assert whole["grip"].range is None


@pytest.mark.parametrize(
    ("unknown", "names"),
    [
        (["armature"], [f"rotor_inertia[{k}]" for k in range(1, 6)]),
        (["damping"], [f"viscous_friction[{k}].coefficient" for k in range(1, 6)]),
        ("frictionloss", [f"coulomb_friction[{k}].level" for k in range(1, 6)]),
    ],
)
def test_values_of_joints_are_unknown_where_the_case_says_so(folder, unknown, names):
    assert machine_of(folder, unknown=unknown)[1].parameters.names == names


def test_a_spring_is_unknown_with_the_force_of_its_rest(folder):
    free = {f.name: f.guess for f in machine_of(folder, unknown="stiffness")[1].parameters.free}
    # pitch: -2 x - 0.3 x^2 - 0.5 x^3, x from 0.2
    assert free["linear_stiffness[2].coefficient"] == pytest.approx(2 - 0.3 * 0.4 + 0.5 * 3 * 0.04)
    assert free["constant_force[2].level"] == pytest.approx(2 * 0.2 - 0.3 * 0.04 + 0.5 * 0.008)


def test_effects_of_the_case_take_the_place_of_the_files(folder):
    entry = {"kind": "viscous_friction", "joint": "lift", "coefficient": {"guess": 9.0}}
    case = read_case({"plant": PLANT, "effects": [entry]}, None, folder)
    viscous = [
        (e.ports, [v.guess for v in e.parameters["coefficient"]])
        for e in case.effects
        if e.cls.kind == "viscous_friction"
    ]
    assert viscous[0] == ((2,), [9.0])
    assert 2 not in viscous[1][0]
    assert viscous[1][0] == (0, 1, 3, 4)


def test_parameters_of_the_case_take_the_place_of_the_files(folder):
    parameters = {"mass": {"copy": {"guess": 0.5}}, "rotor_inertia": {"yaw": 0.01}}
    case, machine = machine_of(folder, parameters=parameters, gear_ratio={"yaw": 10.0})
    assert machine.parameters.names == ["mass[5]"]
    assert case.plant.links[4] == "copy"
    assert machine.plant.rotor_inertia[0] == 0.01
    assert machine.plant.gear_ratio.tolist() == [10.0, 1.0, 1.0, 1.0, 1.0]


def test_a_geared_rotor_counts_by_the_square(folder):
    plain, geared = machine_of(folder)[1].plant, machine_of(folder, gear_ratio=7.0)[1].plant
    np.testing.assert_allclose(geared.rotor_inertia * 49, plain.rotor_inertia)
    states = np.random.default_rng(0).uniform(-1, 1, (3, 5))
    np.testing.assert_allclose(geared.inertial(*states), plain.inertial(*states), rtol=1e-12)


SERVO = """<mujoco><option timestep="0.004"/><worldbody>
  <body><joint name="a" axis="0 1 0" range="-60 90"/>
    <inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
    <body pos="0.2 0 0"><joint name="b" axis="0 1 0" range="-1 1"/>
      <inertial pos="0.1 0 0" mass="0.5" diaginertia="0.1 0.1 0.1"/></body></body></worldbody>
  <actuator>
    <position joint="a" kp="50" kv="2" forcerange="-3 3"/>
    <general joint="b" biastype="affine" gainprm="40" biasprm="0 -40 -1" forcerange="-5 5"/>
  </actuator></mujoco>"""
LOG = {"time": "t", "position": ["q1", "q2"], "force": ["u1", "u2"], "reference": ["r1", "r2"]}


def test_position_servos_are_the_controller_of_a_log_with_a_reference(tmp_path):
    (tmp_path / "robot.xml").write_text(SERVO)
    controller = read_case({"plant": PLANT, "log": LOG}, None, tmp_path).controller
    assert (controller.kind, controller.period, controller.limit) == ("pd", 0.004, (3.0, 5.0))
    assert controller.law["kp"] == (50.0, 40.0)
    assert controller.law["kd"] == (2.0, 1.0)
    assert controller.law["derivative"] == "velocity"
    stroke = read_case({"plant": PLANT, "log": LOG}, None, tmp_path).limits.stroke
    np.testing.assert_allclose(stroke, np.radians([[-60, 90], [-1, 1]]))
    # No reference, no loop; a controller of the case goes before the file's; and a case may do without.
    open_loop = {k: v for k, v in LOG.items() if k != "reference"}
    assert read_case({"plant": PLANT, "log": open_loop}, None, tmp_path).controller is None
    own = {"kind": "pd", "kp": 1.0, "kd": 1.0, "period": 0.01}
    assert (
        read_case({"plant": PLANT, "log": LOG, "controller": own}, None, tmp_path).controller.period == 0.01
    )
    without = {"plant": PLANT | {"actuators": False}, "log": LOG}
    assert read_case(without, None, tmp_path).controller is None


LEFT_OUT = """<mujoco><option density="1.2"/><worldbody>
  <body name="base"><freejoint name="root"/><geom size="0.1"/>
    <body pos="0.3 0 0" gravcomp="1"><joint name="a" axis="0 1 0"/><geom size="0.1"/>
      <body pos="0.3 0 0"><joint name="b" type="ball"/><geom size="0.1"/></body>
      <body pos="0 0.3 0"><joint name="c" axis="0 1 0"/><geom size="0.1"/></body></body></body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="c" coef="-1"/></fixed></tendon>
  <equality><connect name="k" body1="base" anchor="0 0 0"/>
    <joint name="bent" joint1="c" joint2="a" polycoef="0 1 0.5 0 0"/></equality>
  <actuator><position name="geared" joint="a" kp="5" gear="3"/><motor name="pull" tendon="t"/>
    <motor name="one" joint="c"/><motor name="two" joint="c" forcerange="-1 2"/></actuator></mujoco>"""


def test_what_is_not_taken_over_is_named_in_a_line_each(tmp_path):
    (tmp_path / "robot.xml").write_text(LEFT_OUT)
    robot = read_mjcf(tmp_path / "robot.xml")
    assert robot.names == ("a", "c")
    assert [drive.name for drive in robot.drives] == ["one"]
    notes = "\n".join(robot.notes)
    for words in (
        "free joint 'root' is held",
        "ball joint 'b' is held",
        "equality 'k' (connect) is not kept",
        "equality 'bent' (joint) is not kept",
        "'geared' is a servo with a gear",
        "'pull' does not act on one joint",
        "'two' is a second one of joint 'c'",
        "forcerange at actuator 'two' differs by direction",
        "1 tendon is not kept",
        "gravcomp",
        "drag by a fluid",
        "contacts",
    ):
        assert words in notes, (words, notes)
    assert not [note for note in robot.notes if "\n" in note]


def test_meshes_may_be_absent_where_bodies_state_their_inertia(tmp_path):
    shown = '<geom type="mesh" mesh="shape" material="paint"/>'
    asset = '<asset><mesh name="shape" file="absent.stl"/><texture name="x" type="2d" file="absent.png"/>'
    asset += '<material name="paint" texture="x"/></asset>'
    text = SERVO.replace("<worldbody>", asset + "<worldbody>").replace("<inertial", shown + "<inertial", 1)
    (tmp_path / "robot.xml").write_text(text)
    (tmp_path / "plain.xml").write_text(SERVO)
    whole, plain = (read_mjcf(tmp_path / f"{name}.xml") for name in ("robot", "plain"))
    np.testing.assert_array_equal(whole.bodies, plain.bodies)
    needed = text.replace('<inertial pos="0.1 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>', "")
    (tmp_path / "robot.xml").write_text(needed)
    with pytest.raises(InputError, match=r"robot\.xml: MuJoCo cannot read it: .*absent\.stl"):
        read_mjcf(tmp_path / "robot.xml")


def test_without_mujoco_a_line_says_so(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError) as caught:
        load_case_of(folder)
    assert str(caught.value).count("\n") == 0
    assert "needs MuJoCo" in str(caught.value)
    assert "jaxid[mujoco]" in str(caught.value)


def load_case_of(folder):
    (folder / "case.toml").write_text('[plant]\nkind = "tree"\nmjcf = "robot.xml"\n')
    return load_case(folder / "case.toml")


@pytest.mark.skipif(
    "JAXID_DATA" not in os.environ, reason="JAXID_DATA does not name the folder of measured data"
)
def test_the_so101_is_mujocos():
    path = Path(os.environ["JAXID_DATA"]) / "so101" / "so101.xml"
    robot, model = read_mjcf(path), mujoco.MjModel.from_xml_path(str(path))
    plant = LinkTree(
        *robot.bodies.T,
        geometry=robot.geometry,
        parents=robot.parents,
        rotor_inertia=[joint.armature for joint in robot.joints],
        gravity_vector=robot.gravity,
    )
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, states = mujoco.MjData(model), np.random.default_rng(5).uniform(-2, 2, (1000, 3, 6))

    def theirs(q, qd, qdd):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        return data.qfrc_inverse + data.qfrc_passive

    wanted = np.array([theirs(*s) for s in states])
    found = np.asarray(jax.jit(jax.vmap(plant.inertial))(*states.transpose(1, 0, 2)))
    assert np.max(np.abs(found - wanted).max(axis=1) / np.abs(wanted).max(axis=1)) < 1e-10
    assert [drive.kp for drive in robot.drives] == [998.22] * 6
    assert [drive.limit for drive in robot.drives] == [3.35] * 6
    assert {joint.friction for joint in robot.joints} == {0.052}
