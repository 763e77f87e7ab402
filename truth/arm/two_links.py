"""Two links in a vertical plane: closed-form equations of motion in plain numbers, without recursion.

The equations are exact; dry friction is a sign smoothed far below any speed at which a sample counts.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit


@dataclass(frozen=True)
class TwoLinks:
    """Revolute joints in a plane in which weight acts along -y; q = 0 stretches the arm along x.

    m1, m2: masses [kg]; x1, x2 and y2: centres of mass in the links' frames [m]; i1, i2: moments of inertia
    about them [kg m^2]; length: from joint to joint [m]; viscous [N m s/rad] and coulomb [N m], one a joint.
    """

    m1: float = 3.0
    m2: float = 2.0
    x1: float = 0.2
    x2: float = 0.25
    y2: float = 0.03
    i1: float = 0.06
    i2: float = 0.05
    length: float = 0.5
    viscous: tuple[float, float] = (1.5, 0.8)
    coulomb: tuple[float, float] = (2.0, 1.2)
    gravity: float = 9.81
    # Of a shaft that turns with the sum of both joints: viscous, Coulomb friction, and inertia.
    shaft: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Of the smoothed sign [rad/s]; far below any speed at which a sample counts.
    width: float = 1e-3

    @property
    def base(self) -> dict[str, float]:
        """Identifiable sums, by the inertial parameters that stand for them."""
        return {
            "inertia_zz[1]": self.i1 + self.m1 * self.x1**2 + self.m2 * self.length**2,
            "first_moment_x[1]": self.m1 * self.x1 + self.m2 * self.length,
            "first_moment_y[1]": 0.0,
            "first_moment_x[2]": self.m2 * self.x2,
            "first_moment_y[2]": self.m2 * self.y2,
            "inertia_zz[2]": self.i2 + self.m2 * (self.x2**2 + self.y2**2),
        }

    @property
    def constants(self) -> tuple[float, ...]:
        """The values that the equations of motion take."""
        names = (
            "inertia_zz[1]",
            "first_moment_x[1]",
            "first_moment_x[2]",
            "first_moment_y[2]",
            "inertia_zz[2]",
        )
        links = (*(self.base[name] for name in names), self.length, self.gravity)
        return tuple(map(float, (*links, *self.viscous, *self.coulomb, *self.shaft, self.width)))

    def acceleration(self, q1, q2, v1, v2, u1, u2):
        """Return the accelerations of both joints."""
        return acceleration(self.constants, q1, q2, v1, v2, u1, u2)

    def advance(self, x, u, h, steps):
        """Advance x = (q1, q2, v1, v2) by `steps` classical Runge-Kutta steps of h [s] at constant torque."""
        return advance(self.constants, tuple(map(float, x)), tuple(map(float, u)), float(h), int(steps))


@njit(cache=True)
def acceleration(constants, q1, q2, v1, v2, u1, u2):
    """Return the accelerations of both joints, from Lagrange's equations as textbooks print them."""
    zz1, mx1, px, py, m22, l, g, b1, b2, d1, d2, viscous, coulomb, inertia, width = constants
    c, s = math.cos(q2), math.sin(q2)
    couple = l * (px * c - py * s)
    bend = l * (px * s + py * c)
    m12, m11 = m22 + couple, zz1 + m22 + 2.0 * couple

    w2 = g * (px * math.cos(q1 + q2) - py * math.sin(q1 + q2))
    w1 = g * mx1 * math.cos(q1) + w2
    fs = viscous * (v1 + v2) + coulomb * math.tanh((v1 + v2) / width)
    f1 = b1 * v1 + d1 * math.tanh(v1 / width) + fs
    f2 = b2 * v2 + d2 * math.tanh(v2 / width) + fs
    m11, m12, m22 = m11 + inertia, m12 + inertia, m22 + inertia

    r1 = u1 - w1 - f1 + bend * (2.0 * v1 * v2 + v2 * v2)
    r2 = u2 - w2 - f2 - bend * v1 * v1
    det = m11 * m22 - m12 * m12
    return (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det


@njit(cache=True)
def _rate(constants, x, u):
    a1, a2 = acceleration(constants, x[0], x[1], x[2], x[3], u[0], u[1])
    return x[2], x[3], a1, a2


@njit(cache=True)
def _moved(x, k, h):
    return x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3]


