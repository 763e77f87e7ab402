"""The strip of frames of an arm's motion, against MuJoCo's kinematics."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.results.poses import bones_of, places_of, poses_of
from jaxid.results.report.data import PoseStrip
from jaxid.results.report.pose_plots import plot_poses, pose_table
from tests.support.hidden_arm import JOINTS, user_file
from tests.support.mjcf_robots import BRANCHED


def plant_of(folder, text):
    (folder / "robot.xml").write_text(text)
    return build_machine(read_case({"plant": {"kind": "tree", "mjcf": "robot.xml"}}, None, folder)).plant


def test_joints_are_where_mujoco_has_them(tmp_path):
    plant = plant_of(tmp_path, BRANCHED)
    model = mujoco.MjModel.from_xml_string(BRANCHED)
    data = mujoco.MjData(model)
    names = [model.joint(k).name for k in range(model.njnt)]
    free = [name for name in names if name != "copy"]
    q = np.random.default_rng(0).uniform(-0.3, 0.4, (5, len(free)))
    places = places_of(plant, q)
    for now, shown in zip(q, places, strict=True):
        for name, value in zip(free, now, strict=True):
            data.qpos[model.joint(name).qposadr] = value
        data.qpos[model.joint("copy").qposadr] = 0.05 - 1.5 * now[free.index("grip")]
        mujoco.mj_kinematics(model, data)
        # An anchor may lie anywhere on its axis, and a slide's moves with it.
        for k, name in enumerate(names):
            joint = model.joint(name).id
            off = shown[1 + k] - data.xanchor[joint]
            off -= (off @ data.xaxis[joint]) * data.xaxis[joint]
            assert np.linalg.norm(off) < 1e-9, name


def test_the_end_is_the_centre_of_mass_of_the_last_link(tmp_path):
    plant = plant_of(tmp_path, user_file())
    model = mujoco.MjModel.from_xml_string(user_file())
    data = mujoco.MjData(model)
    data.qpos[:] = q = np.array([0.4, -0.7, 1.1])
    mujoco.mj_kinematics(model, data)
    assert places_of(plant, q[None])[0, -1] == pytest.approx(data.xipos[-1], abs=1e-12)
    assert bones_of(plant) == ((0, 1), (1, 2), (2, 3), (3, 4))


def strip_of(folder):
    plant = plant_of(folder, user_file())
    q = np.stack([0.5 * np.sin(np.arange(8) + k) for k in range(len(JOINTS))], axis=1)
    both = (places_of(plant, x) for x in (q, q + [0.0, 0.1, 0.0]))
    return PoseStrip("log", np.arange(8.0), bones_of(plant), *both, np.array([0.0, 0.0, 1.0]))


def test_the_table_states_how_far_the_simulated_end_is(tmp_path):
    strip = strip_of(tmp_path)
    table = pose_table(strip)
    assert table.heads[-2] == "simulated end off by [mm]"
    off = 1e3 * np.linalg.norm(strip.simulated[:, -1] - strip.measured[:, -1], axis=1)
    assert [float(row[-2]) for row in table.rows] == pytest.approx(off.tolist(), rel=1e-3)
    assert np.all(off > 10.0)


def test_frames_stand_beside_and_below_each_other(tmp_path):
    strip = strip_of(tmp_path)
    wide, narrow = plot_poses(strip), plot_poses(strip, size=(4.6, 7.0), columns=4)
    assert [f.axes[0].get_gridspec().get_geometry() for f in (wide, narrow)] == [(2, 8), (4, 4)]
    for figure in (wide, narrow):
        titles = [ax.get_title() for ax in figure.axes if ax.get_title()]
        assert titles == [f"{t:.2f} s" for t in range(8)]


def test_a_machine_without_geometry_has_no_picture():
    session = SimpleNamespace(machine=SimpleNamespace(plant=object()))
    run = SimpleNamespace(log=SimpleNamespace(steady=None))
    assert poses_of(session, run, None) is None
