"""Delays and lags of sampled signals, with a derivative by the delay and by the lag."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array


def shifted(signal: Float[Array, "time m"], shift: Array, ahead: int = 0) -> Float[Array, "time m"]:
    """Delay a signal by a number of samples, with lines between them; it stood still beyond its ends.

    Args:
        signal: Values at the samples, (time, m).
        shift: Delay in samples, not negative, one for all columns or one each.
        ahead: Samples by which the result is taken later: 1 gives the values at the ends of the intervals.
    """
    samples, width = signal.shape
    shift = jnp.broadcast_to(shift, (width,))
    whole = jnp.floor(shift)
    part = shift - whole
    at = jnp.arange(samples)[:, None] - whole.astype(int) + ahead

    def value(k: Array) -> Array:
        return jnp.take_along_axis(signal, jnp.clip(k, 0, samples - 1), axis=0)

    return (1 - part) * value(at) + part * value(at - 1)


def lagged(signal: Float[Array, "time m"], part: Array) -> Float[Array, "time m"]:
    """Low-pass a signal: each sample moves the result by a part of its distance; it starts at the first.

    Args:
        signal: Values at the samples, (time, m).
        part: Part of the distance, above zero and at most one, one for all columns or one each.
    """

    def follow(last: Array, now: Array) -> tuple[Array, Array]:
        new = last + part * (now - last)
        return new, new

    return jax.lax.scan(follow, jnp.asarray(signal[0], float), signal)[1]
