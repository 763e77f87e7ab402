"""First cases of robots whose file has no servos, from logs of commands and positions without a force."""

from functools import cache

import numpy as np
import pytest

import jaxid
from jaxid.errors import InputError
from jaxid.first_case.servo import loop_of_servos
from truth.arm.servos import Links, Servo, run

LINKS = Links(mass=(0.3, 0.15), along=(0.1, 0.075), across=(0.0, 0.0), about=(1.25e-3, 3.55e-4), length=0.2)
COUNT = 2 * np.pi / 16_000


def drawn_servo(rotor, kp, kd, viscous, coulomb):
    effects = {"viscous_friction": {"coefficient": viscous}, "coulomb_friction": {"level": coulomb}}
    return Servo(rotor, kp, kd, {**effects, "command_delay": {"delay": 0.006}})


SERVOS = (drawn_servo(0.03, 9.0, 0.4, 0.15, 0.1), drawn_servo(0.01, 3.7, 0.12, 0.04, 0.06))


def urdf() -> str:
    """Return the links as a URDF; its joints lift them out of the x axis, against the weight."""
    text = ['<robot name="two"><link name="base"/>']
    before, place = "base", 0.0
    for k, name in enumerate(("shoulder", "elbow")):
        mass, along, about = LINKS.mass[k], LINKS.along[k], LINKS.about[k]
        text.append(
            f'<link name="{name}_link"><inertial><origin xyz="{along} 0 0"/><mass value="{mass}"/>'
            f'<inertia ixx="1e-5" iyy="{about}" izz="{about}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
            f'<joint name="{name}" type="revolute"><parent link="{before}"/><child link="{name}_link"/>'
            f'<origin xyz="{place} 0 0"/><axis xyz="0 -1 0"/>'
            '<limit lower="-2" upper="2" effort="5" velocity="9"/></joint>'
        )
        before, place = f"{name}_link", LINKS.length
    return "\n".join([*text, "</robot>"])


@cache
def moves(seconds: float = 1.0, every: int = 1) -> dict[str, np.ndarray]:
    """Return a log of the arm in loops of 1 kHz, a row every so many ticks."""
    rng = np.random.default_rng(3)
    t = np.arange(round(1000 * seconds) // every) * every / 1000
    tones = [(0.4, 0.5), (0.25, 1.1), (0.1, 2.9)]
    command = np.stack(
        [sum(a * np.sin(2 * np.pi * f * t + rng.uniform(0, 6)) for a, f in tones) for _ in range(2)], axis=1
    )
    ticks = np.repeat(command, every, axis=0)
    held = np.tile(ticks[0], (1000, 1))
    options = {"rate": 1000.0, "step": 2e-5}
    start = run(LINKS, SERVOS, held, start=ticks[0], **options)["position"][-1]
    noise = 0.2 * COUNT * rng.standard_normal(ticks.shape)
    found = run(LINKS, SERVOS, ticks, start=start, noise=noise, resolution=COUNT, **options)
    q = found["reading"][::every]
    return {"t": t, "q1": q[:, 0], "q2": q[:, 1], "cmd1": command[:, 0], "cmd2": command[:, 1]}


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf())
    return path


def test_a_urdf_and_commands_make_a_case_of_unknown_loops(robot, tmp_path):
    first = jaxid.init(moves(), urdf=robot, folder=tmp_path)
    tables = first.tables
    assert tables["plant"]["unknown"] == ["armature", "damping", "frictionloss"]
    assert tables["log"]["reference"] == {"shoulder": "cmd1", "elbow": "cmd2"}
    # The fit finds the course of the command, and the loop reads counts.
    assert "reference_hold" not in tables["log"]
    assert tables["sensor"]["position_resolution"] == pytest.approx(COUNT, rel=1e-4)

    loop = tables["controller"]
    assert loop["kind"] == "pd"
    assert "derivative" not in loop
    assert loop["period"] == 1e-3
    assert [unknown["guess"] for unknown in loop["delay"]] == [0.02, 0.02]
    # A loop of 5 Hz about the links; a URDF has no rotors.
    rate, log = 2 * np.pi * 5.0, moves()
    couple = LINKS.mass[1] * LINKS.length * LINKS.along[1]
    varying = 2 * couple * np.cos(log["q2"]).mean()
    second = LINKS.constants[5]
    inertias = np.array([LINKS.constants[0] + second + varying, second])
    for key, factors in (("kp", rate**2), ("kd", 1.4 * rate)):
        guesses = [unknown["guess"] for unknown in loop[key]]
        assert guesses == pytest.approx(inertias * factors, rel=0.06), key
    assert any("a position loop is taken to move each joint" in line for line in first.assumed)
    assert any("at which rate" in line for line in first.questions)


def test_a_search_leaves_friction_that_a_file_lacks_to_be_found(robot, tmp_path):
    first = jaxid.init(moves(), urdf=robot, folder=tmp_path, search=True)
    assert first.tables["plant"]["unknown"] == ["armature"]
    with_friction = urdf().replace("</joint>", '<dynamics damping="0.1"/></joint>')
    robot.write_text(with_friction)
    first = jaxid.init(moves(), urdf=robot, folder=tmp_path, search=True)
    assert first.tables["plant"]["unknown"] == ["armature", "damping"]


