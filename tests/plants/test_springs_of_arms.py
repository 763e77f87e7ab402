"""Links of an arm behind the springs of its joints, beside the exact arm of two servos."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxid.dynamics.rhs import State, hold_polynomial, step
from jaxid.effects import EFFECTS
from jaxid.estimators.apart.joint import joints_alone
from jaxid.estimators.apart.loads import with_simulated_loads
from jaxid.estimators.several.parts import parts_of
from jaxid.plants.loaded_axis import LoadedAxis
from jaxid.session import open_session
from jaxid.simulation.replay import Numerics, make_replay
from truth.arm.servos import Links, Servo, run

LINKS = Links(mass=(0.5, 0.3), along=(0.1, 0.12), across=(0.01, 0.02), about=(1e-3, 1e-3), length=0.2)
RATE = 500.0
FRICTION = {"viscous_friction": {"coefficient": 0.05}, "coulomb_friction": {"level": 0.1}}
SPRINGS = ({"stiffness": 40.0, "damping": 0.1}, {"stiffness": 12.0, "damping": 0.03})
PLAY = {"stiffness": 300.0, "damping": 0.5, "gap": 0.03}


def inertias_at_zero() -> np.ndarray:
    first, _, _, along, _, second, length = LINKS.constants
    return np.array([first + second + 2 * length * along, second])


def servos(springs: dict[int, dict[str, float]]) -> list[Servo]:
    rows = zip((0.02, 0.008), (40.0, 12.0), (1.5, 0.4), strict=True)
    kind = lambda k: "backlash" if "gap" in springs[k] else "joint_flexibility"
    return [
        Servo(rotor, kp, kd, FRICTION | ({kind(k): springs[k]} if k in springs else {}))
        for k, (rotor, kp, kd) in enumerate(rows)
    ]


def exact(springs: dict[int, dict[str, float]], seconds: float = 1.0) -> tuple[dict, np.ndarray]:
    """Motion of the exact arm from rest, and its commands."""
    t = np.arange(round(seconds * RATE))[:, None] / RATE
    asked = 0.4 * (1 - np.cos(2 * np.pi * np.array([1.1, 1.7]) * t)) + [-1.0, 0.5]
    arm, held = servos(springs), np.tile(asked[0], (round(2 * RATE), 1))
    options = {"rate": RATE, "step": 2e-5}
    rest = run(LINKS, arm, held, start=asked[0], **options)
    start, behind = rest["position"][-1], rest["links"][-1]
    return run(LINKS, arm, asked, start=start, start_of_links=behind, **options), asked


def opened(springs: dict[int, dict[str, float]], motion: dict, asked: np.ndarray):
    """The session of the arm with true values."""
    arm, zeros = servos(springs), [0.0] * 5
    rows = zip((0.0, LINKS.length), LINKS.mass, LINKS.along, LINKS.across, LINKS.about, arm, strict=True)
    effects = [{"kind": kind, "joint": k + 1, **FRICTION[kind]} for k in range(2) for kind in FRICTION]
    effects += [
        {"kind": "joint_flexibility", "joint": k + 1, **spring, "load_inertia": inertias_at_zero()[k]}
        for k, spring in springs.items()
    ]
    case = {
        "plant": {
            "kind": "serial_arm",
            "gravity_vector": [0.0, -9.81, 0.0],
            "links": [
                {
                    "joint": "revolute",
                    "alpha_deg": 0.0,
                    "a": a,
                    "mass": m,
                    "first_moment": [m * x, m * y, 0.0],
                    "inertia": [*zeros, i + m * (x**2 + y**2)],
                    "rotor_inertia": {"guess": servo.rotor},
                }
                for a, m, x, y, i, servo in rows
            ],
        },
        "effects": effects,
        "controller": {
            "kind": "pd",
            "period": 1 / RATE,
            "kp": [s.kp for s in arm],
            "kd": [s.kd for s in arm],
        },
        "log": {
            "time": "t",
            "position": ["q1", "q2"],
            "reference": ["r1", "r2"],
            "reference_hold": "zero_order",
        },
    }
    log = {"t": np.arange(len(asked)) / RATE}
    log |= {f"q{k + 1}": motion["position"][:, k] for k in range(2)}
    log |= {f"r{k + 1}": asked[:, k] for k in range(2)}
    return open_session(case, log)


@pytest.mark.parametrize(
    ("springs", "near"),
    [
        pytest.param({0: SPRINGS[0]}, 5e-5, marks=pytest.mark.slow),
        pytest.param({1: SPRINGS[1]}, 5e-5, marks=pytest.mark.slow),
        (dict(enumerate(SPRINGS)), 1e-4),
        pytest.param({1: PLAY}, 2e-4, marks=pytest.mark.slow),
    ],
)
def test_a_simulated_arm_is_the_exact_one(springs, near):
    motion, asked = exact(springs)
    session = opened(springs, motion, asked)
    replay = make_replay(session.machine, session.fit.log, Numerics(substeps=4))
    found = replay(session.machine.plant)
    assert np.sqrt(np.mean((np.asarray(found.position) - motion["position"]) ** 2)) < near
    # It matters: rigid joints are far away, and the links sag at the start.
    rigid = exact({})[0]["position"]
    assert np.sqrt(np.mean((rigid - motion["position"]) ** 2)) > 5 * near
    assert np.allclose(found.links[0][0], motion["links"][0], atol=1e-3)
    assert np.abs(motion["links"][0] - motion["position"][0]).max() > 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("joint", [0, 1])
def test_a_joint_alone_moves_as_in_the_whole_arm(joint):
    """Its load is that of the links, with their inertia, behind its spring."""
    springs = {joint: SPRINGS[joint]}
    motion, asked = exact(springs)
    session = opened(springs, motion, asked)
    parts, numerics = parts_of(session), Numerics(substeps=4)
    at = session.machine.parameters.guess
    whole = make_replay(session.machine, session.fit.log, numerics)(session.machine.plant)
    loaded = with_simulated_loads(joints_alone(session.machine, parts), at, parts)
    for alone in loaded:
        [part] = alone.parts
        found = make_replay(part.machine, part.log, numerics)(part.machine.plant)
        off = np.asarray(found.position)[:, 0] - np.asarray(whole.position)[:, alone.joint]
        assert np.sqrt(np.mean(off**2)) < 1e-4, alone.joint
    # Without its share of the links behind the spring the joint is elsewhere.
    alone = next(a for a in loaded if a.joint == joint)
    [part] = alone.parts
    held = np.array(part.machine.held_load)
    held[:, 1:] = [1.0, 0.0]  # a constant inertia, and no weight
    other = replace(part.machine, held_load=held)
    found = make_replay(other, part.log, numerics)(other.plant)
    off = np.asarray(found.position)[:, 0] - np.asarray(whole.position)[:, joint]
    assert np.sqrt(np.mean(off**2)) > 1e-3


def test_the_spring_of_a_shaft_has_a_constant_inertia_behind_it():
    """Beside that of a joint, which has links behind it."""
    motion, asked = exact({})
    plant = opened({1: SPRINGS[1]}, motion, asked).machine.plant
    spring = plant.effects[-1]
    plant = replace(plant, shafts=((1.0, 2.0),), effects=(spring, replace(spring, port=2)))
    rng = np.random.default_rng(0)
    q, qd, qdd = rng.normal(size=(3, 2))
    states, zero = tuple(0.1 * rng.normal(size=(2, 2))), np.zeros(())
    both = plant.balance(q, qd, qdd, np.zeros(2), zero, states, behind=True)
    alone = replace(plant, effects=plant.effects[:1])
    one = alone.balance(q, qd, qdd, np.zeros(2), zero, states[:1], behind=True)

    [e, ed], speed = states[1], np.sqrt(spring.stiffness / spring.load_inertia)
    pull = spring.stiffness * e / speed + spring.damping * ed
    ydd = qdd[0] + 2 * qdd[1]
    force = spring.load_inertia * ydd + pull
    assert np.allclose(both.residual, one.residual - force * np.array([1.0, 2.0]))
    assert np.allclose(both.rates[1], [speed * ed, -ydd - pull / spring.load_inertia])
    assert np.allclose(both.rates[0], one.rates[0])


@pytest.mark.parametrize("part", [0.5, pytest.param(1.0, marks=pytest.mark.slow)])
def test_energy_is_kept_with_a_part_of_the_links_behind_a_spring(part):
    motion, asked = exact({})
    plant = opened({0: SPRINGS[0]}, motion, asked).machine.plant
    spring = plant.effects[-1]
    spring = replace(spring, damping=np.zeros(()), load_inertia=part * spring.load_inertia)
    plant = replace(plant, effects=(spring,), gravity_vector=np.zeros(3)).prepared()
    x = State(np.array([0.3, 0.8]), np.array([2.0, -3.0]), (np.array([0.5, 1.0]),))
    links = replace(plant, effects=(), rotor_inertia=None)
    kinetic = lambda q, v: 0.5 * v @ (links.inertial(q, 0 * v, v))

    def energy(x: State) -> float:
        """Energy of both parts of the links, of the rotors and of the spring."""
        [e, ed], [w] = np.asarray(x.own[0]), [np.sqrt(spring.stiffness / spring.load_inertia)]
        ahead = np.array([1.0, 0.0])
        moving = kinetic(x.q + e / w * ahead, x.qd + ed * ahead)
        rotors = 0.5 * float(np.sum(np.asarray(plant.rotor_inertia) * x.qd**2))
        pull = 0.5 * float(spring.stiffness) * (e / w) ** 2
        return float(part * moving + (1 - part) * kinetic(x.q, x.qd)) + rotors + pull

    still = hold_polynomial((np.zeros(2),))
    after = jax.jit(
        lambda x: jax.lax.fori_loop(
            0, 200, lambda _, x: step(plant, x, still, np.zeros(()), np.asarray(1e-3)), x
        )
    )(x)
    assert abs(energy(after) / energy(x) - 1) < 1e-4
    assert abs(after.q[0] - x.q[0]) > 0.1


def test_the_rotor_alone_is_in_front_of_links_that_fold():
    """Their inertia is then beyond the mean and the rotor together."""
    spring = EFFECTS["joint_flexibility"](40.0, 0.1, 0.06)
    plant = LoadedAxis(0.05, mean=0.04, at_zero=0.06, effects=(spring,))
    still, states = np.zeros(1), (np.array([0.2, 0.3]),)
    load = np.array([0.0, 0.7, 1.4, 2.0])

    def residual(acceleration: float) -> float:
        motion = (still, still, np.array([acceleration]))
        return float(plant.balance(*motion, load, np.zeros(()), states, behind=True).residual[0])

    assert np.isclose(residual(1.0) - residual(0.0), 0.05 - 0.04)
    assert np.isclose(residual(0.0), -float(spring.spring(states[0])[2]))
