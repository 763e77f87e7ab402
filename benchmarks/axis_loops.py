"""Loops for one axis in its cascade loop, written by hand and compiled by numba.

`theta` is inertia, viscous coefficient, Coulomb level and constant force; `loop` holds the known values:
gain, kp, kv, limit, period and the width of the smoothed sign. The velocity is the difference of two
positions two ticks apart, as in `velocity_average = 2`.
"""

import math

import numpy as np
from numba import njit, prange

P = 4


@njit(cache=False)
def command(r, q, past, loop):
    """Return the command of the cascade law within its limit, before the drive's gain."""
    _, kp, kv, limit, period, _ = loop
    u = kv * (kp * (r - q) - (q - past) / (2 * period))
    return min(max(u, -limit), limit)


@njit(cache=False)
def acceleration(v, u, theta, width):
    """Return the acceleration [m/s^2] under a force u [N], with smoothed friction."""
    m, c, f, f0 = theta
    return (u - c * v - f * math.tanh(v / width) + f0) / m


@njit(cache=False, nogil=True)
def rk4_forward(theta, reference, loop, start, out):
    """Simulate smoothed friction by Runge-Kutta, one step a tick; write positions [m] to `out`, (time,)."""
    h, width = loop[4], loop[5]
    half = 0.5 * h
    q, v = start
    last, past = q - h * v, q - 2 * h * v
    for k in range(len(reference)):
        out[k] = q
        u = loop[0] * command(reference[k], q, past, loop)
        a1 = acceleration(v, u, theta, width)
        v2 = v + half * a1
        a2 = acceleration(v2, u, theta, width)
        v3 = v + half * a2
        a3 = acceleration(v3, u, theta, width)
        v4 = v + h * a3
        a4 = acceleration(v4, u, theta, width)
        past, last = last, q
        q += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)


@njit(cache=False)
def linear_flow(theta, h):
    """Return the Runge-Kutta map of v' = (f - c v) / m over a step h [s].

    Returns:
        Factors of v and f in the next v, then of v and f in the change of q.
    """
    m, c, _, _ = theta
    z = -h * c / m
    grow = 1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))
    p1 = 1 + z / 2 * (1 + z / 3 * (1 + z / 4))
    p2 = 0.5 + z / 6 * (1 + z / 4)
    return grow, h / m * p1, h * p1, h * h / m * p2


@njit(cache=False, nogil=True)
def ideal_forward(theta, reference, loop, start, out):
    """Simulate set-valued friction, one step a tick; write positions [m] to `out`.

    After the linear flow friction stops the axis, turns within the step, or drags it.
    """
    h = loop[4]
    vv, vf, qv, qf = linear_flow(theta, h)
    level, mobility = theta[2], h / theta[0]
    q, v = start
    last, past = q - h * v, q - 2 * h * v
    for k in range(len(reference)):
        out[k] = q
        force = loop[0] * command(reference[k], q, past, loop) + theta[3]
        free = vv * v + vf * force
        ahead = v if v != 0.0 else free
        drag = level if ahead > 0.0 else -level if ahead < 0.0 else 0.0
        slid = free - mobility * drag
        past, last = last, q
        if v * slid >= 0.0 and v != 0.0:
            q += qv * v + qf * (force - drag)
            v = free - vf * drag
            continue
        # At rest before, or within the step.
        part = v / (v - slid) if v != 0.0 else 1.0
        if abs(free - v) <= mobility * level:
            reaction, after = -free / mobility, 0.0
        else:
            reaction = (1.0 - 2.0 * part) * drag
            after = free + vf * reaction
        if v != 0.0:
            q += qv * v + qf * (force + reaction) - 0.5 * h * ((1.0 - part) * v + part * after)
        elif after != 0.0:
            q += qf * (force + reaction)
        v = after


@njit(cache=False)
def sensed(v, u, theta, width, dv, du, da):
    """Return the acceleration, and write its derivative by the parameters to `da`, (4,).

    Args:
        v, u: Velocity [m/s] and force [N].
        theta, width: Parameters, and the width of the smoothed sign [m/s].
        dv, du: Derivatives of v and u by the parameters, (4,).
        da: Array that the derivative is written to.
    """
    m, c, f, f0 = theta
    t = math.tanh(v / width)
    a = (u - c * v - f * t + f0) / m
    slope = -(c + f * (1 - t * t) / width)
    for i in range(P):
        da[i] = du[i] + slope * dv[i]
    da[0] -= a
    da[1] -= v
    da[2] -= t
    da[3] += 1.0
    for i in range(P):
        da[i] /= m
    return a


@njit(cache=False)
def rk4_normal(theta, reference, measured, loop, start, normal, gradient):
    """Write J'J to `normal` (4, 4) and J'e to `gradient` (4,), with sensitivities written by hand.

    Returns:
        Half the sum of squares of the residual in position [m^2].
    """
    gain, kp, kv, limit, h, width = loop
    half = 0.5 * h
    q, v = start
    last, past = q - h * v, q - 2 * h * v
    dq, dv, dlast, dpast = np.zeros(P), np.zeros(P), np.zeros(P), np.zeros(P)
    du, d2, d3, d4 = np.zeros(P), np.zeros(P), np.zeros(P), np.zeros(P)
    e1, e2, e3, e4 = np.zeros(P), np.zeros(P), np.zeros(P), np.zeros(P)
    normal[:] = 0.0
    gradient[:] = 0.0
    cost = 0.0
    for k in range(len(reference)):
        e = measured[k] - q
        cost += 0.5 * e * e
        for i in range(P):
            gradient[i] -= e * dq[i]
            for j in range(P):
                normal[i, j] += dq[i] * dq[j]
        raw = kv * (kp * (reference[k] - q) - (q - past) / (2 * h))
        inside = gain if abs(raw) < limit else 0.0
        u = gain * min(max(raw, -limit), limit)
        for i in range(P):
            du[i] = -inside * kv * (kp * dq[i] + (dq[i] - dpast[i]) / (2 * h))
        a1 = sensed(v, u, theta, width, dv, du, e1)
        v2 = v + half * a1
        for i in range(P):
            d2[i] = dv[i] + half * e1[i]
        a2 = sensed(v2, u, theta, width, d2, du, e2)
        v3 = v + half * a2
        for i in range(P):
            d3[i] = dv[i] + half * e2[i]
        a3 = sensed(v3, u, theta, width, d3, du, e3)
        v4 = v + h * a3
        for i in range(P):
            d4[i] = dv[i] + h * e3[i]
        a4 = sensed(v4, u, theta, width, d4, du, e4)
        past, last = last, q
        q += h / 6 * (v + 2 * v2 + 2 * v3 + v4)
        v += h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        for i in range(P):
            dpast[i], dlast[i] = dlast[i], dq[i]
            dq[i] += h / 6 * (dv[i] + 2 * d2[i] + 2 * d3[i] + d4[i])
            dv[i] += h / 6 * (e1[i] + 2 * e2[i] + 2 * e3[i] + e4[i])
    return cost


@njit(cache=False, parallel=True)
def rk4_sets(thetas, reference, measured, loop, start, costs):
    """Write half the sum of squares [m^2] of each parameter set to `costs`, (sets,), on all threads."""
    for n in prange(len(thetas)):
        out = np.empty(len(reference))
        rk4_forward(thetas[n], reference, loop, start, out)
        cost = 0.0
        for k in range(len(reference)):
            cost += 0.5 * (measured[k] - out[k]) ** 2
        costs[n] = cost
