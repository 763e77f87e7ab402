"""Base parameters of an arm by closed rules: which parameters have no effect, and which join others'."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.base_parameters import BaseParameters, standard_places, tidied
from jaxid.arms.pseudo_inertia import TEN, moved
from jaxid.plants import SerialArm

_MASS, _X, _Y, _Z, _XX, _XY, _XZ, _YY, _YZ, _ZZ = range(10)
_TENSOR = (_XX, _XY, _XZ, _YY, _YZ, _ZZ)


def base_parameters_by_rules(plant: SerialArm, tolerance: float = 1e-9) -> BaseParameters:
    """Find the base parameters of an arm without its regressor, link by link from the tip to the base.

    Elimination, after (2.14)-(2.16) of the PA-10 report: what changes neither kinetic energy nor, but for a
    constant, potential energy. Regrouping, after (2.17)-(2.18): a body that looks the same however its joint
    stands may as well be part of the link before. About a revolute joint such are a mass on its axis, its
    first moment along it, and equal moments about x and y; on a prismatic one whatever only resists rotation.
    Up to the second axis that is not parallel to the first, links turn about one direction only, and more
    is without effect.

    Args:
        plant: The arm; only its geometry, direction of gravity and whether it has rotors matter.
        tolerance: Sines of angles, and lengths [m], below it count as zero. Rounding of right angles is
            1e-16; angles given to five digits ask for 1e-4.

    Returns:
        The same as `jaxid.arms.base_parameters.base_parameters` finds, without singular values.

    Raises:
        ValueError: If the arm is without weight: what does not move its own origin then has no first
            moment, which these rules do not follow; take `base_parameters`.

    Source:
        Gautier & Khalil (1990), IEEE Trans. Robotics and Automation 6(3); Khalil & Dombre (2002), chapter 9,
        for the rules, here for frames that stand anywhere and with rotors. "PA-10 traineeship", (2.14)-(2.18)
        and Appendix A, corrected: (A.1) I_yy7 + 2 d_7 mZ_7 + d_7^2 m_7; (A.2)-(A.4) with m_7 in every mass.
    """
    weight = np.asarray(plant.gravity_vector)
    if not np.linalg.norm(weight) > 0:
        raise ValueError("the closed rules need weight: give gravity_vector, or take base_parameters.")
    n, places = plant.joints, standard_places(plant)
    chain = _Chain.of(plant, tolerance)
    # Each parameter of each link as a sum of standard ones; those without effect and those regrouped vanish.
    sums = [np.zeros((10, len(places))) for _ in range(n)]
    rotors = np.zeros((n, len(places)))
    for column, (name, k) in enumerate(places):
        if name in TEN:
            sums[k][TEN.index(name), column] = 1.0
        else:
            rotors[k, column] = 1.0
    kept = np.ones((n, 11), dtype=bool)
    kept[:, 10] = plant.rotor_inertia is not None
    for k in reversed(range(n)):
        before = sums[k - 1] if k else np.zeros((10, len(places)))
        _regroup(k, chain, sums[k], before, rotors[k], kept[k])
    rows = np.concatenate([np.vstack([s, r]) for s, r in zip(sums, rotors, strict=True)])
    names = [(name, k) for k in range(n) for name in (*TEN, "rotor_inertia")]
    index = {place: row for row, (place, keep) in enumerate(zip(names, kept.ravel(), strict=True)) if keep}
    chosen = tuple(column for column, place in enumerate(places) if place in index)
    return BaseParameters(places, chosen, tidied(rows[[index[places[c]] for c in chosen]]))


@dataclass(frozen=True)
class _Chain:
    """What the rules ask of the geometry; joints count from 0.

    Args:
        revolute: Whether each joint is.
        axis: z of each frame in the base's, joints at zero, (n, 3).
        turns: z of the first revolute joint there; None where there is none.
        first, second: The first revolute joint, and the first one not parallel to it; n where there is none.
        weight: Direction of gravity.
        on_axis: Whether the origin of each link stays on the axis of the first revolute joint whatever turns.
        into: Of each link's parameters into those of the link before, joint at zero.
        direction: `turns` in each frame.
        zero: What counts as zero.
    """

    revolute: np.ndarray
    axis: np.ndarray
    turns: np.ndarray | None
    first: int
    second: int
    weight: np.ndarray
    on_axis: np.ndarray
    into: list[np.ndarray]
    direction: np.ndarray
    zero: float

    @classmethod
    def of(cls, plant: SerialArm, zero: float) -> _Chain:
        n, revolute = plant.joints, plant.geometry.revolute > 0
        axes, origins = (np.asarray(x) for x in plant.geometry.frames(jnp.zeros(n)))
        whole, at, frames, points = np.eye(3), np.zeros(3), [], []
        for turn, origin in zip(axes, origins, strict=True):
            at, whole = at + whole @ origin, whole @ turn
            frames.append(whole)
            points.append(at)
        frames, points = np.array(frames), np.array(points)
        axis, turning = frames[:, :, 2], np.flatnonzero(revolute)
        first = int(turning[0]) if turning.size else n
        turns = axis[first] if turning.size else None
        other = [k for k in turning if np.linalg.norm(np.cross(axis[k], turns)) >= zero]
        on_axis = np.zeros(n, dtype=bool)
        if turning.size:
            offset = np.linalg.norm(np.cross(points - points[first], turns), axis=1)
            away = revolute & (offset >= zero)
            on_axis = np.array([not np.any(away[first : k + 1]) for k in range(n)])
        weight = np.asarray(plant.gravity_vector)
        direction = np.zeros((n, 3)) if turns is None else np.einsum("kij,i->kj", frames, turns)
        return cls(
            revolute,
            axis,
            turns,
            first,
            int(other[0]) if other else n,
            weight / np.linalg.norm(weight),
            on_axis,
            [moved(a, o) for a, o in zip(axes, origins, strict=True)],
            direction,
            zero,
        )

    def along(self, axis: np.ndarray) -> bool:
        """Whether a direction is that of the first revolute joint."""
        return bool(np.linalg.norm(np.cross(axis, self.turns)) < self.zero)

    def slides_across(self, k: int) -> bool:
        """Whether a prismatic joint up to the k-th moves links across the only direction of rotation."""
        return any(not self.revolute[i] and not self.along(self.axis[i]) for i in range(k + 1))

    def without_first_moment(self, k: int) -> bool:
        """Whether the centre of mass of a link that turns about one direction can be anywhere."""
        return self.along(self.weight) and bool(self.on_axis[k]) and not self.slides_across(k)

    def moves_alone_along(self, k: int) -> bool:
        """Whether a link moves along its prismatic joint by that joint only, and without weight."""
        fixed = k < self.first or (k < self.second and self.along(self.axis[k]))
        others = [self.axis[i] for i in range(k) if not self.revolute[i]]
        return fixed and all(abs(self.axis[k] @ a) < self.zero for a in (*others, self.weight))

    def turns_alone(self, k: int) -> bool:
        """Whether a link turns about its revolute joint's axis by that joint only."""
        return k == self.first or (k == self.second and abs(self.axis[k] @ self.turns) < self.zero)


