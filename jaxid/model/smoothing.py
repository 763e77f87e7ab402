"""The width over which the sign of dry friction is smoothed."""

from __future__ import annotations

import equinox as eqx

from jaxid.arrays import Array
from jaxid.model.parameter import as_array


class Smoothing(eqx.Module):
    """The width of the smoothed sign, as a fraction of a typical velocity.

    Both are traced arrays, so that a continuation in the sharpness compiles once.

    Args:
        sharpness: Width over the typical velocity, dimensionless.
        velocity_scale: Typical velocity of all joints, or one for each, (n,) [m/s or rad/s].
    """

    sharpness: Array = eqx.field(converter=as_array, default=1e-3)
    velocity_scale: Array = eqx.field(converter=as_array, default=1.0)

    @property
    def width(self) -> Array:
        """Velocity over which the sign is smoothed [m/s or rad/s]."""
        return self.sharpness * self.velocity_scale
