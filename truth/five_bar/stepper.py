"""Logs of a five-bar robot with exact dry friction in every hinge.

Moreau's midpoint step: friction impulses lie within their levels and bring a hinge to rest where they can,
found by projected Gauss-Seidel sweeps. Rates and accelerations of the links are solved for as vectors, by
hand; a test compares them with the multipliers of `truth.five_bar.oracle`.
"""

import numpy as np
from numba import njit

from truth.five_bar.oracle import Robot

# Rounds of the sweeps; a round that changes no impulse by more than 1e-14 of its level is the last.
SWEEPS = 200


@njit(cache=True)
def _kinematics(l, c, q, v, n, bias, w):
    """Fill in rates of (q1, q2, phi1, phi2, c1, c2, p) by joint rates, n (10, 2), what they would be without
    accelerations of the joints, bias (10,), and rates of the hinges by joint rates, w (5, 2)."""
    ex, ey = np.empty(2), np.empty(2)
    for k in range(2):
        ex[k] = l[1 + k] * np.cos(q[k])
        ey[k] = l[1 + k] * np.sin(q[k])
    wx, wy = l[0] + ex[1] - ex[0], ey[1] - ey[0]
    d = np.hypot(wx, wy)
    phi1 = np.arctan2(wy, wx) + np.arccos((l[3] ** 2 + d * d - l[4] ** 2) / (2.0 * l[3] * d))
    d1x, d1y = l[3] * np.cos(phi1), l[3] * np.sin(phi1)
    d2x, d2y = d1x - wx, d1y - wy
    phi2 = np.arctan2(d2y, d2x)
    det = d1x * d2y - d1y * d2x
    n[:] = 0.0
    n[0, 0] = n[1, 1] = 1.0
    # elbow 2 less elbow 1, by each joint's rate
    sx, sy = np.array([ey[0], -ey[1]]), np.array([-ex[0], ex[1]])
    for j in range(2):
        n[2, j] = (sx[j] * d2x + sy[j] * d2y) / det
        n[3, j] = (sx[j] * d1x + sy[j] * d1y) / det
    o1 = n[2, 0] * v[0] + n[2, 1] * v[1]
    o2 = n[3, 0] * v[0] + n[3, 1] * v[1]
    bx = -ex[1] * v[1] ** 2 + ex[0] * v[0] ** 2 - o2 * o2 * d2x + o1 * o1 * d1x
    by = -ey[1] * v[1] ** 2 + ey[0] * v[0] ** 2 - o2 * o2 * d2y + o1 * o1 * d1y
    bias[0] = bias[1] = 0.0
    bias[2] = (bx * d2x + by * d2y) / det
    bias[3] = (bx * d1x + by * d1y) / det
    for k in range(2):
        phi = phi1 if k == 0 else phi2
        o = o1 if k == 0 else o2
        rx = c[k, 0] * np.cos(phi) - c[k, 1] * np.sin(phi)
        ry = c[k, 0] * np.sin(phi) + c[k, 1] * np.cos(phi)
        for j in range(2):
            n[4 + 2 * k, j] = -ry * n[2 + k, j]
            n[5 + 2 * k, j] = rx * n[2 + k, j]
        n[4 + 2 * k, k] -= ey[k]
        n[5 + 2 * k, k] += ex[k]
        bias[4 + 2 * k] = -ex[k] * v[k] ** 2 - ry * bias[2 + k] - rx * o * o
        bias[5 + 2 * k] = -ey[k] * v[k] ** 2 + rx * bias[2 + k] - ry * o * o
    for j in range(2):
        n[8, j] = -d1y * n[2, j]
        n[9, j] = d1x * n[2, j]
    n[8, 0] -= ey[0]
    n[9, 0] += ex[0]
    bias[8] = -ex[0] * v[0] ** 2 - d1y * bias[2] - d1x * o1 * o1
    bias[9] = -ey[0] * v[0] ** 2 + d1x * bias[2] - d1y * o1 * o1
    for j in range(2):
        w[0, j], w[1, j] = n[0, j], n[1, j]
        w[2, j] = n[1, j] - n[3, j]
        w[3, j] = n[3, j] - n[2, j]
        w[4, j] = n[2, j] - n[0, j]


