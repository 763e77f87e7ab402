"""A robot's file in place of a case: columns by joint name, and the case beside the result."""

import json
import tomllib

import mujoco
import numpy as np
import pytest

import jaxid
from jaxid.case.case import load_case
from jaxid.cli import main
from jaxid.commands.discover import discover
from jaxid.commands.init import init
from jaxid.commands.robot_case import RobotCase, implied_case, let_go
from jaxid.errors import InputError
from jaxid.results.as_json import identification_json
from jaxid.results.as_text import parameter_rows
from jaxid.results.report.build import identification_data
from jaxid.results.report.numbers import plain
from jaxid.results.verdict.robot_file import contradicted_file, values_of_file
from jaxid.session import open_session
from tests.export.test_replayed import SERVOS, TRUE, logged, text
from tests.support.cli_setup import run
from tests.support.mjcf_robots import PENDULUM_ON_CART
from tests.support.urdf_arms import arm
from tests.support.written_logs import write_csv

NAMES = {"qa": "q_a", "qb": "q_b", "ra": "u_a", "rb": "u_b"}


@pytest.fixture
def folder(tmp_path):
    columns = {NAMES.get(n, n): x for n, x in logged(text(**TRUE)).items() if n not in ("ua", "ub")}
    write_csv(tmp_path / "log.csv", columns)
    (tmp_path / "robot.xml").write_text(text())
    return tmp_path


def test_a_robot_and_its_log_imply_a_case(folder):
    made = RobotCase.of(str(folder / "robot.xml"), [str(folder / "log.csv")])
    plant, log = made.tables["plant"], made.tables["log"]
    assert plant["kind"] == "tree"
    assert plant["unknown"] == ["base", "armature", "damping", "frictionloss"]
    assert log["position"] == {"a": "q_a", "b": "q_b"}
    assert "units" not in plant
    assert "actuators" not in plant
    assert log["force"] == {"a": "u_a", "b": "u_b"}
    # A search begins with what the file states: it has armature and damping, and no dry friction.
    search = RobotCase.of(str(folder / "robot.xml"), [str(folder / "log.csv")], search=True)
    assert search.tables["plant"]["unknown"] == ["base", "armature", "damping"]
    (folder / "out").mkdir()
    case = load_case(made.save(folder / "out"))
    assert case.plant.names == ("a", "b")
    assert case.tables["plant"]["mjcf"] == "../robot.xml"


@pytest.mark.parametrize("of", [jaxid.identify, jaxid.discover])
def test_python_takes_a_robots_file_for_a_case_too(folder, of):
    with pytest.raises(InputError, match="a robot's file alone has no log"):
        of(folder / "robot.xml")
    with pytest.raises(InputError, match="no such file"):
        of(folder / "robot.xml", folder / "absent.csv")
    case = implied_case(folder / "robot.xml", [str(folder / "log.csv")], search=of is jaxid.discover)
    made = RobotCase.of(str(folder / "robot.xml"), [str(folder / "log.csv")], search=of is jaxid.discover)
    assert case == made.tables


def test_values_of_the_file_that_the_log_contradicts_are_listed(folder):
    """The log is of a robot with other friction; against its own file it contradicts nothing."""
    found = jaxid.identify(folder / "robot.xml", folder / "log.csv", method="inverse_dynamics")
    assert found.model_complete
    first = found.findings[0]
    assert first.startswith("The model is complete for this log: the force gap of ")
    assert first.endswith(" that filtering and integration may leave.")
    [line] = [f for f in found.judgement.findings if "robot.xml" in f]
    assert "values are not those of robot.xml: " in line
    p = found.parameters
    for name in ("coulomb_friction[1].level", "coulomb_friction[2].level"):
        off = abs(p[name].value - p[name].guess) > max(3 * p[name].std, 0.01 * p[name].value)
        assert off == (f"{name} = " in line), name
        assert f"({p[name].guess:g} in the file)" in line
    # They stand beside the values that were found, wherever these are shown.
    head, *rows = parameter_rows(found)
    at = head.index("in robot.xml")
    assert {row[0]: row[at] for row in rows} == {n: plain(v.guess) for n, v in p.items()}
    listed = identification_json(found)["parameters"]
    assert listed["coulomb_friction[1].level"]["in_file"] == p["coulomb_friction[1].level"].guess
    moments = [p[f"first_moment_x[{k}]"].guess for k in (1, 2)]
    assert listed["first_moment_x"]["in_file"] == pytest.approx(moments)
    [shown] = [r for r in identification_data(found).parameters if r.name == "first_moment_x[1]"]
    assert shown.in_file == pytest.approx(moments[0])
    # A value of the case itself is none of the file's.
    tables = implied_case(folder / "robot.xml", folder / "log.csv")
    tables["plant"]["mjcf"] = str(folder / "robot.xml")
    tables["plant"]["unknown"] = ["base", "armature", "damping"]
    tables["effects"] = [{"kind": "coulomb_friction", "level": {"guess": [3.0, 3.0]}}]
    session = open_session(tables, folder / "log.csv")
    [line] = contradicted_file(session, found.estimate)
    assert "coulomb_friction[1].level = " not in line
    assert "coulomb_friction[1].level" not in values_of_file(session)

    (folder / "robot.xml").write_text(text(**TRUE))
    right = open_session(implied_case(folder / "robot.xml", folder / "log.csv"), folder / "log.csv")
    assert contradicted_file(right, found.estimate) == []


