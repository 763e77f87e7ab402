"""Results as URDF, C, Python and Isaac Lab: the forces are jaxid's, and what is left out is named."""

import ctypes
import importlib.util
import json
import shutil
import subprocess
import sys
import types
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.commands.export import export
from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.results.model_json import drives_json, robot_json
from tests.case.test_mjcf import FREE
from tests.support.mjcf_robots import BRANCHED
from tests.support.urdf_arms import arm

# Every effect whose force is a function of the motion, and the drive's own.
FOUND = (
    ("coulomb_friction", {"level": 0.7}),
    ("stribeck_friction", {"level": 0.4, "velocity": 0.3}),
    ("asymmetric_viscous", {"coefficient": -0.2}),
    ("quartic_friction", {"coefficient": 0.05}),
    ("cogging", {"amplitude": 0.3, "period": 0.2, "phase": 0.7}),
    ("unbalance", {"moment": 0.1, "phase": -0.4}),
    ("added_mass", {"mass": 0.06}),
)
IN_DRIVE = (("actuator_gain", {"gain": 0.8}), ("actuator_offset", {"level": 0.1}))


def machine_of(folder, text=BRANCHED, key="mjcf", **plant):
    file = f"robot.{'xml' if key == 'mjcf' else 'urdf'}"
    (folder / file).write_text(text)
    case = read_case({"plant": {"kind": "tree", key: file} | plant}, None, folder)
    return case.plant, build_machine(case)


def with_effects(machine, *effects, port=1):
    plant = machine.plant
    for kind, values in effects:
        plant = plant.with_effect(EFFECTS[kind](port=port, **{n: jnp.asarray(v) for n, v in values.items()}))
    return replace(machine, plant=plant)


def result_of(entry, machine, held=()):
    model = robot_json(machine.plant, entry, dict(held)) | {"drives": drives_json(machine)}
    return {"model": model}


def states(joints=5, count=40):
    """Positions, velocities away from zero, and accelerations."""
    q, v, a = np.random.default_rng(5).uniform(-1, 1, (3, count, joints))
    return q, np.where(np.abs(v) < 0.02, 0.02, v), a


def needed(machine, q, v, a):
    """Force of the drives at the joints by jaxid, dry friction by its sharp sign."""
    plant = machine.plant
    drives = plant.driven(plant.joints)
    zero, none = jnp.zeros(len(drives)), plant.initial_states(jnp.zeros(len(drives)))
    # The sign is a tanh of the velocity over a width, here far below every velocity.
    plant = plant.smoothed(sharpness=jnp.asarray(1e-9), velocity_scale=jnp.ones(plant.joints))
    one = lambda *x: plant.balance(*x, zero, jnp.zeros(()), none).residual
    return np.asarray(jax.jit(jax.vmap(one))(q, v, a))


def compiled(tmp_path, content, name):
    """The functions of a C header, by a shared library of them."""
    cc = shutil.which("cc")
    if cc is None:
        pytest.skip("no C compiler")
    (tmp_path / f"{name}.h").write_bytes(content)
    (tmp_path / "call.c").write_text(
        f'#include "{name}.h"\n'
        "#define THREE const float *q, const float *v, const float *a, float *out\n"
        f"void torque(THREE) {{ {name}_torque(q, v, a, out); }}\n"
        f"void command(THREE) {{ {name}_command(q, v, a, out); }}\n"
    )
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-Wfloat-conversion"]
    subprocess.run(
        [cc, *strict, "-O2", "-shared", "-fPIC", "-o", "call.so", "call.c", "-lm"], cwd=tmp_path, check=True
    )
    return ctypes.CDLL(str(tmp_path / "call.so"))


def in_c(function, rows, width):
    out = np.zeros((len(rows[0]), width), np.float32)
    pointer = ctypes.POINTER(ctypes.c_float)
    for k, state in enumerate(zip(*rows, strict=True)):
        arrays = [np.ascontiguousarray(x, np.float32) for x in state] + [out[k]]
        function(*(x.ctypes.data_as(pointer) for x in arrays))
    return out


