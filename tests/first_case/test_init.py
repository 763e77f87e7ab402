"""From raw logs to cases that run: `jaxid init`, then the next commands on what it wrote."""

import os
from pathlib import Path

import numpy as np
import pandas
import pytest
from rosbags.rosbag2 import StoragePlugin

import jaxid
from jaxid.errors import InputError
from tests.logs.test_formats import EPOCH
from tests.support.cli_setup import recorded, refused, run
from tests.support.ros_bags import STORE, joint_state, write_bag
from tests.support.written_logs import signals, write_csv
from truth.arm.two_links import TwoLinks, run_sampled, unknown_reference
from truth.axis.machines import emps_like

NEWTONS_PER_AMPERE = 35.15065


def german(x: float, digits: int = 4) -> str:
    return f"{x:.{digits}f}".replace(".", ",")


def drive_export(path: Path, seconds: float = 6.0) -> Path:
    """A trace as a drive's commissioning tool exports it in Germany: metadata, semicolons, mm and A.

    Written by hand after published exports of TIA Portal and Sysmac traces; no package writes these. The
    motion is that of the exact axis, whose command stands for the current.
    """
    made = emps_like(0, duration=seconds).run()
    head = ["Trace;Achse_1", "Antrieb;S210", "Abtastzeit;1 ms", ""]
    names = "Zeit [ms];Lageistwert [mm];Stromistwert [A];Lagesollwert [mm];Motortemperatur [°C]"
    rows = [
        ";".join([str(k), german(1e3 * q, 5), german(u), german(1e3 * r, 5), "41,5"])
        for k, (q, u, r) in enumerate(zip(made["position"], made["force"], made["reference"], strict=True))
    ]
    path.write_text("\n".join([*head, names, *rows, ""]), encoding="latin-1")
    return path


def test_a_drives_export_in_mm_and_ampere(tmp_path, capsys):
    log, case = drive_export(tmp_path / "trace.csv"), tmp_path / "case.toml"
    ran = run(capsys, "init", log, "-o", case)
    assert ran.status == 0, ran.err
    for line in ("the time is in ms, as the column states", "the position is in mm", "results are per A"):
        assert line in ran.out
    assert "question: torque_constant [N m/A], gear_ratio, lead [m/rev]" in ran.out
    assert f"next: jaxid check {case}" in ran.out

    tables = jaxid.load_case(case).tables
    assert tables["log"]["units"] == {"time": "ms", "position": "mm", "reference": "mm"}
    assert tables["log"]["reference"] == "Lagesollwert"
    assert tables["plant"]["motion"] == "linear"
    assert tables["plant"]["parameters"]["inertia"]["guess"] == pytest.approx(
        95.1 / NEWTONS_PER_AMPERE, rel=0.1
    )
    assert tables["sensor"]["position_resolution"] == pytest.approx(5e-8)

    checked = run(capsys, "check", case, log)
    assert checked.status == 0, checked.err
    assert "the log is sound" in checked.out
    fitted = run(capsys, "identify", case, log, folder=tmp_path / "out")
    assert fitted.status == 0, fitted.err
    found = fitted.json("result.json")["parameters"]
    assert found["inertia"]["value"] == pytest.approx(95.1 / NEWTONS_PER_AMPERE, rel=0.01)
    assert found["coulomb_friction.level"]["value"] == pytest.approx(20.39 / NEWTONS_PER_AMPERE, rel=0.02)
    assert found["inertia"]["unit"] == "A s^2/m"
    assert (tmp_path / "out" / "report.html").is_file()


@pytest.mark.slow
def test_a_drives_export_to_a_search_in_three_commands(tmp_path, capsys):
    log, case = drive_export(tmp_path / "trace.csv"), tmp_path / "case.toml"
    for words in (("init", log, "-o", case), ("check", case, log)):
        assert run(capsys, *words).status == 0
    ran = run(capsys, "discover", case, log, folder=tmp_path / "out")
    assert ran.status == 0, ran.err
    assert ran.json("discovery.json")["verdict"] == "nothing_missing"
    assert (tmp_path / "out" / "report.html").is_file()


URDF = """<?xml version="1.0"?>
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0.2 0 0"/><mass value="{m1}"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="{i1}"/></inertial></link>
  <link name="lower"><inertial><origin xyz="0.25 0 0"/><mass value="{m2}"/>
    <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.01" iyz="0" izz="{i2}"/></inertial></link>
  <joint name="shoulder_joint" type="revolute"><origin rpy="1.5707963267948966 0 0"/>
    <parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="99" velocity="9"/></joint>
  <joint name="elbow_joint" type="revolute"><origin xyz="0.5 0 0"/>
    <parent link="upper"/><child link="lower"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="99" velocity="9"/></joint>
</robot>
"""