@njit(cache=True)
def advance(constants, x, u, h, steps):
    """Advance x = (q1, q2, v1, v2) by `steps` classical Runge-Kutta steps of h [s] at constant torque."""
    for _ in range(steps):
        k1 = _rate(constants, x, u)
        k2 = _rate(constants, _moved(x, k1, 0.5 * h), u)
        k3 = _rate(constants, _moved(x, k2, 0.5 * h), u)
        k4 = _rate(constants, _moved(x, k3, h), u)
        for k, weight in ((k1, 1.0), (k2, 2.0), (k3, 2.0), (k4, 1.0)):
            x = _moved(x, k, h / 6 * weight)
    return x


@njit(cache=True)
def _run(constants, x, command, reference, gains, noise, resolution, rate, steps):
    """Run a sampled PD loop on the readings, with a command that is added to it."""
    positions, commands = np.zeros(noise.shape), np.zeros(noise.shape)
    for t in range(len(noise)):
        for j in range(2):
            reading = x[j] + noise[t, j]
            if resolution > 0:
                reading = round(reading / resolution) * resolution
            positions[t, j] = reading
            before = max(t - 1, 0)
            error, last = reference[t, j] - reading, reference[before, j] - positions[before, j]
            commands[t, j] = command[t, j] + gains[0, j] * error + gains[1, j] * (error - last) * rate
        x = advance(constants, x, (commands[t, 0], commands[t, 1]), 1.0 / rate / steps, steps)
    return positions, commands


def run_sampled(
    arm: TwoLinks,
    *,
    rate: float,
    start: np.ndarray,
    command: np.ndarray | None = None,
    reference: np.ndarray | None = None,
    kp: tuple[float, float] = (0.0, 0.0),
    kd: tuple[float, float] = (0.0, 0.0),
    resolution: float = 0.0,
    noise: float = 0.0,
    force_noise: float = 0.0,
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Run the arm from rest at `start` under a command, a PD loop on its readings, or both.

    The loop is u = kp (r - y) + kd (r - y)', with backward differences; resolution and noise of a reading
    in rad, of the logged torque in N m.

    Returns:
        The columns t, q1, q2, u1, u2.
    """
    given = command if reference is None else reference
    assert given is not None, "an arm needs a command or a reference"
    none, rng = np.zeros(given.shape), np.random.default_rng(seed)
    reading, steps = noise * rng.standard_normal(given.shape), round(20_000 / rate)
    position, torque = _run(
        arm.constants,
        (float(start[0]), float(start[1]), 0.0, 0.0),
        none if command is None else command,
        none if reference is None else reference,
        np.array([kp, kd]),
        reading,
        resolution,
        rate,
        steps,
    )
    torque = torque + force_noise * rng.standard_normal(given.shape)
    times = np.arange(len(given)) / rate
    return dict(zip(("t", "q1", "q2", "u1", "u2"), (times, *position.T, *torque.T), strict=True))


def unknown_reference(times, seed):
    """Return six sines of 0.1 to 1.5 Hz, about 1 rad: by joint, (time, 2)."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.1, 1.5, (2, 6)), rng.uniform(0, 2 * np.pi, (2, 6))
    waves = np.sin(2 * np.pi * f[:, None] * times[:, None] + phase[:, None])
    return 0.35 * waves.sum(axis=-1).T


def followed(arm: TwoLinks, duration=8.0, rate=1000.0, noise=1e-5, seed=0) -> dict[str, np.ndarray]:
    """Run a PD loop along a random reference; return the columns t, q1, q2, u1, u2."""
    times = np.arange(round(duration * rate)) / rate
    reference = unknown_reference(times, seed)
    speed = np.gradient(reference, 1 / rate, axis=0)
    rng = np.random.default_rng(seed + 1)
    x, rows = (*reference[0], *speed[0]), []
    for r, v in zip(reference, speed, strict=True):
        u = (
            300.0 * (r[0] - x[0]) + 30.0 * (v[0] - x[2]),
            150.0 * (r[1] - x[1]) + 10.0 * (v[1] - x[3]),
        )
        rows.append((*x[:2], *u))
        x = arm.advance(x, u, 0.05 / rate, 20)
    log = np.array(rows)
    log[:, :2] += noise * rng.standard_normal((len(log), 2))
    return dict(zip(("t", "q1", "q2", "u1", "u2"), (times, *log.T), strict=True))