def imported(tmp_path, content, name="found"):
    path = tmp_path / f"{name}.py"
    path.write_bytes(content)
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_c_and_python_have_the_forces_of_the_result(tmp_path):
    entry, machine = machine_of(tmp_path)
    machine = with_effects(machine, *FOUND)
    file = export(result_of(entry, machine), "c", name="my arm-2")
    assert not file.notes
    library = compiled(tmp_path, file.content, "my_arm_2")
    q, v, a = states()
    wanted = needed(machine, q, v, a)
    size = np.abs(wanted).max(axis=1, keepdims=True)
    bare = needed(machine_of(tmp_path)[1], q, v, a)
    assert np.max(np.abs(bare - wanted) / size) > 0.05
    # Single precision: 2^-24 a rounding, and a few dozen of them.
    found = in_c(library.torque, (q, v, a), len(FREE))
    assert np.max(np.abs(found - wanted) / size) < 3e-6
    gains = np.array(machine.gain)
    commands = in_c(library.command, (q, v, a), len(gains))
    np.testing.assert_allclose(commands * gains / size, wanted / size, atol=3e-6)

    module = imported(tmp_path, export(result_of(entry, machine), "python").content)
    ours = np.array([module.torque(*state) for state in zip(q, v, a, strict=True)])
    assert np.max(np.abs(ours - wanted) / size) < 1e-12
    tau = np.array([module.command(*state) for state in zip(q, v, a, strict=True)]) * gains
    assert np.max(np.abs(tau - wanted) / size) < 1e-12
    back = np.array([module.acceleration(*state) for state in zip(q, v, wanted, strict=True)])
    np.testing.assert_allclose(back, a, atol=1e-10)


def test_a_python_file_needs_numpy_only(tmp_path):
    entry, machine = machine_of(tmp_path)
    (tmp_path / "found.py").write_bytes(export(result_of(entry, machine), "python").content)
    code = "import sys, found; print([m for m in ('jax', 'jaxid', 'scipy', 'mujoco') if m in sys.modules])"
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert ran.stdout.strip() == "[]"


def test_commands_undo_gain_and_offset_of_a_drive_in_their_order(tmp_path):
    entry, machine = machine_of(tmp_path)
    drive = with_effects(machine, *IN_DRIVE, port=0)
    module = imported(tmp_path, export(result_of(entry, drive), "python").content)
    q, v, a = (x[0] for x in states())
    u = module.command(q, v, a)
    # jaxid's balance under this command is zero.
    none = drive.plant.initial_states(jnp.zeros(5))
    plant = drive.plant.smoothed(sharpness=jnp.asarray(1e-9), velocity_scale=jnp.ones(5))
    rest = plant.balance(q, v, a, jnp.asarray(u * np.array(drive.gain)), jnp.zeros(()), none).residual
    np.testing.assert_allclose(rest, 0.0, atol=1e-10)


def test_what_a_formula_leaves_out_is_named(tmp_path):
    entry, machine = machine_of(tmp_path)
    machine = with_effects(
        machine, ("input_delay", {"delay": 0.004}), ("static_friction", {"level": 0.2}), port=0
    )
    for target in ("c", "python"):
        file = export(result_of(entry, machine), target)
        text = file.content.decode()
        assert "input_delay[yaw] (delay = 0.004) is left out: give the command earlier by it" in file.notes
        assert "static_friction[yaw] (level = 0.2) acts at rest only, and is left out" in file.notes
        assert all(f"Not in it: {note}." in text for note in file.notes)
        assert len(file.lost) == 2


def test_a_urdf_gets_bodies_damping_and_friction(tmp_path):
    text = arm(["revolute", "prismatic", "fixed", "revolute"], seed=3).replace(
        "</joint>", '<!-- "kept" --><dynamics damping="0.2"/></joint>', 1
    )
    entry, machine = machine_of(tmp_path, text, "urdf")
    same = export(result_of(entry, machine), "urdf", tmp_path / "robot.urdf")
    assert same.content.decode() == text
    assert same.changed == same.notes == ()

    rng = np.random.default_rng(0)
    factor = jnp.asarray(rng.uniform(1.1, 1.4, 3))
    names = [n for n in vars(machine.plant) if n.startswith(("mass", "first", "inertia"))]
    plant = replace(machine.plant, **{n: factor * getattr(machine.plant, n) for n in names})
    machine = with_effects(
        replace(machine, plant=plant),
        ("viscous_friction", {"coefficient": 0.9}),
        ("coulomb_friction", {"level": 0.4}),
        ("cogging", {"amplitude": 0.3, "period": 0.2, "phase": 0.7}),
    )
    file = export(result_of(entry, machine), "urdf", tmp_path / "robot.urdf")
    assert file.notes == (
        "cogging[joint2] (amplitude = 0.3, period = 0.2, phase = 0.7) has no place in a URDF",
    )
    (tmp_path / "robot.urdf").write_bytes(file.content)
    _, again = machine_of(tmp_path, file.content.decode(), "urdf")
    # All else is as it was, and only these tags changed.
    assert file.content.count(b"<") == text.encode().count(b"<") + 1
    assert b'<!-- "kept" -->' in file.content
    less = replace(machine, plant=replace(machine.plant, effects=machine.plant.effects[:-1]))
    q, v, a = states(joints=3)
    wanted, found = needed(less, q, v, a), needed(again, q, v, a)
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert np.max(np.abs(found - wanted) / size) < 1e-10


