"""Arms from URDF files: their dynamics against Pinocchio's own reading, and every fault in one line."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.case.urdf import read_urdf
from jaxid.plants import SerialArm
from tests.support import urdf_arms
from tests.support.case_faults import message
from tests.support.cli_setup import run
from tests.support.written_logs import write_csv
from truth.arm.two_links import TwoLinks, followed

GRAVITY = (1.5, -2.0, -9.2)
LOG = '[log]\ntime = "t"\nposition = {position}\nforce = ["u1", "u2"]\n'
# Straight axes of either direction, and the two that a rotation onto them could divide by zero at.
STRAIGHT = [(0, 0, -1), (0, 0, 1), (1, 0, 0), (0, -1, 0), (1e-7, 0, -1), (0, 1, 0)]
ARMS = {
    "turning": urdf_arms.arm(["revolute"] * 6, 1, STRAIGHT),
    "sliding": urdf_arms.arm(["prismatic", "revolute", "prismatic"], 2),
    "held": urdf_arms.arm(["fixed", "revolute", "fixed", "fixed", "prismatic", "revolute", "fixed"], 3),
}


def plant_of(path, tip=None) -> SerialArm:
    arm = read_urdf(path, tip)
    return SerialArm(*arm.bodies.T, geometry=arm.geometry, gravity_vector=jnp.asarray(GRAVITY))


def agree(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10 * np.abs(theirs).max())


def check_against(pinocchio, model, plant):
    """Torque, mass matrix, Coriolis and weight on random states."""
    model.gravity.linear = np.array(GRAVITY)
    data, zero, rng = model.createData(), np.zeros(model.nv), np.random.default_rng(7)
    inertial = jax.jit(lambda *x: plant.inertial(*x))
    for _ in range(20):
        q, qd, qdd = rng.uniform(-2, 2, (3, model.nv))
        agree(inertial(q, qd, qdd), pinocchio.rnea(model, data, q, qd, qdd))
        agree(inertial(q, zero, zero), pinocchio.computeGeneralizedGravity(model, data, q))
        bias = pinocchio.rnea(model, data, q, qd, zero)
        agree(inertial(q, qd, zero), bias)
        mass = pinocchio.crba(model, data, q)
        columns = [inertial(q, qd, unit) - bias for unit in np.eye(model.nv)]
        agree(np.stack(columns, axis=1), np.triu(mass) + np.triu(mass, 1).T)


@pytest.mark.parametrize("name", ARMS)
def test_dynamics_are_those_that_pinocchio_reads(name, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(ARMS[name])
    model = pinocchio.buildModelFromXML(ARMS[name])
    assert read_urdf(path).names == tuple(model.names)[1:]
    check_against(pinocchio, model, plant_of(path))


def test_unlimited_joints_turn_as_others(tmp_path):
    text = urdf_arms.arm(["revolute", "revolute"], 4)
    for name, kind in (("a", "revolute"), ("b", "continuous")):
        (tmp_path / f"{name}.urdf").write_text(text.replace('"revolute"', f'"{kind}"'))
    states = np.random.default_rng(0).uniform(-2, 2, (3, 2))
    torques = [plant_of(tmp_path / f"{name}.urdf").inertial(*states) for name in "ab"]
    np.testing.assert_array_equal(*torques)


def branching() -> str:
    """An arm of three joints with a camera on the first link, and two fingers beyond the hand."""
    rng = np.random.default_rng(5)
    more = "".join(
        urdf_arms.link(name, rng) + urdf_arms.joint(f"to_{name}", kind, parent, name, rng)
        for name, kind, parent in (
            ("camera", "revolute", "link1"),
            ("left", "prismatic", "link3"),
            ("right", "prismatic", "link3"),
        )
    )
    return urdf_arms.arm(["revolute"] * 3, 6).replace("</robot>", more + "</robot>")


def test_what_branches_off_the_way_to_the_tip_is_held(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(branching())
    whole = pinocchio.buildModelFromXML(branching())
    away = [whole.getJointId(name) for name in ("to_camera", "to_left", "to_right")]
    model = pinocchio.buildReducedModel(whole, away, np.zeros(whole.nq))
    assert read_urdf(path, "link3").names == ("joint1", "joint2", "joint3")
    check_against(pinocchio, model, plant_of(path, "link3"))


# Two links in a plane, as `TwoLinks`.
def planar(arm: TwoLinks, joints=("shoulder", "elbow")) -> str:
    body = (
        '<link name="{0}"><inertial><origin xyz="{1} {2} 0"/><mass value="{3}"/>'
        '<inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="{4}"/></inertial></link>'
    )
    join = (
        '<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/>'
        '<origin xyz="{3} 0 0"/><axis xyz="0 0 1"/></joint>'
    )
    return (
        urdf_arms.HEAD
        + '<link name="ground"/>'
        + "".join(
            [
                body.format("upper", arm.x1, 0.0, arm.m1, arm.i1),
                body.format("lower", arm.x2, arm.y2, arm.m2, arm.i2),
                join.format(joints[0], "ground", "upper", 0.0),
                join.format(joints[1], "upper", "lower", arm.length),
            ]
        )
        + "</robot>"
    )


def case(position='["q1", "q2"]', unknown="base", more="") -> str:
    friction = "".join(
        f'[[effects]]\nkind = "{kind}"\n{key} = {{ guess = 0.1 }}\n'
        for kind, key in (("viscous_friction", "coefficient"), ("coulomb_friction", "level"))
    )
    plant = f'[plant]\nkind = "serial_arm"\nurdf = "arm.urdf"\nunknown = "{unknown}"\n'
    return plant + "gravity_vector = [0.0, -9.81, 0.0]\n" + friction + more + LOG.format(position=position)


BY_NAME = '{ elbow = "q2", shoulder = "q1" }'


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "arm.urdf").write_text(planar(TwoLinks()))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("position", [pytest.param('["q1", "q2"]', marks=pytest.mark.slow), BY_NAME])
def test_base_parameters_and_friction_come_back(folder, position):
    """The log is of a closed form; guesses are those of the file, in which the second mass is doubled."""
    arm = TwoLinks()
    doubled = planar(arm).replace(f'mass value="{arm.m2}"', f'mass value="{2 * arm.m2}"')
    (folder / "arm.urdf").write_text(doubled)
    (folder / "case.toml").write_text(case(position))
    log = write_csv(folder / "log.csv", followed(arm))
    estimate = jaxid.identify(folder / "case.toml", log, method="inverse_dynamics").estimate
    pairs = (("viscous_friction", "coefficient", arm.viscous), ("coulomb_friction", "level", arm.coulomb))
    true = arm.base | {
        f"{kind}[{k}].{key}": v for kind, key, values in pairs for k, v in enumerate(values, start=1)
    }
    assert set(estimate.names) == set(true)
    for name, value, std in zip(estimate.names, estimate.theta, estimate.std, strict=True):
        assert abs(value - true[name]) < 3 * std, (name, value, true[name], std)
    start = build_machine(load_case(folder / "case.toml")).parameters
    guess = dict(zip(start.names, start.guess, strict=True))
    assert guess["first_moment_x[2]"] == pytest.approx(2 * arm.m2 * arm.x2)
    assert abs(guess["inertia_zz[1]"] - arm.base["inertia_zz[1]"]) > 0.1


def test_unknown_says_which_parameters_are_fitted(folder):
    for unknown, count in (("none", 4), ("base", 6 + 4), ("all", 20 + 4)):
        (folder / "case.toml").write_text(case(unknown=unknown))
        assert len(build_machine(load_case(folder / "case.toml")).parameters.free) == count
    states = np.random.default_rng(1).uniform(-2, 2, (3, 2))
    torques = []
    for unknown in ("base", "all"):
        (folder / "case.toml").write_text(case(unknown=unknown))
        torques.append(build_machine(load_case(folder / "case.toml")).plant.inertial(*states))
    np.testing.assert_allclose(*torques, rtol=1e-12)


def test_effects_go_by_names_of_joints(folder):
    more = '[[effects]]\nkind = "constant_force"\njoint = "elbow"\nlevel = 1.0\n'
    (folder / "case.toml").write_text(case(more=more))
    assert load_case(folder / "case.toml").effects[-1].ports == (1,)


GOOD = planar(TwoLinks(m2=4.0))
_AT = GOOD.index('<link name="lower">')
LOWER = GOOD[_AT : GOOD.index("</link>", _AT)]
BACK = '<joint name="back" type="fixed"><parent link="ground"/><child link="lower"/></joint></robot>'
COPY, END = '<mimic joint="shoulder"/>', "</joint></robot>"
WRONG = {
    "loop": ("</robot>", BACK, ["link 'lower'", "'elbow' and 'back'", "loop"]),
    "ring": (
        '<parent link="ground"/>',
        '<parent link="lower"/>',
        ["from link 'upper' on lead back to it: a loop"],
    ),
    "closed": ('<link name="ground"/>', "", ["no link 'ground', its parent", "upper, lower"]),
    "no inertial": (LOWER, '<link name="lower">', ["link 'lower'", "has no <inertial>", "'elbow'"]),
    "massless": ('<mass value="4.0"/>', '<mass value="0"/>', ["has no mass", "moves it"]),
    "negative": ('<mass value="4.0"/>', '<mass value="-4"/>', ["<mass> is negative: -4 kg"]),
    "half": ('<mass value="4.0"/>', "", ["<inertial> has no <mass>", "add <mass"]),
    "type": (
        'name="elbow" type="revolute"',
        'name="elbow" type="planar"',
        ["joint 'elbow'", "type 'planar'", "revolute, continuous, prismatic, fixed"],
    ),
    "number": ('izz="', 'izz="${x}', ['<inertia> has izz="${x}', "give a number"]),
    "axis": ('xyz="0 0 1"', 'xyz="0 0 0"', ["<axis> has no length"]),
    "twice": ('name="elbow"', 'name="shoulder"', ["two <joint> are named 'shoulder'"]),
    "mimic": (END, COPY + END, ["joint 'elbow'", "copies joint 'shoulder'"]),
    "held": ('type="revolute"', 'type="fixed"', ["no joint can move"]),
    "not xml": ("</robot>", "", ["is not XML", "correct that line"]),
    "no robot": ("robot", "sdf", ["is no URDF", "<sdf>"]),
    "entities": ("<robot", '<!DOCTYPE r [<!ENTITY a "b">]><robot', ["document type declaration"]),
    "macro": ('<link name="ground"/>', '<link name="ground"/><xacro:arm/>', ["a macro", "xacro arm.urdf"]),
}


@pytest.mark.parametrize("fault", WRONG)
def test_faults_of_the_file_are_told_in_one_line(folder, capsys, fault):
    old, new, words = WRONG[fault]
    assert old in GOOD
    (folder / "arm.urdf").write_text(GOOD.replace(old, new))
    (folder / "case.toml").write_text(case())
    ran = run(capsys, "identify", folder / "case.toml", folder / "log.csv", folder=folder / "out")
    assert ran.status == 2
    assert ran.err.count("\n") == 1
    assert not [word for word in [str(folder / "arm.urdf"), *words] if word not in ran.err], ran.err
    assert not (folder / "out").exists()


def test_a_loop_that_hangs_on_nothing_is_refused(tmp_path):
    rng = np.random.default_rng(0)
    ring = "".join(urdf_arms.link(n, rng) for n in "ab") + "".join(
        urdf_arms.joint(p + c, "revolute", p, c, rng) for p, c in ("ab", "ba")
    )
    path = tmp_path / "arm.urdf"
    for text in (ring, ring + urdf_arms.link("ground", rng)):
        path.write_text(f"<robot>{text}</robot>")
        with pytest.raises(jaxid.InputError, match="lead back to it: a loop|closes to a loop"):
            read_urdf(path)


def test_branches_ask_for_a_tip(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(branching())
    with pytest.raises(jaxid.InputError, match=r"'joint2' and 'to_camera' branch.*tip = "):
        read_urdf(path)
    with pytest.raises(jaxid.InputError, match=r"there is no link 'link9', the tip; did you mean 'link"):
        read_urdf(path, "link9")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (BY_NAME, '{ shoulder = "q1" }', ["position", "no column for joint 'elbow'", "shoulder, elbow"]),
        (
            BY_NAME,
            '{ shoulder = "q1", elbow = "q2", hand = "q3" }',
            ["position", "names an unknown joint 'hand'"],
        ),
        (BY_NAME, '["q1", "q2", "q3"]', ["does not fit 2 joints", "shoulder, elbow"]),
        ('urdf = "arm.urdf"', 'urdf = "arms.urdf"', ["no such file", "arm.urdf"]),
        ('urdf = "arm.urdf"', 'links = []\nurdf = "arm.urdf"', ["both urdf and [[plant.links]]"]),
        ('urdf = "arm.urdf"\n', "links = []\n", ["unknown", "goes with urdf only"]),
        ('unknown = "base"', 'unknown = "some"', ["none, base, all"]),
        (
            "[log]",
            '[[effects]]\nkind = "constant_force"\njoint = "wrist"\nlevel = 1.0\n[log]',
            ["wrist", "is no joint of the arm", "shoulder, elbow"],
        ),
    ],
)
def test_faults_of_the_case_are_told_in_one_line(folder, old, new, words):
    good = case(BY_NAME)
    assert old in good
    told = message(folder, good.replace(old, new, 1)) if "arms" not in new else None
    if told is None:
        (folder / "case.toml").write_text(good.replace(old, new, 1))
        with pytest.raises(jaxid.InputError) as caught:
            load_case(folder / "case.toml")
        told = str(caught.value)
    assert not [word for word in words if word not in told], told
