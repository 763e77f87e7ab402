"""[plant] of a tree: joints that are kept and held, the same from either file, and faults in one line."""

from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio
import pytest

from jaxid.arms.base_by_rules import base_parameters_by_rules
from jaxid.arms.base_parameters import base_parameters
from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.case.robot import kept
from jaxid.case.urdf import read_urdf_tree
from jaxid.errors import InputError
from jaxid.plants import LinkTree, SerialArm
from tests.support import urdf_arms

GRAVITY = (1.5, -2.0, -9.2)


def branched(seed: int = 5) -> str:
    """An arm of three joints, with a camera on the first link and two fingers beyond the hand."""
    rng = np.random.default_rng(seed)
    more = "".join(
        urdf_arms.link(name, rng) + urdf_arms.joint(f"to_{name}", kind, parent, name, rng)
        for name, kind, parent in (
            ("camera", "revolute", "link1"),
            ("left", "prismatic", "link3"),
            ("right", "prismatic", "link3"),
        )
    )
    return urdf_arms.arm(["revolute"] * 3, seed + 1).replace("</robot>", more + "</robot>")


MIMIC = '<mimic joint="to_left" multiplier="-0.7" offset="0.02"/></joint>'


def with_mimic() -> str:
    head, name, tail = branched().partition('<joint name="to_right"')
    assert name
    return head + name + tail.replace("</joint>", MIMIC, 1)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.urdf").write_text(branched())
    return tmp_path


def plant_of(folder, **plant):
    table = {"kind": "tree", "urdf": "arm.urdf", "gravity_vector": list(GRAVITY)} | plant
    case = read_case({"plant": table}, None, folder)
    return build_machine(case).plant, case.plant.names


def check_against_pinocchio(model, plant, names):
    """Forces at random states; joints by their names."""
    model.gravity.linear = np.array(GRAVITY)
    data, order = model.createData(), list(model.names)[1:]
    assert sorted(order) == sorted(names)
    at = [list(names).index(name) for name in order]
    ours = jax.jit(lambda *x: plant.inertial(*x))
    for q, qd, qdd in np.random.default_rng(7).uniform(-2, 2, (20, 3, len(names))):
        wanted = pinocchio.rnea(model, data, q[at], qd[at], qdd[at])
        np.testing.assert_allclose(
            np.asarray(ours(q, qd, qdd))[at], wanted, rtol=0, atol=1e-10 * abs(wanted).max()
        )


def test_all_joints_of_a_tree_move(folder):
    plant, names = plant_of(folder)
    assert plant.parents == (-1, 0, 1, 2, 2, 0)
    check_against_pinocchio(pinocchio.buildModelFromXML(branched()), plant, names)


def test_held_joints_stay_at_their_positions(folder):
    whole = pinocchio.buildModelFromXML(branched())
    q = pinocchio.neutral(whole)
    q[whole.joints[whole.getJointId("joint2")].idx_q] = 0.8
    q[whole.joints[whole.getJointId("to_left")].idx_q] = -0.3
    away = [whole.getJointId(name) for name in ("joint2", "to_left", "to_camera")]
    model = pinocchio.buildReducedModel(whole, away, q)
    held = {"joint2": 0.8, "to_left": -0.3}
    plant, names = plant_of(folder, joints=["joint1", "joint3", "to_right"], held=held)
    assert names == ("joint1", "joint3", "to_right")
    check_against_pinocchio(model, plant, names)
    # Without joints, those stay that are not held.
    assert plant_of(folder, held=held)[1] == ("joint1", "joint3", "to_right", "to_camera")


def test_a_joint_that_follows_is_held_with_its_leader(tmp_path):
    (tmp_path / "arm.urdf").write_text(with_mimic())
    whole = pinocchio.buildModelFromXML(branched())
    q = pinocchio.neutral(whole)
    for name, value in (("to_left", 0.4), ("to_right", -0.7 * 0.4 + 0.02)):
        q[whole.joints[whole.getJointId(name)].idx_q] = value
    model = pinocchio.buildReducedModel(whole, [whole.getJointId(f"to_{n}") for n in ("left", "right")], q)
    plant, names = plant_of(tmp_path, held={"to_left": 0.4})
    check_against_pinocchio(model, plant, names)


