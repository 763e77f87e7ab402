"""Springs between the joints of a plant, as ports on which effects act."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.plant import Plant


class WithSprings(Plant):
    """A plant with springs: behind the joints, ports are their elongations.

    A plant that takes this on writes `elongations` and `spring_laws`, and `springs` if there are several.
    """

    def elongations(self, q: Float[Array, " n"]) -> Float[Array, " s"]:
        """Return the elongation of each spring [m or rad]."""
        raise NotImplementedError

    def spring_laws(self) -> tuple[Float[Array, " s"], Float[Array, " s"]]:
        """Return stiffness [N/m or N m/rad] and damping [N s/m or N m s/rad] of each spring."""
        raise NotImplementedError

    @classmethod
    def springs(cls, joints: int) -> int:
        return 1

    def ports(self, q: Array) -> Array:
        return jnp.concatenate([q, self.elongations(q)])

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        none = jnp.zeros_like(q)
        stiffness, damping = self.spring_laws()
        return jnp.concatenate([none, stiffness]), jnp.concatenate([none, damping])

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        return (port,) if port < joints else tuple(range(joints))
