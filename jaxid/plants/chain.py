"""A chain of masses between two walls, joined by springs."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import as_array, parameter
from jaxid.model.plant import Plant

# Effects that are a parameter of the plant by another name: on joints, and on springs.
_OF_JOINTS = {"added_mass": "mass", "viscous_friction": "damping"}
_OF_SPRINGS = {"linear_stiffness": "stiffness"}


class Chain(Plant):
    """m_i (a_i + g) + c_i v_i + k_i e_i - k_(i+1) e_(i+1) = u_i + effects; e_i = x_i - x_(i-1).

    n masses in a row, walls at both ends: x_0 = x_(n+1) = 0. Ports are the n masses and then the
    n + 1 springs, by their elongations e. g acts along a vertical chain only.

    Args:
        mass: m, (n,) [kg or kg m^2].
        damping: c, of each mass to ground, (n,) [N s/m or N m s/rad].
        stiffness: k, (n + 1,) [N/m or N m/rad].
        effects: Forces beside these, in the order of the drive.
        actuated: Masses that are driven, 0-based, in the order of their drives; None: all.
        gravity: g [m/s^2].
        vertical: Whether weight acts along the chain (positive position is up).
        sharpness: Width of the smoothed sign over `velocity_scale`, dimensionless.
        velocity_scale: A typical velocity [m/s or rad/s].
    """

    kind = "chain"
    diagonal = True

    mass: Array = parameter("inertia", "positive", "masses, one each", more=0)
    damping: Array = parameter("force*time/position", "nonnegative", "damping to ground, one a mass", more=0)
    stiffness: Array = parameter("force/position", "nonnegative", "springs, one more than masses", more=1)
    effects: tuple[Effect, ...] = eqx.field(default=(), kw_only=True)
    actuated: tuple[int, ...] | None = eqx.field(static=True, default=None, kw_only=True)
    gravity: Array = eqx.field(converter=as_array, default=9.81, kw_only=True)
    sharpness: Array = eqx.field(converter=as_array, default=1e-3, kw_only=True)
    velocity_scale: Array = eqx.field(converter=as_array, default=1.0, kw_only=True)
    vertical: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def joints(self) -> int:
        """Masses."""
        return self.mass.shape[-1]

    def own_inertia(self) -> Array:
        return self.mass

    @classmethod
    def springs(cls, joints: int) -> int:
        return joints + 1

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        pull = self.stiffness * _elongations(q)
        weight = self.mass * self.port_gravity(q)[: q.size]
        return self.mass * qdd + weight + self.damping * qd + pull[:-1] - pull[1:]

    def ports(self, q: Array) -> Array:
        return jnp.concatenate([q, _elongations(q)])

    def port_gravity(self, q: Array) -> Array:
        along = self.gravity if self.vertical else 0.0 * self.gravity
        return jnp.concatenate([jnp.full_like(q, along), jnp.zeros(q.size + 1)])

    def port_normal(self, q: Array) -> Array:
        return jnp.concatenate([self.mass * self.gravity, jnp.zeros(q.size + 1)])

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        stiffness = jnp.concatenate([jnp.zeros_like(q), self.stiffness])
        return stiffness, jnp.zeros_like(stiffness)

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        spring = port - joints
        return (port,) if spring < 0 else tuple(i for i in (spring - 1, spring) if 0 <= i < joints)

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int] | None:
        what, k = self.place(port)
        name = (_OF_JOINTS if what == "joint" else _OF_SPRINGS).get(effect.kind)
        return None if name is None else (name, k - 1)


def _elongations(q: Array) -> Array:
    """Of the springs, (n + 1,), from positions (n,)."""
    wall = jnp.zeros(1, q.dtype)
    x = jnp.concatenate([wall, q, wall])
    return x[1:] - x[:-1]
