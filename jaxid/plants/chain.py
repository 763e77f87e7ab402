"""A chain of masses between two walls, joined by springs."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameter
from jaxid.model.springs import WithSprings
from jaxid.model.weight import WithWeight

# Parameters of the plant that effects duplicate: on joints, and on springs.
_OF_JOINTS = {"added_mass": "mass", "viscous_friction": "damping"}
_OF_SPRINGS = {"linear_stiffness": "stiffness"}


class Chain(WithSprings, WithWeight):
    """m_i (a_i + g) + c_i v_i + k_i e_i - k_(i+1) e_(i+1) = u_i + effects; e_i = x_i - x_(i-1).

    n masses in a row, walls at both ends: x_0 = x_(n+1) = 0. Ports are the n masses and then the
    n + 1 springs, by their elongations e. g acts along a vertical chain only.

    Args:
        mass: m, (n,) [kg or kg m^2].
        damping: c, of each mass to ground, (n,) [N s/m or N m s/rad].
        stiffness: k, (n + 1,) [N/m or N m/rad].
        actuated: Masses that are driven, 0-based, in the order of their drives; None: all.
    """

    kind = "chain"
    diagonal = True

    mass: Array = parameter("inertia", "positive", "masses, one each", more=0)
    damping: Array = parameter("force*time/position", "nonnegative", "damping to ground, one a mass", more=0)
    stiffness: Array = parameter("force/position", "nonnegative", "springs, one more than masses", more=1)
    actuated: tuple[int, ...] | None = eqx.field(static=True, default=None, kw_only=True)

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

    def elongations(self, q: Array) -> Array:
        return _elongations(q)

    def spring_laws(self) -> tuple[Array, Array]:
        return self.stiffness, jnp.zeros_like(self.stiffness)

    def port_gravity(self, q: Array) -> Array:
        along = self.gravity if self.vertical else 0.0 * self.gravity
        return jnp.concatenate([jnp.full_like(q, along), jnp.zeros(q.size + 1)])

    def port_normal(self, q: Array) -> Array:
        return jnp.concatenate([self.mass * self.gravity, jnp.zeros(q.size + 1)])

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        spring = port - joints
        return (port,) if spring < 0 else tuple(i for i in (spring - 1, spring) if 0 <= i < joints)

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int] | None:
        place, k = self.place(port)
        name = (_OF_JOINTS if place == "joint" else _OF_SPRINGS).get(effect.kind)
        return None if name is None else (name, k - 1)


def _elongations(q: Array) -> Array:
    """Return the elongations of the springs, (n + 1,), from positions (n,)."""
    wall = jnp.zeros(1, q.dtype)
    x = jnp.concatenate([wall, q, wall])
    return x[1:] - x[:-1]