MJCF = (
    '<mujoco><worldbody><body><joint name="shoulder" axis="0 -1 0"/><geom size="0.05" mass="1"/>'
    '<body pos="0.2 0 0"><joint name="elbow" axis="0 -1 0"/><geom size="0.05" mass="1"/></body></body>'
    "</worldbody><actuator>{}</actuator></mujoco>"
)


def test_motors_of_an_mjcf_are_no_servos(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(MJCF.format('<motor joint="shoulder" gear="3"/><motor joint="elbow" gear="2"/>'))
    first = jaxid.init(moves(), mjcf=path, folder=tmp_path)
    assert first.tables["plant"]["actuators"] is False
    assert first.case().controller.unknown.keys() >= {"kp", "kd", "delay"}
    # A rotor of 0.1 kg m^2 adds to the guess of the gain.
    path.write_text(path.read_text().replace('name="elbow" axis', 'name="elbow" armature="0.1" axis'))
    heavier = jaxid.init(moves(), mjcf=path, folder=tmp_path)
    kp = [[entry["guess"] for entry in f.tables["controller"]["kp"]] for f in (first, heavier)]
    assert kp[1][0] == kp[0][0]
    assert kp[1][1] - kp[0][1] == pytest.approx(0.1 * (2 * np.pi * 5.0) ** 2, rel=0.06)


def test_a_file_with_a_servo_at_one_of_two_joints_is_refused(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text(MJCF.format('<position joint="shoulder" kp="3"/><motor joint="elbow"/>'))
    with pytest.raises(InputError, match="no position servo at 'elbow'"):
        jaxid.init(moves(), mjcf=path, folder=tmp_path)


def test_commands_of_one_of_two_joints_are_not_enough(robot, tmp_path):
    log = {name: x for name, x in moves().items() if name != "cmd2"}
    with pytest.raises(InputError, match="or the commanded position of each joint"):
        jaxid.init(log, urdf=robot, folder=tmp_path)


def test_forces_of_some_joints_are_not_dropped(robot, tmp_path):
    log = moves() | {"shoulder_torque": np.cos(7 * moves()["t"])}
    with pytest.raises(InputError, match="not each has a force: 'shoulder_torque'"):
        jaxid.init(log, urdf=robot, folder=tmp_path)


def test_counts_are_no_angles_of_links(robot, tmp_path):
    log = {name: x if name == "t" else np.round(2048 + x / COUNT) for name, x in moves().items()}
    with pytest.raises(InputError, match="'q1' is in count, and the links of .*arm.urdf need rad"):
        jaxid.init(log, urdf=robot, folder=tmp_path)


def test_a_joint_at_rest_has_a_command_and_no_force(robot, tmp_path):
    log, still = moves(), np.full(len(moves()["t"]), 0.3)
    names = {"shoulder_pos": log["q1"], "elbow_pos": still, "shoulder_cmd": log["cmd1"], "elbow_cmd": still}
    first = jaxid.init({"t": log["t"], **names}, urdf=robot, folder=tmp_path)
    assert "force" not in first.tables["log"]
    assert first.tables["log"]["reference"] == {"shoulder": "shoulder_cmd"}
    assert first.tables["plant"]["joints"] == ["shoulder"]


def test_a_joint_without_inertia_has_a_guess_above_zero():
    assert [unknown["guess"] for unknown in loop_of_servos([2.0, 0.0], 0.001).keys["kp"]] == [2000.0, 2.0]
    assert loop_of_servos([0.0], 0.004).keys["kp"]["guess"] > 0


@pytest.mark.parametrize(("period", "words"), [(0.002, "State 1 / rate"), (0.004, "else identify finds it")])
def test_a_stated_rate_of_the_loop_is_not_searched_for(period, words):
    loop = loop_of_servos([1.0], period)
    assert ("period" in loop.keys) == (period < 0.003)
    assert words in loop.questions[0]


@pytest.mark.slow
def test_the_first_case_of_a_urdf_gives_the_values_of_its_servos(robot, tmp_path):
    log = moves(4.0, 2)
    found = jaxid.identify(jaxid.init(log, urdf=robot, folder=tmp_path).case(), log)
    fit = found.estimate
    assert fit.converged
    values = dict(zip(fit.names, zip(fit.theta, fit.std, strict=True), strict=True))
    for k, servo in enumerate(SERVOS, start=1):
        true = {
            f"rotor_inertia[{k}]": servo.rotor,
            f"controller.kp[{k}]": servo.kp,
            f"controller.delay[{k}]": 0.006,
            f"coulomb_friction[{k}].level": servo.effects["coulomb_friction"]["level"],
        }
        for name, value in true.items():
            estimate, std = values[name]
            assert abs(estimate - value) < 4 * std, name
            assert std < 0.2 * value, name
