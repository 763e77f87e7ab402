"""Two links in a vertical plane: closed-form equations of motion in plain numbers, without recursion.

The equations are exact; dry friction is a sign smoothed far below any speed at which a sample counts.
"""

import math
from dataclasses import dataclass

import numpy as np


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

    def acceleration(self, q1, q2, v1, v2, u1, u2):
        """Return the accelerations of both joints, from Lagrange's equations as textbooks print them."""
        b, g, cos, sin, tanh = self.base, self.gravity, math.cos, math.sin, math.tanh
        px, py, l = b["first_moment_x[2]"], b["first_moment_y[2]"], self.length
        c, s = cos(q2), sin(q2)
        couple = l * (px * c - py * s)
        bend = l * (px * s + py * c)
        m22 = b["inertia_zz[2]"]
        m12, m11 = m22 + couple, b["inertia_zz[1]"] + m22 + 2.0 * couple
        w2 = g * (px * cos(q1 + q2) - py * sin(q1 + q2))
        w1 = g * b["first_moment_x[1]"] * cos(q1) + w2
        f1 = self.viscous[0] * v1 + self.coulomb[0] * tanh(v1 / self.width)
        f2 = self.viscous[1] * v2 + self.coulomb[1] * tanh(v2 / self.width)
        viscous, coulomb, inertia = self.shaft
        fs = viscous * (v1 + v2) + coulomb * tanh((v1 + v2) / self.width)
        f1, f2, m11, m12, m22 = f1 + fs, f2 + fs, m11 + inertia, m12 + inertia, m22 + inertia
        r1 = u1 - w1 - f1 + bend * (2.0 * v1 * v2 + v2 * v2)
        r2 = u2 - w2 - f2 - bend * v1 * v1
        det = m11 * m22 - m12 * m12
        return (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det

    def advance(self, x, u, h, steps):
        """Advance x = (q1, q2, v1, v2) by `steps` classical Runge-Kutta steps of h [s] at constant torque."""

        def rate(x):
            return (x[2], x[3], *self.acceleration(*x, *u))

        def moved(x, k, h):
            return tuple(a + h * b for a, b in zip(x, k, strict=True))

        for _ in range(steps):
            k1 = rate(x)
            k2 = rate(moved(x, k1, 0.5 * h))
            k3 = rate(moved(x, k2, 0.5 * h))
            k4 = rate(moved(x, k3, h))
            x = tuple(
                a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
            )
        return x


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
