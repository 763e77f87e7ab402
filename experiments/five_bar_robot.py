"""The five-bar robot of Righettini et al. by other physics than jaxid's, its case, and a loop around it.

Geometry and masses are those of tables 1 and 2. What is not published is chosen here, and listed: REDUCTION,
the PD law, friction, the drives' gains, noise, and the region of the targets.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
import scipy.signal

import jaxid
from truth.five_bar.oracle import ORDERS, PLANT, Robot
from truth.five_bar.stepper import _advance, arrays

REDUCTION = 20.0
# Actual torque over the measured one, by drive.
GAINS = (0.93, 1.06)
# By hinge (joints 1, 2, then the passive angles), of sign v, v, v |v|, v^3 [N m (s/rad)^k]. The quadratic
# terms are negative, as those that were published; the whole dissipates at any velocity.
FRICTION = {
    "coulomb_friction": (5.0, 4.0, 0.02, 0.02, 0.02),
    "viscous_friction": (4.6, 3.6, 0.01, 0.01, 0.01),
    "quadratic_drag": (-1.2, -0.9, 0.0, 0.0, 0.0),
    "cubic_friction": (0.17, 0.13, 0.0, 0.0, 0.0),
}
KP, KD = 150.0, 4.0  # at the motors [N m/rad], [N m s/rad]
# PD law of the paper: nothing of the model fed forward.
PD = 'kind = "computed_torque"\ndynamics = false'
PERIOD, UPDATE, LOOK = 2.5e-4, 1e-3, 2e-2
COUNTS = 2 * np.pi / (4 * 65536)  # of the virtual encoder, at the joint [rad]
# Of a gyroscope and of the acceleration that an accelerometer 0.1 m from the joint tells.
GYRO_NOISE, ACCELERATION_NOISE = 1.5e-3, 0.2  # rad/s, rad/s^2
# Table 3, and where the condition index is above 0.2.
SPEED, ACCELERATION, JERK = np.deg2rad([210.0, 1680.0, 25_200.0])
POLYGON = [
    [1.2, 0.3],
    [1.5, 0.3],
    [2.0, 0.85],
    [2.65, 1.6],
    [2.6, 1.9],
    [2.0, 1.7],
    [1.5, 1.3],
    [1.2, 0.65],
]
HOME = [1.5, 0.5]
STEP = 5e-5  # of the exact robot [s]
# Friction of a joint that no model has: part by which it fluctuates about its mean, and for how long [s].
FLUCTUATION, MEMORY = 0.25, 0.05
# Of a kind of friction, where it is no coefficient.
PARAMETER = {"coulomb_friction": "level"}


SENSORS = "".join(
    f"""[[inertial_sensors]]
kind = "{kind}"
link = {link}
axes = ["{axis}"]
noise = {noise}
rate = {1 / UPDATE}
{where}
"""
    for link in (1, 2)
    for kind, axis, noise, where in (
        ("gyroscope", "z", GYRO_NOISE, ""),
        ("accelerometer", "y", 0.1 * ACCELERATION_NOISE, "position = [0.1, 0.0, 0.0]"),
    )
)


def robot(scale: float = 1.0, **changed: float) -> Robot:
    """Return the robot, with all friction times `scale`."""
    return replace(Robot(friction={k: scale * np.array(v) for k, v in FRICTION.items()}), **changed)


def fluctuating(seconds: float, seed: int, period: float = PERIOD) -> Callable[[float], np.ndarray]:
    """Factors on the friction of every hinge that wander about one (Ornstein and Uhlenbeck), by time."""
    rng, keep = np.random.default_rng(seed), np.exp(-period / MEMORY)
    kicks = FLUCTUATION * np.sqrt(1 - keep**2) * rng.standard_normal((round(seconds / period) + 1, 5))
    factors = 1.0 + scipy.signal.lfilter([1.0], [1.0, -keep], kicks, axis=0)
    return lambda t: np.maximum(factors[round(t / period)], 0.0)


def friction_text(orders: int, where: str = "", guess: Callable[[str, int], str] | None = None) -> str:
    """Effects of a friction polynomial of an order, on the joints or on the passive angles."""
    count = 3 if where else 2
    guess = guess or (lambda kind, k: "{ guess = 0.0 }")
    out = []
    for kind in ORDERS[: orders + 1]:
        values = ", ".join(guess(kind, k) for k in range(count))
        name = PARAMETER.get(kind, "coefficient")
        out.append(f'[[effects]]\nkind = "{kind}"\n{where}\n{name} = [{values}]\n')
    return "".join(out)


def case_text(
    law: str,
    *,
    friction: str | None = None,
    gain: str | Sequence = "{ guess = 1.0 }",
    seed: int = 0,
    duration: float = 40.0,
    more: str = "",
    tip_mass: str = "2.72",
    inertial: bool = True,
    period: float = PERIOD,
) -> str:
    """Return a case: the model of the robot, a law for [controller], random targets."""
    gains = ", ".join(map(str, (gain, gain) if isinstance(gain, str) else gain))
    plant = PLANT.replace("tip_mass = 2.72", f"tip_mass = {tip_mass}")
    return f"""{plant}[[effects]]