def arm_bag(folder: Path, arm: TwoLinks) -> tuple[Path, Path]:
    """A rosbag2 of joint states by the bag's writer, joints in another order than the arm's, and its URDF."""
    times = np.arange(2000) / 250.0
    reference = unknown_reference(times, 3)
    made = run_sampled(
        arm,
        rate=250.0,
        start=reference[0],
        reference=reference,
        kp=(900.0, 300.0),
        kd=(60.0, 15.0),
        noise=1e-5,
    )
    names = ("elbow_joint", "shoulder_joint")

    def messages():
        for k, t in enumerate(made["t"]):
            q, u = ([made[f"{x}2"][k], made[f"{x}1"][k]] for x in "qu")
            yield (
                "/joint_states",
                "sensor_msgs/msg/JointState",
                EPOCH + t + 1e-4,
                joint_state(STORE, EPOCH + t, names, q, u),
            )

    bag = write_bag(folder / "bag", StoragePlugin.MCAP, messages())
    urdf = folder / "arm.urdf"
    # Masses of the file are a third off, as those of a CAD model may be.
    urdf.write_text(URDF.format(m1=arm.m1 * 0.7, m2=arm.m2 * 1.3, i1=arm.i1, i2=arm.i2))
    return bag, urdf


@pytest.mark.slow
def test_a_bag_with_a_urdf(tmp_path, capsys):
    arm = TwoLinks()
    (tmp_path / "cases").mkdir()
    (bag, urdf), case = arm_bag(tmp_path, arm), tmp_path / "cases" / "case.toml"
    ran = run(capsys, "init", bag, "--urdf", urdf, "--tip", "lower", "-o", case)
    assert ran.status == 0, ran.err
    assert "columns belong to the joints of arm.urdf by their names" in ran.out
    tables = jaxid.load_case(case).tables
    assert tables["plant"]["urdf"] == "../arm.urdf"
    assert "armature" in tables["plant"]["unknown"]
    assert tables["log"]["force"] == {
        "shoulder_joint": "/joint_states.effort[shoulder_joint]",
        "elbow_joint": "/joint_states.effort[elbow_joint]",
    }
    checked = run(capsys, "check", case, bag)
    assert checked.status == 0, checked.err
    fitted = run(capsys, "identify", case, bag, folder=tmp_path / "out")
    assert fitted.status == 0, fitted.err
    found = fitted.json("result.json")["parameters"]
    for name, value in (
        ("coulomb_friction[1].level", arm.coulomb[0]),
        ("coulomb_friction[2].level", arm.coulomb[1]),
    ):
        assert found[name]["value"] == pytest.approx(value, rel=0.05)
    assert (tmp_path / "out" / "report.html").is_file()

    one = jaxid.init(bag)
    assert any("2 joints: the case is of that of" in line for line in one.assumed)
    assert any("--urdf FILE" in line for line in one.questions)
    part = jaxid.init(bag, urdf=urdf, tip="upper")
    assert part.tables["plant"]["joints"] == ["shoulder_joint"]
    assert any("those of 'elbow' are no joints up to that tip" in line for line in part.assumed)
    third = {f"{name}_wrist": np.ones(100) * np.arange(100) for name in ("t", "position", "effort")}
    with pytest.raises(InputError, match="'position_wrist'.*and arm.urdf moves shoulder_joint, elbow_joint"):
        jaxid.init({**third, "t": np.arange(100) / 100}, urdf=urdf)


def test_several_joints_by_numbers(tmp_path):
    """A table as the TX40's: positions and currents of six joints, without a time."""
    t = np.arange(3000) / 1000.0
    log = {f"p{k}": k * np.sin(3 * t + k) for k in range(1, 7)}
    log |= {f"u{k}": k * np.cos(3 * t + k) for k in range(1, 7)}
    first = jaxid.init(write_csv(tmp_path / "log.csv", log))
    assert first.tables["log"]["position"] == "p6"
    assert first.tables["log"]["force"] == "u6"
    assert first.tables["log"]["sample_rate"] == 1000.0
    assert "the log has no time. Which sampling rate has it?" in first.questions


