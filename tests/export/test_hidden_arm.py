"""A MuJoCo arm of which the user's file lacks four things and misstates a mass: found, exported, replayed."""

import numpy as np
import pytest

import jaxid
from jaxid.commands.export import check_export, export
from jaxid.commands.robot_case import RobotCase
from jaxid.export.exported import ExportedFile
from jaxid.results.as_json import identification_json
from tests.support.hidden_arm import HIDDEN, arm_log, inertial_forces, stated, true_file, user_file
from tests.support.written_logs import write_csv


@pytest.mark.slow
def test_all_that_the_file_lacks_is_identified_written_and_replayed(tmp_path):
    (tmp_path / "robot.xml").write_text(user_file())
    log = write_csv(tmp_path / "log.csv", arm_log(seconds=6.0, rate=200))
    second = write_csv(tmp_path / "second.csv", arm_log(seed=1, seconds=4.0, rate=200))
    tables = RobotCase.of(str(tmp_path / "robot.xml"), [str(log)]).tables
    tables["plant"]["unknown"] = ["base", "armature", "damping", "frictionloss", "stiffness"]
    result = identification_json(jaxid.identify(tables, log))
    exported = export(result, "mjcf")
    assert exported.real
    target = tmp_path / "found.xml"
    target.write_bytes(exported.content)
    values = stated(target.read_text())
    for name, attributes in HIDDEN.items():
        for attribute, true in attributes.items():
            assert values[f"{name} {attribute}"] == pytest.approx(true, rel=0.01), (name, attribute)

    # The wrong mass: its sums, since torques show no more of it.
    true, found, before = map(inertial_forces, (true_file(), target.read_text(), user_file()))
    size = np.abs(true).max(axis=0)
    assert np.max(np.abs(found - true) / size) < 0.01
    assert np.max(np.abs(before - true) / size) > 0.1

    # On a log that nothing was fitted to, the file is as near as that of the machine itself.
    exact = ExportedFile(true_file().encode(), (), ())
    ours, theirs = (check_export(result, "mjcf", f, second) for f in (exported, exact))
    assert np.all(ours.after < 1.3 * theirs.after)
    assert np.all(ours.before > 50 * ours.after)
    assert np.all(ours.share < 0.01)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The user's file and his log of the machine."""
    folder = tmp_path_factory.mktemp("hidden_arm")
    (folder / "robot.xml").write_text(user_file())
    return folder / "robot.xml", write_csv(folder / "log.csv", arm_log(seconds=6.0, rate=200))


@pytest.mark.slow
def test_discover_names_all_that_the_file_lacks(files):
    robot, log = files
    tables = RobotCase.of(str(robot), [str(log)], search=True).tables
    found = jaxid.discover(tables, log)
    values = {name: p.value for name, p in found.parameters.items()}
    elbow, stiffness = HIDDEN["elbow"], HIDDEN["elbow"]["stiffness"]
    expected = {
        "coulomb_friction[1].level": HIDDEN["yaw"]["frictionloss"],
        "viscous_friction[2].coefficient": HIDDEN["shoulder"]["damping"],
        "added_mass[3].mass": elbow["armature"],
        "linear_stiffness[3].coefficient": stiffness,
        "constant_force[3].level": stiffness * elbow["springref"],
    }
    assert {e.label for e in found.effects} == {name.split(".")[0] for name in expected}
    for name, true in expected.items():
        assert values[name] == pytest.approx(true, rel=0.01), name


# A machine whose file states no friction at any joint, nor the rotor of the last.
RUBBING = {
    "yaw": {"frictionloss": 0.4, "damping": 0.3},
    "shoulder": {"frictionloss": 0.9, "damping": 0.6},
    "elbow": {"frictionloss": 0.3, "damping": 0.2, "armature": 0.05},
}


@pytest.mark.slow
def test_what_every_joint_lacks_is_named_at_once(tmp_path):
    """Seven laws: added one by one, the largest residual is of one joint and the evidence of another."""
    (tmp_path / "robot.xml").write_text(user_file())
    log = write_csv(tmp_path / "log.csv", arm_log(seconds=6.0, rate=200, hidden=RUBBING))
    lines = []
    tables = RobotCase.of(str(tmp_path / "robot.xml"), [str(log)], search=True).tables
    found = jaxid.discover(tables, log, progress=lines.append)
    expected = {"added_mass[3].mass": RUBBING["elbow"]["armature"]}
    for k, values in enumerate(RUBBING.values(), start=1):
        expected[f"coulomb_friction[{k}].level"] = values["frictionloss"]
        expected[f"viscous_friction[{k}].coefficient"] = values["damping"]
    assert {e.label for e in found.effects} == {name.split(".")[0] for name in expected}
    for name, true in expected.items():
        assert found.parameters[name].value == pytest.approx(true, rel=0.01), name
    # They come before any single effect.
    at = next(k for k, line in enumerate(lines) if "all joints at once" in line)
    assert not any("screening" in line for line in lines[:at]), lines
