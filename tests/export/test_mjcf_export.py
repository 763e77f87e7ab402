"""Results in the user's own MJCF: MuJoCo then has the forces that jaxid has, and all else stays."""

import copy
import json
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxid
from jaxid.arms.bodies import are_bodies, bodies_of, links_of
from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.commands.export import export
from jaxid.errors import InputError
from jaxid.names import TEN
from jaxid.results.model_json import bodies_json, robot_json
from tests.case.test_mjcf import FREE, forces_of_mujoco
from tests.support.mjcf_robots import BRANCHED, CART_JOINTS, cart, cart_log
from tests.support.written_logs import write_csv

CASE = """
[plant]
kind = "tree"
mjcf = "robot.xml"
unknown = ["base", "armature", "damping", "frictionloss", "stiffness"]
[log]
time = "t"
hold = "zero_order"
position = { rail = "q_rail", pole = "q_pole", boom = "q_boom", plunger = "q_plunger" }
force = { rail = "u_rail", pole = "u_pole", boom = "u_boom", plunger = "u_plunger" }
[sensor]
position_noise = 1e-6
"""


def machine_of(folder, text=BRANCHED, **plant):
    (folder / "robot.xml").write_text(text)
    case = read_case({"plant": {"kind": "tree", "mjcf": "robot.xml"} | plant}, None, folder)
    return case.plant, build_machine(case).plant, plant.get("held", {})


def exported(folder, entry, plant, held):
    return export({"model": robot_json(plant, entry, held)}, "mjcf", folder / "robot.xml")


def test_a_result_that_is_the_file_changes_nothing(tmp_path):
    file = exported(tmp_path, *machine_of(tmp_path))
    assert file.content == BRANCHED.encode()
    assert file.changed == file.notes == ()


def altered(plant, scale=1.3, seed=0):
    """Other bodies, rotors and friction; each link remains a body."""
    rng = np.random.default_rng(seed)
    factor = jnp.asarray(rng.uniform(1.0, scale, plant.mass.size))
    links = {n: factor * getattr(plant, n) for n in vars(plant) if n.startswith(("mass", "first", "inertia"))}
    effects = tuple(
        replace(e, coefficient=1.5 * e.coefficient) if e.kind == "viscous_friction" else e
        for e in plant.effects
    )
    return replace(plant, **links, rotor_inertia=plant.rotor_inertia + 0.05, effects=effects)


def forces_of_jaxid(plant, q, qd, qdd):
    """M qdd + h - effects, without drives, by state."""
    zero = jnp.zeros(plant.joints)
    none = plant.initial_states(zero)
    one = lambda *x: plant.balance(*x, zero, jnp.zeros(()), none).residual
    return np.asarray(jax.jit(jax.vmap(one))(q, qd, qdd))


def test_mujoco_has_the_forces_of_the_result(tmp_path):
    entry, plant, held = machine_of(tmp_path)
    new = altered(plant)
    file = exported(tmp_path, entry, new, held)
    assert not file.notes
    states = np.random.default_rng(4).uniform(-1, 1, (20, 3, len(FREE)))
    zero = np.zeros(len(FREE))
    wanted = forces_of_jaxid(new, *states.transpose(1, 0, 2))
    found = np.array([forces_of_mujoco(*s, zero, file.content.decode()) for s in states])
    before = np.array([forces_of_mujoco(*s, zero) for s in states])
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.max(np.abs(found - wanted) / size) < 1e-10
    assert np.max(np.abs(before - wanted) / size) > 0.05


def test_all_other_lines_stay(tmp_path):
    text = BRANCHED.replace('<body name="left"', '<!-- the "left" <arm> -->\n      <body name="left"')
    file = exported(tmp_path, *(lambda e, p, h: (e, altered(p), h))(*machine_of(tmp_path, text)))
    old, new = text.splitlines(), file.content.decode().splitlines()
    # The body of a shape gets an <inertial>, as a line of its own.
    added = [line for line in new if line not in old and "<inertial" in line and "mass" in line]
    assert len(new) == len(old) + 1
    rest = [line for line in new if line not in added]
    for a in old:
        if a not in rest:
            assert "<joint" in a or "<inertial" in a, a
    assert any("<arm>" in line for line in new)


