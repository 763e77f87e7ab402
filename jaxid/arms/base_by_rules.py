"""Base parameters of an arm or a tree by closed rules: parameters without effect, or to regroup."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.base_parameters import BaseParameters, standard_places, tidied
from jaxid.arms.pseudo_inertia import moved
from jaxid.names import TEN
from jaxid.plants import LinkTree

_MASS, _X, _Y, _Z, _XX, _XY, _XZ, _YY, _YZ, _ZZ = range(10)
_TENSOR = (_XX, _XY, _XZ, _YY, _YZ, _ZZ)


def base_parameters_by_rules(plant: LinkTree, tolerance: float = 1e-9) -> BaseParameters:
    """Find the base parameters of an arm without its regressor, link by link from the tips to the base.

    Elimination, after (2.14)-(2.16) of the PA-10 report: a parameter goes if it changes neither the kinetic
    energy nor, except for a constant, the potential energy. Regrouping, after (2.17)-(2.18): a body whose
    inertia does not depend on the position of its joint may as well be part of the link before. For a
    revolute joint these are a mass on its axis, its first moment along it, and equal moments about x and y;
    for a prismatic one every part that only resists rotation. Up to the second axis that is not parallel to
    the first, links turn about one direction only, and more parameters are without effect. In a tree this
    holds along the way from the base to each link.

    Args:
        plant: The arm; only its geometry, its direction of gravity and the presence of rotors matter.
        tolerance: Sines of angles, and lengths [m], below it count as zero. Rounding of right angles is
            1e-16; angles given to five digits require 1e-4.

    Returns:
        The result of `jaxid.arms.base_parameters.base_parameters`, without singular values.

    Raises:
        ValueError: If the arm is without weight: a link that does not move its origin then has no first
            moment, which these rules do not cover; or if a joint follows another one. Use `base_parameters`.

    Source:
        Gautier & Khalil (1990), IEEE Trans. Robotics and Automation 6(3); Khalil & Dombre (2002), chapter 9,
        for the rules, here for frames in any position and with rotors. "PA-10 traineeship", (2.14)-(2.18)
        and Appendix A, corrected: (A.1) I_yy7 + 2 d_7 mZ_7 + d_7^2 m_7; (A.2)-(A.4) with m_7 in every mass.
    """
    weight = np.asarray(plant.gravity_vector)
    if not np.linalg.norm(weight) > 0:
        raise ValueError("the closed rules need weight: give gravity_vector, or use base_parameters.")
    if plant.copies:
        raise ValueError("the closed rules need free joints: use base_parameters.")
    n, places = plant.joints, standard_places(plant)
    parents = plant.tree.parents

    # Each parameter of each link as a sum of standard ones; a sum without effect or regrouped becomes zero.
    sums = [np.zeros((10, len(places))) for _ in range(n)]
    rotors = np.zeros((n, len(places)))
    for column, (name, k) in enumerate(places):
        assert k is not None, "parameters of an arm have one value a link"
        if name in TEN:
            sums[k][TEN.index(name), column] = 1.0
        else:
            rotors[k, column] = 1.0 if plant.gear_ratio is None else float(plant.gear_ratio[k]) ** 2

    kept = np.ones((n, 11), dtype=bool)
    kept[:, 10] = plant.rotor_inertia is not None
    for k in reversed(range(n)):
        before = sums[parents[k]] if parents[k] >= 0 else np.zeros((10, len(places)))
        chain = _Chain.of(plant, k, tolerance)
        _regroup(len(chain.axis) - 1, chain, sums[k], before, rotors[k], kept[k])

    rows = np.concatenate([np.vstack([s, r]) for s, r in zip(sums, rotors, strict=True)])
    names: list[tuple[str, int | None]] = [(name, k) for k in range(n) for name in (*TEN, "rotor_inertia")]
    index = {place: row for row, (place, keep) in enumerate(zip(names, kept.ravel(), strict=True)) if keep}
    chosen = tuple(column for column, place in enumerate(places) if place in index)
    return BaseParameters(places, chosen, tidied(rows[[index[places[c]] for c in chosen]]))


@dataclass(frozen=True)
class _Chain:
    """Geometry of the way from the base to a link, as the rules need it; its joints count from 0.

    Args:
        revolute: Mask of the revolute joints.
        axis: z axis of each frame in the base frame, joints at zero, (n, 3).
        turns: z axis of the first revolute joint in the base frame; None without one.
        first, second: The first revolute joint, and the first one not parallel to it; n without one.
        weight: Direction of gravity in the base frame.
        on_axis: Mask of the links whose origin stays on the axis of the first revolute joint.
        into: Matrix from the link's parameters into those of the link before, joint at zero.
        direction: `turns` in each frame, (n, 3).
        zero: Tolerance below which a number counts as zero.
    """

    revolute: np.ndarray
    axis: np.ndarray
    turns: np.ndarray | None
    first: int
    second: int
    weight: np.ndarray
    on_axis: np.ndarray
    into: np.ndarray
    direction: np.ndarray
    zero: float

    @classmethod
    def of(cls, plant: LinkTree, link: int, zero: float) -> _Chain:
        """Compute the geometry of the way to a link with all joints at zero."""
        way = plant.way(link)
        n, revolute = len(way), plant.geometry.revolute[way] > 0
        axes, origins = (np.asarray(x)[way] for x in plant.geometry.frames(jnp.zeros(plant.joints)))
        whole, at = np.eye(3), np.zeros(3)
        frame_list, point_list = [], []
        for turn, origin in zip(axes, origins, strict=True):
            at = at + whole @ origin
            whole = whole @ turn
            frame_list.append(whole)
            point_list.append(at)
        frames, points = np.array(frame_list), np.array(point_list)

        axis, turning = frames[:, :, 2], np.flatnonzero(revolute)
        first = int(turning[0]) if turning.size else n
        turns, other = None, []
        on_axis = np.zeros(n, dtype=bool)
        if turning.size:
            turns = axis[first]
            other = [k for k in turning if np.linalg.norm(np.cross(axis[k], turns)) >= zero]
            offset = np.linalg.norm(np.cross(points - points[first], turns), axis=1)
            away = revolute & (offset >= zero)
            on_axis = np.array([not np.any(away[first : k + 1]) for k in range(n)])

        weight = np.asarray(plant.gravity_vector)
        return cls(
            revolute=revolute,
            axis=axis,
            turns=turns,
            first=first,
            second=int(other[0]) if other else n,
            weight=weight / np.linalg.norm(weight),
            on_axis=on_axis,
            into=moved(axes[-1], origins[-1]),
            direction=np.zeros((n, 3)) if turns is None else np.einsum("kij,i->kj", frames, turns),
            zero=zero,
        )

    def along(self, axis: np.ndarray) -> bool:
        """Check that a direction is that of the first revolute joint."""
        assert self.turns is not None, "asked of links that turn only"
        return bool(np.linalg.norm(np.cross(axis, self.turns)) < self.zero)

    def slides_across(self, k: int) -> bool:
        """Check that a prismatic joint up to the k-th moves links across the only direction of rotation."""
        return any(not self.revolute[i] and not self.along(self.axis[i]) for i in range(k + 1))

    def without_first_moment(self, k: int) -> bool:
        """Check that the centre of mass of a link that turns about one direction has no effect."""
        return self.along(self.weight) and bool(self.on_axis[k]) and not self.slides_across(k)

    def moves_alone_along(self, k: int) -> bool:
        """Check that a link moves along its prismatic joint by that joint only, and without weight."""
        fixed = k < self.first or (k < self.second and self.along(self.axis[k]))
        others = [self.axis[i] for i in range(k) if not self.revolute[i]]
        return fixed and all(abs(self.axis[k] @ a) < self.zero for a in (*others, self.weight))

    def turns_alone(self, k: int) -> bool:
        """Check that a link turns about its revolute joint's axis by that joint only."""
        if k == self.first:
            return True
        return k == self.second and self.turns is not None and abs(self.axis[k] @ self.turns) < self.zero


