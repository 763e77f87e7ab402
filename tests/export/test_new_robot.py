"""Arms of which no file exists, as new MJCF and URDF files: MuJoCo and Pinocchio have jaxid's forces."""

import json
from dataclasses import replace
from xml.etree import ElementTree

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jaxid.arms.bodies import are_bodies, links_of
from jaxid.arms.likely_bodies import likely_bodies
from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.case.mjcf import read_mjcf
from jaxid.case.urdf import read_urdf_tree
from jaxid.cli import main
from jaxid.commands.export import export
from jaxid.export.shaft_tendons import ShaftTendons
from jaxid.results.model_json import drives_json, robot_json
from tests.export.test_other_targets import compiled, imported, in_c

# A body with its centre beside the axis; and two by what forces show of them, with zeros for the rest.
BALL = {"mass": 2.0, "first_moment": [0.2, 0.1, -0.1], "inertia": [0.1, -0.01, 0.01, 0.12, 0.005, 0.13]}
SUMS = (
    {"mass": 0.0, "first_moment": [0.0, 0.0, 0.0], "inertia": [0.0, 0.0, 0.0, 0.0, 0.0, 0.6]},
    {"mass": 0.0, "first_moment": [0.2, 0.1, 0.0], "inertia": [-0.02, -0.01, 0.01, 0.0, 0.005, 0.13]},
)
TURNED = (
    {"joint": "revolute", "alpha": 0.4, "a": 0.1},
    {"joint": "revolute", "alpha": -1.57, "a": 0.3, "d": 0.1},
)
# All tests of forces have the same effects, so that jaxid's are compiled once.
EFFECTS = [
    {"kind": "viscous_friction", "coefficient": [0.3, 0.2]},
    {"kind": "linear_stiffness", "joint": 1, "coefficient": 4.0},
    {"kind": "constant_force", "level": [0.5, -0.4]},
    {"kind": "added_mass", "shaft": 1, "mass": 0.05},
    {"kind": "viscous_friction", "shaft": 1, "coefficient": 0.6},
    {"kind": "coulomb_friction", "level": [0.7, 0.0]},
    {"kind": "coulomb_friction", "shaft": 1, "level": 0.9},
]


def arm(folder, links=(BALL, BALL), effects=EFFECTS, rotors=(0.02, 0.03), **tables):
    """Result and machine of an arm of two joints, without a fit."""
    rows = [
        {**place, **link, "rotor_inertia": r} for place, link, r in zip(TURNED, links, rotors, strict=True)
    ]
    plant = {
        "kind": "serial_arm",
        "links": rows,
        "gravity_vector": [1.0, 2.0, -9.0],
        "shafts": [{"joints": [1, 2], "ratios": [-1.0, 2.0]}],
    }
    case = read_case({"plant": plant, "effects": list(effects)} | tables, None, folder)
    machine = build_machine(case)
    model = robot_json(machine.plant, case.plant, {}) | {"drives": drives_json(machine)}
    return {"model": json.loads(json.dumps(model))}, machine


def without(values, *kinds):
    """Result and machine with effects of some kinds at zero."""
    result, machine = values
    for effect in result["model"]["effects"]:
        if effect["kind"] in kinds:
            effect["parameters"] = {n: v and 0.0 for n, v in effect["parameters"].items()}
    effects = [jax.tree.map(jnp.zeros_like, e) if e.kind in kinds else e for e in machine.plant.effects]
    return result, replace(machine, plant=replace(machine.plant, effects=tuple(effects)))


@eqx.filter_jit
def balance(plant, q, v, a):
    none = plant.initial_states(jnp.zeros(2))
    one = lambda *x: plant.balance(*x, jnp.zeros(2), jnp.zeros(()), none).residual
    return jax.vmap(one)(q, v, a)


def needed(machine, q, v, a):
    """Force of the drives at the joints by jaxid, dry friction by its sharp sign."""
    smooth = machine.plant.smoothed(sharpness=jnp.asarray(1e-9), velocity_scale=jnp.ones(2))
    return np.asarray(balance(smooth, q, v, a))


