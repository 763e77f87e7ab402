"""Logs of machines of which one joint has a drive: a pendulum on a cart, and one on a turning arm."""

import mujoco
import numpy as np
import pytest

import jaxid
from jaxid.errors import InputError
from truth.axis.machines import multisine

CART = """<robot name="cartpole">
  <link name="rail"/>
  <link name="cart"><inertial><mass value="0.57"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 -0.3"/><mass value="0.2"/>
    <inertia ixx="6e-3" iyy="6e-3" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slider" type="prismatic"><parent link="rail"/><child link="cart"/><axis xyz="1 0 0"/>
    <limit lower="-1" upper="1"{effort} velocity="5"/></joint>
  <joint name="pivot" type="continuous"><parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/></joint>
</robot>
"""
# Its friction settles within a millisecond, so that it is close to Coulomb's law.
TRUE = """<mujoco><compiler angle="radian"/><option timestep="0.0002" integrator="implicitfast"/>
<worldbody><body><inertial pos="0 0 0" mass="0.57" diaginertia="1e-4 1e-4 1e-4"/>
<joint type="slide" axis="1 0 0" damping="4.3" armature="0.39" frictionloss="1.1"
 solreffriction="0.0008 1" solimpfriction="0.99 0.999 0.001 0.5 2"/>
<body><inertial pos="0 0 -0.33" mass="0.23" diaginertia="7.9e-3 7.9e-3 1e-6"/>
<joint type="hinge" axis="0 1 0" damping="0.0024"/></body></body></worldbody></mujoco>
"""
TOTAL, MOMENT, INERTIA = 0.57 + 0.23 + 0.39, 0.23 * 0.33, 7.9e-3 + 0.23 * 0.33**2


def cart_log(names=("x", "alpha", "force"), seconds: float = 8.0) -> dict[str, np.ndarray]:
    """Return a log at 500 Hz of a cart that MuJoCo drives to and fro by a multisine of force."""
    model = mujoco.MjModel.from_xml_string(TRUE)
    data, rows = mujoco.MjData(model), []
    t = np.arange(round(500 * seconds)) / 500
    force = multisine(t, [0.4, 0.9, 1.5, 2.1], 14.0, 3)
    counts = np.array([2.275e-5, 2 * np.pi / 4096])
    for value in force:
        rows.append(np.round(data.qpos / counts) * counts)
        data.qfrc_applied[0] = value
        mujoco.mj_step(model, data, nstep=10)
    place, angle = np.array(rows).T
    return dict(zip(("t", *names), (t, place, angle, force), strict=True))


def urdf(folder, effort: str = ' effort="20"'):
    path = folder / "cart.urdf"
    path.write_text(CART.format(effort=effort))
    return path


@pytest.mark.parametrize("effort", [' effort="20"', ""])
def test_a_pendulum_on_a_cart_needs_one_force(tmp_path, effort):
    log = cart_log(seconds=1.0)
    first = jaxid.init(log, urdf=urdf(tmp_path, effort), folder=tmp_path)
    plant, table = first.tables["plant"], first.tables["log"]
    assert plant["actuated"] == ["slider"]
    assert table["position"] == {"slider": "x", "pivot": "alpha"}
    # Without a limit of effort nothing says which joint is driven.
    asked = [line for line in first.questions if "which joint does force drive?" in line]
    assert len(asked) == (0 if effort else 1)


def test_the_first_case_of_a_pendulum_on_a_cart_gives_the_true_values(tmp_path):
    log = cart_log()
    first = jaxid.init(log, urdf=urdf(tmp_path), folder=tmp_path)
    fit = jaxid.identify(first.case(), log, method="inverse_dynamics").estimate
    assert fit.converged
    values = dict(zip(fit.names, zip(fit.theta, fit.std, strict=True), strict=True))
    true = {"rotor_inertia[1]": TOTAL, "first_moment_y[2]": MOMENT, "inertia_zz[2]": INERTIA}
    true |= {"viscous_friction[1].coefficient": 4.3, "coulomb_friction[1].level": 1.1}
    for name, value in true.items():
        found, std = values[name]
        assert abs(found - value) < min(4 * std, 0.02 * value), name


def test_the_name_of_a_force_names_its_joint(tmp_path):
    log = cart_log(("x", "theta", "tau_pivot"), seconds=1.0)
    first = jaxid.init(log, urdf=urdf(tmp_path, ""), folder=tmp_path)
    assert first.tables["plant"]["actuated"] == ["pivot"]


