"""Torques of a serial arm from energies of point sums, differenced, in numpy.

Kinetic and potential energy come from homogeneous transforms and 4 x 4 pseudo-inertias, as in
Lagrange's derivation; nothing is recursive, and no frame but the base's is used.
"""

import numpy as np

NAMES = (
    "mass",
    "first_moment_x",
    "first_moment_y",
    "first_moment_z",
    "inertia_xx",
    "inertia_xy",
    "inertia_xz",
    "inertia_yy",
    "inertia_yz",
    "inertia_zz",
)


def bodies(n: int, rng: np.random.Generator) -> np.ndarray:
    """Return ten parameters of n clouds of 20 random points each, (n, 10): what bodies can have."""
    out = []
    for _ in range(n):
        m, r = rng.uniform(0.05, 0.4, 20), rng.uniform(-0.2, 0.2, (20, 3)) + rng.uniform(-0.2, 0.2, 3)
        j = np.einsum("p,pi,pj->ij", m, r, r)
        tensor = np.trace(j) * np.eye(3) - j
        out.append([m.sum(), *(m @ r), *tensor[np.triu_indices(3)]])
    return np.array(out)


def transforms(rows, q):
    """Multiply turns and shifts to the transforms of all links in the base's frame, (n, 4, 4)."""
    whole, out = np.eye(4), []
    for (joint, alpha, a, d, theta), value in zip(rows, q, strict=True):
        theta, d = (theta + value, d) if joint == "revolute" else (theta, d + value)
        steps = [_turn(0, alpha), _shift(0, a), _turn(2, theta), _shift(2, d)]
        for step in steps:
            whole = whole @ step
        out.append(whole)
    return np.array(out)


def _turn(axis: int, angle: float) -> np.ndarray:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out = np.eye(4, dtype=np.result_type(angle, float))
    out[i, i] = out[j, j] = np.cos(angle)
    out[i, j], out[j, i] = -np.sin(angle), np.sin(angle)
    return out


def _shift(axis: int, length: float) -> np.ndarray:
    out = np.eye(4, dtype=np.result_type(length, float))
    out[axis, 3] = length
    return out


def pseudo_inertias(parameters) -> np.ndarray:
    """Return the sums of m r r' over each link, r = (x, y, z, 1), (n, 4, 4)."""
    out = []
    for m, x, y, z, xx, xy, xz, yy, yz, zz in parameters:
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        j = np.zeros((4, 4))
        j[:3, :3] = 0.5 * np.trace(tensor) * np.eye(3) - tensor
        j[3, :3] = j[:3, 3] = x, y, z
        j[3, 3] = m
        out.append(j)
    return np.array(out)


def slopes(rows, q):
    """Differentiate the transforms by complex steps, (n joints, n links, 4, 4)."""
    h = 1e-40
    out = []
    for k in range(len(q)):
        moved = np.array(q, dtype=complex)
        moved[k] += 1j * h
        out.append(transforms(rows, moved).imag / h)
    return np.array(out)


def mass_matrix(rows, parameters, q):
    s, j = slopes(rows, q), pseudo_inertias(parameters)
    return np.einsum("aimn,ino,bimo->ab", s, j, s)


def gravity_torque(rows, parameters, q, gravity):
    """Return the slope of the potential energy -sum m g' r."""
    s, j = slopes(rows, q), pseudo_inertias(parameters)
    return -np.einsum("m,aimn,in->a", np.append(gravity, 0.0), s, j[:, :, 3])


def inverse_dynamics(rows, parameters, q, qd, qdd, gravity):
    """Return M qdd + h, by d/dt dT/dqd - dT/dq - the slope of the potential energy."""
    j, first = pseudo_inertias(parameters), slopes(rows, q)
    second = _second(rows, q)
    acceleration = np.einsum("aimn,a->imn", first, qdd) + np.einsum("abimn,a,b->imn", second, qd, qd)
    inertia = np.einsum("aimn,ino,imo->a", first, j, acceleration)
    return inertia + gravity_torque(rows, parameters, q, gravity)


def _second(rows, q):
    """Return the second derivatives, from products of single factors' derivatives."""
    n = len(q)
    alone = [transforms([row], [value])[0] for row, value in zip(rows, q, strict=True)]
    one = [slopes([row], [value])[0, 0] for row, value in zip(rows, q, strict=True)]
    two = []
    for (joint, alpha, a, _, theta), value in zip(rows, q, strict=True):
        twist = _turn(0, alpha) @ _shift(0, a)
        bend = -(_turn(2, theta + value) @ np.diag([1.0, 1.0, 0.0, 0.0]))
        # A prismatic joint is linear in its coordinate.
        two.append(twist @ bend if joint == "revolute" else np.zeros((4, 4)))
    out = np.zeros((n, n, n, 4, 4))
    for i in range(n):
        for b in range(n):
            for c in range(n):
                whole = np.eye(4)
                for k in range(i + 1):
                    order = (k == b) + (k == c)
                    whole = whole @ (alone, one, two)[order][k]
                if max(b, c) <= i:
                    out[b, c, i] = whole
    return out