def test_tables_in_memory():
    log = recorded()
    frame = pandas.DataFrame(log)
    for given in (log, frame):
        first = jaxid.init(given)
        assert first.tables["log"] == {"time": "t", "position": "q", "force": "u", "reference": "ref"}
        assert first.case().plant.parameters.keys() == {"inertia"}
        assert "FirstCase of" in repr(first)
        jaxid.check(first.case(), given)


def test_names_that_say_nothing(tmp_path):
    log = signals(400)
    log["q"] = 0.1 * np.sin(20 * log["t"]) + 0.05 * np.sin(7 * log["t"])
    named = {"ch0": log["q"], "ch1": np.sign(np.sin(35 * log["t"]))}
    first = jaxid.init(write_csv(tmp_path / "log.csv", named))
    assert (first.tables["log"]["position"], first.tables["log"]["force"]) == ("ch0", "ch1")
    assert "is 'ch0' the position, and not the force?" in first.questions
    with pytest.raises(
        InputError, match="no column is a position or a velocity by its name: 'ch0', 'ch1', 'ch2'"
    ):
        jaxid.init({**named, "ch2": log["u"]})


def test_a_log_of_one_row_is_too_short(tmp_path):
    path = write_csv(tmp_path / "log.csv", {name: values[:1] for name, values in signals(400).items()})
    with pytest.raises(InputError, match="log.csv: is too short: no column has two numbers"):
        jaxid.init(path)


def test_a_force_that_brakes(tmp_path):
    log = recorded()
    first = jaxid.init({**log, "u": -log["u"]})
    assert first.tables["log"]["sign"] == {"force": -1}
    assert "is a positive force one that drives a positive velocity?" in first.questions
    jaxid.check(first.case(), {**log, "u": -log["u"]})


def test_degrees_and_revolutions_by_their_ratio():
    log = recorded()
    v = np.gradient(log["q"], log["t"])
    base = {"t": log["t"], "tau": log["u"]}
    for scale, speed, units in (
        (180 / np.pi, 1.0, {"position": "deg"}),
        (1.0, 30 / np.pi, {"velocity": "rpm"}),
        (0.5 / np.pi, 30 / np.pi, {"position": "rev", "velocity": "rpm"}),
        (1.0, 1.0, None),
    ):
        first = jaxid.init({**base, "theta": scale * log["q"], "omega": speed * v})
        assert first.tables["log"].get("units", {}).get("position") == (units or {}).get("position")
        assert first.tables["log"].get("units", {}).get("velocity", "") == (units or {}).get(
            "velocity", "rad/s" if units else ""
        )


def test_units_in_the_names_of_a_table_in_memory():
    log = recorded()
    named = {
        "Zeit [ms]": 1e3 * log["t"],
        "Winkel [°]": np.degrees(log["q"]),
        "Drehmoment [mNm]": 1e3 * log["u"],
    }
    first = jaxid.init(named)
    assert first.tables["log"]["units"] == {"time": "ms", "position": "°", "force": "mNm"}
    fitted = jaxid.as_log(named, first.case().columns)
    np.testing.assert_allclose(fitted.position[:, 0], log["q"], atol=1e-12)


def test_values_that_are_nan():
    log = recorded()
    log["q"] = np.where(np.arange(2000) % 7 == 3, np.nan, log["q"])
    first = jaxid.init(log)
    assert first.tables["log"]["resample"] == pytest.approx(500.0)
    jaxid.check(first.case(), log)


def test_an_export_of_a_twincat_scope(tmp_path):
    """By hand after published exports: a key before each value, and a time before each channel."""
    log = recorded()
    head = [
        "Name\tC:\\Scope",
        "",
        "\t".join(["Name\tAxis1.ActPos", "Name\tAxis1.ActCurrent", "Name\tAxis1.SetPos"]),
        "\t".join(["SampleTime[ms]\t2"] * 3),
        "",
    ]
    rows = [
        "\t".join(f"{2 * k}\t{german(x, 6)}" for x in (1e3 * q, u, 1e3 * r))
        for k, (q, u, r) in enumerate(zip(log["q"], log["u"], log["ref"], strict=True))
    ]
    path = tmp_path / "scope.csv"
    path.write_text("\r\n".join([*head, *rows, "EOF", ""]))
    table = jaxid.init(path).tables["log"]
    assert [table[key] for key in ("time", "position", "force", "reference")] == [
        "Name",
        "Axis1.ActPos",
        "Axis1.ActCurrent",
        "Axis1.SetPos",
    ]
    assert table["units"] == {"time": "ms"}


