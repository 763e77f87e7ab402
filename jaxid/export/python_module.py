"""A Python file with the dynamics of a result, which needs NumPy only."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxid.export.exported import ExportedFile
from jaxid.export.laws import Language, written
from jaxid.export.plain import PlainTree

_PYTHON = Language({"sign": "np.sign", "exp": "np.exp", "cos": "np.cos", "fabs": "abs", "clip": "_clip"})

_MODULE = '''\
"""Dynamics of {title}: forces, mass matrix and accelerations of its joints.

Written by jaxid {version} from a result; it needs NumPy only. Units: rad, m, s, N m, N; commands in the unit
of the log. Joints stand in the order of JOINTS. The functions take one state; dry friction takes its sign
from the velocity, and is zero at rest.
{remarks}"""

import numpy as np

JOINTS = {joints}
# Driven joints, from 0, and the force at each per unit of its command.
DRIVES = {drives}
GAINS = {gains}
# Joint that moves each link, parent of each link (-1: the base), and whether its joint turns.
LINKS = {links}
PARENTS = {parents}
TURNS = {turns}
# Free joint by which each link's joint moves, and how much of it.
LEADERS = {leaders}
RATIOS = np.array({ratios})
# Frame of each link in its parent's, joints at zero: axes as columns, and origin [m].
AXES = np.array({axes})
ORIGINS = np.array({origins})
# Mass, first moment, and inertia about the origin of each link's frame: xx xy xz yy yz zz.
BODIES = np.array({bodies})
ROTORS = np.array({rotors})
GRAVITY = np.array({gravity})


def torque(q, v, a):
    """Return the forces of the joints that give them an acceleration, friction and springs overcome.

    Args:
        q, v, a: Position, velocity and acceleration of the joints.
    """
    return inertial(q, v, a) + friction(q, v, a)


def command(q, v, a):
    """Return the commands of the drives that give the same motion."""
    forces = torque(q, v, a)
    out = []
    for joint, gain in zip(DRIVES, GAINS):
        out.append(_delivered(joint, forces[joint]) / gain)
    return np.array(out)


def mass_matrix(q):
    """Return the inertia between the joints, rotors included."""
    zero = np.zeros(len(JOINTS))
    rest = inertial(q, zero, zero)
    return np.stack([inertial(q, zero, unit) - rest for unit in np.eye(len(JOINTS))], axis=1)


def acceleration(q, v, forces):
    """Return the acceleration of the joints under forces of their drives; dry friction does not stick."""
    zero = np.zeros(len(JOINTS))
    rest = friction(q, v, zero)
    added = np.stack([friction(q, v, unit) - rest for unit in np.eye(len(JOINTS))], axis=1)
    matrix = mass_matrix(q) + added
    return np.linalg.solve(matrix, forces - torque(q, v, zero))


def friction(q, v, a):
    """Return the forces that the drives need for friction, springs and what else was found at the joints."""
    out = np.zeros(len(JOINTS))
{forces}    return out


def inertial(q, v, a):
    """Return the forces of the joints that move the bodies, against their weight."""
    count = len(LINKS)
    x, xd, xdd = (RATIOS * np.asarray(y, dtype=float)[list(LEADERS)] for y in (q, v, a))
    turns, origins, speeds, gains, rises = [], [], [], [], []
    forces, moments = np.zeros((count, 3)), np.zeros((count, 3))
    along = np.array([0.0, 0.0, 1.0])
    for k, parent in enumerate(PARENTS):
        w, dw, rise = np.zeros(3), np.zeros(3), -GRAVITY
        if parent >= 0:
            w, dw, rise = speeds[parent], gains[parent], rises[parent]
        turn, origin = AXES[k], ORIGINS[k]
        if TURNS[k]:
            c, s = np.cos(x[k]), np.sin(x[k])
            turn = turn @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        else:
            origin = origin + x[k] * turn[:, 2]
        rise = turn.T @ (rise + np.cross(dw, origin) + np.cross(w, np.cross(w, origin)))
        w, dw = turn.T @ w, turn.T @ dw
        if TURNS[k]:
            dw = dw + np.cross(w, xd[k] * along) + xdd[k] * along
            w = w + xd[k] * along
        else:
            rise = rise + 2.0 * np.cross(w, xd[k] * along) + xdd[k] * along
        mass, first, (xx, xy, xz, yy, yz, zz) = BODIES[k, 0], BODIES[k, 1:4], BODIES[k, 4:]
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        forces[k] = mass * rise + np.cross(dw, first) + np.cross(w, np.cross(w, first))
        moments[k] = inertia @ dw + np.cross(w, inertia @ w) + np.cross(first, rise)
        for values, value in zip((turns, origins, speeds, gains, rises), (turn, origin, w, dw, rise)):
            values.append(value)
    out = ROTORS * np.asarray(a, dtype=float)
    for k in reversed(range(count)):
        out[LEADERS[k]] += RATIOS[k] * (moments if TURNS[k] else forces)[k, 2]
        if PARENTS[k] >= 0:
            push = turns[k] @ forces[k]
            forces[PARENTS[k]] += push
            moments[PARENTS[k]] += turns[k] @ moments[k] + np.cross(origins[k], push)
    return out


def _delivered(joint, f):
    """Return the declared force of a drive that delivers a force at its joint."""
{commands}    return f


def _clip(f, limit):
    return min(max(f, -limit), limit)
'''


def export_python(model: Mapping[str, Any], stem: str, version: str, where: str) -> ExportedFile:
    """Write a Python file with forces, mass matrix and accelerations, which needs NumPy only.

    Args:
        model: `model` of result.json.
        stem: Name of the file without its suffix.
        version: That of jaxid.
        where: The result, for messages.

    Source:
        Recursive Newton-Euler algorithm; Featherstone (2008), Rigid Body Dynamics Algorithms, section 5.3.
    """
    plain = PlainTree.of(model, where)
    laws = written(model, _PYTHON, plain.field)
    remarks = "".join(f"\nNot in it: {_in_docstring(note)}.\n" for note in laws.notes)
    forces = "".join(
        f"    out[{joint}] += {term}\n" for joint, terms in enumerate(laws.forces) for term in terms
    )
    commands = ""
    for joint, steps in enumerate(laws.commands):
        if steps:
            commands += f"    if joint == {joint}:\n" + "".join(f"        f = {step}\n" for step in steps)
    text = _MODULE.format(
        title=_in_docstring(stem),
        version=version,
        remarks=remarks,
        joints=repr(plain.names),
        drives=repr(plain.drives),
        gains=repr(plain.gains),
        links=repr(plain.links),
        parents=repr(plain.parents),
        turns=repr(plain.revolute),
        leaders=repr(plain.leaders),
        ratios=repr(list(plain.ratios)),
        axes=_listed(plain.axes),
        origins=_listed(plain.origins),
        bodies=_listed(plain.bodies),
        rotors=repr(plain.rotors.tolist()),
        gravity=repr(plain.gravity.tolist()),
        forces=forces,
        commands=commands,
    )
    return ExportedFile(text.encode(), plain.names, laws.notes, laws.lost)


def _listed(matrix: np.ndarray) -> str:
    """Return rows of numbers, a line each."""
    rows = "".join(f"    {row!r},\n" for row in matrix.tolist())
    return f"[\n{rows}]"


def _in_docstring(text: str) -> str:
    """Return a text that does not end the docstring in which it stands."""
    return text.replace("\\", "/").replace('"""', "'''")
