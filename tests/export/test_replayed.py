"""Exported files replayed by MuJoCo on a log, and models drawn from a posterior."""

import copy
import json

import mujoco
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.commands.export import check_export, draw_exports, export
from jaxid.errors import InputError
from jaxid.export.found_machine import case_of, found_machine
from jaxid.export.replayed import mujoco_robot
from jaxid.results.model_json import drives_json, robot_json
from tests.support.urdf_arms import arm
from tests.support.written_logs import write_csv

# Two links in a vertical plane; the log's are heavier, and rub.
ARM = """<mujoco><option timestep="0.00025" integrator="implicitfast"/><worldbody>
  <body><joint name="a" axis="0 1 0" damping="0.5" {rub}/>
    <inertial pos="0.1 0 0" mass="{mass}" diaginertia="0.02 0.02 0.02"/>
    <body pos="0.2 0 0"><joint name="b" axis="0 1 0" damping="0.3" armature="0.01"/>
      <inertial pos="0.1 0 0" mass="0.5" diaginertia="0.01 0.01 0.01"/></body></body></worldbody>
  <actuator>{drives}</actuator></mujoco>"""
MOTORS = '<motor joint="a" gear="2"/><motor joint="b"/>'
SERVOS = '<position joint="a" kp="{kp}" kv="2"/><position joint="b" kp="20" kv="0.5"/>'
# Dry friction of MuJoCo is soft: this one settles within two steps.
STIFF = 'solreffriction="0.002 1"'
RATE = 250.0


def text(drives=MOTORS, mass=1.0, rub=STIFF, **values):
    return ARM.format(drives=drives.format(**values), mass=mass, rub=rub)


TRUE = {"mass": 1.4, "rub": f'frictionloss="0.3" {STIFF}'}


def logged(content, seconds=2.0, gear=(0.0, 0.0)):
    """Columns of a log by MuJoCo: commands are sums of sines, torques or references.

    `gear` is the friction of each joint in proportion to the torque of its drive, which no MJCF holds.
    """
    model = mujoco.MjModel.from_xml_string(content)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    inner, count = round(1 / RATE / model.opt.timestep), round(seconds * RATE)
    level = model.dof_frictionloss.copy()
    t = np.arange(count) / RATE
    waves = [np.sin(2 * np.pi * f * t) for f in (0.7, 1.9)]
    ctrl = 0.4 * np.stack([waves[0] + waves[1], waves[1] - waves[0]], axis=1) * [2.0, 1.0]
    q, u = np.zeros((count, 2)), np.zeros((count, 2))
    for k in range(count):
        q[k], data.ctrl[:] = data.qpos, ctrl[k]
        mujoco.mj_forward(model, data)
        u[k] = data.qfrc_actuator
        for _ in range(inner):
            # The torque is that of the last step, 0.25 ms late.
            model.dof_frictionloss[:] = level + np.array(gear) * np.abs(data.qfrc_actuator)
            mujoco.mj_step(model, data)
    q += 1e-6 * rng.normal(size=q.shape)
    columns = {"t": t, "qa": q[:, 0], "qb": q[:, 1], "ra": ctrl[:, 0], "rb": ctrl[:, 1]}
    return columns | {"ua": u[:, 0], "ub": u[:, 1]}


def result_of(folder, start, true, log, file="robot.xml", **plant):
    """A result that is right: the machine of the file behind the log, stated for the user's own file."""
    (folder / file).write_text(true)
    plant |= {"kind": "tree", "urdf" if file.endswith(".urdf") else "mjcf": file}
    tables = {"plant": plant, "log": log, "sensor": {"position_noise": 1e-6}}
    case = read_case(tables, None, folder)
    machine = build_machine(case, period=1 / RATE)
    (folder / file).write_text(start)
    model = robot_json(machine.plant, case.plant, {}) | {"drives": drives_json(machine)}
    return {"model": model | {"case": {"folder": str(folder), "tables": tables}}}


FORCED = {"time": "t", "position": ["qa", "qb"], "force": ["ra", "rb"], "hold": "zero_order"}
FOLLOWED = {
    "time": "t",
    "position": ["qa", "qb"],
    "force": ["ua", "ub"],
    "reference": ["ra", "rb"],
    "reference_hold": "zero_order",
}