def test_counts_that_start_anew_after_a_turn():
    log = recorded()
    # Of the recorded motion, three turns of an encoder whose header states its unit.
    turns = 3.3 * (log["q"] - log["q"].min()) / np.ptp(log["q"])
    counts = {"t [s]": log["t"], "enc [counts]": np.floor(4096 * turns) % 4096, "tau [Nm]": log["u"]}
    first = jaxid.init(counts)
    table = first.tables["log"]
    assert table["counts_per_revolution"] == 4096
    assert "is a turn of the joint 4096 counts? Else counts_per_revolution" in first.questions
    read = jaxid.as_log(counts, first.case().columns)
    np.testing.assert_allclose(read.position[:, 0], 2 * np.pi * turns, atol=2 * np.pi / 4096)
    assert first.tables["sensor"]["position_resolution"] == pytest.approx(2 * np.pi / 4096)

    # A counter of 16 bits starts anew after a turn of its own.
    counts["enc [counts]"] = np.floor(65536 * turns) % 65536
    assert jaxid.init(counts).tables["plant"]["units"]["position"] == "count"


def test_a_servo_in_counts_has_a_case_that_is_checked_and_leaves_its_loop_open():
    """The case stated the law and the rate that were assumed, and `check` refused its counts."""
    time = 0.02 * np.arange(400)
    goal = np.round(600 * np.sin(2 * time)) + 2048
    servo = {"t": time, "goal_position": goal, "present_position": np.roll(goal, 2)}
    first = jaxid.init(servo)
    assert first.tables["plant"]["units"] == {"position": "count"}
    assert not {"period", "derivative"} & set(first.tables["controller"])
    assert "stroke 1200 count" in str(jaxid.check(first.tables, servo))

    # Between uneven stamps they are no whole numbers any more.
    uneven = servo | {"t": time + 1e-3 * np.random.default_rng(0).uniform(-1, 1, time.size)}
    plant = {key: value for key, value in first.tables["plant"].items() if key != "units"}
    plain = {**first.tables, "plant": plant}
    for log in (servo, uneven):
        with pytest.raises(InputError, match="position holds whole numbers only"):
            jaxid.check(plain, log)


def test_columns_that_only_their_unit_names():
    log = recorded()
    servo = {"t": log["t"], "goal_deg": np.degrees(log["ref"]), "present_deg": np.degrees(log["q"])}
    first = jaxid.init(servo)
    table = first.tables["log"]
    assert (table["reference"], table["position"]) == ("goal_deg", "present_deg")
    assert "controller" in first.tables

    two = {"t": log["t"], "motor_rad": log["q"], "load_rad": 0.9 * log["q"] ** 3, "torque": log["u"]}
    with pytest.raises(InputError, match=r"2 joints move \('motor_rad', 'load_rad'\).*flexible_axis"):
        jaxid.init(two)


def test_a_column_that_is_left_out_is_said():
    log = recorded()
    first = jaxid.init({"t": log["t"], "angle": log["q"], "carriage": log["q"] ** 3, "torque": log["u"]})
    assert any("no name says what they are: 'carriage'" in line for line in first.assumed)


@pytest.mark.parametrize("more", [(), ("i_q",)])
def test_currents_of_phases_are_no_force(more):
    t = np.arange(0.0, 5.0, 0.002)
    q = t * np.sin(t)
    torque = np.gradient(np.gradient(q, t), t) + 0.1 * np.sign(np.gradient(q, t))
    phases = {f"i_{name}": torque * np.cos(7 * q + 2 * np.pi * k / 3) for k, name in enumerate("uvw")}
    table = {"t": t, "theta": q, **phases, **dict.fromkeys(more, torque)}
    if not more:
        with pytest.raises(InputError, match="no column is a force"):
            jaxid.init(table)
        return
    case = jaxid.init(table)
    assert case.tables["log"]["force"] == "i_q"
    assert any("'i_u', 'i_v', 'i_w' are not used" in line for line in case.assumed)


