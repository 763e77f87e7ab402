"""A force of the wrong sign is refused with the fix; forces that brake rightly are not."""

import dataclasses
import tomllib

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.session import open_session
from truth.arm.two_links import TwoLinks
from truth.axis.cases import case_text
from truth.axis.machines import Setup, emps_like, moves, multisine
from truth.axis.stepper import Loop, Machine, Sensor

RATE = 1000.0
SECONDS = 4.0
FRICTION = {"viscous_friction": {"coefficient": 400.0}, "coulomb_friction": {"level": 60.0}}
DECLARED = tuple(FRICTION.items())
TIME = np.arange(round(RATE * SECONDS)) / RATE
SENSOR = Sensor(position_resolution=1e-6, force_noise=0.03)
COLUMNS = {"t": "t", "q": "position", "u": "force"}


def setup(machine: Machine, loop: Loop, **changes) -> Setup:
    return dataclasses.replace(Setup(machine, loop, SENSOR, RATE, SECONDS, 0), **changes)


def tour() -> np.ndarray:
    return moves(TIME, [0.0, 0.1, 0.02, 0.3], [0.1, 0.3, 0.2, 0.4], 2.0, rest=0.05)


def pd(machine: Machine, reference: np.ndarray) -> Setup:
    loop = Loop(kind="pd", kp=600.0, kd=40.0, limit=np.inf, reference=reference)
    return setup(machine, loop)


def axis(**changes) -> Machine:
    return Machine(**{"inertia": 180.0, "actuator_gain": 226.2, "effects": FRICTION, **changes})


def logged(of: Setup, turned: bool = False, **changes) -> dict[str, np.ndarray]:
    run = of.run(**changes)
    log = {column: run[name] for column, name in COLUMNS.items()}
    return {**log, "u": -log["u"]} if turned else log


def opened(of: Setup, log: dict, declared=DECLARED, **case):
    text = case_text(of, declared, sensor=False, closed=False, **case).replace(
        "[log]", '[log]\nhold = "zero_order"'
    )
    return open_session(tomllib.loads(text), log)


def lowering() -> Setup:
    machine = axis(gravity_force=-180.0 * 9.81)
    reference = -moves(TIME, [0.0, 0.5], [0.25, 0.25], 2.0, rest=2.0)
    return pd(machine, reference)


def stopping() -> tuple[Setup, dict]:
    """An axis that runs at the start, and a force that only brakes it: its power is never positive."""
    force = -300.0 * (1.2 + np.sin(2 * np.pi * 1.3 * TIME)) * (TIME < 1.4) / 226.2
    return setup(axis(), Loop(input=force)), {"initial_velocity": 4.0, "duration": 1.4}


def spring_swing() -> Setup:
    """An undeclared spring, in a motion below its resonance: force and acceleration oppose each other."""
    machine = axis(effects={**FRICTION, "linear_stiffness": {"coefficient": 180.0 * 60.0**2}})
    return setup(machine, Loop(input=multisine(TIME, [0.6, 1.7, 3.1], 60.0)))


SOUND = {
    "tour": lambda: (pd(axis(), tour()), {}, {}),
    "lowering": lambda: (lowering(), {}, {"orientation": "vertical"}),
    "lowering, weight undeclared": lambda: (lowering(), {}, {}),
    "braking only": lambda: (*stopping(), {}),
    "undeclared spring": lambda: (spring_swing(), {}, {}),
    "EMPS": lambda: (emps_like(0, duration=SECONDS), {}, {}),
}


def spindle(speed: float = 5.0, teeth: int = 72) -> Setup:
    """A spindle that turns at one speed: its loop answers the ripple, so that force and speed oppose."""
    friction = {"viscous_friction": {"coefficient": 2e-3}, "coulomb_friction": {"level": 0.05}}
    ripple = {"cogging": {"amplitude": 0.1, "period": 2 * np.pi / teeth, "phase": 0.3}}
    machine = Machine(inertia=2e-3, effects=friction | ripple)
    loop = Loop(kind="cascade_pd", kp=2.0, kv=0.02, limit=np.inf, reference=speed * np.arange(6000) / RATE)
    return Setup(machine, loop, Sensor(position_resolution=2 * np.pi / 20000, force_noise=1e-3), RATE, 6.0, 0)


SPINDLE = (("viscous_friction", {"coefficient": 2e-3}), ("coulomb_friction", {"level": 0.05}))


