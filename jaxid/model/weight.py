"""The weight of a plant, for plants that a case places in the field of gravity."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import STANDARD_GRAVITY
from jaxid.model.parameter import as_array
from jaxid.model.plant import Plant


class WithGravity(Plant):
    """A plant that depends on gravity. A case may state `gravity` in its [plant] table.

    Args:
        gravity: Acceleration of gravity g [m/s^2].
    """

    gravity: Array = eqx.field(converter=as_array, default=STANDARD_GRAVITY, kw_only=True)

    @property
    def field(self) -> Array:
        return self.gravity


class WithWeight(WithGravity):
    """A plant whose joints all move along one direction, horizontally or vertically, as a case states.

    Args:
        vertical: Whether weight acts along the joints (positive position is up).
    """

    vertical: bool = eqx.field(static=True, default=False, kw_only=True)

    def port_gravity(self, q: Array) -> Array:
        return jnp.full_like(q, self.gravity) if self.vertical else jnp.zeros_like(q)
