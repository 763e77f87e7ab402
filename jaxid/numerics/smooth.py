"""Smoothed sign, absolute value, clip and dead zone: the only place where corners are rounded.

Each function takes the width over which the corner is rounded, in the units of its argument. As the
width goes to zero, each function tends to its sharp namesake.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array

_TINY = 1e-9


def sign(x: Float[Array, "..."], width: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the smoothed sign, tanh(x / width)."""
    # The compiler moves the reciprocal of a constant width out of a loop, but not a division.
    return jnp.tanh(x * (1.0 / width))


def absolute(x: Float[Array, "..."], width: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the smoothed |x|, x tanh(x / width): never above |x|, below it by at most 0.28 width."""
    return x * jnp.tanh(x / width)


def at_rest(x: Float[Array, "..."], width: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the smoothed indicator of x = 0: one at zero, 0.02 two widths away.

    It is used for forces that act only at rest (break-away friction). Its product with the smoothed sign
    peaks at `REST_PEAK`, so callers that need a peak of one divide by it.
    """
    return jnp.exp(-((x / width) ** 2))


# max over x of tanh(x) exp(-x**2), at x = 0.6247.
REST_PEAK = 0.37526


def clip(
    x: Float[Array, "..."], limit: Float[Array, "..."], width: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the smoothed clip of x to plus or minus limit, corners rounded over `width`."""
    return x - dead_zone(x, limit, width)


def within(
    x: Float[Array, "..."], limit: Float[Array, "..."], width: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the slope of `clip`: one inside plus or minus limit, zero outside."""
    return jax.nn.sigmoid((limit - x) / width) - jax.nn.sigmoid((-limit - x) / width)


def ramp(
    x: Float[Array, "..."], limit: Float[Array, "..."], width: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the smoothed clip of x to 0 below and limit above, rounded over `width`, which may be zero."""
    # For x far above a tiny limit the two corners would give a difference of infinities.
    rounded = width > _TINY * jnp.abs(x)
    safe = jnp.where(rounded, width, 1.0)
    soft = safe * (jax.nn.softplus(x / safe) - jax.nn.softplus((x - limit) / safe))
    return jnp.where(rounded, soft, jnp.clip(x, 0.0, limit))


def sharp_clip(x: Float[Array, "..."], limit: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the clip of x to plus or minus limit, not smoothed.

    It replaces `jnp.clip`, whose derivative is halved at ties, which costs two divisions in every loop.
    """
    return jnp.where(x > limit, limit, jnp.where(x < -limit, -limit, x))


def dead_zone(
    x: Float[Array, "..."], limit: Float[Array, "..."], width: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the smoothed dead zone: zero inside plus or minus limit, x minus or plus limit outside."""
    above = jax.nn.softplus((x - limit) / width)
    below = jax.nn.softplus((-x - limit) / width)
    return width * (above - below)