def test_a_replay_says_how_near_the_file_is_and_what_it_lacks(tmp_path, capsys):
    from jaxid.cli import main

    true = text(**TRUE)
    write_csv(tmp_path / "log.csv", logged(true))
    result = result_of(tmp_path, text(), true, FORCED)
    stribeck = {"kind": "stribeck_friction", "joint": 2, "joint_name": "b", "name": "stribeck_friction[2]"}
    result["model"]["effects"].append(stribeck | {"parameters": {"level": 0.02, "velocity": 0.3}})
    file = export(result, "mjcf")
    found = check_export(result, "mjcf", file, tmp_path / "log.csv")
    assert not found.closed
    # MuJoCo made the log: its run of the exported file differs by starts from differenced readings alone.
    assert np.all(found.after < 0.01 * found.before)
    lost = next(sizes for what, sizes in found.costs if what.startswith("without stribeck_friction[b]"))
    # What jaxid has beyond the file is the difference between both, on that joint.
    assert lost[1] > 1e-3
    assert found.difference[1] == pytest.approx(lost[1], rel=0.2)
    creep, left, step = found.costs[1:]
    assert creep[0] == "creep of your file's dry friction (solreffriction)"
    assert left[0] == "creep that the exported file's dry friction leaves"
    assert np.all(left[1] <= 0.01 * creep[1])
    assert step[0] == "time step of 0.00025 s, against a 10th"
    (tmp_path / "result.json").write_text(json.dumps(result))

    def status(out, log):
        argv = [tmp_path / "result.json", "--to", "mjcf", "-o", tmp_path / out, "--check", tmp_path / log]
        return main(["export", *map(str, argv)])

    assert status("new.xml", "log.csv") == 0
    shown = capsys.readouterr().out
    assert "replay by MuJoCo, open loop, anew from the log every 0.25 s" in shown
    assert (tmp_path / "new.xml").read_bytes() == file.content
    # A log without the columns of the case leaves nothing behind.
    write_csv(tmp_path / "bad.csv", {"t": [0.0, 0.1], "x": [0.0, 0.0]})
    assert status("other.xml", "bad.csv") == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "other.xml").exists()


def test_a_motor_whose_gain_was_found_takes_the_commands(tmp_path):
    result = result_of(tmp_path, text(), text(**TRUE), FORCED)
    model = result["model"]
    gain = {"kind": "actuator_gain", "joint": 1, "joint_name": "a", "name": "actuator_gain[1]"}
    model["effects"].append(gain | {"parameters": {"gain": 0.8}})
    case = case_of(model, "result")
    machine = found_machine(model, case, build_machine(case, period=1 / RATE))
    file = export(result, "mjcf")
    assert b'gear="1.6"' in file.content
    assert mujoco_robot(file.content, tmp_path / "robot.xml", model, case, machine).driven
    other = file.content.replace(b'gear="1.6"', b'gear="1.5"')
    assert not mujoco_robot(other, tmp_path / "robot.xml", model, case, machine).driven


@pytest.mark.slow
def test_servos_of_the_file_close_the_loop(tmp_path):
    true = text(SERVOS, kp=60, **TRUE)
    write_csv(tmp_path / "log.csv", logged(true))
    result = result_of(tmp_path, text(SERVOS, kp=40), true, FOLLOWED, unknown=["kp", "kv"])
    file = export(result, "mjcf")
    assert "actuator '1'" in file.changed
    found = check_export(result, "mjcf", file, tmp_path / "log.csv")
    assert found.closed
    assert np.all(found.before > 20 * found.after)
    # jaxid holds the servo's force over each step of the file, MuJoCo's Euler runs half a step ahead of that:
    # 3 mrad at steps of 1 ms, 0.9 mrad at these.
    assert np.all(found.difference < 1e-3)
    # What an actuator of MuJoCo cannot hold is all that both then differ by.
    lacking = copy.deepcopy(result)
    dead = {"kind": "dead_band", "joint": 1, "joint_name": "a", "name": "dead_band[1]"}
    lacking["model"]["effects"].append(dead | {"parameters": {"width": 0.1}})
    replayed = check_export(lacking, "mjcf", export(lacking, "mjcf"), tmp_path / "log.csv")
    [(what, cost), *_] = replayed.costs
    assert what.startswith("without dead_band[a]")
    assert cost[0] > 3e-3
    assert replayed.difference[0] == pytest.approx(cost[0], rel=0.1)
    # The same law stated by the case runs at its own ticks in place of the servos.
    own = copy.deepcopy(result)
    law = {"kind": "pd", "derivative": "velocity", "kp": [60.0, 20.0], "kd": [2.0, 0.5], "period": 0.00025}
    own["model"]["case"]["tables"]["controller"] = law
    by_law = check_export(own, "mjcf", export(own, "mjcf"), tmp_path / "log.csv")
    # A law differences readings where a servo has the velocity.
    assert np.all(by_law.difference < 1e-3)
    assert np.all(by_law.before > 2e-3)


