"""Families of references and inputs with a few numbers, within their limits for any values of the numbers."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.references.moves import plan_move

# Part of the time in which a signal rises from rest, and returns to it at the end.
_RISE = 0.04
# Number of frequencies of sines, spaced by a constant factor.
_SINES = 10
# Speeds of a tour from end to end, relative to the limit: forces that depend on speed need several.
_SPEEDS = (1.0, 0.5, 0.25, 0.12, 0.06)
# The centre may move over this part of the range between the limits.
_CENTRE = 0.8
# Part of every limit that is reserved for the overshoot of a loop.
_ROOM = 0.02
# Order of the norm that replaces the maximum. It exceeds the maximum by at most the number of values to the
# power of one over the order, so 6 % for 60 000. The maximum itself has a kink at two equal peaks, at which a
# descent gets stuck.
_ORDER = 200


class Shapes(eqx.Module):
    """A family of signals: weights of basis functions, a centre and an amplitude.

    For any weights the signal is scaled to the largest amplitude within the limits.

    Args:
        basis: Functions from rest at zero and back to it, of largest magnitude one, (time, k).
        low, high: Range of the signal, (n,).
        step: Largest change from sample to sample, (n,); infinite without a limit.
        curve: Largest change of that change, (n,); None: no limit.
    """

    basis: Float[Array, "time k"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    step: Float[Array, " n"]
    curve: Float[Array, " n"] | None = None

    @classmethod
    def within(
        cls,
        basis: Float[np.ndarray, "time k"],
        low: np.ndarray,
        high: np.ndarray,
        step: np.ndarray,
        curve: np.ndarray | None = None,
    ) -> Shapes:
        """Build a family with room for the overshoot of a loop."""
        room = 0.5 * _ROOM * (high - low)
        bend = None if curve is None else jnp.asarray((1 - _ROOM) * curve, dtype=float)
        values = (basis, low + room, high - room, (1 - _ROOM) * step)
        functions, least, most, pace = (jnp.asarray(v, dtype=float) for v in values)
        return cls(functions, least, most, pace, bend)

    def __call__(self, p: Float[Array, " p"]) -> Float[Array, "time n"]:
        """Return the signal of some numbers: weights by joint, then centres, then the amplitude."""
        n, k = self.low.size, self.basis.shape[1]
        x = self.basis @ p[: n * k].reshape(n, k).T
        half = 0.5 * (self.high - self.low)
        centre = self.low + half * (1 + _CENTRE * jnp.tanh(p[n * k : n * k + n]))
        steps = jnp.diff(x, axis=0) / self.step
        needs = [x / (self.high - centre), -x / (centre - self.low), steps, -steps]
        if self.curve is not None:
            bends = jnp.diff(x, n=2, axis=0) / self.curve
            needs += [bends, -bends]
        scale = 1.0 / largest(jnp.concatenate(needs))
        return centre + jax.nn.sigmoid(p[-1]) * scale * x

    def signal(self, p: Float[np.ndarray, " p"]) -> Float[np.ndarray, "time n"]:
        """Return the signal of some numbers, by compiled code."""
        return np.asarray(_signal(self, jnp.asarray(p)))

    def numbers(self, weights: Float[np.ndarray, " k"], centre: float = 0.0) -> np.ndarray:
        """Return the numbers of a signal with the same weights for all joints, at 0.98 of the amplitude."""
        n = self.low.size
        return np.concatenate([np.tile(weights, n), np.full(n, np.arctanh(centre / _CENTRE)), [4.0]])

    def smaller(self, p: Float[np.ndarray, " p"], factor: float) -> np.ndarray:
        """Return the numbers of the same signal with its amplitude reduced by a factor below one."""
        amplitude = factor / (1 + np.exp(-p[-1]))
        return np.append(p[:-1], np.log(amplitude / (1 - amplitude)))


_signal = eqx.filter_jit(lambda shapes, p: shapes(p))


def largest(x: Float[Array, "time *n"]) -> Float[Array, "*n"]:
    """Return a smooth bound of the largest positive value along the first axis, never below it."""
    # The norm does not depend on this scale, which keeps its powers from overflowing.
    top = jax.lax.stop_gradient(jnp.maximum(x.max(axis=0), 1e-300))
    return top * jnp.sum(jax.nn.relu(x / top) ** _ORDER, axis=0) ** (1 / _ORDER)


def basis(
    samples: int,
    period: float,
    fastest_hz: float,
    tour: tuple[float, float, float],
    log_signal: np.ndarray | None,
) -> tuple[Float[np.ndarray, "time k"], list[np.ndarray]]:
    """Build basis functions, and weights from which a search starts.

    Args:
        samples: Number of samples of the signal.
        period: Time between samples [s].
        fastest_hz: Highest frequency of the sines.
        tour: Stroke, speed and acceleration of a tour from end to end.
        log_signal: The signal of the log, (samples,); None if there is none.

    Returns:
        Sines and cosines of frequencies spaced by a constant factor, a tour at several speeds, and the log's
        signal; and the starts: the tour, slow sines, sines of equal speed, fast sines, and the log's signal.
    """
    time = period * np.arange(samples)
    slowest = 1.0 / time[-1]
    frequency = np.geomspace(slowest, max(fastest_hz, 2 * slowest), _SINES)
    angle = 2 * np.pi * frequency * time[:, None]
    columns = [np.sin(angle), np.cos(angle), _tour(time, *tour)[:, None]]
    columns += [] if log_signal is None else [log_signal[:, None]]
    whole = np.concatenate(columns, axis=1) * _rise(time)[:, None]
    whole /= np.maximum(np.abs(whole).max(axis=0), 1e-300)
    return whole, _starts(whole.shape[1], frequency, log_signal is not None)


def _starts(k: int, frequency: np.ndarray, has_log_signal: bool) -> list[np.ndarray]:
    """Return the weights of the starts, with phases that keep the peaks of sines from coinciding."""
    place = np.arange(_SINES)
    # Every sine has the same peak speed, so that slow ones go far.
    phase = -np.pi * place * (place - 1) / _SINES
    flat = np.concatenate([np.cos(phase), np.sin(phase), np.zeros(k - 2 * _SINES)])
    slow = np.tile(place < _SINES // 2, 2)
    fast = np.tile(frequency / frequency[-1], 2)
    starts = [np.eye(k)[2 * _SINES]]
    for weight in (slow, np.tile(frequency[0] / frequency, 2), fast):
        weights = flat.copy()
        weights[: 2 * _SINES] *= weight
        starts.append(weights)
    return [*starts, np.eye(k)[-1]] if has_log_signal else starts


def _rise(time: np.ndarray) -> np.ndarray:
    """Rise from zero to one and fall back to zero, smoothly in velocity and acceleration."""
    s = np.clip(np.minimum(time, time[-1] - time) / (_RISE * time[-1]), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _tour(time: np.ndarray, stroke: float, speed: float, acceleration: float) -> np.ndarray:
    """Move there and back at one speed after the other, from end to end if the time suffices."""
    out, now, turn = np.full(time.size, -0.5 * stroke), 0.0, 0
    while now < time[-1]:
        pace = speed * _SPEEDS[turn // 2 % len(_SPEEDS)]
        # The fastest speed may take half of the time, and the others share the rest.
        longest = time[-1] / (4 if turn < 2 else 4 * (len(_SPEEDS) - 1))
        way = min(stroke, pace * longest) * (1 if turn % 2 == 0 else -1)
        move = plan_move(way, pace, acceleration)
        out += move.position(time - now)
        now, turn = now + move.duration, turn + 1
    return out