def test_held_joints_stay_where_they_are(tmp_path):
    held = {"pitch": 0.2, "swing": -0.4}
    entry, plant, _ = machine_of(tmp_path, held=held)
    new = altered(plant)
    file = exported(tmp_path, entry, new, held)
    (tmp_path / "robot.xml").write_bytes(file.content)
    case = {"plant": {"kind": "tree", "mjcf": "robot.xml", "held": held}}
    again = build_machine(read_case(case, None, tmp_path)).plant
    np.testing.assert_allclose(links_of(again), links_of(new), rtol=1e-9, atol=1e-9)


def test_what_an_mjcf_cannot_express_is_named(tmp_path):
    entry, plant, held = machine_of(tmp_path)
    model = robot_json(plant, entry, held)
    place = {"joint": 2, "joint_name": "pitch"}
    model["effects"] += [
        {"kind": "stribeck_friction", **place, "parameters": {"level": 0.3, "velocity": 0.1}},
        {"kind": "linear_stiffness", **place, "parameters": {"coefficient": -50.0}},
    ]
    file = export({"model": model}, "mjcf", tmp_path / "robot.xml")
    assert file.content == BRANCHED.encode()
    assert "stribeck_friction[pitch] (level = 0.3, velocity = 0.1) has no place in an MJCF" in file.notes
    assert "a spring of an MJCF has a rest, and pulls towards it" in file.notes[1]


def test_bodies_behind_base_parameters_are_real_and_move_alike(tmp_path):
    _, whole, _ = machine_of(tmp_path, cart())
    _, base, _ = machine_of(tmp_path, cart(), unknown=["base", "armature"])
    assert not are_bodies(links_of(base))
    # From a file whose masses are off by a quarter.
    start, rotors = links_of(whole) * np.array([1.25, 0.8, 1.1, 0.9])[:, None], np.zeros(4)
    found = bodies_of(base, start, rotors)
    assert are_bodies(found.links)
    assert found.error < 1e-9
    names = [n for n in vars(base) if n.startswith(("mass", "first", "inertia"))]
    real = replace(
        base, **dict(zip(names, jnp.asarray(found.links.T), strict=True)), rotor_inertia=found.rotors
    )
    states = np.random.default_rng(2).uniform(-1, 1, (20, 3, 4))
    force = jax.jit(jax.vmap(lambda p, s: p.inertial(*s), (None, 0)))
    wanted = np.asarray(force(whole, states))
    np.testing.assert_allclose(force(real, states), wanted, atol=1e-8 * np.abs(wanted).max())


def test_rotors_that_a_case_states_are_not_put_into_its_links(tmp_path):
    _, whole, _ = machine_of(tmp_path, cart())
    stated = [0.3, 0.4, 0.5, 0.6]
    _, base, _ = machine_of(tmp_path, cart(), unknown=["base"], parameters={"rotor_inertia": stated})
    found = bodies_of(base, links_of(whole), np.zeros(4))
    np.testing.assert_array_equal(found.rotors, stated)
    np.testing.assert_allclose(found.links, links_of(whole), atol=1e-8)


def test_results_hold_bodies_that_can_exist(tmp_path):
    entry, base, _ = machine_of(tmp_path, cart(), unknown=["base", "armature"])
    assert not are_bodies(links_of(base))
    held = bodies_json(base, entry)
    links = np.stack([held[name] for name in TEN], axis=-1)
    assert are_bodies(links)
    assert held["error"] < 1e-6
    # The sums are those of the file itself, so its bodies are found again.
    whole = links_of(machine_of(tmp_path, cart())[1])
    np.testing.assert_allclose(links, whole, atol=1e-8)
    # Links that no body can be are said to be none.
    less = replace(base, **{"inertia_zz": base.inertia_zz - 10.0})
    assert bodies_json(less, entry)["error"] > 1e-3


def forward(text: str, u: np.ndarray, start: np.ndarray, rate: int) -> np.ndarray:
    """Positions by MuJoCo under the forces of a log, held between its samples."""
    model = mujoco.MjModel.from_xml_string(text)
    data, inner = mujoco.MjData(model), round(1 / rate / model.opt.timestep)
    data.qpos[:], out = start, np.zeros_like(u)
    for k, now in enumerate(u):
        out[k], data.ctrl[:] = data.qpos, now
        for _ in range(inner):
            mujoco.mj_step(model, data)
    return out


