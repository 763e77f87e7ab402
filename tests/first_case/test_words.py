"""Names of columns as drives, robots and measuring programs write them, in English and German."""

import pytest

from jaxid.first_case.words import meaning_of

NAMES = {
    # Siemens, Beckhoff, Bosch Rexroth and CiA 402 words for the same quantities
    "Lage-Istwert": "position",
    "Lageistwert": "position",
    "LageSollwert": "position wanted",
    "Sollposition": "position wanted",
    "Drehmomentistwert": "torque",
    "Stromistwert": "current",
    "Drehzahlistwert": "velocity",
    "Schleppfehler": "passed over",
    "Kraft [N]": "force",
    "Temperatur [°C]": "temperature",
    "Zeit [s]": "time",
    "Axis1.ActPos": "position of 1",
    "Axis1.ActCurrent": "current of 1",
    "position_actual_value": "position",
    "torque_actual_value": "torque",
    "target_current": "current wanted",
    "current_position": "position",
    # robots
    "/joint_states.position[shoulder]": "position of shoulder",
    "/joint_states.effort[shoulder_pan]": "torque of shoulder pan",
    "/joint_states/joint1/position": "position of 1",
    "observation.state[elbow_flex.pos]": "position of elbow flex",
    "action[elbow_flex.pos]": "position wanted of elbow flex",
    "des_dof_pos": "position wanted",
    "q_target": "position wanted",
    "tau_est": "torque",
    "cmd_vel": "velocity wanted",
    "q1": "position of 1",
    "cmd3": "wanted of 3",
    "load2": "load of 2",
    "header.stamp": "time of header",
    "__time": "time",
    # drives and hobby electronics
    "Iq": "current",
    "i_q": "current",
    "Uq": "voltage",
    "Vsupply": "passed over",
    "Reference Velocity": "velocity wanted",
    "pwm": "duty",
    "counts": "position",
    "theta": "position",
    "dq": "velocity",
    "u": "command",
    "set_point_2": "wanted of 2",
    "pos_sp": "position wanted",
    "sp1": "wanted of 1",
    "i_v": "current of v",
    "U_w": "voltage of w",
    "Iist": "current",
    "Isoll": "current wanted",
    "n_soll": "velocity wanted",
    "nist": "velocity",
    "list": "",
    "thetam": "position",
    "thetaM": "position",
    "theta_M": "position",
    "omegaL": "velocity",
    "wl": "velocity",
    "qdes": "position wanted",
    "xref": "position wanted",
    "thetaref": "position wanted",
    "omegacmd": "velocity wanted",
    "q1des": "position wanted of 1",
    "xact": "position",
    "fact": "of fact",
    "ides": "current wanted",
    "iref": "current wanted",
    # readings of a body, which are those of no joint
    "gyro_x": "passed over",
    "accelerometer_y": "passed over",
    "twist.angular.z": "velocity",
    "twist [deg]": "of twist",
    "joint_position_twist": "position of twist",
    "imu_time": "time of imu",
    # derivatives, as students and robots' programs write them
    "theta_dot": "velocity",
    "thetaDot": "velocity",
    "q1_dot": "velocity of 1",
    "dphi": "velocity",
    "d_theta": "velocity",
    "alphadot": "velocity",
    "x_ddot": "acceleration",
    "q_dd": "acceleration",
    "omegadot": "acceleration",
    "dtorque": "of dtorque",
    "force_dot": "",
    "q_d": "position wanted",
    "theta_d": "position wanted",
    "i_d": "current of d",
    "tau_d": "torque wanted",
    "xdd": "acceleration",
    "vx": "velocity",
    "link_voltage": "passed over of link",
    # motor and load
    "theta_load": "position of load",
    "link_pos": "position of link",
    "dc_link_voltage": "passed over of link",
    # coordinates and windings
    "alpha": "position",
    "yaw": "position of yaw",
    "hip_roll_pos": "position of hip roll",
    "WristPitchTorque": "torque of wrist pitch",
    "roll_rate": "velocity of roll",
    "roll_diameter": "of roll diameter",
    "theta_a": "position of a",
    "vel_dx": "velocity",
    "joint_vel_dtheta": "velocity",
    "acc_ddx": "acceleration",
    "d_current": "current of d",
    "dtheta1_dt": "velocity of 1",
    "linear_pos": "position of linear",
    "left_x_pos": "position of left x",
    "vm": "of vm",
    "th2": "position of 2",
    "velocity_x": "velocity",
    "force_x": "force",
    "angular_velocity": "velocity",
    "position_load": "position of load",
    "q_load": "position of load",
    "load": "load",
    "i_a": "current",
    "Vm": "voltage",
    # nothing is known of these
    "Joint_1": "of 1",
    "vir": "of vir",
    "kp": "of kp",
}


@pytest.mark.parametrize("name", NAMES)
def test_meaning(name):
    found = meaning_of(name)
    joint = f"of {' '.join(found.joint)}" if found.joint else ""
    words = [found.quantity, "wanted" if found.reference else "", joint]
    assert " ".join(word for word in words if word) == NAMES[name]


@pytest.mark.parametrize(
    ("name", "quantity", "unit"),
    [
        ("t_us", "time", "us"),
        ("ms", "time", "ms"),
        ("axis_pos_mm", "position", "mm"),
        ("speed_rpm", "velocity", "rpm"),
        # A capital within the unit begins no word.
        ("current_mA", "current", "mA"),
        ("motorCurrent_mA", "current", "mA"),
        ("currentmA", "current", "mA"),
        ("I_A", "current", "A"),
        ("force_kN", "force", "kN"),
        ("torque_mNm", "torque", "mNm"),
        ("mA", "", "mA"),
        ("actualPositionDeg", "position", "deg"),
        ("speedRpm", "velocity", "rpm"),
    ],
)
def test_units_at_the_end_of_a_name(name, quantity, unit):
    found = meaning_of(name)
    assert (found.quantity, found.unit) == (quantity, unit)


def test_words_of_a_turn_and_of_a_slide():
    assert meaning_of("Winkel").motion == "rotary"
    assert meaning_of("Hub").motion == "linear"
    assert meaning_of("Lage").motion == ""
