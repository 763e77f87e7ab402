"""The drives of a plant: the joints on which they act, and the conversion of quantities by joint."""

from __future__ import annotations

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array


class Drives(eqx.Module):
    """The part of every plant that knows its drives. A plant states `actuated` if a joint has none."""

    # Joints with a drive, 0-based, in the order of their drives; None: all joints, in their order.
    # Not annotated, since a class may make it a field of its instances.
    actuated = None

    # Number of joints; a plant whose parameter lists have as many entries as joints makes it a property.
    joints: ClassVar[int] = 1

    @property
    def gearing(self) -> Array | float:
        """Force at each driven joint per unit of force of its drive: known gear ratios.

        `balance` counts forces at the joints; the gain of a machine contains these ratios.
        """
        return 1.0

    def drive_of(self, port: int, drives: int) -> int | None:
        """Return the index of the drive that acts on a port; None if it has none."""
        if self.actuated is None:
            return port if port < drives else None
        return self.actuated.index(port) if port in self.actuated else None

    def at_drives(self, x: Array) -> Array:
        """Pick the driven joints, by drive, from a quantity by joint (its last axis)."""
        return x if self.actuated is None else x[..., list(self.actuated)]

    def driven(self, coordinates: int) -> tuple[int, ...]:
        """Return the driven joints in the order of their drives."""
        return tuple(int(i) for i in self.at_drives(np.arange(coordinates)))

    def applied(self, u: Array, coordinates: int) -> Array:
        """Return the generalized forces of the drives, by coordinate."""
        if self.actuated is None:
            return u
        drives = [self.drive_of(i, u.size) for i in range(coordinates)]
        return jnp.stack([jnp.zeros((), u.dtype) if j is None else u[j] for j in drives])