def _regroup(
    k: int,
    chain: _Chain,
    own: Float[np.ndarray, "10 standard"],
    before: Float[np.ndarray, "10 standard"],
    rotor: Float[np.ndarray, " standard"],
    kept: np.ndarray,
) -> None:
    """Take from a link what has no effect, or the same as part of the link before or of the rotor."""
    into = chain.into[k]

    def move(*parameters: int) -> None:
        for p in parameters:
            before[:] += np.outer(into[:, p], own[p])
        drop(*parameters)

    def drop(*parameters: int) -> None:
        own[list(parameters)] = 0.0
        kept[list(parameters)] = False

    alone = chain.first <= k < chain.second
    if chain.revolute[k]:
        if alone:
            drop(_XX, _XY, _XZ, _YY, _YZ)
            if chain.without_first_moment(k):
                drop(_X, _Y)
        else:
            before[:] += np.outer(into[:, _XX] + into[:, _YY], own[_YY])
            own[_XX] -= own[_YY]
            drop(_YY)
        move(_Z, _MASS)
        if kept[10] and chain.turns_alone(k):
            own[_ZZ] += rotor
            kept[10] = False
        return
    move(*_TENSOR)
    if k < chain.first:
        drop(_X, _Y, _Z)
    elif alone and chain.along(chain.axis[k]):
        move(_X, _Y)
        drop(_Z)
    elif alone:
        # The first moment along the only direction of rotation tells nothing: one component joins the others.
        u = chain.direction[k]
        last = max(i for i in range(3) if abs(u[i]) > chain.zero)
        for i in range(last):
            own[_X + i] -= u[i] / u[last] * own[_X + last]
        drop(_X + last)
    if kept[10] and chain.moves_alone_along(k):
        rotor += own[_MASS]
        move(_MASS)
