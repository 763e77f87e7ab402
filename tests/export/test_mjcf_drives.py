"""Actuators of a corrected MJCF: the file, read again, has the drives of the result."""

import copy
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.build import build_machine
from jaxid.case.case import read_case
from jaxid.case.mjcf import read_mjcf
from jaxid.commands.export import export
from jaxid.effects import EFFECTS
from jaxid.export.mjcf_drives import servo_words
from jaxid.results.model_json import drives_json, robot_json
from tests.case.test_mjcf import LOG, PLANT, SERVO

MOTORS = SERVO.replace(
    '<position joint="a" kp="50" kv="2" forcerange="-3 3"/>',
    '<motor name="m" joint="a" gear="-4" forcerange="-3 3"/>',
).replace('<general joint="b" biastype="affine" gainprm="40" biasprm="0 -40 -1"', '<motor joint="b"')


def built(folder, text, **plant):
    (folder / "robot.xml").write_text(text)
    case = read_case({"plant": PLANT | plant, "log": LOG}, None, folder)
    machine = build_machine(case, period=0.004)
    return (
        case,
        machine,
        {"model": robot_json(machine.plant, case.plant, {}) | {"drives": drives_json(machine)}},
    )


def drives_after(folder, result):
    file = export(result, "mjcf", folder / "robot.xml")
    (folder / "new.xml").write_bytes(file.content)
    return file, read_mjcf(folder / "new.xml").drives


def test_unknown_gains_range_and_delay_of_servos_are_those_of_the_controller(tmp_path):
    case, machine, _ = built(tmp_path, SERVO, unknown=["kp", "kv", "forcerange", "delay"])
    free = {f.name: f.guess for f in machine.parameters.free}
    assert free == {
        "controller.kp[1]": 50.0,
        "controller.kp[2]": 40.0,
        "controller.kd[1]": 2.0,
        "controller.kd[2]": 1.0,
        "controller.limit[1]": 3.0,
        "controller.limit[2]": 5.0,
        "controller.delay[1]": 0.005,
        "controller.delay[2]": 0.005,
    }
    assert not [e for e in machine.plant.effects if e.kind in ("input_delay", "saturation")]


def test_unknown_ranges_and_delays_of_motors_are_effects(tmp_path):
    _, machine, _ = built(tmp_path, MOTORS, unknown=["forcerange", "delay"])
    free = {f.name: f.guess for f in machine.parameters.free}
    assert free["saturation[1].limit"] == 12.0
    assert free["input_delay[2].delay"] == 0.005


def test_servos_get_gains_range_and_delay(tmp_path):
    _, _, result = built(tmp_path, SERVO)
    same, _ = drives_after(tmp_path, result)
    assert same.content.decode() == SERVO
    law = result["model"]["drives"]["controller"]
    law |= {"kp": [61.0, 33.0], "kd": [1.5, 0.25], "limit": [2.5, 5.0], "delay": [0.013, 0.0]}
    file, (a, b) = drives_after(tmp_path, result)
    assert file.changed == ("actuator '1'", "actuator '2'")
    assert not file.notes
    assert (a.kp, a.kd, a.limit, a.delay) == (61.0, 1.5, 2.5, 0.013)
    assert (b.kp, b.kd, b.limit, b.delay) == (33.0, 0.25, 5.0, 0.0)
    # MuJoCo delays by steps of 0.004 s: four of them, and both ends.
    assert 'nsample="6"' in file.content.decode()
    cascade = copy.deepcopy(result)
    cascade["model"]["drives"]["controller"] = {"kind": "cascade_pd", "kp": 20.0, "kv": 3.0, "period": 0.004}
    _, (a, _) = drives_after(tmp_path, cascade)
    assert (a.kp, a.kd) == (60.0, 3.0)


@pytest.mark.parametrize("law", ["pd", "cascade_pd"])
def test_the_loop_of_a_result_can_be_written_as_servos(law):
    gains = {"kp": [60.0, 20.0], "kd": [2.0, 0.5]} if law == "pd" else {"kp": [30.0, 40.0], "kv": [2.0, 0.5]}
    controller = {"kind": law, **gains, "delay": [0.002, 0.0]}
    drives = {"joints": [2, 1], "gain": [1.0, 2.0], "controller": controller}
    model = {"joints": ["a", "b"], "drives": drives}
    elements, delays, *slope = servo_words(model)
    assert elements.endswith('<position joint="b" kp="60" kv="2"/> <position joint="a" kp="40" kv="1"/>')
    assert delays.endswith("2 ms, 0 ms")
    assert len(slope) == (1 if law == "pd" else 0)
    drives["controller"] = {**controller, "derivative": "velocity"}
    assert len(servo_words(model)) == 2
    drives["controller"] = {"kind": "pid"}
    assert servo_words(model) == []
    assert servo_words({**model, "drives": None}) == []


def test_motors_get_gear_range_and_delay_and_joints_the_rest(tmp_path):
    case, machine, _ = built(tmp_path, MOTORS)

    def with_effect(kind, port, **values):
        effect = EFFECTS[kind](port=port, **{n: jnp.asarray(v) for n, v in values.items()})
        return replace(machine, plant=machine.plant.with_effect(effect))

    for change in (
        {"kind": "actuator_gain", "port": 0, "gain": 0.5},
        {"kind": "input_delay", "port": 0, "delay": 0.006},
        {"kind": "back_emf_damping", "port": 1, "coefficient": 0.7},
    ):
        machine = with_effect(**change)
    effects = [
        replace(e, limit=jnp.asarray(5.0)) if e.kind == "saturation" else e for e in machine.plant.effects
    ]
    machine = replace(machine, plant=replace(machine.plant, effects=tuple(effects)))
    model = robot_json(machine.plant, case.plant, {}) | {"drives": drives_json(machine)}
    file, (a, b) = drives_after(tmp_path, {"model": model})
    assert not file.notes
    assert (a.gain, a.delay) == (-2.0, 0.006)
    assert a.limit == pytest.approx(5.0)
    assert b.limit == pytest.approx(5.0)
    damped = {joint.name: joint.damping[0] for joint in read_mjcf(tmp_path / "new.xml").joints}
    assert damped == {"a": 0.0, "b": pytest.approx(0.7)}


def test_what_an_actuator_lacks_is_named(tmp_path):
    case, machine, _ = built(tmp_path, MOTORS)
    lag = EFFECTS["actuator_lag"](port=1, time_constant=jnp.asarray(0.02))
    plant = machine.plant.with_effect(lag)
    file, _ = drives_after(tmp_path, {"model": robot_json(plant, case.plant, {})})
    assert file.notes[0].startswith("actuator_lag[b] (time_constant = 0.02) has no place")
    assert [plant.effects[k].kind for k in file.lost] == ["actuator_lag"]
    np.testing.assert_array_equal(file.content, MOTORS.encode())