def states(count=30):
    """Positions, velocities away from zero at the joints and the shaft, and accelerations."""
    q, v, a = np.random.default_rng(3).uniform(-2.0, 2.0, (3, count, 2))
    v = np.where(np.abs(v) < 0.1, 0.1, v)
    clear = np.abs(v @ [-1.0, 2.0]) > 0.1
    return q[clear], v[clear], a[clear]


def inverse(model, q, v, a):
    """Forces of the motors by MuJoCo, friction's and those of their constant part apart."""
    data, out, dry = mujoco.MjData(model), [], []
    for data.qpos[:], data.qvel[:], data.qacc[:] in zip(q, v, a, strict=True):
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse - model.actuator_biasprm[:, 0])
        dry.append(data.qfrc_constraint.copy())
    return np.array(out), np.array(dry)


@pytest.mark.parametrize("links", [(BALL, BALL), SUMS], ids=["bodies", "sums"])
def test_mujoco_has_the_forces_of_an_arm_without_a_file(tmp_path, links):
    result, machine = without(arm(tmp_path, links), "coulomb_friction")
    file = export(result, "mjcf", name="my arm")
    assert file.new
    assert file.real
    assert not file.notes
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    q, v, a = states()
    wanted = needed(machine, q, v, a)
    found, dry = inverse(model, q, v, a)
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()
    assert not dry.any()
    (tmp_path / "new.xml").write_bytes(file.content)
    assert are_bodies(read_mjcf(tmp_path / "new.xml").bodies)


def test_dry_friction_of_joints_and_shafts_is_mujocos(tmp_path):
    result, _ = arm(tmp_path)
    model = mujoco.MjModel.from_xml_string(export(result, "mjcf").content.decode())
    q, v, _ = states()
    turn = v @ [-1.0, 2.0]
    # A joint that slows down within a step would have less: none accelerates here.
    _, dry = inverse(model, q, v, 0 * v)
    wanted = -np.stack([0.7 * np.sign(v[:, 0]), 0 * turn], axis=1)
    wanted -= 0.9 * np.sign(turn)[:, None] * [-1.0, 2.0]
    np.testing.assert_allclose(dry, wanted, atol=1e-12)


def test_pinocchio_has_the_forces_of_the_urdf(tmp_path):
    pinocchio = pytest.importorskip("pinocchio")
    kinds = {effect["kind"] for effect in EFFECTS}
    result, machine = without(arm(tmp_path, SUMS, rotors=(0.0, 0.0)), *kinds)
    file = export(result, "urdf", name="my arm")
    (gravity,) = file.notes
    assert gravity == "gravity [1.0, 2.0, -9.0] m/s^2 has no place in a URDF: set it in the simulation"
    model = pinocchio.buildModelFromXML(file.content.decode())
    model.gravity.linear = np.array([1.0, 2.0, -9.0])
    data = model.createData()
    q, v, a = states()
    # A joint without limits has cosine and sine for its angle.
    turns = np.stack([np.cos(q), np.sin(q)], axis=-1).reshape(len(q), 4)
    found = [pinocchio.rnea(model, data, *state).copy() for state in zip(turns, v, a, strict=True)]
    wanted = needed(machine, q, v, a)
    assert np.abs(found - wanted).max() < 1e-9 * np.abs(wanted).max()
    (tmp_path / "new.urdf").write_bytes(file.content)
    assert read_urdf_tree(tmp_path / "new.urdf").names == ("joint1", "joint2")


def test_shafts_are_in_c_and_python(tmp_path):
    result, machine = arm(tmp_path)
    q, v, a = states()
    wanted = needed(machine, q, v, a)
    module = imported(tmp_path, export(result, "python").content)
    found = np.array([module.torque(*state) for state in zip(q, v, a, strict=True)])
    assert np.abs(found - wanted).max() < 1e-12 * np.abs(wanted).max()
    back = np.array([module.acceleration(*state) for state in zip(q, v, wanted, strict=True)])
    np.testing.assert_allclose(back, a, atol=1e-10)
    library = compiled(tmp_path, export(result, "c", name="arm").content, "arm")
    found = in_c(library.torque, (q, v, a), 2)
    assert np.abs(found - wanted).max() < 3e-6 * np.abs(wanted).max()


