"""The width over which the sign of dry friction is smoothed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array, library
from jaxid.model.parameter import as_array

if TYPE_CHECKING:
    from jaxid.model.plant import Plant


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


def typical_velocity(
    plant: Plant, speeds: Float[Array, "rows n"], combine: Callable[[Array], Array | float]
) -> Array:
    """Return a typical velocity of all joints, or one for each if joints have different kinds of motion.

    A root mean square over metres and radians together would have no meaning.

    Args:
        plant: The plant, which groups its joints by `velocity_groups`.
        speeds: Velocities by joint [m/s or rad/s].
        combine: The statistic of a group, such as the root mean square or the largest.

    Returns:
        A scalar for one group of joints, else (n,). A group at rest takes the value of all joints together.
    """
    xp, whole, groups = library(speeds), combine(speeds), plant.velocity_groups()
    if len(groups) == 1:
        return xp.asarray(whole)
    out = [whole] * plant.joints
    for joints in groups:
        of_group = combine(speeds[:, list(joints)])
        for k in joints:
            out[k] = xp.where(of_group > 0, of_group, whole)
    return xp.stack(out).astype(np.float64)