def _regroup(
    k: int,
    chain: _Chain,
    link: Float[np.ndarray, "10 standard"],
    before: Float[np.ndarray, "10 standard"],
    rotor: Float[np.ndarray, " standard"],
    kept: np.ndarray,
) -> None:
    """Remove parameters of a link that have no effect, or the same effect in the link before or the rotor.

    Args:
        k: Index of the link among those of its way, the last one.
        chain: Geometry of the way to it.
        link: Parameters of the link as sums of standard ones; changed in place.
        before: Parameters of the link before; changed in place.
        rotor: Rotor inertia of the joint; changed in place.
        kept: Mask of the link's ten parameters and its rotor that remain; changed in place.
    """
    into = chain.into

    def move(*parameters: int) -> None:
        for p in parameters:
            before[:] += np.outer(into[:, p], link[p])
        drop(*parameters)

    def drop(*parameters: int) -> None:
        link[list(parameters)] = 0.0
        kept[list(parameters)] = False

    alone = chain.first <= k < chain.second
    if chain.revolute[k]:
        if alone:
            drop(_XX, _XY, _XZ, _YY, _YZ)
            if chain.without_first_moment(k):
                drop(_X, _Y)
        else:
            before[:] += np.outer(into[:, _XX] + into[:, _YY], link[_YY])
            link[_XX] -= link[_YY]
            drop(_YY)
        move(_Z, _MASS)
        if kept[10] and chain.turns_alone(k):
            link[_ZZ] += rotor
            kept[10] = False
        return

    move(*_TENSOR)
    if k < chain.first:
        drop(_X, _Y, _Z)
    elif alone and chain.along(chain.axis[k]):
        move(_X, _Y)
        drop(_Z)
    elif alone:
        # The first moment along the only direction of rotation has no effect: one component joins the others.
        u = chain.direction[k]
        last = max(i for i in range(3) if abs(u[i]) > chain.zero)
        for i in range(last):
            link[_X + i] -= u[i] / u[last] * link[_X + last]
        drop(_X + last)
    if kept[10] and chain.moves_alone_along(k):
        rotor += link[_MASS]
        move(_MASS)
