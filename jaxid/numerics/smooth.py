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


# Width over which the edge of a dead band is rounded in a derivative, relative to the band.
_EDGE = 0.1


@jax.custom_jvp
def outside(x: Float[Array, "..."], band: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return x where its magnitude is at least the band, else zero.

    The value is exact. Its derivative by the band, an impulse at the edge, is spread over a tenth of the
    band: summed over the samples of a passage it is that of the time at which the edge is crossed.
    """
    return jnp.where(jnp.abs(x) >= band, x, 0.0)


@outside.defjvp
def _outside_jvp(primals: tuple[Array, Array], tangents: tuple[Array, Array]) -> tuple[Array, Array]:
    x, band = primals
    moved, widened = tangents
    width = jnp.maximum(_EDGE * band, _TINY)
    # Slope of tanh((|x| - band) / width) / 2: its integral over |x| is one.
    impulse = 0.5 / width / jnp.cosh(jnp.clip((jnp.abs(x) - band) / width, -50.0, 50.0)) ** 2
    edge = x * impulse
    return outside(x, band), jnp.where(jnp.abs(x) >= band, moved, 0.0) + edge * (
        jnp.sign(x) * moved - widened
    )


def dead_zone(
    x: Float[Array, "..."], limit: Float[Array, "..."], width: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Return the smoothed dead zone: zero inside plus or minus limit, x minus or plus limit outside."""
    above = jax.nn.softplus((x - limit) / width)
    below = jax.nn.softplus((-x - limit) / width)
    return width * (above - below)