def test_joints_that_the_log_lacks_are_held(folder):
    t = np.arange(100) / 100
    columns = {"t": t, "q_b": np.sin(3 * t), "torque_b": np.cos(7 * t)}
    first = init(write_csv(folder / "one.csv", columns), mjcf=folder / "robot.xml", folder=folder)
    assert first.tables["plant"]["joints"] == ["b"]
    assert first.tables["log"]["position"] == {"b": "q_b"}
    case = first.case()
    assert case.plant.names == ("b",)
    # A torque is that of the joint, whatever gear the file's motors have.
    assert case.tables["plant"]["actuators"] is False
    assert case.actuator.gain == 1.0
    assert any("the others are held at zero" in line for line in first.assumed)


@pytest.mark.parametrize("force", ["F [N]", "slide torque [N]"])
def test_joints_without_an_actuator_need_no_force(tmp_path, force):
    (tmp_path / "cart.xml").write_text(PENDULUM_ON_CART.format(slide="", swing=""))
    t = np.arange(400) / 100
    columns = {"t": t, "x [m]": np.sin(2 * t), "theta [rad]": np.cos(3 * t), force: np.cos(7 * t)}
    if force != "F [N]":
        columns = {"t": t, "slide pos": np.sin(2 * t), "swing pos": np.cos(3 * t), force: np.cos(7 * t)}
    log = write_csv(tmp_path / "log.csv", columns)
    first = init(log, mjcf=tmp_path / "cart.xml", folder=tmp_path)
    assert any("only slide of cart.xml has an actuator" in line for line in first.assumed)
    case = first.case()
    assert case.plant.names == ("slide", "swing")
    assert case.tables["log"]["force"] == force.split(" [")[0]
    assert open_session(case, log).fit.log.force.shape == (400, 1)


def test_a_force_for_some_joints_only_is_named(tmp_path, capsys):
    t = np.arange(400) / 100
    columns = {"t": t, "x": np.sin(2 * t), "theta": np.cos(3 * t), "F": np.cos(7 * t)}
    log = write_csv(tmp_path / "log.csv", columns)
    assert main(["init", str(log), "-o", str(tmp_path / "case.toml")]) == 2
    [line] = capsys.readouterr().err.strip().splitlines()
    assert "2 joints move ('x', 'theta'), and not each has a force: 'F'" in line
    assert "--mjcf" in line


def test_a_urdf_is_a_tree_too(folder):
    (folder / "robot.urdf").write_text(arm(["revolute", "fixed", "prismatic"]))
    t = np.arange(100) / 100
    columns = {"t": t}
    for k, name in enumerate(("joint1", "joint3"), start=2):
        columns |= {f"{name}_pos": np.sin(k * t), f"{name} effort": np.cos(k * t)}
    log = write_csv(folder / "two.csv", columns)
    made = RobotCase.of(str(folder / "robot.urdf"), [str(log)], search=True)
    assert made.tables["plant"]["unknown"] == ["base"]
    assert made.tables["log"]["force"] == {"joint1": "joint1 effort", "joint3": "joint3 effort"}
    case = load_case(made.tables)
    assert case.plant.names == ("joint1", "joint3")
    assert case.tables["plant"]["kind"] == "tree"


def test_servos_that_follow_a_reference_need_no_force(folder):
    (folder / "robot.xml").write_text(text(SERVOS, kp=40))
    columns = {n: x for n, x in logged(text(SERVOS, kp=60, **TRUE)).items() if n not in ("ua", "ub")}
    called = {"qa": "q_a", "qb": "q_b", "ra": "q_ref_a", "rb": "q_ref_b"}
    renamed = {called.get(n, n): x for n, x in columns.items()}
    first = init(write_csv(folder / "moves.csv", renamed), mjcf=folder / "robot.xml", folder=folder)
    assert first.tables["log"]["reference"] == {"a": "q_ref_a", "b": "q_ref_b"}
    case = first.case()
    assert set(case.controller.unknown) == {"kp", "kd", "delay"}


def test_a_search_of_servos_and_links_without_a_force_is_refused_at_once(tmp_path):
    inertial = '<inertial pos="0 0 0.05" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>'
    link = '<body pos="0 0 0.1"><joint name="{n}" axis="0 1 0"/>' + inertial
    servos = "".join(f'<position joint="{n}" kp="20" kv="1"/>' for n in "abc")
    body = "".join(link.format(n=n) for n in "abc") + 3 * "</body>"
    file = tmp_path / "arm.xml"
    file.write_text(f"<mujoco><worldbody>{body}</worldbody><actuator>{servos}</actuator></mujoco>")
    t = np.arange(400) / 100
    columns = {"t": t}
    for k, n in enumerate("abc", start=2):
        columns |= {f"q_{n}": np.sin(k * t), f"q_ref_{n}": np.sin(k * t + 0.1)}
    log = write_csv(tmp_path / "log.csv", columns)
    tables = RobotCase.of(str(file), [str(log)], search=True).tables
    # The file states neither friction nor springs, which the search may find.
    assert tables["plant"]["unknown"] == ["kp", "kv", "delay", "forcerange"]
    tables["plant"]["unknown"] = [*tables["plant"]["unknown"], "base"]
    with pytest.raises(InputError, match="joint by joint, which these 3 joints do not allow"):
        discover(tables, str(log))