def test_a_urdf_names_rotors_and_gets_inertials_where_it_had_none(tmp_path):
    text = arm(["revolute", "fixed", "revolute"], seed=1)
    start = text.index('<link name="link1">')
    end = text.index("</link>", start) + len("</link>")
    text = text[:start] + '<link name="link1"/>' + text[end:]
    entry, machine = machine_of(tmp_path, text, "urdf")
    plant = replace(machine.plant, mass=1.5 * machine.plant.mass, rotor_inertia=jnp.array([0.0, 0.03]))
    file = export(result_of(entry, replace(machine, plant=plant)), "urdf", tmp_path / "robot.urdf")
    assert file.notes == ("the rotor of joint 'joint3' (0.03) has no place in a URDF",)
    _, again = machine_of(tmp_path, file.content.decode(), "urdf")
    np.testing.assert_allclose(again.plant.mass, plant.mass, rtol=1e-12)
    np.testing.assert_allclose(again.plant.inertia_xx, plant.inertia_xx, rtol=1e-10)


@pytest.fixture
def stand_in(monkeypatch):
    """Names of Isaac Lab, whose classes keep their arguments."""
    module = types.ModuleType("isaaclab.actuators")
    for name in ("ImplicitActuatorCfg", "DelayedPDActuatorCfg"):
        setattr(module, name, lambda name=name, **values: {"class": name, **values})
    monkeypatch.setitem(sys.modules, "isaaclab", types.ModuleType("isaaclab"))
    monkeypatch.setitem(sys.modules, "isaaclab.actuators", module)


def test_isaaclab_gets_gains_limits_friction_and_rotors(tmp_path, stand_in):
    entry, machine = machine_of(tmp_path)
    machine = with_effects(machine, ("coulomb_friction", {"level": 0.7}), ("static_friction", {"level": 0.2}))
    result = result_of(entry, machine)
    file = export(result, "isaaclab", name="arm")
    found = imported(tmp_path, file.content).ACTUATORS["arm"]
    assert found["class"] == "ImplicitActuatorCfg"
    assert found["joint_names_expr"] == FREE
    assert found["friction"]["pitch"] == pytest.approx(0.9)
    assert found["dynamic_friction"]["pitch"] == pytest.approx(0.7)
    rotors = dict(zip(FREE, np.array(machine.plant.rotor_inertia), strict=True))
    assert found["armature"] == pytest.approx(rotors)
    drag = 4 * 3.0 + 0.4
    assert found["viscous_friction"]["pitch"] == pytest.approx(drag)
    assert any(note.startswith("linear_stiffness[pitch]") for note in file.notes)
    assert found["stiffness"] == dict.fromkeys(FREE, 0.0)

    law = {"kind": "pd", "derivative": "velocity", "kp": [4.0] * 5, "kd": 0.5, "delay": 0.012, "limit": 2.0}
    result["model"]["drives"]["controller"] = law | {"period": 0.004}
    found = imported(tmp_path, export(result, "isaaclab", name="arm").content).ACTUATORS["arm"]
    gain = dict(zip(FREE, machine.gain, strict=True))
    assert found["class"] == "DelayedPDActuatorCfg"
    assert found["stiffness"] == pytest.approx({n: 4 * g for n, g in gain.items()})
    assert found["damping"] == pytest.approx({n: 0.5 * g for n, g in gain.items()})
    assert found["effort_limit"] == pytest.approx({n: 2 * abs(g) for n, g in gain.items()})
    assert found["min_delay"] == found["max_delay"] == 3


def test_faults_are_stated_in_one_line(tmp_path, capsys):
    from jaxid.cli import main

    entry, machine = machine_of(tmp_path)
    good = result_of(entry, machine)
    (tmp_path / "good.json").write_text(json.dumps(good))
    old = {"model": {k: v for k, v in good["model"].items() if k != "tree"}}
    (tmp_path / "old.json").write_text(json.dumps(old))
    for argv, words in (
        (["good.json", "--to", "c", "-o", "a.hpp"], "end its name in .h"),
        (["good.json", "--to", "isaac", "-o", "a.py"], "target 'isaac' is not known"),
        (["good.json", "--to", "c", "-o", "a.h", "--model", "robot.xml"], "--model goes with mjcf and urdf"),
        (["good.json", "--to", "mjcf", "-o", "a.xml"], "does not say which MJCF"),
        (["good.json", "--to", "urdf", "-o", "a.urdf", "--model", "robot.xml"], "is no URDF"),
        (["old.json", "--to", "python", "-o", "a.py"], "an older jaxid wrote it"),
    ):
        given = [str(tmp_path / w) if "." in w else w for w in argv]
        assert main(["export", *given]) == 2
        told = capsys.readouterr().err
        assert words in told, told
        assert told.count("\n") == 1
    assert not [*tmp_path.glob("a.*")]
    with pytest.raises(InputError, match="has no robot to export"):
        export({}, "c")
