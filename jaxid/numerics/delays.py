"""Delays, lags and limits of the rates of sampled signals, with derivatives by their parameters."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.numerics.smooth import sharp_clip


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


def shifted_hold(signal: Float[Array, "time m"], shift: Array) -> tuple[Array, Array]:
    """Delay a signal that is held from sample to sample; return a line's values at the ends of each interval.

    With a part of a sample in the delay, the older value acts for that part of the interval and the newer one
    for the rest. The line has the same mean and the same first moment, so that a mass moves as under the two
    values, in velocity and position.

    Args:
        signal: Values at the samples, (time, m).
        shift: Delay in samples, not negative, one for all columns or one each.

    Returns:
        Values at the starts and at the ends of the intervals, (time, m) each.
    """
    mean = shifted(signal, shift)
    part = shift - jnp.floor(shift)
    newer, older = (shifted(signal, jnp.floor(shift) + k) for k in (0, 1))
    lean = 3.0 * part * (1.0 - part) * (newer - older)
    return mean - lean, mean + lean


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


def slewed(signal: Float[Array, "time m"], limit: Array, period: float) -> Float[Array, "time m"]:
    """Follow a signal with a limited velocity; the result starts at the first sample.

    Args:
        signal: Target at the samples, (time, m).
        limit: Largest velocity, above zero, one for all columns or one each [unit of the signal / s].
        period: Time between two samples [s].
    """

    def follow(last: Array, now: Array) -> tuple[Array, Array]:
        new = last + sharp_clip(now - last, limit * period)
        return new, new

    first = jnp.asarray(signal[0], float)
    return jax.lax.scan(follow, first + jnp.zeros_like(limit), signal)[1]


def accelerated(signal: Float[Array, "time m"], limit: Array, period: float) -> Float[Array, "time m"]:
    """Follow a signal with a limited acceleration, so as to stop at its present value without overshoot.

    At each sample the profile has the largest velocity from which it can stop at the signal, as far as the
    limit lets it change: the trapezoidal, or triangular, course of a point-to-point motion, with a new target
    at every sample. It starts at rest at the first sample. All pieces are joined continuously, so that
    derivatives by signal and limit are those of the pieces.

    Args:
        signal: Target at the samples, (time, m).
        limit: Largest acceleration, above zero, one for all columns or one each [unit of the signal / s^2].
        period: Time between two samples [s].

    Returns:
        The profile at the samples, (time, m).
    """
    gain = limit * period

    def follow(state: tuple[Array, Array], target: Array) -> tuple[tuple[Array, Array], Array]:
        now, speed = state
        away = target - now
        # Braking by `gain` a sample from v takes v^2 / (2 limit) + v period / 2.
        near = jnp.abs(away) <= gain * period
        root = jnp.sqrt(0.25 * gain**2 + 2.0 * limit * jnp.where(near, 0.0, jnp.abs(away)))
        wanted = jnp.where(near, away / period, jnp.sign(away) * (root - 0.5 * gain))
        speed = speed + sharp_clip(wanted - speed, gain)
        now = now + period * speed
        return (now, speed), now

    first = jnp.asarray(signal[0], float)
    return jax.lax.scan(follow, (first, jnp.zeros_like(first) * gain), signal)[1]
