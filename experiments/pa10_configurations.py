"""Study of the PA-10's dominant-inertia method over stacked configurations, (4.12)-(4.17), for `pa10.py`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxid
from experiments.common import Table
from experiments.pa10_arm import COULOMB, KNOWN, VISCOUS, arm_of, random_bodies
from experiments.pa10_joint import CROSSING, EXACT, FAST, RATE, case_text, settled, unknown
from jaxid.arms.base_parameters import BaseParameters, base_parameters
from jaxid.arms.dominant_inertia import DominantInertias, from_dominant_inertias, of_swing
from jaxid.logs.log import Log
from jaxid.plants import SerialArm, pa10
from truth.arm.oracle import NAMES
from truth.axis.stepper import Loop, Machine, Sensor, simulate

# Configurations a joint, and as many others to predict; angles within two rad, drawn.
CONFIGURATIONS, RANGE = 8, 2.0
# Chosen [N m/rad]: friction at the limit cycle's amplitude is a third of the spring's torque.
STIFFNESS = np.array([450.0, 1110.0, 235.0, 380.0, 1290.0, 1090.0, 670.0])
# No inertia is larger [kg m^2]: logs of a joint are of one length, for which a fit compiles once.
LARGEST = np.array([6.0, 7.0, 2.5, 2.5, 0.3, 0.09, 0.04])
# A swing under Coulomb friction begins so many times f_c / K_p away, and turns three times.
BEGINS = 6.5
# Read finely: what the reading's noise does in the loop's difference would shake the joint.
FINE = Sensor(position_noise=1e-7, force_noise=0.2)


def joint(k: int, inertia: float) -> Machine:
    """Joint k, from 0, with the others locked and weight compensated."""
    friction = {"viscous_friction": {"coefficient": VISCOUS[k]}, "coulomb_friction": {"level": COULOMB[k]}}
    return Machine(inertia, friction)


def limit_cycle(k: int, inertia: float, rate: float = RATE, average: int = 1) -> float:
    """Period [s] where both frictions are compensated and cross the joint's at 0.5 rad/s.

    The compensation of viscous friction is tuned further by K_p / 2 rate, which is what a held spring drives.
    """
    kp, more = STIFFNESS[k], 0.05 * COULOMB[k]
    # Five time constants of what is left of the damping; at least thirty swings.
    duration = max(10 * inertia * CROSSING / more, 60 * np.pi * np.sqrt(inertia / kp))
    loop = Loop(
        "friction_compensation",
        kp=kp,
        coulomb=COULOMB[k] + more,
        velocity_average=average,
        viscous=VISCOUS[k] - more / CROSSING - kp / (2 * rate),
        reference=np.zeros(round(duration * rate)),
    )
    begin = 8 / np.pi * CROSSING * np.sqrt(inertia / kp)
    log = simulate(
        joint(k, inertia),
        loop,
        EXACT,
        rate=rate,
        duration=duration,
        step=5e-5,
        initial_position=begin,
        log_rate=RATE,
    )
    return settled(log)[1]


def swing(k: int, inertia: float, sensor: Sensor = EXACT, average: int = 1) -> tuple[Loop, dict]:
    """Simulate a swing in which viscous friction is compensated, and Coulomb friction left to the joint."""
    kp = STIFFNESS[k]
    duration = 1.6 * 2 * np.pi * np.sqrt(LARGEST[k] / kp)
    loop = Loop(
        "friction_compensation",
        kp=kp,
        viscous=VISCOUS[k] - kp / (2 * RATE),
        velocity_average=average,
        reference=np.zeros(round(duration * RATE)),
    )
    made = simulate(
        joint(k, inertia),
        loop,
        sensor,
        rate=RATE,
        duration=duration,
        step=1e-5,
        initial_position=BEGINS * COULOMB[k] / kp,
    )
    return loop, made


def turning(log: dict[str, np.ndarray]) -> float:
    """Period from turn to turn: Coulomb friction shifts a half swing's centre, not how long it lasts."""
    v, t = log["true_velocity"], log["t"]
    k = 1 + np.flatnonzero((v[1:-1] != 0) & (v[1:-1] * v[2:] <= 0))
    # Extrapolated, for the acceleration jumps at the turn.
    at = t[k] + v[k] / (v[k - 1] - v[k]) / RATE
    return float(2 * np.mean(np.diff(at))) if k.size > 1 else np.nan


def identified(folder: Path, method: str) -> Callable[[int, float], float]:
    """Identify the inertia from the noisy log of the swing, with guesses off by half."""

    def inertia_of(k: int, inertia: float) -> float:
        loop, made = swing(k, inertia, FINE)
        friction = {
            "viscous_friction": {"coefficient": unknown(1.5 * VISCOUS[k])},
            "coulomb_friction": {"level": unknown(0.5 * COULOMB[k])},
        }
        law = {"kp": float(loop.kp), "kd": 0.0, "coulomb": 0.0, "viscous": float(loop.viscous)}
        (folder / "swing.toml").write_text(
            case_text(
                unknown(0.5 * inertia),
                friction,
                controller={"kind": "friction_compensation", **law, "period": 1 / RATE},
                sensor={"position_noise": FINE.position_noise, "force_noise": FINE.force_noise},
            )
        )
        keys = {k: made[k] for k in ("position", "force", "reference")}
        log = Log(time=made["t"], **keys, source=f"joint {k + 1}")
        return jaxid.identify(folder / "swing.toml", log, method=method).value("inertia")

    return inertia_of