def test_frames_of_links_are_pinocchios(tmp_path):
    (tmp_path / "arm.urdf").write_text(with_mimic())
    model = pinocchio.buildModelFromXML(branched())
    data = model.createData()
    plant, names = plant_of(tmp_path)
    assert names == ("joint1", "joint2", "joint3", "to_left", "to_camera")
    q = np.random.default_rng(0).uniform(-1, 1, 5)
    along = {
        joint.get("name"): [float(x) for x in joint.find("axis").get("xyz").split()]
        for joint in ElementTree.fromstring(branched()).findall("joint")
    }
    by_name = dict(zip(names, q, strict=True)) | {"to_right": -0.7 * q[3] + 0.02}
    pinocchio.forwardKinematics(model, data, np.array([by_name[n] for n in list(model.names)[1:]]))
    for k, name in enumerate(names):
        there = data.oMi[model.getJointId(name)]
        axes, origin = plant.frame(k, jnp.asarray(q))
        np.testing.assert_allclose(origin, there.translation, atol=1e-12)
        np.testing.assert_allclose(axes[:, 2], there.rotation @ along[name], atol=1e-12)


def test_a_chain_is_a_serial_arm(tmp_path):
    (tmp_path / "arm.urdf").write_text(urdf_arms.arm(["revolute", "prismatic", "revolute"], 3))
    cases = [
        read_case({"plant": {"kind": kind, "urdf": "arm.urdf", "unknown": "base"}}, None, tmp_path)
        for kind in ("serial_arm", "tree")
    ]
    arm, tree = (build_machine(case) for case in cases)
    assert isinstance(arm.plant, SerialArm)
    assert arm.parameters.names == tree.parameters.names
    np.testing.assert_allclose(arm.parameters.guess, tree.parameters.guess, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rotors", [None, np.ones(6)])
def test_closed_rules_give_the_numerical_mapping_of_a_tree(folder, rotors):
    robot = read_urdf_tree(folder / "arm.urdf")
    plant = LinkTree(*robot.bodies.T, geometry=robot.geometry, parents=robot.parents, rotor_inertia=rotors)
    rules, numbers = base_parameters_by_rules(plant), base_parameters(plant)
    assert rules.chosen == numbers.chosen
    np.testing.assert_allclose(rules.mapping, numbers.mapping, atol=1e-9)


def test_base_parameters_of_a_tree_with_a_follower_move_it_as_all_do(tmp_path):
    (tmp_path / "arm.urdf").write_text(with_mimic())
    states = np.random.default_rng(1).uniform(-1, 1, (3, 5))
    whole, base = plant_of(tmp_path)[0], plant_of(tmp_path, unknown="base")[0]
    assert np.count_nonzero(base.mass) < 6
    np.testing.assert_allclose(base.inertial(*states), whole.inertial(*states), rtol=1e-9)


@pytest.mark.parametrize("plant", [{}, {"held": {"joint3": 0.4}}], ids=["free", "held"])
def test_a_payload_hangs_at_a_point_of_a_link(folder, plant):
    """Against a link of that mass in the file, fixed at the point; the link that carries it may be held."""
    point, mass = [0.1, -0.2, 0.05], 1.7
    load = (
        f'<link name="load"><inertial><mass value="{mass}"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" '
        'izz="0"/></inertial></link><joint name="grip" type="fixed"><origin xyz="0.1 -0.2 0.05"/>'
        '<parent link="link3"/><child link="load"/></joint></robot>'
    )
    (folder / "loaded.urdf").write_text(branched().replace("</robot>", load))
    wanted, _ = plant_of(folder, urdf="loaded.urdf", **plant)
    carrier = "joint2" if "held" in plant else "joint3"
    stated = {"payload_at": {"link3": point}, "parameters": {"payload": {carrier: mass}}}
    found, _ = plant_of(folder, **stated, **plant)
    empty, _ = plant_of(folder, payload_at={"link3": point}, **plant)
    bare, _ = plant_of(folder, **plant)
    moments = [np.asarray(p.prepared().moments) for p in (wanted, found, empty, bare)]
    np.testing.assert_allclose(moments[1], moments[0], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(moments[2], moments[3])
    assert np.abs(moments[0] - moments[3]).max() > 0.9 * mass


def test_friction_and_ranges_of_a_urdf_count(tmp_path):
    text = branched().replace(
        '<joint name="joint2" type="revolute">',
        '<joint name="joint2" type="revolute"><dynamics damping="0.3" friction="0.7"/>',
    )
    (tmp_path / "arm.urdf").write_text(text)
    case = read_case({"plant": {"kind": "tree", "urdf": "arm.urdf"}}, None, tmp_path)
    assert [(e.cls.kind, e.ports) for e in case.effects] == [
        ("viscous_friction", (1,)),
        ("coulomb_friction", (1,)),
    ]
    assert case.limits.stroke == ((-2.0, 2.0),) * 6


FAULTS = {
    "no file": ({"urdf": None}, "'urdf' or 'mjcf' is missing"),
    "two files": ({"mjcf": "a.xml"}, "both urdf and mjcf are given"),
    "no joint": ({"joints": ["joint9"]}, "there is no joint 'joint9'; did you mean 'joint"),
    "order": ({"joints": ["joint2", "joint1"]}, "not in the order of the file; write joint1, joint2"),
    "both": ({"joints": ["joint1"], "held": {"joint1": 0.1}}, "'joint1' is in joints and in held"),
    "follower": ({"joints": ["to_right"]}, "'to_right' follows 'to_left'"),
    "unknown": ({"unknown": ["base", "masses"]}, '"masses"'),
    "base and all": ({"unknown": ["base", "all"]}, "has base and all"),
    "gear": ({"gear_ratio": {"joint9": 2.0}}, "gear_ratio names 'joint9'"),
    "driven": ({"actuated": ["joint1", "joint1"]}, "names a joint twice"),
    "parameter": ({"parameters": {"weight": {}}}, "unknown key 'weight'"),
    "link": ({"parameters": {"mass": {"joint9": 1.0}}}, "mass names 'joint9'"),
    "length": ({"parameters": {"mass": [1.0]}}, "mass has 1 entries; give 6"),
    "value": ({"parameters": {"mass": {"joint1": -1.0}}}, "mass.joint1 = -1.0 is negative"),
    "links": ({"links": []}, "unknown key 'links'"),
    "payload": ({"parameters": {"payload": {"joint1": 1.0}}}, "payload has no place; state payload_at"),
    "no such link": ({"payload_at": {"hand": [0, 0, 0]}}, "payload_at names 'hand', which is no link"),
    "base link": ({"payload_at": {"base": [0, 0, 0]}}, "payload_at names 'base', which no joint moves"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_stated_in_one_line(tmp_path, fault):
    plant, words = FAULTS[fault]
    (tmp_path / "arm.urdf").write_text(with_mimic())
    table = {k: v for k, v in ({"kind": "tree", "urdf": "arm.urdf"} | plant).items() if v is not None}
    with pytest.raises(InputError) as caught:
        read_case({"plant": table}, None, tmp_path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_joint_without_mass_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    more = urdf_arms.link("empty", None) + urdf_arms.joint("loose", "revolute", "link1", "empty", rng)
    text = branched().replace("</robot>", more + "</robot>")
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.raises(InputError, match="joint 'loose': it moves no mass"):
        plant_of(tmp_path)
    robot = read_urdf_tree(tmp_path / "arm.urdf")
    assert "loose" not in kept(robot, None, {"loose": 0.0}).names
