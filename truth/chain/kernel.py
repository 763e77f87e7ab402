"""Compiled loop of the ground-truth chain: masses in a row under set-valued dry friction.

The forces on one mass are those of `truth.axis.kernel`; here the springs couple them. One step
is drift, kick, drift (second order where all is smooth). Positions, and with them the springs,
stand still in the kick, so that each mass stops, sticks and breaks away by itself, in closed form.
Where a spring has a damper, its force is that of the velocities halfway.
"""

import math

import numpy as np
from numba import njit

from truth.axis import kernel as axis


@njit(cache=True)
def pull_of_springs(springs, q, v, pull):
    """Fill `pull` with the springs' force on each mass [N], walls at 0.

    Spring j joins mass j - 1 and mass j; its row of `springs` holds k, k2 and k3 of the force
    k e + k2 e^2 + k3 e^3 at elongation e, which draws both ends together, the d of a damper beside
    it, and a clearance, inside which neither spring nor damper pulls.
    """
    pull[:] = 0.0
    before, speed = 0.0, 0.0
    for j in range(q.size + 1):
        here = q[j] if j < q.size else 0.0
        now = v[j] if j < q.size else 0.0
        e, half = here - before, 0.5 * springs[j, 4]
        force = 0.0
        if abs(e) >= half:
            e -= math.copysign(half, e)
            force = e * (springs[j, 0] + e * (springs[j, 1] + e * springs[j, 2]))
            force += springs[j, 3] * (now - speed)
        if j < q.size:
            pull[j] -= force
        if j > 0:
            pull[j - 1] += force
        before, speed = here, now


@njit(cache=True)
def advance(masses, springs, q, v, drive, pull, h):
    """Take one step of h [s], in place: positions q [m] and velocities v [m/s]."""
    half, middle = 0.5 * h, np.empty(q.size)
    for i in range(q.size):
        q[i] += half * v[i]
    pull_of_springs(springs, q, v, pull)
    for i in range(q.size):
        p = masses[i]
        force = drive[i] + pull[i] + axis.position_force(p, q[i], 0.0) + axis.velocity_force(p, v[i])
        middle[i] = axis.kick(p, v[i], abs(v[i]), half, force, 1.0, drive[i])
    pull_of_springs(springs, q, middle, pull)
    for i in range(q.size):
        p, mid = masses[i], middle[i]
        force = drive[i] + pull[i] + axis.position_force(p, q[i], 0.0) + axis.velocity_force(p, mid)
        v[i] = axis.kick(p, v[i], abs(mid), h, force, 1.0, drive[i])
        q[i] += half * v[i]


@njit(cache=True)
def run(
    masses,
    springs,
    laws,
    driven,
    u,
    reference,
    bursts,
    noise,
    resolution,
    period,
    step,
    q,
    v,
    drive,
    pull,
    reading,
    truth,
    memory,
):
    """Fill u, reading and truth (position, velocity, acceleration, force) tick by tick.

    Shapes: u (time, drives), reference, noise and reading (time, masses), truth (time, masses, 4),
    memory (drives, 2). `driven` holds the mass of each drive; `bursts` is empty. A drive with a lag
    starts at zero force.
    """
    steps = int(math.ceil(period / step - 1e-6))
    h = period / steps
    target = np.zeros(q.size)
    for k in range(u.shape[0]):
        for i in range(q.size):
            reading[k, i] = q[i] + noise[k, i]
            if resolution > 0.0:
                reading[k, i] = round(reading[k, i] / resolution) * resolution
        for d in range(driven.size):
            i = driven[d]
            if laws[d].kind != axis.OPEN:
                u[k, d] = axis.command(laws[d], k, reference[:, i], reading[:, i], memory[d], period)
            target[i] = masses[i].gain * u[k, d]
            if masses[i].lag == 0.0:
                drive[i] = target[i]
        pull_of_springs(springs, q, v, pull)
        for i in range(q.size):
            force = drive[i] + pull[i]
            truth[k, i, 0], truth[k, i, 1], truth[k, i, 3] = q[i], v[i], drive[i]
            truth[k, i, 2] = axis.acceleration(masses[i], bursts, q[i], v[i], 0.0, force, 0.0)
        for _ in range(steps):
            lagging(masses, drive, target, 0.5 * h)
            advance(masses, springs, q, v, drive, pull, h)
            lagging(masses, drive, target, 0.5 * h)


@njit(cache=True)
def lagging(masses, drive, target, h):
    """Let drives with a lag come nearer to their targets for h [s], in place."""
    for i in range(drive.size):
        if masses[i].lag > 0.0:
            drive[i] = target[i] + (drive[i] - target[i]) * math.exp(-h / masses[i].lag)


@njit(cache=True)
def hold(masses, springs, q, v, drive, pull, period, step):
    """Let the chain move for one period under held forces, in place."""
    steps = int(math.ceil(period / step - 1e-6))
    for _ in range(steps):
        advance(masses, springs, q, v, drive, pull, period / steps)
