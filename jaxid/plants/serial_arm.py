"""An arm: an open chain of rigid links with revolute and prismatic joints."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.links import WithLinks
from jaxid.model.parameter import as_array, parameter
from jaxid.plants.geometry import Geometry
from jaxid.plants.rigid_tree import Tree, inverse_dynamics, pseudo_inertia

_FIRST = ("inertia*position", "free")
_SECOND = ("inertia", "free")


class SerialArm(WithLinks):
    """tau = M(q) qdd + h(q, qd), of links by ten inertial parameters each.

    `inertial` is linear in the parameters: mass, first moments and inertia of a link are about the origin of
    its frame and along its axes. `jaxid.arms.base_parameters` gives the identifiable combinations. Ports are
    the joints, and behind them the shafts: drives that turn with several joints, such as a belt to the last
    joint of a wrist that runs over the one before.

    Args:
        mass: m, (n,) [kg].
        first_moment_x, first_moment_y, first_moment_z: Mass times centre of mass, (n,) [kg m].
        inertia_xx, inertia_xy, inertia_xz, inertia_yy, inertia_yz, inertia_zz: Inertia tensor about the
            frame's origin, (n,); off its diagonal -sum of m x y and so on [kg m^2].
        rotor_inertia: Inertia of each drive, reflected to the joint, (n,) [kg m^2, or kg at a prismatic
            joint], or None for none.
        geometry: Frames of the links, the first one in the base.
        shafts: Ratios by which each shaft turns with the joints, a row of n for each shaft.
        gravity_vector: Acceleration of gravity in the base's frame, (3,) [m/s^2].
        moments: Pseudo-inertias of the links, (n, 4, 4), as `prepared` computes them from the ten parameters.

    Source:
        `jaxid.plants.rigid_tree`; Khalil & Kleinfinger (1987) for parameters about the origins of modified
        Denavit-Hartenberg frames, in which the forces are linear.
    """

    kind = "serial_arm"
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
    geometry: Geometry = eqx.field(kw_only=True)
    shafts: tuple[tuple[float, ...], ...] = eqx.field(static=True, default=(), kw_only=True)
    gravity_vector: Array = eqx.field(converter=as_array, default=(0.0, 0.0, -9.81), kw_only=True)
    moments: Array | None = eqx.field(default=None, kw_only=True)

    @property
    def joints(self) -> int:
        """Joints, as many as links."""
        return len(self.geometry.joints)

    def ports(self, q: Array) -> Array:
        return jnp.concatenate([q, np.array(self.shafts) @ q]) if self.shafts else q

    @property
    def ports_are_joints(self) -> bool:
        return not self.shafts

    def place(self, port: int) -> tuple[str, int]:
        return ("joint", port + 1) if port < self.joints else ("shaft", port - self.joints + 1)

    def motion(self, port: int) -> str:
        first = self.joints_loaded_by(port, self.joints)[0]
        return "rotary" if self.geometry.joints[first] == "revolute" else "linear"

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
        axes, origins = self.geometry.frames(q)
        whole, origin = axes[0], origins[0]
        for k in range(1, link + 1):
            origin = origin + _times(whole, origins[k])
            whole = jnp.sum(whole[:, :, None] * axes[k][None, :, :], axis=1)
        return whole, origin

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        """Return the forces of the links, whose derivatives are analytical, and of the rotors."""
        tree = Tree.chain(self.geometry.joints)
        moments = self._moments() if self.moments is None else self.moments
        tau = inverse_dynamics(tree, self.geometry, -self.gravity_vector, moments, q, qd, qdd)
        return tau if self.rotor_inertia is None else tau + self.rotor_inertia * qdd

    def prepared(self) -> SerialArm:
        return replace(self, geometry=self.geometry.at_zero(), moments=self._moments())

    def _moments(self) -> Float[Array, "n 4 4"]:
        return pseudo_inertia(self.mass, self._first_moments(), self._tensors())

    def _first_moments(self) -> Float[Array, "n 3"]:
        return jnp.stack([self.first_moment_x, self.first_moment_y, self.first_moment_z], axis=-1)

    def _tensors(self) -> Float[Array, "n 3 3"]:
        xx, xy, xz = self.inertia_xx, self.inertia_xy, self.inertia_xz
        yy, yz, zz = self.inertia_yy, self.inertia_yz, self.inertia_zz
        rows = [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]
        return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _times(matrix: Float[Array, "3 3"], x: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """Multiply a matrix and a vector without a call to a matrix library, since it is used in loops."""
    return jnp.sum(matrix * x, axis=1)
