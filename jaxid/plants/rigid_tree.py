"""Inverse dynamics of rigid links that form a tree of joints, with derivatives by their own recursion.

Every quantity is in the base's frame, about its origin. There the motion of a link is a sum over the joints
from the base to it, and the load of a joint a sum over the links that it carries. A force is the moment of
an acceleration over the mass of a link: the integral over its points r of a (r, 1)^T, which is a matrix that
moves a point times the link's `pseudo_inertia`.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.plants.geometry import Geometry


def _lifting() -> Float[np.ndarray, "6 3 4"]:
    """Return the matrices [w x | u] of the six unit motions (w, u)."""
    out = np.zeros((6, 3, 4))
    for a, b, c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[a, c, b], out[a, b, c], out[3 + a, a, 3] = 1.0, -1.0, 1.0
    return out


_LIFTING = _lifting()
# Contractions of a small matrix as products with a constant one: slices of three compile to branches.
_LIFT, _LOWER = _LIFTING.reshape(6, 12), _LIFTING.reshape(6, 12).T
_AXIAL = _LIFTING[:3, :, :3].reshape(3, 9).T
_LAST_ROW = np.array([[[0.0, 0.0, 0.0, 1.0]]])


@dataclass(frozen=True)
class Tree:
    """The order of the links: each hangs on one before it, by one joint.

    Args:
        parents: Index of the link on which each link hangs; -1 for the base.
        revolute: Whether each joint turns about z of its link's frame; otherwise it slides along it.
    """

    parents: tuple[int, ...]
    revolute: tuple[bool, ...]

    @classmethod
    def chain(cls, joints: tuple[str, ...]) -> Tree:
        """Return the tree of an arm: each link hangs on the one before."""
        return cls(tuple(range(-1, len(joints) - 1)), tuple(joint == "revolute" for joint in joints))

    @property
    def carries(self) -> Float[np.ndarray, "n n"]:
        """One where the joint of the row carries the link of the column, itself included; else zero."""
        out = np.eye(len(self.parents))
        for link, parent in enumerate(self.parents):
            if parent >= 0:
                out[:, link] += out[:, parent]
        return out


def pseudo_inertia(
    mass: Float[Array, "*n"], first_moment: Float[Array, "*n 3"], inertia: Float[Array, "*n 3 3"]
) -> Float[Array, "*n 4 4"]:
    """Return the second moments of the points (r, 1) of each link, linear in its ten parameters.

    Args:
        mass: Masses [kg].
        first_moment: Mass times centre of mass [kg m].
        inertia: Inertia tensors about the origins of the links' frames [kg m^2].

    Source:
        Wensing, Kim & Slotine (2018), IEEE Robotics and Automation Letters 3 (1).
    """
    half = 0.5 * jnp.trace(inertia, axis1=-2, axis2=-1)
    second = half[..., None, None] * np.eye(3) - inertia
    column = jnp.concatenate([first_moment, mass[..., None]], axis=-1)
    return jnp.concatenate(
        [jnp.concatenate([second, first_moment[..., None, :]], axis=-2), column[..., None]], axis=-1
    )


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def inverse_dynamics(
    tree: Tree,
    geometry: Geometry,
    rise: Float[Array, "3"],
    bodies: Float[Array, "n 4 4"],
    q: Float[Array, " n"],
    qd: Float[Array, " n"],
    qdd: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Return the forces of the joints that give the links a motion [N or N m].

    Its derivatives share what does not depend on their direction, whatever their number: the mass matrix, the
    slopes in position and velocity, and the regressor.

    Args:
        tree: The order of the links.
        geometry: Frame of each link in that on which it hangs.
        rise: Acceleration of the base [m/s^2]; upwards, at the size of gravity, it gives the weight.
        bodies: Pseudo-inertia of each link in its frame.
        q, qd, qdd: Motion of the joints.

    Source:
        Featherstone (2008), Rigid Body Dynamics Algorithms; derivatives after Singh, Russell & Wensing
        (2022), IEEE Robotics and Automation Letters 7 (2), written with moments of points.
    """
    motion = _Motion.of(tree, geometry, rise, q, qd, qdd)
    return _Loads.of(tree, motion, bodies).force(motion)