def test_sums_that_no_bodies_have_are_said(tmp_path):
    sums = ({**SUMS[0]}, {**SUMS[1], "inertia": [-0.02, -0.01, 0.01, 0.0, 0.005, -0.01]})
    result, machine = arm(tmp_path, sums)
    file = export(result, "mjcf")
    assert not file.real
    assert file.notes[0].startswith("no bodies have the inertias that were found: sums differ by ")
    assert b"Not in it: no bodies" in file.content
    # They are the nearest ones: of the joint's inertia nothing is left, and it is still a body.
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    assert model.body_inertia.min() >= 0
    found = likely_bodies(replace(machine.plant, effects=()))
    assert are_bodies(found.links)
    assert found.error > 0.1
    whole = replace(machine.plant, mass=jnp.ones(2), inertia_xx=jnp.ones(2), inertia_yy=jnp.ones(2))
    whole = replace(whole, inertia_zz=jnp.ones(2))
    np.testing.assert_array_equal(likely_bodies(whole).links, links_of(whole))


def test_drives_are_in_the_actuators(tmp_path):
    chain = [
        {"kind": "actuator_gain", "joint": 1, "gain": 0.8},
        {"kind": "actuator_offset", "joint": 1, "level": 0.1},
        {"kind": "input_delay", "joint": 1, "delay": 0.0035},
        {"kind": "saturation", "joint": 1, "limit": 5.0},
        {"kind": "actuator_lag", "joint": 2, "time_constant": 0.02},
        {"kind": "saturation", "joint": 2, "limit": 3.0},
        {"kind": "asymmetric_viscous", "joint": 1, "coefficient": 0.1},
        {"kind": "constant_force", "joint": 2, "level": 0.3},
    ]
    result, _ = arm(tmp_path, effects=chain)
    file = export(result, "mjcf")
    lost = [note.split()[0] for note in file.notes]
    assert lost == ["asymmetric_viscous[joint1]", "constant_force[joint2]"]
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    data = mujoco.MjData(model)
    for data.ctrl[:], forces in (([2.0, 0.0], [1.7, 0.0]), ([20.0, 90.0], [5.0, 3.0])):
        for _ in range(400):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.actuator_force, forces, rtol=1e-6)
    assert model.actuator_delay[0] == 0.0035


def test_faults_leave_no_file(tmp_path, capsys):
    result, _ = arm(tmp_path)
    old = {"model": {k: v for k, v in result["model"].items() if k != "tree"}}
    (tmp_path / "good.json").write_text(json.dumps(result))
    (tmp_path / "old.json").write_text(json.dumps(old))
    for to, file, more, words in (
        ("mjcf", "old.json", [], "an older jaxid wrote it"),
        ("urdf", "old.json", [], "an older jaxid wrote it"),
        ("mjcf", "good.json", ["--model", "none.xml"], "none.xml"),
        ("mjcf", "good.json", ["--check", "none.csv"], "does not hold its case"),
        ("mjcf", "good.json", ["--samples", "2"], "covariance"),
    ):
        out = tmp_path / f"new.{'xml' if to == 'mjcf' else 'urdf'}"
        assert main(["export", str(tmp_path / file), "--to", to, "-o", str(out), *more]) == 2
        told = capsys.readouterr().err
        assert words in told, told
        assert told.count("\n") == 1
        assert not out.exists()
    out = tmp_path / "new.xml"
    assert main(["export", str(tmp_path / "good.json"), "--to", "mjcf", "-o", str(out)]) == 0
    told = capsys.readouterr().out
    assert "the case names no MJCF to change: a new one is written" in told
    assert "wrote joint 'joint1', joint 'joint2'" in told


def test_names_of_joints_are_escaped_in_a_tendon():
    """A name that XML would end early stays whole."""
    joints = ['a "left" & <upper>', "b"]
    effect = {"kind": "viscous_friction", "shaft": 1, "parameters": {"coefficient": 0.6}}
    model = {"joints": joints, "shafts": [[-1.0, 2.0]], "effects": [effect]}
    (text,) = ShaftTendons.of(model, 1e-3, joints).texts
    tendon = ElementTree.fromstring(text)
    assert [joint.get("joint") for joint in tendon] == joints
    assert tendon.get("damping") == "0.6"
