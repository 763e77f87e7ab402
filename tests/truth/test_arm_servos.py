"""The compiled arm of servos beside the stepper whose links are Pinocchio's."""

import numpy as np
import pytest

from truth.arm.servos import Links, Servo, run

LINKS = Links(mass=(1.5, 0.8), along=(0.2, 0.25), across=(0.01, 0.025), about=(0.03, 0.02), length=0.4)
KP, KD = np.array([120.0, 40.0]), np.array([8.0, 2.0])
RATE, VISCOUS, COULOMB = 250.0, np.array([1.0, 0.4]), np.array([0.5, 0.2])


def reference(seconds: float = 2.0) -> np.ndarray:
    t = np.arange(round(seconds * RATE))[:, None] / RATE
    return 0.4 * (1 - np.cos(2 * np.pi * np.array([0.6, 1.1]) * t)) + [0.4, -0.3]


def servos(*effects: dict) -> list[Servo]:
    """Both servos with viscous and dry friction, and an effect more at each."""
    rows = zip(KP, KD, VISCOUS, COULOMB, effects or ({}, {}), strict=True)
    return [
        Servo(0.0, kp, kd, {"viscous_friction": {"coefficient": c}, "coulomb_friction": {"level": f}, **more})
        for kp, kd, c, f, more in rows
    ]


def ours(*effects: dict, step: float = 1e-4) -> np.ndarray:
    asked = reference()
    return run(LINKS, servos(*effects), asked, rate=RATE, step=step, start=asked[0])["position"]


@pytest.mark.parametrize("gear", [(0.0, 0.0), (0.2, 0.1)])
def test_the_motion_is_that_of_pinocchio_s_links(gear):
    pytest.importorskip("pinocchio")
    from truth.arm.stepper import Arm, followed

    bodies = []
    for m, x, y, i in zip(LINKS.mass, LINKS.along, LINKS.across, LINKS.about, strict=True):
        zz = i + m * (x**2 + y**2)
        bodies.append([m, m * x, m * y, 0, m * y**2, -m * x * y, 0, m * x**2, 0, zz])
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    arm = Arm(
        np.stack([upright, np.eye(3)]),
        np.array([[0.0, 0.0, 0.0], [LINKS.length, 0.0, 0.0]]),
        np.array(bodies),
        VISCOUS,
        COULOMB,
    )
    theirs = followed(arm, reference(), rate=RATE, kp=KP, kd=KD, gear=np.array(gear))["q"]
    found = ours(*({"load_friction": {"coefficient": g}} for g in gear))
    assert np.ptp(theirs, axis=0).min() > 0.5
    assert np.abs(found - theirs).max() < 1e-9


EFFECTS = {
    "stribeck_friction": {"level": 0.3, "velocity": 0.3},
    "saturation": {"limit": 1.5},
    "unbalance": {"moment": 0.05, "phase": 0.4},
    "dead_band": {"width": 0.02},
    "command_lag": {"time_constant": 0.03},
    "command_delay": {"delay": 0.04},
}


@pytest.mark.parametrize("kind", EFFECTS)
def test_an_effect_is_that_of_the_exact_axis(kind):
    """At an arm whose links weigh nothing beside the first rotor."""
    from truth.axis.stepper import Loop, Machine, Sensor, simulate

    links = Links(mass=(0.0, 1e-12), along=(0.0, 0.0), across=(0.0, 0.0), about=(0.0, 1e-12), length=0.1)
    frictions = {"viscous_friction": {"coefficient": 1.0}, "coulomb_friction": {"level": 0.5}}
    effects, asked = {**frictions, kind: EFFECTS[kind]}, reference()
    arm = [Servo(0.3, KP[0], KD[0], effects), Servo(0.1, 4.0, 0.5)]
    found = run(links, arm, asked, rate=RATE, step=1e-5, start=asked[0])["position"][:, 0]
    loop = Loop(kind="pd", kp=KP[0], kd=KD[0], reference=asked[:, 0])
    axis = simulate(
        Machine(0.3, effects), loop, Sensor(), rate=RATE, duration=len(asked) / RATE,
        initial_position=asked[0, 0],
    )["true_position"]  # fmt: skip
    without = run(
        links, [Servo(0.3, KP[0], KD[0], frictions), arm[1]], asked, rate=RATE, step=1e-5, start=asked[0]
    )["position"][:, 0]
    assert np.abs(found - axis).max() < 1e-6
    assert np.abs(without - axis).max() > 1e-3


@pytest.mark.parametrize("gap", [pytest.param(0.0, marks=pytest.mark.slow), 0.04])
def test_an_elastic_joint_is_that_of_the_exact_chain(gap):
    """At an arm whose second link weighs nothing beside the first, and without weight."""
    from truth.axis.stepper import Loop, Sensor
    from truth.chain.stepper import ChainMachine, simulate_chain

    rotor, behind, stiffness, damping = 0.1, 0.3, 300.0, 2.0
    links = Links(mass=(0.0, 1e-12), along=(0.0, 0.0), across=(0.0, 0.0), about=(behind, 1e-12), length=0.1)
    frictions = {"viscous_friction": {"coefficient": 1.0}, "coulomb_friction": {"level": 0.5}}
    spring = {"stiffness": stiffness, "damping": damping}
    hidden = {"backlash": {**spring, "gap": gap}} if gap else {"joint_flexibility": spring}
    asked = reference()
    arm = [Servo(rotor, KP[0], KD[0], {**frictions, **hidden}), Servo(0.1, 4.0, 0.5)]
    found = run(links, arm, asked, rate=RATE, step=1e-5, start=asked[0])["position"][:, 0]

    effects: dict = {("coulomb_friction", 1): frictions["coulomb_friction"]}
    effects |= {("backlash", 2): {"gap": gap}} if gap else {}
    machine = ChainMachine(
        (rotor, behind),
        (1.0, 0.0),
        (0.0, stiffness, 0.0),
        effects=effects,
        actuated=(1,),
        coupling=(0.0, damping, 0.0),
    )
    loop = Loop(kind="pd", kp=KP[0], kd=KD[0], reference=asked[:, 0])
    chain = simulate_chain(
        machine, [loop], Sensor(), rate=RATE, duration=len(asked) / RATE, step=1e-5,
        initial_position=asked[0, 0],
    )["position"][:, 0]  # fmt: skip
    rigid = run(
        links, [Servo(rotor, KP[0], KD[0], frictions), arm[1]], asked, rate=RATE, step=1e-5, start=asked[0]
    )["position"][:, 0]
    assert np.abs(found - chain).max() < 1e-5
    assert np.abs(found - rigid).max() > 1e-3