@functools.partial(inverse_dynamics.defjvp, symbolic_zeros=True)
def _inverse_dynamics_jvp(tree: Tree, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    geometry, rise, bodies, q, qd, qdd = primals
    *around, bodies_dot, q_dot, qd_dot, qdd_dot = tangents
    motion = _Motion.of(tree, geometry, rise, q, qd, qdd)
    loads = _Loads.of(tree, motion, bodies)

    terms: list[Array] = []
    if _moves(qdd_dot):
        terms.append(_times(loads.mass(tree, motion), qdd_dot))
    if _moves(q_dot) or _moves(qd_dot):
        slopes = loads.slopes(tree, motion)
        terms += [_times(m, x) for m, x in zip(slopes, (q_dot, qd_dot), strict=True) if _moves(x)]
    if _moves(bodies_dot):
        terms.append(jnp.sum(_regressor(tree, motion) * bodies_dot, axis=(1, 2, 3)))
    if any(map(_moves, jax.tree.leaves(around))):
        terms.append(_around(tree, primals, around))
    return loads.force(motion), sum(terms[1:], terms[0])


def _moves(tangent: Any) -> bool:
    return not isinstance(tangent, SymbolicZero)


def _around(tree: Tree, primals: tuple, around: list) -> Array:
    """Return the derivative along a change of geometry and of the base's rise, by plain differentiation."""

    def force(geometry: Geometry, rise: Array) -> Array:
        motion = _Motion.of(tree, geometry, rise, *primals[3:])
        return _Loads.of(tree, motion, primals[2]).force(motion)

    whole = jax.tree.map(lambda t: t if _moves(t) else jnp.zeros(t.shape, t.dtype), around)
    return jax.jvp(force, tuple(primals[:2]), tuple(whole))[1]


class _Motion(NamedTuple):
    """The motion of the links, in the base's frame.

    A motion (w, u) moves a point r with the velocity w x r + u; its matrix is [w x | u].

    Args:
        frames: Frame of each link, as a homogeneous matrix, (n, 4, 4).
        joint: Unit motion of each joint, (n, 6); joint_matrix: its matrix, (n, 3, 4).
        speed: Motion of each link, (n, 6); speed_matrix: its matrix.
        turning: Rate of the joint's unit motion as the links before it carry it, (n, 6).
        rise: Rate of `speed`, the base's included, (n, 6); rise_matrix: its matrix.
    """

    frames: Array
    joint: Array
    joint_matrix: Array
    speed: Array
    speed_matrix: Array
    turning: Array
    rise: Array
    rise_matrix: Array

    @classmethod
    def of(cls, tree: Tree, geometry: Geometry, rise: Array, q: Array, qd: Array, qdd: Array) -> _Motion:
        frames = _in_base(tree, *geometry.frames(q))
        axes, origin = frames[:, :3, :3], frames[:, :3, 3]
        x, y, z = (axes[:, :, k] for k in range(3))
        turns = np.asarray(tree.revolute, dtype=float)[:, None]
        across = turns[:, :, None] * (y[:, :, None] * x[:, None, :] - x[:, :, None] * y[:, None, :])
        along = (1.0 - turns) * z - _apply(across, origin)
        joint = jnp.concatenate([turns * z, along], axis=1)
        joint_matrix = jnp.concatenate([across, along[:, :, None]], axis=2)

        passed = tree.carries.T
        speed = _sums(passed, joint * qd[:, None])
        speed_matrix = _matrix(speed)
        turning = _commutator(speed_matrix, speed, joint_matrix, joint)
        above = _sums(passed, turning * qd[:, None] + joint * qdd[:, None])
        above = jnp.concatenate([above[:, :3], above[:, 3:] + rise], axis=1)
        return cls(
            frames=frames,
            joint=joint,
            joint_matrix=joint_matrix,
            speed=speed,
            speed_matrix=speed_matrix,
            turning=turning,
            rise=above,
            rise_matrix=_matrix(above),
        )


class _Loads(NamedTuple):
    """Moments over the points r of all links that a joint carries, in the base's frame.

    Args:
        masses: Integral of (r, 1) (r, 1)^T, (n, 4, 4).
        speeds: Integral of velocity times (r, 1)^T, (n, 3, 4).
        rises: Integral of acceleration times (r, 1)^T, (n, 3, 4).
    """

    masses: Array
    speeds: Array
    rises: Array

    @classmethod
    def of(cls, tree: Tree, motion: _Motion, bodies: Array) -> _Loads:
        masses = _product_t(_product(motion.frames, bodies), motion.frames)
        speeds = _product(motion.speed_matrix, masses)
        # Each sum apart: put together before, their parts would be computed anew for each entry.
        changing = _product(motion.rise_matrix, masses), _product(motion.speed_matrix[:, :, :3], speeds)
        carried = [_sums(tree.carries, x) for x in (masses, speeds, *changing)]
        return cls(carried[0], carried[1], carried[2] + carried[3])

    def force(self, motion: _Motion) -> Float[Array, " n"]:
        return jnp.sum(motion.joint_matrix * self.rises, axis=(1, 2))

    def _momentum(self, motion: _Motion) -> Float[Array, "n 6"]:
        return _vector(_product(motion.joint_matrix, self.masses))

    def mass(self, tree: Tree, motion: _Motion) -> Float[Array, "n n"]:
        lower = _pairs(self._momentum(motion), motion.joint)
        return _both(tree, lower, lower)

    def slopes(self, tree: Tree, motion: _Motion) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
        """Return the derivatives of the forces by position and by velocity."""
        joint, joint_matrix = motion.joint, motion.joint_matrix
        turning, turning_matrix = motion.turning, _matrix(motion.turning)
        # Second rate of the joint's unit motion.
        again = _commutator(motion.rise_matrix, motion.rise, joint_matrix, joint) + _commutator(
            motion.speed_matrix, motion.speed, turning_matrix, turning
        )
        momentum = self._momentum(motion)
        coriolis = jnp.sum(_product_t(joint_matrix, self.speeds).reshape(-1, 9, 1) * (2.0 * _AXIAL), axis=1)

        # A joint that carries another: force at the outer joint by motion of the inner one, and reverse.
        outer = jnp.concatenate([coriolis, momentum], axis=1)
        by_position = _pairs(outer, jnp.concatenate([turning[:, :3], again], axis=1))
        by_speed = _pairs(outer, jnp.concatenate([joint[:, :3], 2.0 * turning], axis=1))

        across = joint_matrix[:, :, :3]
        moved = _product_t(self.rises, joint_matrix)
        change = (
            2.0 * _product(turning_matrix[:, :, :3], self.speeds)
            + _product(_matrix(again), self.masses)
            + _product(across, self.rises)
            + jnp.concatenate([moved, jnp.zeros_like(moved[:, :, :1])], axis=2)
        )
        faster = 2.0 * (_product(across, self.speeds) + _product(turning_matrix, self.masses))
        change, faster = (_pairs(_vector(x), joint) for x in (change, faster))
        return _both(tree, by_position, change), _both(tree, by_speed, faster)


def _regressor(tree: Tree, motion: _Motion) -> Float[Array, "n n 4 4"]:
    """Return the derivative of each joint's force by the pseudo-inertia of each link."""
    rise = motion.rise_matrix + jnp.concatenate(
        [_product(motion.speed_matrix[:, :, :3], motion.speed_matrix)], axis=2
    )
    moved = _product(rise, motion.frames)
    placed = jnp.sum(motion.joint_matrix[:, None, :, :, None] * motion.frames[None, :, None], axis=3)
    whole = jnp.sum(moved[None, :, :, :, None] * placed[:, :, :, None, :], axis=2)
    return tree.carries[:, :, None, None] * whole


def _in_base(tree: Tree, axes: Array, origins: Array) -> Float[Array, "n 4 4"]:
    """Return the frames of the links in the base, from those in the links on which they hang."""
    n = len(tree.parents)
    own = jnp.concatenate([axes, origins[:, :, None]], axis=2)
    own = jnp.concatenate([own, jnp.broadcast_to(_LAST_ROW, (n, 1, 4))], axis=1)
    out: list[Array] = []
    for link, parent in enumerate(tree.parents):
        out.append(own[link] if parent < 0 else jnp.sum(out[parent][:, :, None] * own[link][None], axis=1))
    return jnp.stack(out)


def _both(tree: Tree, outer: Array, inner: Array) -> Float[Array, "n n"]:
    """Put together the entries at the outer joint of a pair, and those at the inner one, transposed."""
    carries = tree.carries
    return outer * carries.T + (inner * (carries.T - np.eye(len(carries)))).T


# Sums of products, since a call to a matrix library would defeat the loop flag (see `jaxid._platform`).


def _times(matrix: Float[Array, "n n"], x: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.sum(matrix * x, axis=1)


def _sums(which: Float[np.ndarray, "n n"], x: Float[Array, "n ..."]) -> Float[Array, "n ..."]:
    """Sum entries of x along its first axis, those that each row of `which` marks."""
    rows = x.reshape(len(which), -1)
    return jnp.sum(which[:, :, None] * rows[None], axis=1).reshape(x.shape)


def _pairs(outer: Float[Array, "n k"], inner: Float[Array, "n k"]) -> Float[Array, "n n"]:
    return jnp.sum(outer[:, None] * inner[None], axis=2)


def _product(a: Float[Array, "n i k"], b: Float[Array, "n k j"]) -> Float[Array, "n i j"]:
    return jnp.sum(a[:, :, :, None] * b[:, None], axis=2)


def _product_t(a: Float[Array, "n i k"], b: Float[Array, "n j k"]) -> Float[Array, "n i j"]:
    return jnp.sum(a[:, :, None] * b[:, None], axis=3)


def _apply(matrix: Float[Array, "n i k"], x: Float[Array, "n k"]) -> Float[Array, "n i"]:
    return jnp.sum(matrix * x[:, None], axis=2)


def _matrix(motion: Float[Array, "n 6"]) -> Float[Array, "n 3 4"]:
    """Return the matrix [w x | u] of each motion (w, u)."""
    return jnp.sum(motion[:, :, None] * _LIFT, axis=1).reshape(-1, 3, 4)


def _vector(moment: Float[Array, "n 3 4"]) -> Float[Array, "n 6"]:
    """Return moment and force, whose product with a motion is the contraction with its matrix."""
    return jnp.sum(moment.reshape(-1, 12, 1) * _LOWER, axis=1)


def _commutator(a_matrix: Array, a: Array, b_matrix: Array, b: Array) -> Float[Array, "n 6"]:
    """Return the rate of a motion b that a motion a carries."""
    turn = a_matrix[:, :, :3]
    along = _apply(turn, b[:, 3:]) - _apply(b_matrix[:, :, :3], a[:, 3:])
    return jnp.concatenate([_apply(turn, b[:, :3]), along], axis=1)
