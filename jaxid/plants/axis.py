"""One axis, linear or rotary: a single inertia with forces beside it."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import as_array, parameter
from jaxid.model.plant import Plant


class Axis(Plant):
    """m (a + g) = u + effects; g acts along a vertical axis only.

    Args:
        inertia: m [kg or kg m^2].
        effects: Forces beside the inertia, in the order of the drive.
        gravity: g [m/s^2].
        vertical: Whether weight acts along the axis (positive position is up).
        sharpness: Width of the smoothed sign over `velocity_scale`, dimensionless.
        velocity_scale: A typical velocity [m/s or rad/s].
    """

    kind = "axis"

    inertia: Array = parameter("inertia", "positive", "moving mass or moment of inertia")
    effects: tuple[Effect, ...] = eqx.field(default=(), kw_only=True)
    gravity: Array = eqx.field(converter=as_array, default=9.81, kw_only=True)
    sharpness: Array = eqx.field(converter=as_array, default=1e-3, kw_only=True)
    velocity_scale: Array = eqx.field(converter=as_array, default=1.0, kw_only=True)
    vertical: bool = eqx.field(static=True, default=False, kw_only=True)

    def own_inertia(self) -> Array:
        return self.inertia

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self.inertia * (qdd + self.port_gravity(q))

    def port_gravity(self, q: Array) -> Array:
        return jnp.full_like(q, self.gravity) if self.vertical else jnp.zeros_like(q)

    def port_normal(self, q: Array) -> Array:
        return jnp.full_like(q, 1.0) * self.inertia * self.gravity