@pytest.mark.parametrize(
    ("effort", "columns"),
    [(' effort="20"', ("x", "theta", "theta_torque")), ("", ("x", "theta", "wrist_torque"))],
)
def test_a_force_that_names_another_joint_is_not_that_of_the_driven_one(tmp_path, effort, columns):
    log = cart_log(columns, seconds=1.0)
    with pytest.raises(InputError, match=r"\('x', 'theta'\), and not each has a force.*elbow_torque"):
        jaxid.init(log, urdf=urdf(tmp_path, effort), folder=tmp_path)


def test_a_single_force_of_a_robot_whose_joints_are_all_driven_is_refused(tmp_path):
    path = urdf(tmp_path)
    path.write_text(
        path.read_text().replace(
            '<axis xyz="0 1 0"/></joint>',
            '<axis xyz="0 1 0"/><limit effort="3" velocity="9"/></joint>',
        )
    )
    with pytest.raises(InputError, match="not each has a force"):
        jaxid.init(cart_log(seconds=1.0), urdf=path, folder=tmp_path)


@pytest.mark.parametrize("effort", ["inf", "${most}", ""])
def test_a_limit_of_effort_that_is_no_number_stops_nothing(tmp_path, effort):
    path = urdf(tmp_path, f' effort="{effort}"')
    first = jaxid.init(cart_log(seconds=1.0), urdf=path, folder=tmp_path)
    assert first.tables["plant"]["actuated"] == ["slider"]


def test_a_stray_column_takes_no_position_servo_over(tmp_path):
    log = cart_log(("a_pos", "b_pos", "voltage"), seconds=1.0)
    log |= {"a_cmd": log["a_pos"], "b_cmd": log["b_pos"]}
    path = tmp_path / "servos.xml"
    body = '<body><joint name="{0}" axis="0 0 1"/><geom size="0.05" mass="1"/>{1}</body>'
    path.write_text(
        f"<mujoco><worldbody>{body.format('a', body.format('b', ''))}</worldbody><actuator>"
        '<position joint="a" kp="5"/><position joint="b" kp="5"/></actuator></mujoco>'
    )
    table = jaxid.init(log, mjcf=path, folder=tmp_path).tables["log"]
    assert "force" not in table
    assert table["reference"] == {"a": "a_cmd", "b": "b_cmd"}


def test_alpha_is_an_angle_unless_a_velocity_stands_beside_it(tmp_path):
    log = cart_log(("theta", "alpha", "tau"), seconds=1.0)
    both = log | {f"{name}_dot": np.gradient(log[name], log["t"]) for name in ("theta", "alpha")}
    for columns in (log, both):
        first = jaxid.init(columns, urdf=urdf(tmp_path), folder=tmp_path)
        assert first.tables["log"]["position"] == {"slider": "theta", "pivot": "alpha"}
        assert ("velocity" in first.tables["log"]) == (columns is both)

    alone = {"t": log["t"], "theta": log["theta"], "omega": np.gradient(log["theta"], log["t"])}
    alone |= {"alpha": np.gradient(alone["omega"], log["t"]), "tau": log["tau"]}
    assert jaxid.init(alone).tables["log"]["position"] == "theta"


@pytest.mark.parametrize(("name", "dotted"), [("theta", "thetad"), ("phi", "phip"), ("x", "xd")])
def test_values_say_whether_a_name_is_that_of_a_derivative_or_of_what_is_desired(name, dotted):
    log = cart_log((name, "rest", "force"), seconds=2.0)
    del log["rest"]
    speed = log | {dotted: np.gradient(log[name], log["t"])}
    # What the machine follows is 40 ms ahead, as that of a servo.
    desired = log | {dotted: np.append(log[name][20:], np.full(20, log[name][-1]))}
    nothing = log | {dotted: log["force"]}
    assert jaxid.init(speed).tables["log"]["velocity"] == dotted
    assert jaxid.init(desired).tables["log"]["reference"] == dotted
    assert not {"velocity", "reference"} & jaxid.init(nothing).tables["log"].keys()


def test_joints_that_only_symbols_name():
    log = cart_log(seconds=1.0)
    gantry = {"t": log["t"], "x_pos": log["x"], "y_pos": log["alpha"]}
    gantry |= {"x_torque": log["force"], "y_torque": 0.1 * log["force"]}
    table = jaxid.init(gantry).tables["log"]
    assert (table["position"], table["force"]) == ("y_pos", "y_torque")  # that one moves most


def test_a_log_with_too_few_positions_is_refused(tmp_path):
    log = cart_log(seconds=1.0)
    del log["alpha"]
    with pytest.raises(InputError, match=r"1 column says the position of a joint \('x'\).*slider_position"):
        jaxid.init(log, urdf=urdf(tmp_path), folder=tmp_path)
