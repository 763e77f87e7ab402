"""The readings of the motion in log and controller: quantised and noisy."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.stats import norm

from jaxid.arrays import Array, library
from jaxid.sensors.inertial import InertialSensors

# Noise of this many counts makes the rounding error independent of the signal
# (Schuchman 1964; Gaussian noise, to 1 %).
_DITHERS = 0.5
# Neighbouring counts on each side that a reading may take with less noise than that, and the noise in counts
# that stands for none.
_LEVELS, _NOISELESS = 3, 1e-6


class Sensor(eqx.Module):
    """An encoder and a force reading; None for figures that are not known.

    Args:
        position_resolution: Size of one count [m or rad].
        position_noise: Standard deviation of white noise before rounding [m or rad].
        force_noise: Standard deviation on the logged command, in its units.
        velocity_noise: Standard deviation of a velocity, measured in place of a position [m/s or rad/s].
        hold: Ticks of the loop for which a reading of a position is held.
        inertial: Gyroscopes and accelerometers; None if there are none.
    """

    position_resolution: Array | None = None
    position_noise: Array | None = None
    force_noise: Array | None = None
    hold: int = eqx.field(static=True, default=1)
    inertial: InertialSensors | None = None
    velocity_noise: Array | None = None

    def read(self, q: Array, noise: Array | None = None) -> Array:
        """Return the reading of a position, rounded with a straight-through gradient.

        The true derivative of rounding is zero almost everywhere and infinite in between: through
        a loop it makes sensitivities useless. The straight-through one is that of the mean.
        """
        if noise is not None and self.position_noise is not None:
            q = q + self.position_noise * noise
        if self.position_resolution is None:
            return q
        counts = jnp.round(q / self.position_resolution) * self.position_resolution
        return q + jax.lax.stop_gradient(counts - q)

    def expected(self, q: Array) -> Array:
        """Return the mean of all readings of a position, (..., n), with a straight-through gradient."""
        if self.position_resolution is None:
            return q
        count = jnp.asarray(self.position_resolution)
        noise = jnp.zeros(()) if self.position_noise is None else jnp.asarray(self.position_noise)
        parts = jnp.broadcast_to(noise / count, q.shape[-1:])[:, None]
        off = (q / count - jnp.round(q / count))[..., None]
        edges = jnp.arange(_LEVELS) + 0.5

        # A reading exceeds the nearest count by one for each edge above that the noise crosses.
        crossed = [norm.cdf((sign * off - edges) / (parts + _NOISELESS)) for sign in (1.0, -1.0)]
        rounded = count * (jnp.round(q / count) + jnp.sum(crossed[0] - crossed[1], axis=-1))
        mean = jnp.where(noise < _DITHERS * count, rounded, q)
        return q + jax.lax.stop_gradient(mean - q)

    def read_command(self, u: Array, noise: Array | None = None) -> Array:
        """Return the reading of a command, in its units."""
        return u if noise is None or self.force_noise is None else u + self.force_noise * noise

    @property
    def mean(self) -> Sensor:
        """The sensor of mean readings: without rounding, if noise of half a count or more dithers it.

        Rounding is then one more white noise. The side of a count on which a simulated reading falls is
        unrelated to that of a noisy log, and would only make a cost rough.
        """
        noise, count = self.position_noise, self.position_resolution
        if noise is None or count is None or not np.all(np.asarray(noise) >= _DITHERS * np.asarray(count)):
            return self
        return replace(self, position_resolution=None)

    @property
    def position_std(self) -> Array | None:
        """Standard deviation of the reading, rounding included; None if it is not known."""
        parts, xp = [], library(self.position_noise, self.position_resolution)
        if self.position_noise is not None:
            parts.append(xp.square(self.position_noise))
        if self.position_resolution is not None:
            parts.append(xp.square(self.position_resolution) / 12)
        return xp.sqrt(sum(parts)) if parts else None
