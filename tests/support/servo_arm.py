"""A two-joint arm of servos by the exact stepper, and its case: command and encoder, no force."""

import numpy as np

from truth.arm.stepper import Arm, followed

RATE, COUNT, NOISE = 250.0, 2 * np.pi / 16384, 2e-4
# Ticks before a log, in which the arm sinks to where its servos hold it.
SETTLING = 250
KP, KD = np.array([120.0, 40.0]), np.array([8.0, 2.0])
VISCOUS, COULOMB = np.array([1.0, 0.4]), np.array([0.5, 0.2])
# Ten parameters of each link about its joint, in the order of `truth.arm.oracle.NAMES`.
BODIES = np.array(
    [
        [1.5, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.09],
        [0.8, 0.2, 0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.07],
    ]
)
LENGTH = 0.4
# The first axis is horizontal: weight acts along -y of the links' plane.
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def command(seconds: float, seed: int) -> np.ndarray:
    """Sums of four sines that begin at rest, (ticks, 2) [rad]."""
    t, rng = np.arange(round(seconds * RATE)) / RATE, np.random.default_rng(seed)
    frequency, phase = rng.uniform(0.15, 1.0, (4, 2)), rng.uniform(0, 2 * np.pi, (4, 2))
    waves = 0.35 * np.sin(2 * np.pi * frequency * t[:, None, None] + phase).sum(axis=1)
    grows = np.clip(t / 0.5, 0.0, 1.0)[:, None]
    return waves * grows**2 * (3.0 - 2.0 * grows) + [0.4, -0.3]


def servo_arm_log(
    seconds: float = 8.0, seed: int = 0, gear=(0.0, 0.0), viscous=VISCOUS, coulomb=COULOMB
) -> dict[str, np.ndarray]:
    """Columns of a log; `gear` is the friction of each joint in proportion to the torque of its drive."""
    rng = np.random.default_rng([7, seed])
    axes, origins = np.stack([UPRIGHT, np.eye(3)]), np.array([[0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0]])
    arm = Arm(axes, origins, BODIES, np.asarray(viscous, float), np.asarray(coulomb, float))
    asked = command(seconds, seed)
    asked = np.concatenate([np.tile(asked[0], (SETTLING, 1)), asked])

    def read(q: np.ndarray) -> np.ndarray:
        return COUNT * np.round((q + NOISE * rng.normal(size=2)) / COUNT)

    run = followed(arm, asked, rate=RATE, kp=KP, kd=KD, gear=np.asarray(gear), read=read)
    q, asked = run["q"][SETTLING:], asked[SETTLING:]
    columns = {"t": np.arange(len(asked)) / RATE}
    for k in range(2):
        columns |= {f"q{k + 1}": q[:, k], f"r{k + 1}": asked[:, k]}
    return columns


def servo_arm_case(*effects: dict) -> dict:
    """The case of the arm: gains, viscous and dry friction unknown, a factor of two and three off."""
    links = [
        {
            "joint": "revolute",
            "alpha_deg": 0.0,
            "a": a,
            "mass": body[0],
            "first_moment": body[1:4].tolist(),
            "inertia": body[4:].tolist(),
        }
        for a, body in zip((0.0, LENGTH), BODIES, strict=True)
    ]
    guessed = lambda values, factor: [{"guess": factor * float(x)} for x in values]
    return {
        "plant": {"kind": "serial_arm", "gravity_vector": [0.0, -9.81, 0.0], "links": links},
        "effects": [
            {"kind": "viscous_friction", "coefficient": guessed(VISCOUS, 0.4)},
            *effects,
        ],
        "controller": {"kind": "pd", "kp": guessed(KP, 2.0), "kd": KD.tolist(), "period": 1 / RATE},
        "log": {"time": "t", "position": ["q1", "q2"], "reference": ["r1", "r2"]},
    }


def dry(factor: float = 3.0) -> dict:
    """The dry friction of both joints, as a case declares it."""
    return {"kind": "coulomb_friction", "level": [{"guess": factor * float(x)} for x in COULOMB]}
