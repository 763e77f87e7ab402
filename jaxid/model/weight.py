"""The weight of a plant whose joints all move along one direction."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant


class WithWeight(Plant):
    """A plant that a case may set up horizontally or vertically. It takes part in the case's [plant] keys.

    Args:
        gravity: Acceleration of gravity g [m/s^2].
        vertical: Whether weight acts along the joints (positive position is up).
    """

    gravity: Array = eqx.field(converter=as_array, default=9.81, kw_only=True)
    vertical: bool = eqx.field(static=True, default=False, kw_only=True)

    def port_gravity(self, q: Array) -> Array:
        return jnp.full_like(q, self.gravity) if self.vertical else jnp.zeros_like(q)