@pytest.mark.slow
def test_a_wrong_file_becomes_that_of_the_log(tmp_path, capsys):
    """Rotors, dry friction, damping, a spring and a mass that the file lacks are in the log."""
    sprung = cart(rail=2.0, pole=0.15).replace(
        'name="boom" axis', 'name="boom" stiffness="8" springref="0.2" axis'
    )
    assert sprung != cart(rail=2.0, pole=0.15)
    wrong = cart().replace('mass="0.8"', 'mass="0.5"').replace('armature="0.02"', 'armature="0.01"')
    wrong = wrong.replace('damping="4"', 'damping="2"')
    (tmp_path / "robot.xml").write_text(wrong)
    (tmp_path / "case.toml").write_text(CASE)
    log = cart_log(sprung, seconds=8.0, rate=250)
    write_csv(tmp_path / "log.csv", log)
    result = jaxid.identify(tmp_path / "case.toml", tmp_path / "log.csv", method="inverse_dynamics")
    result.save(tmp_path / "out")
    argv = (tmp_path / "out" / "result.json", "--to", "mjcf", "--model", tmp_path / "robot.xml")
    ran = run_export(capsys, *argv, "-o", tmp_path / "found.xml")
    assert "changed joint 'rail'" in ran
    text = (tmp_path / "found.xml").read_text()
    u, q = (np.stack([log[f"{x}_{n}"] for n in CART_JOINTS], axis=-1) for x in "uq")
    model = mujoco.MjModel.from_xml_string(text)
    np.testing.assert_allclose(model.dof_frictionloss, [2.0, 0.15, 0.0, 0.0], atol=1e-3)
    np.testing.assert_allclose(model.dof_damping, [4.0, 0.1, 0.2, 3.0], rtol=1e-3)
    assert model.jnt_stiffness[2] == pytest.approx(8.0, rel=1e-3)
    assert model.qpos_spring[2] == pytest.approx(0.2, rel=1e-3)
    # In open loop the first second under the logged forces: before and after. The log has the softness of dry
    # friction that stands among the file's defaults; the exported joints hold, as those of a machine do.
    part, (head, defaults, joints) = 250, text.partition("</default>")
    soft = head + defaults + re.sub(r' sol(ref|imp)friction="[^"]*"', "", joints)
    assert soft != text
    off = [np.abs(forward(t, u[:part], q[0], 250) - q[:part]).max() for t in (wrong, soft, text)]
    assert off[0] > 1.0
    assert off[1] < 1e-4
    assert off[1] < off[2] < 1e-3


def run_export(capsys, *argv) -> str:
    from jaxid.cli import main

    assert main(["export", *map(str, argv)]) == 0
    return capsys.readouterr().out


def test_faults_are_stated_in_one_line(tmp_path, capsys):
    from jaxid.cli import main

    entry, plant, held = machine_of(tmp_path)
    good = {"model": robot_json(plant, entry, held)}
    (tmp_path / "bare.json").write_text("{}")
    (tmp_path / "good.json").write_text(json.dumps(good))
    other = copy.deepcopy(good)
    other["model"]["links"][0] = "elsewhere"
    (tmp_path / "other.json").write_text(json.dumps(other))
    (tmp_path / "part.xml").write_text('<mujoco><include file="robot.xml"/></mujoco>')
    for argv, words in (
        (["bare.json", "robot.xml", "new.xml"], "has no robot to export"),
        (["none.json", "robot.xml", "new.xml"], "cannot be read"),
        (["other.json", "robot.xml", "new.xml"], "those of the result"),
        (["good.json", "none.xml", "new.xml"], "none.xml"),
        (["good.json", "part.xml", "new.xml"], "stand in other files"),
        (["good.json", "robot.xml", "robot.xml"], "exists already"),
        (["good.json", "robot.xml", "new.csv"], "end its name in .xml"),
    ):
        result, model, out = (str(tmp_path / name) for name in argv)
        assert main(["export", result, "--to", "mjcf", "--model", model, "-o", out]) == 2
        told = capsys.readouterr().err
        assert words in told, told
        assert told.count("\n") == 1
    with pytest.raises(InputError, match="target 'sdf' is not known"):
        export(good, "sdf", tmp_path / "robot.xml")
