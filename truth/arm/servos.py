"""Two links in a vertical plane with geared servos: exact dry friction in both joints, compiled.

The equations of motion are `two_links` with a rotor at each joint; a step is Moreau's midpoint step, as in
`stepper`, whose links are Pinocchio's. A servo has the law and the effects of `truth.axis`, at its joint.
A joint may be elastic: rotor, encoder and friction are then in front of its spring, and the link behind it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from truth.axis import stepper as axis

# Rounds of the sweeps over the friction of both joints, and the change of an impulse that ends them, as part
# of the largest one.
SWEEPS, SETTLED = 200, 1e-13
# Effects at a joint -> their parameter -> the column of a joint's values.
COLUMNS = {
    ("viscous_friction", "coefficient"): 0,
    ("coulomb_friction", "level"): 1,
    ("stribeck_friction", "level"): 2,
    ("stribeck_friction", "velocity"): 3,
    ("load_friction", "coefficient"): 4,
    ("saturation", "limit"): 5,
    ("unbalance", "moment"): 6,
    ("unbalance", "phase"): 7,
    ("dead_band", "width"): 8,
    ("joint_flexibility", "stiffness"): 9,
    ("joint_flexibility", "damping"): 10,
    ("backlash", "stiffness"): 9,
    ("backlash", "damping"): 10,
    ("backlash", "gap"): 11,
}
NEUTRAL = np.array([0.0, 0.0, 0.0, 1.0, 0.0, np.inf, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
# Effects of the command; see `truth.axis.stepper.reached`.
COMMANDED = ("command_delay", "command_lag")


@dataclass(frozen=True)
class Links:
    """Two links whose joints turn about horizontal axes; at zero they lie along x, and weight acts along -y.

    Attributes:
        mass: Of both [kg].
        along, across: Their centres of mass in their frames [m].
        about: Moments of inertia about the centres [kg m^2].
        length: From joint to joint [m].
    """

    mass: tuple[float, float]
    along: tuple[float, float]
    across: tuple[float, float]
    about: tuple[float, float]
    length: float

    @property
    def constants(self) -> np.ndarray:
        """Moments of the links about the joints, as the equations of motion take them."""
        (m1, m2), (x1, x2), (y1, y2), (i1, i2) = self.mass, self.along, self.across, self.about
        first = i1 + m1 * (x1**2 + y1**2) + m2 * self.length**2
        moment = m1 * x1 + m2 * self.length
        second = i2 + m2 * (x2**2 + y2**2)
        return np.array([first, moment, m1 * y1, m2 * x2, m2 * y2, second, self.length])

    def inertia(self) -> np.ndarray:
        """Return the mean inertia about each joint over all angles of the second [kg m^2]."""
        first, _, _, _, _, second, _ = self.constants
        return np.array([first + second, second])


@dataclass(frozen=True)
class Servo:
    """The drive of a joint.

    Attributes:
        rotor: Its inertia, seen at the joint [kg m^2].
        kp, kd: Gains [N m/rad, N m s/rad] of u = kp (r - q) + kd (r' - q'), both differenced backwards.
        effects: Effect -> its parameters, those of `COLUMNS` and `COMMANDED`.
    """

    rotor: float
    kp: float
    kd: float
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def row(self) -> np.ndarray:
        """Return what the compiled loop takes.

        Raises:
            ValueError: If an effect or a parameter of one is unknown.
        """
        values = NEUTRAL.copy()
        for kind, given in self.effects.items():
            if kind in COMMANDED:
                continue
            for name, value in given.items():
                if (kind, name) not in COLUMNS:
                    raise ValueError(f"The servo has no {kind} {name}; it has {sorted(COLUMNS)}.")
                values[COLUMNS[kind, name]] = value
        return np.array([self.rotor, self.kp, self.kd, *values])


def run(
    links: Links,
    servos: Sequence[Servo],
    reference: np.ndarray,
    *,
    rate: float,
    step: float,
    start: np.ndarray,
    start_of_links: np.ndarray | None = None,
    noise: np.ndarray | float = 0.0,
    resolution: float = 0.0,
) -> dict[str, np.ndarray]:
    """Run both servos from rest.

    Args:
        links: The links.
        servos: The servos of both joints.
        reference: Command at every tick, (ticks, 2) [rad].
        rate: Of the ticks [Hz].
        step: Longest step of integration [s].
        start: First position of the rotors, (2,) [rad].
        start_of_links: That of the links [rad]; None: the same.
        noise: Error of each reading before rounding, (ticks, 2) [rad].
        resolution: Step to which a reading is rounded; 0: none [rad].

    Returns:
        reading, position [rad], velocity [rad/s], torque behind the drive's limit [N m] and position of the
        links [rad], (ticks, 2) each. Position and velocity are those of the rotors.
    """
    aim = np.stack(
        [
            axis.reached(column, axis.Machine(1.0, servo.effects), rate)
            for column, servo in zip(reference.T, servos, strict=True)
        ],
        axis=1,
    )
    rows = np.stack([servo.row() for servo in servos])
    errors = np.broadcast_to(np.asarray(noise, float), aim.shape)
    behind, steps = start if start_of_links is None else start_of_links, int(np.ceil(1 / rate / step))
    out = _run(links.constants, rows, aim, errors, resolution, rate, steps, start, behind)
    return dict(zip(("reading", "position", "velocity", "torque", "links"), out, strict=True))


@njit(cache=True)
def _run(links, servos, aim, noise, resolution, rate, steps, start, behind):
    """Return readings, positions, velocities and torques at all ticks, and positions of the links."""
    ticks = aim.shape[0]
    reading, position = np.zeros((ticks, 2)), np.zeros((ticks, 2))
    velocity, torque, beyond = np.zeros((ticks, 2)), np.zeros((ticks, 2)), np.zeros((ticks, 2))
    h = 1.0 / rate / steps
    # Rotors, and the links, which are at the same places where a joint is rigid.
    x, w, q, v = start.copy(), np.zeros(2), behind.copy(), np.zeros(2)
    for t in range(ticks):
        last = max(t - 1, 0)
        for j in range(2):
            reading[t, j] = x[j] + noise[t, j]
            if resolution > 0.0:
                reading[t, j] = round(reading[t, j] / resolution) * resolution
            error = aim[t, j] - reading[t, j]
            if abs(error) < servos[j, 11]:
                error = 0.0
            slope = (aim[t, j] - aim[last, j] - reading[t, j] + reading[last, j]) * rate
            u = servos[j, 1] * error + servos[j, 2] * slope
            torque[t, j] = min(max(u, -servos[j, 8]), servos[j, 8])
        position[t], velocity[t], beyond[t] = x, w, q
        for _ in range(steps):
            _advance(links, servos, x, w, q, v, torque[t], h)
    return reading, position, velocity, torque, beyond


@njit(cache=True)
def _advance(links, servos, x, w, q, v, torque, h):
    """Advance positions and velocities of rotors and links in place by one step of h [s]."""
    half, mean = q + 0.5 * h * v, v.copy()
    before, turning = x + 0.5 * h * w, w.copy()
    inverse, most, new, spun = np.zeros((2, 2)), np.zeros(2), np.zeros(2), np.zeros(2)
    for _ in range(2):
        load = _loaded(links, servos, before, turning, half, mean, torque, inverse)
        for j in range(2):
            gear = servos[j, 7] * abs(torque[j])
            rub = servos[j, 4] + gear + servos[j, 5] * np.exp(-((turning[j] / servos[j, 6]) ** 2))
            if servos[j, 12] > 0.0:
                spun[j] = _spun(servos[j], before, turning, half, mean, torque, w, rub, h, j)
                rub = 0.0
            most[j] = h * rub
        for j in range(2):
            new[j] = v[j] + h * (inverse[j, 0] * load[0] + inverse[j, 1] * load[1])
        _rub(new, inverse, most)
        for j in range(2):
            mean[j] = 0.5 * (v[j] + new[j])
            half[j] = q[j] + 0.5 * h * mean[j]
            if servos[j, 12] == 0.0:
                spun[j] = new[j]
            turning[j] = 0.5 * (w[j] + spun[j])
            before[j] = x[j] + 0.5 * h * turning[j]
    for j in range(2):
        q[j] += h * mean[j]
        v[j] = new[j]
        x[j] += h * turning[j]
        w[j] = spun[j]


@njit(cache=True)
def _spring(servo, apart, speed):
    """Return the torque on the link of an elastic joint whose rotor is this far ahead of it."""
    half = 0.5 * servo[14]
    if abs(apart) <= half:
        return 0.0
    return servo[12] * (apart - np.sign(apart) * half) + servo[13] * speed


@njit(cache=True)
def _spun(servo, before, turning, half, mean, torque, w, rub, h, j):
    """Return the velocity of the rotor of an elastic joint after a step."""
    pull = _spring(servo, before[j] - half[j], turning[j] - mean[j])
    aside = servo[3] * turning[j] + servo[9] * 9.81 * np.cos(before[j] + servo[10])
    free = w[j] + h * (torque[j] - aside - pull) / servo[0]
    return np.sign(free) * max(abs(free) - h * rub / servo[0], 0.0)


@njit(cache=True)
def _loaded(links, servos, before, turning, q, v, torque, inverse):
    """Return the torques beside dry friction that accelerate the links; fill the inverse of their matrix."""
    first, moment, aside, px, py, second, length = links
    c, s = np.cos(q[1]), np.sin(q[1])
    couple, bend = length * (px * c - py * s), length * (px * s + py * c)
    m22, m12, m11 = second, second + couple, first + second + 2.0 * couple
    if servos[0, 12] == 0.0:
        m11 += servos[0, 0]
    if servos[1, 12] == 0.0:
        m22 += servos[1, 0]
    det = m11 * m22 - m12 * m12
    inverse[0, 0], inverse[1, 1], inverse[0, 1], inverse[1, 0] = m22 / det, m11 / det, -m12 / det, -m12 / det
    w2 = 9.81 * (px * np.cos(q[0] + q[1]) - py * np.sin(q[0] + q[1]))
    w1 = 9.81 * (moment * np.cos(q[0]) - aside * np.sin(q[0])) + w2
    load = np.zeros(2)
    load[0] = -w1 + bend * (2.0 * v[0] * v[1] + v[1] * v[1])
    load[1] = -w2 - bend * v[0] * v[0]
    for j in range(2):
        if servos[j, 12] > 0.0:
            load[j] += _spring(servos[j], before[j] - q[j], turning[j] - v[j])
        else:
            load[j] += torque[j] - servos[j, 3] * v[j] - servos[j, 9] * 9.81 * np.cos(q[j] + servos[j, 10])
    return load


@njit(cache=True)
def _rub(v, mobility, most):
    """Change velocities in place by friction impulses up to these sizes, which stop joints if they can."""
    impulse = np.zeros(2)
    for _ in range(SWEEPS):
        moved = 0.0
        for k in range(2):
            if most[k] == 0.0:
                continue
            wanted = min(max(impulse[k] - v[k] / mobility[k, k], -most[k]), most[k])
            change = wanted - impulse[k]
            impulse[k] = wanted
            v[0] += mobility[0, k] * change
            v[1] += mobility[1, k] * change
            moved = max(moved, abs(change) / most[k])
        if moved < SETTLED:
            return