def configurations(folder: Path) -> None:
    """Inertias of all joints in several configurations, and from the last link down what they tell of all.

    Hypothesis: with exact periods the thirteen unknown sums come out; the method fails by what its
    periods are off, more than by the stacking.

    It holds. At 20 kHz inertias elsewhere are right to 0.4 %; of the limit cycle at 1 kHz to 2 % (joints 1 to
    4) and 8 % (wrist), with a velocity of five samples to 38 %. With Coulomb friction left alone, read from
    turn to turn: 0.6 % at 1 kHz, 1.4 % lagging.
    """
    start = time.perf_counter()
    true = random_bodies(np.random.default_rng(0))
    arm = SerialArm(*jnp.asarray(true.T), geometry=pa10())
    base = base_parameters(arm, known=KNOWN)
    q, elsewhere = np.random.default_rng(5).uniform(-RANGE, RANGE, (2, CONFIGURATIONS, 7))
    d, there = (inertias(true, x) for x in (q, elsewhere))
    period = lambda f: lambda k, inertia: of_swing(STIFFNESS[k], f(k, inertia))
    methods: dict[str, Callable[[int, float], float]] = {
        "the true inertias": lambda k, inertia: inertia,
        "limit cycle, 20 kHz": period(lambda k, i: limit_cycle(k, i, FAST)),
        "1 kHz": period(limit_cycle),
        "1 kHz, velocity of 5 samples": period(lambda k, i: limit_cycle(k, i, average=5)),
        "turn to turn, 1 kHz": period(lambda k, i: turning(swing(k, i)[1])),
        "turn to turn, velocity of 5": period(lambda k, i: turning(swing(k, i, average=5)[1])),
        "inverse_dynamics": identified(folder, "inverse_dynamics"),
        "output_error": identified(folder, "output_error"),
    }
    head = ["", *[f"d{k}{k}" for k in range(1, 8)], "s"]
    off = Table(f"inertia of a joint, largest error in {CONFIGURATIONS} configurations [%]", head)
    beyond = Table("in other configurations, of what these tell stacked [%]", head[:-1])
    sums = {"true": base.of(arm)}
    for name, measure in methods.items():
        begun = time.perf_counter()
        measured = np.array([[measure(k, x) for k, x in enumerate(row)] for row in d])
        found = stacked(arm, base, q, measured)
        told = inertias_of(found, elsewhere)
        sums[name] = base.of(found)
        seconds = f"{time.perf_counter() - begun:.0f}"
        for table, a, b, more in ((off, measured, d, [seconds]), (beyond, told, there, [])):
            errors = 100 * np.abs(a / b - 1).max(axis=0)
            table.row(name, *[f"{x:.2g}" for x in errors], *more)
    off.show(time.perf_counter() - start)
    beyond.show(time.perf_counter() - start)
    values = Table("sums of inertias [kg m^2]", ["", *sums])
    for i, name in enumerate(base.chosen_names):
        values.row(name, *[f"{x[i]:.4f}" for x in sums.values()])
    values.show(time.perf_counter() - start)
    few = q.copy()
    few[:, 3] = 0.0
    one = solve(arm, base, 3, few, inertias(true, few)[:, 2])
    text = " and ".join(" ".join(f"{v:+.2f} {n}" for n, v in c.items()) for c in one.unidentifiable)
    print(f"joint 3 with joint 4 at zero throughout does not tell {text}")


def stacked(arm: SerialArm, base: BaseParameters, q: np.ndarray, measured: np.ndarray) -> SerialArm:
    """From the last joint to the first: what a joint's inertias tell, those before taken as known."""
    known: tuple[str, ...] = ()
    plant = arm
    for name in base.names:  # only those that stand for a sum hold anything
        plant = _with(plant, name, 0.0)
    for k in reversed(range(1, 8)):
        found = solve(plant, base, k, q, measured[:, k - 1], known)
        for name, value in zip(found.names, found.theta, strict=True):
            plant = _with(plant, name, value)
        known = (*known, *found.names)
    return plant


def solve(
    plant: SerialArm,
    base: BaseParameters,
    k: int,
    q: np.ndarray,
    measured: np.ndarray,
    known: tuple[str, ...] = (),
) -> DominantInertias:
    """Solve for the unknown sums that joint k, from 1, determines; the others are those of the plant."""
    rest = tuple(n for n in base.names if n not in base.chosen_names)
    return from_dominant_inertias(plant, k, q, measured, (*KNOWN, *rest, *known))


def _with(plant: SerialArm, name: str, value: float) -> SerialArm:
    field, _, k = name.rstrip("]").partition("[")
    return eqx.tree_at(lambda p: getattr(p, field), plant, getattr(plant, field).at[int(k) - 1].set(value))


def inertias(bodies: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Diagonal of the mass matrix in some configurations, by Pinocchio, (w, 7)."""
    import pinocchio

    model, data = arm_of(bodies).model()
    return np.array([np.diag(pinocchio.crba(model, data, x)) for x in q])


def inertias_of(plant: SerialArm, q: np.ndarray) -> np.ndarray:
    """Return the inertias of a plant that was identified."""
    return inertias(np.stack([np.asarray(getattr(plant, n)) for n in NAMES], axis=-1), q)