@njit(cache=True)
def _advance(l, c, m, friction, q, v, torque, h, steps, work):
    """Move q and v on by `steps` of h under constant torques."""
    n, bias, w, mass, load, impulse = work
    half, mean, new = np.empty(2), np.empty(2), np.empty(2)
    for _ in range(steps):
        for j in range(2):
            half[j] = q[j] + 0.5 * h * v[j]
            mean[j] = v[j]
        for again in range(2):
            _kinematics(l, c, half, mean, n, bias, w)
            for i in range(2):
                load[i] = torque[i]
                for j in range(2):
                    mass[i, j] = 0.0
                for k in range(10):
                    load[i] -= n[k, i] * m[k] * bias[k]
                    for j in range(2):
                        mass[i, j] += n[k, i] * m[k] * n[k, j]
            for k in range(5):
                r = w[k, 0] * mean[0] + w[k, 1] * mean[1]
                a = abs(r)
                f = r * (friction[1, k] + a * (friction[2, k] + a * (friction[3, k] + a * friction[4, k])))
                load[0] -= w[k, 0] * f
                load[1] -= w[k, 1] * f
            det = mass[0, 0] * mass[1, 1] - mass[0, 1] * mass[1, 0]
            i00, i11, i01 = mass[1, 1] / det, mass[0, 0] / det, -mass[0, 1] / det
            new[0] = v[0] + h * (i00 * load[0] + i01 * load[1])
            new[1] = v[1] + h * (i01 * load[0] + i11 * load[1])
            impulse[:] = 0.0
            for _ in range(SWEEPS):
                moved = 0.0
                for k in range(5):
                    top = h * friction[0, k]
                    if top == 0.0:
                        continue
                    g0, g1 = i00 * w[k, 0] + i01 * w[k, 1], i01 * w[k, 0] + i11 * w[k, 1]
                    own = w[k, 0] * g0 + w[k, 1] * g1
                    wanted = impulse[k] - (w[k, 0] * new[0] + w[k, 1] * new[1]) / own
                    wanted = min(max(wanted, -top), top)
                    change = wanted - impulse[k]
                    impulse[k] = wanted
                    new[0] += g0 * change
                    new[1] += g1 * change
                    moved = max(moved, abs(change) / top)
                if moved < 1e-14:
                    break
            if again == 0:
                for j in range(2):
                    mean[j] = 0.5 * (v[j] + new[j])
                    half[j] = q[j] + 0.25 * h * (v[j] + new[j])
        for j in range(2):
            q[j] += 0.5 * h * (v[j] + new[j])
            v[j] = new[j]


@njit(cache=True)
def _run(l, c, m, friction, gains, law, reference, noise, resolution, period, steps, out, start):
    work = (np.empty((10, 2)), np.empty(10), np.empty((5, 2)), np.empty((2, 2)), np.empty(2), np.empty(5))
    q, v, torque = start[0].copy(), start[1].copy(), np.empty(2)
    before = np.empty(2)
    for k in range(len(reference)):
        for j in range(2):
            reading = q[j] + noise[k, j]
            if resolution > 0.0:
                reading = np.round(reading / resolution) * resolution
            if k == 0:
                before[j] = reading - period * v[j]
            speed = (reading - before[j]) / period
            before[j] = reading
            # A loop that starts in motion follows a reference that moved before.
            last = max(k, 1)
            slope = (reference[last, j] - reference[last - 1, j]) / period
            u = law[0] * (reference[k, j] - reading) + law[1] * (slope - speed)
            torque[j] = gains[j] * u
            out[k, j], out[k, 2 + j], out[k, 4 + j] = reading, u, v[j]
        _advance(l, c, m, friction, q, v, torque, period / steps, steps, work)


def arrays(robot: Robot) -> tuple:
    """Return the arguments of the kernels for a robot."""
    (m1, m2), m = robot.mass, robot.tip_mass
    body = np.array([*robot.inertia, m1, m1, m2, m2, m, m])
    return np.array(robot.length), np.array(robot.center), body, robot.coefficients


def acceleration(robot: Robot, q, v, torque) -> np.ndarray:
    """Return the acceleration over one tiny step; friction must slide."""
    l, c, m, friction = arrays(robot)
    work = (np.empty((10, 2)), np.empty(10), np.empty((5, 2)), np.empty((2, 2)), np.empty(2), np.empty(5))
    h, q, end = 1e-9, np.array(q, float), np.array(v, float)
    _advance(l, c, m, friction, q, end, np.array(torque, float), h, 1, work)
    return (end - v) / h


def unknown_reference(times, seed, home=(1.9, 1.24), peak=0.32, count=6, band=(0.4, 3.0)) -> np.ndarray:
    """Return sines about the middle of the workspace of `Robot()`, (time, 2) [rad]."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(*band, (2, count)), rng.uniform(0, 2 * np.pi, (2, count))
    waves = np.sin(2 * np.pi * f * times[:, None, None] + phase).sum(axis=-1)
    return np.array(home) + peak * waves / np.abs(waves).max(axis=0)


def followed(
    robot: Robot,
    *,
    duration=10.0,
    rate=1000.0,
    noise=1e-6,
    force_noise=0.0,
    resolution=0.0,
    seed=0,
    gains=(1.0, 1.0),
    reduction=20.0,
    kp=150.0,
    kd=4.0,
    step=1e-5,
    reference=None,
) -> dict[str, np.ndarray]:
    """Run a PD loop; return t, q1, q2, measured motor torques u1, u2, r1, r2.

    gains: actual over measured torque of each drive. The law's gains count at the motors [N m/rad].
    """
    times = np.arange(round(duration * rate)) / rate
    reference = unknown_reference(times, seed) if reference is None else reference
    rng = np.random.default_rng(seed + 1)
    speed = (reference[1] - reference[0]) * rate
    out, steps = np.empty((len(times), 6)), round(1 / rate / step)
    _run(
        *arrays(robot),
        reduction * np.asarray(gains),
        np.array([kp, kd]),
        reference,
        noise * rng.standard_normal((len(times), 2)),
        resolution,
        1 / rate,
        steps,
        out,
        np.array([reference[0], speed]),
    )
    command = out[:, 2:4] + force_noise * rng.standard_normal((len(times), 2))
    columns = (times, *out[:, :2].T, *command.T, *reference.T)
    return dict(zip(("t", "q1", "q2", "u1", "u2", "r1", "r2"), columns, strict=True))
