"""Dry friction and delays of an exported MJCF, in MuJoCo itself."""

import mujoco
import pytest

from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.commands.export import export
from jaxid.export.mujoco_run import FINER, load
from jaxid.export.soft_friction import Softness
from jaxid.results.model_json import drives_json, robot_json

STEP = 0.002
# A servo holds a link in a horizontal plane; the attributes of its joint and of its actuator are inserted.
SERVO = """<mujoco><option timestep="0.002" gravity="0 0 0"/>
  <default><joint armature="0.01"/></default>
  <worldbody><body><joint name="a" axis="0 0 1"{joint}/>
    <inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.01 0.01"/></body></worldbody>
  <actuator><position joint="a" kp="50" kv="2"{drive}/></actuator></mujoco>"""
LOG = {"time": "t", "position": ["q"], "reference": ["r"], "reference_hold": "zero_order"}


def text(joint="", drive=""):
    return SERVO.format(joint=joint, drive=drive)


def exported(folder, start, true):
    """Export of a result whose machine is that of the file `true` into the file `start`."""
    path = folder / "robot.xml"
    path.write_text(true)
    case = read_case({"plant": {"kind": "tree", "mjcf": "robot.xml"}, "log": LOG}, None, folder)
    machine = build_machine(case, period=STEP)
    path.write_text(start)
    model = robot_json(machine.plant, case.plant, {}) | {"drives": drives_json(machine)}
    return export({"model": model}, "mjcf", path)


def creep(content, load=0.6, seconds=5.0):
    """Velocity of the joint under a torque below its friction, its servo off."""
    model = mujoco.MjModel.from_xml_string(content)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = load
    mujoco.mj_step(model, data, round(seconds / STEP))
    return model, data.qvel[0]


@pytest.mark.parametrize(
    "softness",
    [
        "",
        ' solreffriction="0.004 1"',
        ' solreffriction="0.05 0.5" solimpfriction="0.5 0.7"',
        ' solreffriction="-100 -20"',
        ' solreffriction="0.004 1" solimpfriction="0.9999 0.9999"',
    ],
)
def test_the_creep_is_that_of_mujoco(softness):
    model, velocity = creep(text(f' frictionloss="1"{softness}'))
    expected = Softness.of(model, 0).creep * 0.6 * model.dof_invweight0[0]
    assert velocity == pytest.approx(expected, rel=1e-6)
    twice = Softness.of(model, 0).doubled.creep
    assert twice == pytest.approx(2.0 * Softness.of(model, 0).creep, rel=1e-12)


def test_a_friction_that_is_written_holds_the_joint(tmp_path):
    true = text(' frictionloss="1"')
    file = exported(tmp_path, text(), true)
    _, soft = creep(true)
    _, held = creep(file.content.decode())
    assert soft > 0.01
    assert held < 1e-3 * soft
    # It still slides above its level.
    _, slides = creep(file.content.decode(), load=1.1)
    assert slides > 1.0


def test_a_friction_that_stays_keeps_the_softness_of_the_file(tmp_path):
    start = text(' frictionloss="1" damping="2"')
    file = exported(tmp_path, start, text(' frictionloss="1" damping="3"'))
    assert file.content.decode() == start.replace('damping="2"', 'damping="3.0"')
    # A stiff one is left as it is, and a joint without friction gets none.
    stiff = ' solreffriction="0.004 1" solimpfriction="0.9999 0.9999"'
    start = text(f' frictionloss="1"{stiff}')
    file = exported(tmp_path, start, start.replace('loss="1"', 'loss="2"'))
    assert file.content.decode() == start.replace('loss="1"', 'loss="2.0"')
    file = exported(tmp_path, text(' frictionloss="1"'), text())
    assert file.content.decode() == text(' frictionloss="0.0"')


def test_a_delay_between_two_steps_is_the_one_that_was_found(tmp_path):
    """Along a ramp of the command a servo's force lags by kp times the delay."""
    delay = 6.63 * STEP
    start, locked = text(' armature="1e9"'), ' armature="1e9"'
    file = exported(tmp_path, start, text(locked, f' delay="{delay}" nsample="20"'))
    model = mujoco.MjModel.from_xml_string(file.content.decode())
    data = mujoco.MjData(model)
    for k in range(40):
        data.ctrl[0] = k * STEP
        mujoco.mj_step(model, data)
    assert data.actuator_force[0] / 50 == pytest.approx(39 * STEP - delay, abs=1e-9)
    # Its memory serves a replay with a shorter time step too.
    compiled, _ = load(file.content, tmp_path / "robot.xml", ["a"], {}, [0.0, 0.0, 0.0])
    assert compiled.actuator_history[0, 0] * STEP / FINER > delay
