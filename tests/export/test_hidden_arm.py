"""A MuJoCo arm of which the user's file lacks four things and misstates a mass: found, exported, replayed."""

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from jaxid.commands.export import check_export
from jaxid.export.exported import ExportedFile
from tests.support.cli_setup import run
from tests.support.hidden_arm import HIDDEN, JOINTS, arm_log, true_file, user_file
from tests.support.written_logs import write_csv

# What a search calls the attributes of MuJoCo that are hidden; a spring with a rest is two of its effects.
NAMED = {
    ("coulomb_friction", "yaw"),
    ("viscous_friction", "shoulder"),
    ("added_mass", "elbow"),
    ("linear_stiffness", "elbow"),
    ("constant_force", "elbow"),
}


def inertial_forces(text: str, states: np.ndarray) -> np.ndarray:
    """Forces that move the bodies and rotors, by MuJoCo."""
    model = mujoco.MjModel.from_xml_string(text)
    data, out, full = mujoco.MjData(model), [], np.zeros((model.nv, model.nv))
    for q, v, a in states:
        data.qpos[:], data.qvel[:] = q, v
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        out.append(full @ a + data.qfrc_bias)
    return np.array(out)


@pytest.mark.slow
def test_all_that_the_file_lacks_is_found_written_and_replayed(tmp_path, capsys):
    """Two commands and no case; about two minutes of two cores."""
    (tmp_path / "robot.xml").write_text(user_file())
    log = write_csv(tmp_path / "log.csv", arm_log(seconds=6.0, rate=200))
    second = write_csv(tmp_path / "second.csv", arm_log(seed=1, seconds=4.0, rate=200))
    ran = run(capsys, "discover", tmp_path / "robot.xml", log, folder=tmp_path / "out")
    assert ran.status == 0
    found = ran.json("discovery.json")
    assert {(e["kind"], e["joint_name"]) for e in found["effects"]} == NAMED

    target = tmp_path / "found.xml"
    argv = ("--to", "mjcf", "-o", target, "--check", second)
    ran = run(capsys, "export", tmp_path / "out" / "discovery.json", *argv)
    assert ran.status == 0
    assert "not exported" not in ran.out
    model = mujoco.MjModel.from_xml_path(str(target))
    for name, attributes in HIDDEN.items():
        joint, dof = model.joint(name), model.joint(name).dofadr[0]
        values = {
            "frictionloss": model.dof_frictionloss[dof],
            "damping": model.dof_damping[dof],
            "armature": model.dof_armature[dof],
            "stiffness": model.jnt_stiffness[joint.id],
            "springref": model.qpos_spring[joint.qposadr[0]],
        }
        for attribute, true in attributes.items():
            assert values[attribute] == pytest.approx(true, rel=0.01), (name, attribute)

    # The wrong mass: its sums, since torques show no more of it.
    states = (
        np.random.default_rng(0).uniform(-1, 1, (50, 3, len(JOINTS))) * np.array([1.0, 3.0, 10.0])[:, None]
    )
    true, ours, before = (inertial_forces(t, states) for t in (true_file(), target.read_text(), user_file()))
    size = np.abs(true).max(axis=0)
    assert np.max(np.abs(ours - true) / size) < 0.01
    assert np.max(np.abs(before - true) / size) > 0.1

    # On a log that nothing was fitted to, the file is as near as that of the machine itself.
    result = json.loads(Path(tmp_path / "out" / "discovery.json").read_text())
    exported, exact = (ExportedFile(t, (), ()) for t in (target.read_bytes(), true_file().encode()))
    replays = [check_export(result, "mjcf", f, second, tmp_path / "robot.xml") for f in (exported, exact)]
    assert np.all(replays[0].after < 1.3 * replays[1].after)
    assert np.all(replays[0].before > 100 * replays[0].after)
    assert np.all(replays[0].share < 0.01)
