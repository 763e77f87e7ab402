"""First cases of a motor and a load behind a coupling, each with its encoder, on an exact log."""

import numpy as np
import pytest

import jaxid
from jaxid.first_case.columns import choose, columns_of
from jaxid.logs.rough_inertia import ratio_of_strokes
from tests.estimators.test_reading_noise import SOFT, deviations
from truth.chain.flexible_joints import flexible_joint

JOINT = flexible_joint(SOFT)


@pytest.fixture(scope="module")
def log():
    """Return the log of the joint at the rate of its loop."""
    return JOINT.log(1000.0)


@pytest.mark.parametrize(
    ("motor", "load"),
    [
        ("theta_m", "theta_l"),
        ("q_motor", "q_link"),
        ("motor_pos", "joint_pos"),
        ("primary_encoder", "secondary_encoder"),
        ("Motorposition", "Lastposition"),
        ("theta", "theta_load"),
        ("q_joint_motor", "q_joint_load"),
    ],
)
def test_names_of_two_encoders_are_read(log, motor, load):
    case = jaxid.init({"t": log["t"], load: log["q_load"], motor: log["q_motor"], "torque": log["torque"]})
    tables = case.tables
    assert tables["plant"]["kind"] == "flexible_axis"
    assert tables["log"] == {"time": "t", "position": motor, "load_position": load, "force": "torque"}
    assert any(load in line and "coupling" in line for line in case.assumed)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("link1_pos", "link2_pos"),
        ("joint1_pos_m", "joint2_pos_m"),
        ("finger_joint1 pos [m]", "finger_joint2 pos [m]"),
        ("motor_left_arm_pos", "motor_right_arm_pos"),
        ("pos", "last_pos"),
        ("angle", "angle_output"),
    ],
)
def test_two_positions_that_move_together_need_not_be_motor_and_load(log, one, other):
    table = {"t": log["t"], one: log["q_motor"], other: log["q_load"]}
    columns = columns_of({name: x[:, None] for name, x in table.items()}, {}, "t")
    assert choose(columns, "log").load is None


@pytest.mark.parametrize(("behind", "force"), [("tau_link", "tau_motor"), ("link_torque", "current")])
def test_a_torque_behind_the_coupling_is_not_that_of_the_motor(log, behind, force):
    columns = {behind: 0.5 * log["torque"], force: log["torque"]}
    case = jaxid.init({"t": log["t"], "q_motor": log["q_motor"], "q_link": log["q_load"], **columns})
    assert case.tables["log"]["force"] == force
    assert any(f"'{behind}' is not used" in line for line in case.assumed)


def test_a_log_without_a_force_says_that_it_leaves_the_load_out(log):
    table = {"t": log["t"], "q_motor": log["q_motor"], "q_load": log["q_load"], "q_ref": log["q_motor"]}
    case = jaxid.init(table)
    assert any("'q_load' is not used: a log without a force" in line for line in case.assumed)


def test_a_missing_reading_of_the_load_is_resampled(log):
    load = log["q_load"].copy()
    load[500] = np.nan
    case = jaxid.init({"t": log["t"], "q_motor": log["q_motor"], "q_load": load, "torque": log["torque"]})
    assert case.tables["log"]["resample"] == pytest.approx(1000.0)


def test_a_reference_of_the_load_is_brought_to_the_motor_in_front_of_a_gear(log):
    table = {
        "t": log["t"],
        "motor pos [deg]": np.rad2deg(50 * log["q_motor"]),
        "load pos [deg]": np.rad2deg(log["q_load"]),
        "pos ref [deg]": np.rad2deg(log["q_load"]),
        "torque [Nm]": log["torque"] / 50,
    }
    case = jaxid.init(table)
    units = {"position": "deg", "load_position": "deg", "force": "Nm", "reference": "50 deg"}
    assert case.tables["log"]["units"] == units
    read = jaxid.open_session(case.case(), table).fits[0].log
    assert read.reference is not None
    assert np.allclose(read.reference[:, 0], log["q_load"])


def test_the_encoder_of_a_load_that_counts_backwards_has_its_sign_turned(log):
    table = {"t": log["t"], "q_motor": log["q_motor"], "q_load": -log["q_load"], "torque": log["torque"]}
    case = jaxid.init(table)
    assert case.tables["log"]["sign"] == {"load_position": -1}
    assert case.tables["plant"]["kind"] == "flexible_axis"
    assert any("count in opposite directions" in line for line in case.questions)


