"""A tree of rigid links with revolute and prismatic joints, some of which may follow others."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar, Self, TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.balance import BehindSprings
from jaxid.model.effect import AddedSpring, Effect
from jaxid.model.links import WithLinks
from jaxid.model.parameter import as_array, parameter
from jaxid.numerics.elimination import small_solve
from jaxid.plants.few_joints import MOST_JOINTS, FewJoints
from jaxid.plants.geometry import Geometry
from jaxid.plants.rigid_tree import Tree, inverse_dynamics, pseudo_inertia

_FIRST = ("moment", "free")
_SECOND = ("inertia", "free")
# Evaluations of the weight by which a spring settles: it changes little over an elongation.
_SETTLES = 3


class LinkTree(WithLinks):
    """tau = M(q) qdd + h(q, qd), of links by ten inertial parameters each.

    `inertial` is linear in the parameters: mass, first moments and inertia of a link are about the origin of
    its frame and along its axes. `jaxid.arms.base_parameters` gives the identifiable combinations. Ports are
    the joints, and behind them the shafts: drives that turn with several joints, such as a belt to the last
    joint of a wrist that runs over the one before.

    A link whose joint follows another one (a gear, a mimic joint) has no coordinate of its own: it moves by
    `copies` with that joint, and its forces are projected on it.

    Args:
        mass: m, a value for each link [kg].
        first_moment_x, first_moment_y, first_moment_z: Mass times centre of mass, by link [kg m].
        inertia_xx, inertia_xy, inertia_xz, inertia_yy, inertia_yz, inertia_zz: Inertia tensor about the
            frame's origin, by link; off its diagonal -sum of m x y and so on [kg m^2].
        rotor_inertia: Inertia of each drive, (n,) [kg m^2, or kg at a prismatic joint], or None for none. It
            is that seen at the joint, or with `gear_ratio` that of the motor.
        payload: Point mass that each link carries beside its ten parameters, by link [kg], or None.
        payload_position: Position of each payload in its link's frame, (links, 3) [m]; None: the origin.
        geometry: Frame of each link in that on which it hangs.
        shafts: Ratios by which each shaft turns with the joints, a row of n for each shaft.
        gravity_vector: Acceleration of gravity in the base's frame, (3,) [m/s^2].
        parents: Index of the link on which each link hangs, -1 for the base; empty: on the one before.
        copies: The joint by which each link moves, and how much of it; empty: each link by one of its own.
        leading: Where there are `copies`, the link that each free joint moves itself.
        gear_ratio: Turns of each motor for one of its joint, (n,): rotors count times its square. None: 1.
        actuated: Driven joints, 0-based, in the order of their drives; None: all.
        moments: Pseudo-inertias of the links, (links, 4, 4), as `prepared` computes them from the parameters.
        polynomials: Forces of a chain of few joints, as `prepared` computes them from the parameters.
        at_zero: Inertia about each joint in the zero position, as `prepared` computes it for springs.

    Source:
        `jaxid.plants.rigid_tree`; Khalil & Kleinfinger (1987) for parameters about the origins of modified
        Denavit-Hartenberg frames, in which the forces are linear.
    """

    kind = "tree"
    linked = True
    coupled = True
    usual_motion = "rotary"
    # Parameters of a link to leave out first if columns depend on each other.
    regrouped: ClassVar[tuple[str, ...]] = ("first_moment_z", "mass", "inertia_yy")

    mass: Array = parameter("inertia", "nonnegative", "masses, one a link", more=0, motion="linear")
    first_moment_x: Array = parameter(*_FIRST, "m x of the centre of mass", more=0, motion="linear")
    first_moment_y: Array = parameter(*_FIRST, "m y of the centre of mass", more=0, motion="linear")
    first_moment_z: Array = parameter(*_FIRST, "m z of the centre of mass", more=0, motion="linear")
    inertia_xx: Array = parameter(*_SECOND, "about the frame's origin", more=0, motion="rotary")
    inertia_xy: Array = parameter(*_SECOND, "-sum m x y", more=0, motion="rotary")
    inertia_xz: Array = parameter(*_SECOND, "-sum m x z", more=0, motion="rotary")
    inertia_yy: Array = parameter(*_SECOND, "about the frame's origin", more=0, motion="rotary")
    inertia_yz: Array = parameter(*_SECOND, "-sum m y z", more=0, motion="rotary")
    inertia_zz: Array = parameter(*_SECOND, "about the frame's origin", more=0, motion="rotary")
    rotor_inertia: Array | None = parameter(
        "inertia", "nonnegative", "of each drive, seen at the joint", optional=True, more=0
    )
    payload: Array | None = parameter(
        "inertia",
        "nonnegative",
        "point masses that links of a tree carry, see payload_at",
        optional=True,
        more=0,
        motion="linear",
    )
    payload_position: Array | None = eqx.field(
        converter=lambda x: None if x is None else as_array(x), default=None, kw_only=True
    )
    geometry: Geometry = eqx.field(kw_only=True)
    shafts: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(), kw_only=True)
    gravity_vector: Array = eqx.field(converter=as_array, default=(0.0, 0.0, -9.81), kw_only=True)
    parents: tuple[int, ...] = eqx.field(static=True, default=(), kw_only=True)
    copies: tuple[tuple[int, float], ...] = eqx.field(static=True, default=(), kw_only=True)
    leading: tuple[int, ...] = eqx.field(static=True, default=(), kw_only=True)
    gear_ratio: Array | None = eqx.field(
        converter=lambda x: None if x is None else as_array(x), default=None, kw_only=True
    )
    actuated: tuple[int, ...] | None = eqx.field(static=True, default=None, kw_only=True)
    moments: Array | None = eqx.field(default=None, kw_only=True)
    polynomials: FewJoints | None = eqx.field(default=None, kw_only=True)
    at_zero: Array | None = eqx.field(default=None, kw_only=True)

    @property
    def joints(self) -> int:
        """Joints that move freely: as many as links, less those that follow another one."""
        return len(self.leading) if self.copies else len(self.geometry.joints)

    @property
    def tree(self) -> Tree:
        """The order of the links."""
        kinds = self.geometry.joints
        if not self.parents:
            return Tree.chain(kinds)
        return Tree(self.parents, tuple(kind == "revolute" for kind in kinds))

    def first_link(self, joint: int) -> int:
        """Return the link that a joint moves, both from 0; further ones may follow."""
        return self.leading[joint] if self.copies else joint

    def way(self, link: int) -> list[int]:
        """Return the links from the base to one of them, that one included."""
        parents, out = self.tree.parents, [link]
        while parents[out[-1]] >= 0:
            out.append(parents[out[-1]])
        return out[::-1]

    def ports(self, q: Array) -> Array:
        return jnp.concatenate([q, np.array(self.shafts) @ q]) if self.shafts else q

    @property
    def ports_are_joints(self) -> bool:
        return not self.shafts

    def place(self, port: int) -> tuple[str, int]:
        return ("joint", port + 1) if port < self.joints else ("shaft", port - self.joints + 1)

    def motion(self, port: int) -> str:
        first = self.joints_loaded_by(port, self.joints)[0]
        return "rotary" if self.geometry.joints[self.first_link(first)] == "revolute" else "linear"

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        return (port,) if port < joints else tuple(np.flatnonzero(self.shafts[port - joints]).tolist())

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int] | None:
        return ("rotor_inertia", port) if effect.kind == "added_mass" and port < self.joints else None

    @property
    def base_gravity(self) -> Array:
        return jnp.asarray(self.gravity_vector)

    @classmethod
    def links(cls, joints: int) -> int:
        return joints

    def frame(self, link: int, q: Array) -> tuple[Array, Array]:
        axes, origins = self.geometry.frames(self.of_links(q))
        first, *rest = self.way(self.first_link(link))
        whole, origin = axes[first], origins[first]
        for k in rest:
            origin = origin + _times(whole, origins[k])
            whole = jnp.sum(whole[:, :, None] * axes[k][None, :, :], axis=1)
        return whole, origin

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the forces of the links, whose derivatives are analytical, and of the rotors."""
        return self._of_links_alone(q, qd, qdd) + self._of_rotors(qdd)

    def _of_rotors(self, qdd: Array) -> Array | float:
        if self.rotor_inertia is None:
            return 0.0
        return self.rotor_inertia * (qdd if self.gear_ratio is None else self.gear_ratio**2 * qdd)

    def _of_links_alone(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self._links_force(q, qd, qdd) if self.polynomials is None else self.polynomials(q, qd, qdd)

    def behind_springs(
        self, q: Array, qd: Array, qdd: Array, u: Array, states: tuple
    ) -> BehindSprings | None:
        """Return the forces of the arm with links behind springs, each by its own.

        An inertia J behind the spring of a joint stands for the part J / M of the links that turn with the
        joint. M is their inertia in the arm's zero position. If J = M, the rotor alone is in front.
        The spring of a shaft has a constant inertia behind it.
        """
        springs = self._springs(states)
        if not springs:
            return None
        joints = [joint for joint, _, _ in springs]
        parts = [spring.load_inertia / self._inertia_at_zero(joint) for joint, spring, _ in springs]
        at, units = self._beyond(q, qd, springs), jnp.asarray(np.eye(q.size)[joints])
        pulls = [spring.spring(state)[2] for _, spring, state in springs]

        force = functools.partial(self._of_links_alone, *at)
        before, columns = force(qdd), jax.vmap(lambda unit: jax.jvp(force, (qdd,), (unit,))[1])(units)
        own = jnp.stack([columns[:, joint] for joint in joints])
        missing = [
            -pull / part - before[joint] for joint, part, pull in zip(joints, parts, pulls, strict=True)
        ]
        edd = small_solve(own, jnp.stack(missing))
        links = before + jnp.sum(columns * edd[:, None], axis=0)

        # In front of a spring is that part of the links which is not behind it.
        share, mean = dict(zip(joints, parts, strict=True)), sum(parts) / len(parts)
        front = self._of_links_alone(q, qd, qdd)
        rows = [front[k] + share.get(k, mean) * (links[k] - front[k]) for k in range(q.size)]
        turning = dict(zip(joints, edd, strict=True))
        elongating = [turning.get(k) for k in range(self.ports(q).size)]
        return BehindSprings(jnp.stack(rows) + self._of_rotors(qdd), tuple(elongating))

    def beyond_springs(self, q: Array, qd: Array, states: tuple) -> tuple[Array, Array] | None:
        springs = self._springs(states)
        return self._beyond(q, qd, springs) if springs else None

    def _beyond(
        self, q: Array, qd: Array, springs: Sequence[tuple[int, AddedSpring, Array]]
    ) -> tuple[Array, Array]:
        for joint, spring, state in springs:
            (e, ed, _), unit = spring.spring(state), np.eye(q.size)[joint]
            q, qd = q + e * unit, qd + ed * unit
        return q, qd

    def resting_states(self, q: Array, u: Array) -> tuple:
        states, still = list(self.initial_states(u)), jnp.zeros_like(q)
        springs = {k: e for k, e in enumerate(self.effects) if self._stretches(e)}
        for _ in range(_SETTLES if springs else 0):
            at = self._beyond(q, still, [(e.port, e, states[k]) for k, e in springs.items()])[0]
            weight = self._of_links_alone(at, still, still)
            for k, e in springs.items():
                states[k] = e.pulling(-e.load_inertia / self._inertia_at_zero(e.port) * weight[e.port])
        return tuple(states)

    def _springs(self, states: tuple) -> list[tuple[int, AddedSpring, Array]]:
        """Return joint, effect and internal state of each spring that an effect adds to a joint."""
        pairs = zip(self.effects, states, strict=True)
        return [(e.port, e, z) for e, z in pairs if self._stretches(e)]

    def _stretches(self, effect: Effect) -> TypeGuard[AddedSpring]:
        return isinstance(effect, AddedSpring) and effect.port < self.joints

    def inertias_at_zero(self) -> Float[Array, " n"]:
        """Return the inertia of the links about each joint in the arm's zero position, without payload."""
        return jnp.stack([self._inertia_at_zero(joint) for joint in range(self.joints)])

    def _inertia_at_zero(self, joint: int) -> Array:
        """Return the inertia of the links about a joint in the arm's zero position, without payload."""
        if self.at_zero is not None:
            return self.at_zero[joint]
        still, unit = jnp.zeros(self.joints), jnp.asarray(np.eye(self.joints)[joint])
        bare = replace(self, payload=None, moments=None, polynomials=None)
        return jax.jvp(lambda a: bare._links_force(still, still, a), (still,), (unit,))[1][joint]

    def prepared(self) -> Self:
        geometry, moments, polynomials = self.geometry.at_zero(), self._moments(), None
        if self._is_chain and self.joints <= MOST_JOINTS:
            polynomials = FewJoints.of(self.tree, geometry, -self.gravity_vector, moments)
        at_zero = None
        if any(map(self._stretches, self.effects)):
            at_zero = self.inertias_at_zero()
        return replace(self, geometry=geometry, moments=moments, polynomials=polynomials, at_zero=at_zero)

    @property
    def _is_chain(self) -> bool:
        """True if each link hangs on the one before, by a joint of its own."""
        return not self.copies and self.tree.parents == tuple(range(-1, self.joints - 1))

    def _links_force(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the forces of the links by their recursion."""
        moments = self._moments() if self.moments is None else self.moments
        motion = (self.of_links(x) for x in (q, qd, qdd))
        tau = inverse_dynamics(self.tree, self.geometry, -self.gravity_vector, moments, *motion)
        return jnp.sum(self._ratios().T * tau[None, :], axis=1) if self.copies else tau

    def _ratios(self) -> Float[np.ndarray, "links n"]:
        """Return how much each link's joint moves with each free joint."""
        out = np.zeros((len(self.copies), self.joints))
        for link, (joint, ratio) in enumerate(self.copies):
            out[link, joint] = ratio
        return out

    def of_links(self, x: Float[Array, " n"]) -> Float[Array, " links"]:
        """Return the motion of each link's joint, from that of the free ones."""
        return jnp.sum(self._ratios() * x[None, :], axis=1) if self.copies else x

    def _moments(self) -> Float[Array, "links 4 4"]:
        links = pseudo_inertia(self.mass, self._first_moments(), self._tensors())
        if self.payload is None:
            return links
        points = self.payload_position
        if points is None:
            points = jnp.zeros((len(self.payload), 3))
        points = jnp.concatenate([points, jnp.ones_like(points[:, :1])], axis=1)
        return links + self.payload[:, None, None] * points[:, :, None] * points[:, None, :]

    def _first_moments(self) -> Float[Array, "links 3"]:
        return jnp.stack([self.first_moment_x, self.first_moment_y, self.first_moment_z], axis=-1)

    def _tensors(self) -> Float[Array, "links 3 3"]:
        xx, xy, xz = self.inertia_xx, self.inertia_xy, self.inertia_xz
        yy, yz, zz = self.inertia_yy, self.inertia_yz, self.inertia_zz
        rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _times(matrix: Float[Array, "3 3"], x: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """Multiply a matrix and a vector without a call to a matrix library, since it is used in loops."""
    return jnp.sum(matrix * x, axis=1)