@pytest.mark.slow
def test_a_urdf_is_replayed_too(tmp_path):
    """The log is MuJoCo's, of a URDF whose second link is heavier, forces on its joints."""
    true = arm(["revolute", "fixed", "revolute"], seed=4).replace(
        "</joint>", '<dynamics damping="0.4"/></joint>'
    )
    start = true.replace('damping="0.4"', 'damping="0.1"')
    model = mujoco.MjModel.from_xml_string(true)
    # Steps of 0.002 s, which MuJoCo gives a URDF: in the replay too.
    data, t = mujoco.MjData(model), np.arange(500) / RATE
    force = 0.6 * np.stack([np.sin(5 * t), np.sin(9 * t)], axis=1)
    q = np.zeros_like(force)
    for k, now in enumerate(force):
        q[k], data.qfrc_applied[:] = data.qpos, now
        mujoco.mj_step(model, data, 2)
    names = [model.joint(k).name for k in range(2)]
    columns = {"t": t} | {f"q_{n}": q[:, k] for k, n in enumerate(names)}
    write_csv(tmp_path / "log.csv", columns | {f"u_{n}": force[:, k] for k, n in enumerate(names)})
    position, forces = ({n: f"{x}_{n}" for n in names} for x in "qu")
    log = {"time": "t", "position": position, "force": forces, "hold": "zero_order"}
    result = result_of(tmp_path, start, true, log, "robot.urdf")
    file = export(result, "urdf")
    assert len(file.changed) == 2
    found = check_export(result, "urdf", file, tmp_path / "log.csv")
    # Euler's velocities are half a step ahead of the differences of positions from which runs start anew:
    # that is left beside the stated cost of the time step.
    costs = dict(found.costs)
    (time_step,) = (cost for what, cost in costs.items() if what.startswith("time step"))
    assert np.all(found.after < 0.03 * found.before + time_step)


def with_covariance(result, std):
    """A result with an uncertain mass of the first link, friction level and armature."""
    names = ["mass[1]", "coulomb_friction[1].level", "rotor_inertia[2]"]
    matrix = np.diag(np.square([std, 0.2, 0.004]))
    return result | {"covariance": {"names": names, "matrix": matrix.tolist()}}


def test_models_are_drawn_as_the_covariance_says_and_can_exist(tmp_path):
    result = with_covariance(result_of(tmp_path, text(), text(**TRUE), FORCED), 0.1)
    drawn = draw_exports(result, "mjcf", 40, seed=3)
    models = [mujoco.MjModel.from_xml_string(f.content.decode()) for f in drawn.files]
    mass, friction, armature = np.array(
        [(m.body_mass[1], m.dof_frictionloss[0], m.dof_armature[1]) for m in models]
    ).T
    # Of friction 0.3 +- 0.2 a fifteenth is negative and drawn again; of armature 0.01 +- 0.004 one in 160.
    assert 0 < drawn.refused < 15
    assert friction.min() >= 0
    assert mass.mean() == pytest.approx(1.4, abs=0.04)
    assert mass.std() == pytest.approx(0.1, rel=0.3)
    assert armature.std() == pytest.approx(0.004, rel=0.3)
    again = draw_exports(result, "mjcf", 40, seed=3)
    assert [f.content for f in again.files] == [f.content for f in drawn.files]
    other = draw_exports(result, "mjcf", 2, seed=4)
    assert other.files[0].content != drawn.files[0].content


def test_draws_that_are_no_bodies_are_drawn_again(tmp_path):
    """The inertia of link 1 about its end allows for masses up to 3 at 0.1 m: wider draws are no bodies."""
    result = with_covariance(result_of(tmp_path, text(), text(**TRUE), FORCED), 1.5)
    drawn = draw_exports(result, "mjcf", 20)
    assert drawn.refused > 2
    for file in drawn.files:
        mujoco.MjModel.from_xml_string(file.content.decode())
    hopeless = with_covariance(result, 1.5)
    hopeless["model"]["effects"][-1]["parameters"]["level"] = -100.0
    with pytest.raises(InputError, match="its posterior is too wide"):
        draw_exports(hopeless, "mjcf", 1)


def test_options_that_do_not_go_together_are_refused_in_one_line(tmp_path, capsys):
    from jaxid.cli import main

    result = with_covariance(result_of(tmp_path, text(), text(**TRUE), FORCED), 0.1)
    (tmp_path / "good.json").write_text(json.dumps(result))
    bare = {"model": {k: v for k, v in result["model"].items() if k != "case"}}
    (tmp_path / "bare.json").write_text(json.dumps(bare))
    robot = ["--model", str(tmp_path / "robot.xml")]
    for argv, words in (
        (["good.json", "--to", "c", "-o", "a.h", "--check", "log.csv"], "--check goes with mjcf and urdf"),
        (["good.json", "--to", "c", "-o", "a.h", "--samples", "2"], "--samples goes with mjcf and urdf"),
        (["good.json", "--to", "mjcf", "-o", "a.xml", "--samples", "0"], "--samples is 0"),
        (["bare.json", "--to", "mjcf", "-o", "a.xml", *robot, "--samples", "2"], "has no covariance"),
        (
            ["bare.json", "--to", "mjcf", "-o", "a.xml", *robot, "--check", "log.csv"],
            "does not hold its case",
        ),
    ):
        given = [str(tmp_path / w) if w.endswith((".json", ".h", "a.xml", ".csv")) else w for w in argv]
        assert main(["export", *given]) == 2
        told = capsys.readouterr().err
        assert words in told, told
        assert told.count("\n") == 1
    assert not [*tmp_path.glob("a*.xml"), *tmp_path.glob("a*.h")]