def test_what_is_refused(tmp_path, capsys):
    log = write_csv(tmp_path / "log.csv", signals())
    out = tmp_path / "case.toml"
    refused(capsys, tmp_path, "init", tmp_path / "none.csv", "-o", out, told="no such file; check the path")
    refused(capsys, tmp_path, "init", log, "--mjcf", "arm.xml", "-o", out, told="no such file")
    refused(capsys, tmp_path, "init", log, "--tip", "tool", "-o", out, told="--tip goes with --urdf")
    refused(capsys, tmp_path, "init", log, "-o", tmp_path / "case.json", told="a case is a .toml file")
    refused(capsys, tmp_path, "init", log, "-o", tmp_path / "no" / "case.toml", told="has no such folder")
    out.write_text("mine")
    refused(
        capsys,
        tmp_path,
        "init",
        log,
        "-o",
        out,
        told="exists already; choose another -o, or overwrite with --force",
    )
    assert run(capsys, "init", log, "-o", out, "--force").status == 0
    assert "jaxid init" in out.read_text()
    with pytest.raises(InputError, match="a Log has its columns already"):
        jaxid.init(jaxid.Log(*(signals()[name] for name in "tqu")))


# Logs as people have them.


FIELD = """decimal_comma empty_cells pwm_counts sign_flipped sign_good slow_log swing_kick swing_no_torque
swing_zero_torque
target_and_position velocity_only velocity_table
test_quasistatic-forward test_quasistatic-reverse time_doubled time_gaps time_irregular time_microseconds
time_milliseconds time_ros_jitter time_seconds wrapped""".split()
MEASURED = [
    *(f"field/{name}.csv" for name in FIELD),
    *(f"odri_motor/{name}.csv" for name in ("acc_current", "speed_test1")),
    *(f"dfki_pendulum/{name}.csv" for name in ("pd", "swingup_1nm")),
    *(f"emps/{name}.mat" for name in ("DATA_EMPS", "DATA_EMPS_PULSES")),
    "silverbox/SNLS80mV.mat",
    "so101/chirp_sweep.csv",
    "so101/backlash_detection.csv",
]
# Logs that cannot be a case yet, each with the reason that `init` gives.
NO_CASE = {
    "tx40/curr_data.csv": "no column is a position or a velocity by its name: 'Joint_1'",
    "tx40/pos_read_data.csv": "no column is a position or a velocity by its name: 'Joint_1'",
}


def measured(name: str) -> Path:
    if not os.environ.get("JAXID_DATA"):
        pytest.skip("JAXID_DATA is unset: no measured logs here")
    return Path(os.environ["JAXID_DATA"]) / name


# One of each kind runs always; the others are slow together.
ALWAYS = ("decimal_comma", "swing_no_torque", "velocity_only", "velocity_table", "wrapped", "chirp_sweep")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if Path(name).stem in ALWAYS else pytest.mark.slow) for name in MEASURED],
)
def test_a_measured_log_becomes_a_case_that_runs(name):
    log = measured(name)
    first = jaxid.init(log)
    checked = jaxid.check(first.case(), log)
    assert checked.json()["sound"]
    assert first.text.startswith(f"# Case of {log.name}")


@pytest.mark.parametrize("name", NO_CASE)
def test_a_measured_log_that_is_no_case_yet(name):
    with pytest.raises(InputError, match=NO_CASE[name]) as caught:
        jaxid.init(measured(name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["field/test_dynamic-forward.csv", "field/test_dynamic-reverse.csv"])
def test_a_step_of_voltage_has_a_case(name):
    first = jaxid.init(measured(name))
    assert first.tables["log"]["force"] == "voltage"
    assert first.tables["plant"]["parameters"]["inertia"]["guess"] == pytest.approx(0.02, rel=0.1)


TRUE = {
    # published values or those of the simulator, in the units of the case
    "field/sign_flipped.csv": (0.02, 0.12, 0.25),
    "field/time_milliseconds.csv": (0.05, 0.15, 0.4),
    "field/time_microseconds.csv": (0.05, 0.15, 0.4),
    "field/empty_cells.csv": (0.05, 0.15, 0.4),
    "field/wrapped.csv": (6e-4, 1.2e-3, 0.008),
    "field/pwm_counts.csv": tuple(
        np.array([7.82e-3, 0.0240, 0.235]) * (255 / 12) * np.array([2 * np.pi / 1440, 2 * np.pi / 1440, 1.0])
    ),
    "emps/DATA_EMPS.mat": tuple(np.array([95.109, 203.5, 20.39]) / NEWTONS_PER_AMPERE),
}


@pytest.mark.parametrize("name", TRUE)
def test_guesses_are_near_the_truth(name):
    tables = jaxid.init(measured(name)).tables
    guesses = [tables["plant"]["parameters"]["inertia"], *(list(e.values())[1] for e in tables["effects"])]
    for guess, true in zip(guesses, TRUE[name], strict=True):
        assert guess["guess"] == pytest.approx(true, rel=0.4)
