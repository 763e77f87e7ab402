"""What the log and the controller see of the motion: quantised, noisy readings."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


class Sensor(eqx.Module):
    """An encoder and a force reading; None where a figure is not known.

    Args:
        position_resolution: One count [m or rad].
        position_noise: Standard deviation of white noise before rounding [m or rad].
        force_noise: Standard deviation on the logged command, in its units.
    """

    position_resolution: Array | None = None
    position_noise: Array | None = None
    force_noise: Array | None = None

    def read(self, q: Array, noise: Array | None = None) -> Array:
        """Reading of a position; rounded with a straight-through gradient.

        The true derivative of rounding is zero almost everywhere and infinite in between: through
        a loop it makes sensitivities useless. The straight-through one is that of the mean.
        """
        if noise is not None and self.position_noise is not None:
            q = q + self.position_noise * noise
        if self.position_resolution is None:
            return q
        counts = jnp.round(q / self.position_resolution) * self.position_resolution
        return q + jax.lax.stop_gradient(counts - q)

    @property
    def position_std(self) -> Array | None:
        """Standard deviation of the reading, rounding included; None where nothing is known."""
        parts = []
        if self.position_noise is not None:
            parts.append(jnp.square(self.position_noise))
        if self.position_resolution is not None:
            parts.append(jnp.square(self.position_resolution) / 12)
        return jnp.sqrt(sum(parts)) if parts else None