@pytest.mark.parametrize("teeth", [12, 72])
def test_the_loop_of_a_spindle_at_one_speed_is_no_wrong_sign(teeth):
    of = spindle(teeth=teeth)
    findings = opened(of, logged(of), SPINDLE, motion="rotary").findings
    assert not any("brakes" in f.what for f in findings)


@pytest.mark.parametrize("teeth", [12, 72])
def test_a_force_that_brakes_a_spindle_over_turns_is_warned_of(teeth):
    of = spindle(teeth=teeth)
    findings = opened(of, logged(of, turned=True), SPINDLE, motion="rotary").findings
    assert any("brakes the joint over more than 3 turns" in f.what for f in findings)


@pytest.mark.parametrize("name", SOUND)
def test_a_force_that_brakes_rightly_is_not_refused(name):
    of, run, case = SOUND[name]()
    opened(of, logged(of, **run), **case)


@pytest.mark.parametrize("name", ["tour", "lowering", "braking only"])
def test_a_turned_force_is_refused_with_the_gain_to_set(name):
    of, run, case = SOUND[name]()
    with pytest.raises(InputError, match=r"brakes the motion.*set gain = -226\.2 in \[actuator\]"):
        opened(of, logged(of, turned=True, **run), **case)


def test_the_negative_gain_makes_the_turned_log_sound():
    of = pd(axis(), tour())
    turned = dataclasses.replace(of, machine=dataclasses.replace(of.machine, actuator_gain=-226.2))
    assert opened(turned, logged(of, turned=True)).findings == ()


# Two of the efforts of an arm, by closed-form equations


def arm_log(turned=()) -> dict:
    arm, t = TwoLinks(), TIME
    w = 2 * np.pi * np.array([[0.5, 1.1, 1.9], [0.7, 1.3, 2.3]])
    size = np.array([[0.5, -0.3, 0.2], [0.4, 0.3, -0.2]])
    q = np.stack([size[j] @ np.sin(np.outer(w[j], t)) for j in range(2)], axis=1)
    v = np.stack([(size[j] * w[j]) @ np.cos(np.outer(w[j], t)) for j in range(2)], axis=1)
    a = -np.stack([(size[j] * w[j] ** 2) @ np.sin(np.outer(w[j], t)) for j in range(2)], axis=1)
    u = np.empty_like(q)
    for k in range(len(t)):
        rest, one, other = (np.array(arm.acceleration(*q[k], *v[k], *u0)) for u0 in ((0, 0), (1, 0), (0, 1)))
        u[k] = np.linalg.solve(np.stack([one - rest, other - rest], axis=1), a[k] - rest)
    u += 0.05 * np.random.default_rng(1).standard_normal(u.shape)
    u[:, list(turned)] *= -1
    return {"t": t, "q1": q[:, 0], "q2": q[:, 1], "u1": u[:, 0], "u2": u[:, 1]}


ARM = {
    "plant": {
        "kind": "serial_arm",
        "gravity_vector": [0.0, -9.81, 0.0],
        "links": [
            {"joint": "revolute", "alpha": 0.0, "a": a, "mass": 0.0}
            | {"first_moment": [{"guess": 1.0}, {"guess": 0.0}, 0.0]}
            | {"inertia": [0.0, 0.0, 0.0, 0.0, 0.0, {"guess": 0.4}]}
            for a in (0.0, 0.5)
        ],
    },
    "effects": [
        {"kind": "viscous_friction", "coefficient": {"guess": 1.0}},
        {"kind": "coulomb_friction", "level": {"guess": 1.0}},
    ],
    "log": {"time": "t", "position": ["q1", "q2"], "force": ["u1", "u2"], "hold": "linear"},
}


@pytest.mark.parametrize("turned", [(0,), (1,), (0, 1)])
def test_each_turned_effort_of_an_arm_is_named(turned):
    assert open_session(ARM, arm_log()).findings == ()
    gains = ", ".join("-1" if k in turned else "1" for k in range(2))
    with pytest.raises(InputError) as caught:
        open_session(ARM, arm_log(turned))
    assert f"set gain = [{gains}]" in str(caught.value)
    named = " and ".join(str(k + 1) for k in turned)
    assert f"force {named}" in str(caught.value)


# Wrong columns


def test_swapped_columns_and_a_position_command_are_warned_of():
    of = pd(axis(), tour())
    log = logged(of)
    swapped = opened(of, {"t": log["t"], "q": 1e-3 * log["u"], "u": log["q"]}).findings
    assert any("explain the force" in f.what for f in swapped)
    command = opened(of, {**log, "u": of.loop.reference}).findings
    assert any("follows the position" in f.what for f in command)