@pytest.mark.parametrize("load", ["table position [mm]", "y [mm]"])
def test_an_angle_and_a_length_are_motor_and_load_of_a_screw(log, load):
    lead = 0.005
    table = {
        "t": log["t"],
        "angle [deg]": np.rad2deg(log["q_motor"] * 2 * np.pi / lead),
        load: 1e3 * log["q_load"],
        "torque [Nm]": log["torque"] * lead / (2 * np.pi),
    }
    case = jaxid.init(table)
    assert case.tables["plant"]["motion"] == "linear"
    drive = case.tables["actuator"]
    assert drive["lead"] == lead
    assert drive["gain"] == pytest.approx(2 * np.pi / lead, rel=1e-5)
    assert case.tables["log"]["position_at"] == "motor"
    read = jaxid.open_session(case.case(), table).fits[0].log
    assert np.allclose(read.position, np.stack([log["q_motor"], log["q_load"]], axis=1))
    assert np.allclose(read.force[:, 0] * drive["gain"], log["torque"], rtol=1e-5)


def test_joints_of_a_robots_file_are_no_motor_and_load(log):
    columns = columns_of(
        {name: log[name][:, None] for name in ("t", "q_motor", "q_load", "torque")},
        {},
        "t",
        ("motor", "load"),
    )
    assert choose(columns, "log", of_robot=True).load is None
    assert choose(columns, "log").load is not None


@pytest.mark.slow
def test_the_case_of_two_encoders_finds_the_truth(log):
    columns = {"q_motor": log["q_motor"], "q_load": log["q_load"], "torque": log["torque"]}
    table = {"t": log["t"], "dq_motor": np.gradient(log["q_motor"], log["t"]), **columns}
    result = jaxid.identify(jaxid.init(table).case(), table)
    z = deviations(result.estimate, JOINT.true)
    assert np.all(np.abs(z) < 3.0), z
    assert result.model_complete


def test_a_gear_between_two_encoders_is_found_exactly(log):
    """A motor that moves 50 times as far, in degrees, with its torque: stiffness and inertias at the load."""
    table = {
        "t": log["t"],
        "motor position [deg]": np.rad2deg(50 * log["q_motor"]),
        "load position [deg]": np.rad2deg(log["q_load"]),
        "motor torque [Nm]": log["torque"] / 50,
    }
    case = jaxid.init(table)
    assert case.tables["actuator"] == {"gear_ratio": 50.0, "gain": 50.0}
    assert case.tables["log"]["position_at"] == "motor"
    assert any("is the force that of the motor" in line for line in case.questions)
    result = jaxid.identify(case.case(), table)
    assert result.estimate.value("stiffness") == pytest.approx(JOINT.true["stiffness"], rel=0.02)
    assert result.estimate.value("load_inertia") == pytest.approx(JOINT.true["load_inertia"], rel=0.02)


@pytest.mark.parametrize(("unit", "gain"), [("N", 1.0), ("kN", 1.0)])
def test_a_force_beside_a_screw_is_that_on_its_table(log, unit, gain):
    size = {"N": 1.0, "kN": 1e3}[unit]
    table = {
        "t": log["t"],
        "angle [deg]": np.rad2deg(log["q_motor"] * 2 * np.pi / 0.005),
        "table position [mm]": 1e3 * log["q_load"],
        f"force [{unit}]": log["torque"] / size,
    }
    case = jaxid.init(table)
    assert case.tables["actuator"]["gain"] == gain
    assert np.allclose(jaxid.open_session(case.case(), table).fits[0].log.force[:, 0], log["torque"])


@pytest.mark.parametrize(
    ("one", "other", "size"), [("theta1 [deg]", "z2 [mm]", 5.0), ("theta [deg]", "z [mm]", 100.0)]
)
def test_joints_that_turn_and_slide_together_are_no_screw(log, one, other, size):
    """Joints of different numbers, or a travel of 0.6 m in a turn, which no screw has."""
    table = {
        "t": log["t"],
        one: np.rad2deg(log["q_motor"]),
        other: size * log["q_load"],
        "tau": log["torque"],
    }
    columns = columns_of({name: x[:, None] for name, x in table.items()}, {}, "t")
    assert choose(columns, "log").load is None


def test_a_turned_reference_of_a_load_is_left_out_with_its_sign(log):
    table = {"t": log["t"], "q_motor": 1.3 * log["q_motor"], "q_load": log["q_load"]}
    table |= {"q_ref": -log["q_load"], "torque": log["torque"]}
    log_table = jaxid.init(table).tables["log"]
    assert ("reference" in log_table) == ("reference" in log_table.get("sign", {}))


def test_the_resonance_does_not_move_the_ratio(log):
    """A regression of the two positions alone is half a percent off where the load swings further."""
    motor, load = log["q_motor"], log["q_load"]
    assert ratio_of_strokes(80.0 * motor, load).ratio == pytest.approx(80.0, rel=2e-4)


def test_counts_of_two_encoders_ask_for_their_size(log):
    table = {"t": log["t"], "torque": log["torque"]}
    table |= {"motor_counts": np.round(log["q_motor"] / 1e-3), "load_counts": np.round(log["q_load"] / 2e-3)}
    case = jaxid.init(table)
    assert case.tables["plant"]["kind"] == "axis"
    assert "load_position" not in case.tables["log"]
    assert any("how large is one count of each" in line for line in case.questions)