kind = "actuator_gain"
gain = [{gains}]
{friction_text(3) if friction is None else friction}
[controller]
kp = [{KP}, {KP}]
kd = [{KD}, {KD}]
period = {period}
{law}
[log]
time = "t"
position = ["q1", "q2"]
force = ["u1", "u2"]
reference = ["r1", "r2"]
[reference]
kind = "synchronized"
polygon = {POLYGON}
start = {HOME}
velocity = {SPEED}
acceleration = {ACCELERATION}
jerk = {JERK}
dwell = 0.1
seed = {seed}
{SENSORS if inertial else ""}
[simulation]
duration = {duration}
sample_rate = {1 / period}
initial_position = {HOME}
{more}"""


@dataclass(frozen=True)
class Ran:
    """A run in the loop, one row a tick.

    Args:
        live: The loop.
        time: [s].
        q, v, a: True motion of the joints, acceleration as the mean over the tick before.
        command: Torque of the motors as commanded [N m].
        estimates: Of the unknowns, every `LOOK`; none where the law has none.
    """

    live: jaxid.Live
    time: np.ndarray
    q: np.ndarray
    v: np.ndarray
    a: np.ndarray
    command: np.ndarray
    estimates: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Error of the position [rad]."""
        return self.q - self.live.reference[: len(self.q)]


def along(live: jaxid.Live, what: Callable) -> tuple[np.ndarray, ...]:
    """Evaluate a function of position, velocity and acceleration at every tick of a loop's reference."""
    r = live.reference
    v = np.gradient(r, live.period, axis=0)
    return tuple(np.asarray(x) for x in jax.jit(jax.vmap(what))(r, v, np.gradient(v, live.period, axis=0)))


def driven(
    live: jaxid.Live,
    machine: Robot,
    *,
    seconds: float | None = None,
    seed: int = 0,
    torque_noise: float = 0.0,
    inertial: bool = True,
    gains: Sequence[float] = GAINS,
    drift: Callable[[float], float | np.ndarray] | None = None,
    period: float = PERIOD,
) -> Ran:
    """Drive the exact robot by a case's controller.

    Args:
        live: The loop; where a controller is to be warm, with its memory set.
        machine: The robot.
        seconds: How long; absent: as the case says.
        seed: Of the noise.
        torque_noise: Standard deviation of the measured torque at the joint [N m].
        inertial: Whether the loop is given velocity and acceleration by gyroscope and accelerometer.
        gains: Of the drives.
        drift: Factor on all friction at a time, or one a hinge.
        period: Of the loop [s].
    """
    ticks = len(live.reference) if seconds is None else round(seconds / period)
    every, rng = max(1, round(UPDATE / period)), np.random.default_rng(seed)
    l, c, m, friction = arrays(machine)
    work = (np.empty((10, 2)), np.empty(10), np.empty((5, 2)), np.empty((2, 2)), np.empty(2), np.empty(5))
    q, v, last = np.array(HOME), np.zeros(2), np.zeros(2)
    out, estimates, sensed = np.empty((ticks, 8)), [], {}
    gains, adapts = REDUCTION * np.asarray(gains), live.adapts
    u, a, steps = np.zeros(2), np.zeros(2), round(period / STEP)
    for k in range(ticks):
        if inertial and k % every == 0:
            turn, pull = rng.standard_normal((2, 2)) * [[GYRO_NOISE], [ACCELERATION_NOISE]]
            sensed = {"velocity": v + turn, "acceleration": a + pull}
        if torque_noise:
            sensed["measured"] = u + torque_noise / REDUCTION * rng.standard_normal(2)
        u = live.command(np.round(q / COUNTS) * COUNTS, **sensed)
        out[k] = *q, *v, *a, *u
        if adapts and k % round(LOOK / period) == 0:
            estimates.append(np.asarray(live.estimate.theta))
        last = v.copy()
        levels = friction if drift is None else friction * drift(k * period)
        _advance(l, c, m, levels, q, v, gains * u, period / steps, steps, work)
        a = (v - last) / period
    time = period * np.arange(ticks)
    return Ran(live, time, *np.split(out, 4, axis=1), np.array(estimates))