@pytest.mark.slow
def test_servos_without_a_force_end_in_the_robots_file(folder, capsys):
    (folder / "robot.xml").write_text(text(SERVOS, kp=3000, mass=1.4))
    columns = {n: x for n, x in logged(text(SERVOS, kp=60, **TRUE)).items() if n not in ("ua", "ub")}
    called = {"qa": "q_a", "qb": "q_b", "ra": "q_ref_a", "rb": "q_ref_b"}
    log = write_csv(folder / "moves.csv", {called.get(n, n): x for n, x in columns.items()})
    out = folder / "out"
    ran = run(capsys, "identify", folder / "robot.xml", log, folder=out)
    assert ran.status == 0
    assert "replay by MuJoCo: RMS from the log, your file -> exported" in ran.out
    found = mujoco.MjModel.from_xml_path(str(out / "robot_found.xml"))
    assert found.actuator_gainprm[:, 0] == pytest.approx([60.0, 20.0], rel=0.03)
    assert found.dof_frictionloss[0] == pytest.approx(0.3, rel=0.03)
    # The user's own file stays as it was.
    assert 'kp="3000"' in (folder / "robot.xml").read_text()
    # A row of the table: the log, then a pair for each joint.
    lines = ran.out.splitlines()
    [line] = [line for line in lines if line.split()[2:3] == ["->"]]
    before, after = (float(x) for x in line.split()[1:4:2])
    assert before > 10 * after
    # MuJoCo follows the log as jaxid does, to less than a milliradian.
    at = lines.index("exported file in MuJoCo less jaxid's simulation, RMS")
    assert all(float(x) < 1.0 for x in lines[at + 2].split()[1:])
    assert "creep that the exported file's dry friction leaves" in ran.out


@pytest.mark.slow
def test_check_takes_a_robot_and_writes_its_case(folder, capsys):
    ran = run(capsys, "check", folder / "robot.xml", folder / "log.csv", folder=folder / "out")
    assert ran.status == 0
    assert f"{folder / 'out' / 'first_case.toml'}" in ran.out
    assert tomllib.loads((folder / "out" / "first_case.toml").read_text())["plant"]["kind"] == "tree"
    assert ran.json("check.json")


def test_faults_are_one_line_and_leave_nothing(folder, capsys):
    (folder / "broken.xml").write_text("<mujoco><worldbody>")
    (folder / "broken.urdf").write_text("<robot>")
    three = {"t": [0.0, 0.1, 0.2], "q_1": [0.0, 1, 2], "q_2": [0, 2, 1], "q_3": [1, 0, 1]}
    other = write_csv(folder / "other.csv", three)
    for argv, words in (
        (["identify", "robot.xml"], "a robot's file alone has no log"),
        (["identify", "none.xml", "log.csv"], "no such file"),
        (["check", "broken.xml", "log.csv"], "MuJoCo cannot read it"),
        (["check", "broken.urdf", "log.csv"], "is not XML"),
        (["discover", "robot.xml", "none.csv"], "no such file"),
        (["check", "robot.xml", other.name], "moves a, b"),
    ):
        given = [argv[0], *(str(folder / name) for name in argv[1:])]
        assert main([*given, "-o", str(folder / "out")]) == 2
        told = capsys.readouterr().err
        assert words in told, told
        assert told.count("\n") == 1
    assert not (folder / "out").exists()
    with pytest.raises(InputError, match="both given"):
        init(folder / "log.csv", mjcf=folder / "robot.xml", urdf=folder / "broken.urdf")


def test_a_robot_is_let_go(folder, capsys):
    assert let_go(str(folder / "robot.xml"))["simulation"]["sample_rate"] == pytest.approx(500.0)
    ran = run(capsys, "simulate", folder / "robot.xml", "-o", folder / "free.csv")
    assert ran.status == 0
    assert "2500 samples at 500 Hz" in ran.out


@pytest.mark.slow
def test_identify_takes_a_robot_and_its_result_exports_without_a_model(folder, capsys):
    ran = run(capsys, "identify", folder / "robot.xml", folder / "log.csv", folder=folder / "out")
    assert ran.status == 0
    result = ran.json("result.json")
    assert result["parameters"]["coulomb_friction[1].level"]["value"] == pytest.approx(0.3, rel=0.02)
    assert json.dumps(result["model"]["case"]["tables"]["plant"]["kind"]) == '"tree"'
    export = run(capsys, "export", folder / "out" / "result.json", "--to", "mjcf", "-o", folder / "found.xml")
    assert export.status == 0
    assert "changed joint 'a'" in export.out
