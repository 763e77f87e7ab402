"""A single axis, linear or rotary: one inertia with forces beside it."""

from __future__ import annotations

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.parameter import parameter
from jaxid.model.weight import WithWeight


class Axis(WithWeight):
    """m (a + g) = u + effects; g acts along a vertical axis only.

    Args:
        inertia: m [kg or kg m^2].
    """

    kind = "axis"

    inertia: Array = parameter("inertia", "positive", "moving mass or moment of inertia")

    def own_inertia(self) -> Array:
        return self.inertia

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self.inertia * (qdd + self.port_gravity(q))

    def port_normal(self, q: Array) -> Array:
        return jnp.full_like(q, 1.0) * self.inertia * self.gravity
