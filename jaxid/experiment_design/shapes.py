"""References and inputs as a few numbers, each within its limits whatever the numbers are."""

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
# Sines of so many frequencies, a constant factor apart.
_SINES = 10
# Speeds of a tour from end to end, over the limit: what depends on speed shows at several.
_SPEEDS = (1.0, 0.5, 0.25, 0.12, 0.06)
# The centre may move over this part of the way between the limits.
_CENTRE = 0.8
# Room that a loop has to overshoot in, as part of every limit.
_ROOM = 0.02
# Order of the norm that stands for the largest value: above it by at most the number of values to
# the power of one over this, so 6 % for 60 000. The largest itself has a corner wherever two peaks
# are even, and there a descent gets stuck.
_ORDER = 200


class Shapes(eqx.Module):
    """A family of signals: weights of basis functions, a centre and an amplitude.

    Whatever the weights, the signal is scaled to the largest that keeps within the limits.

    Args:
        basis: From rest at zero back to it, largest magnitude one, (time, k).
        low, high: Range of the signal.
        step: Largest change from sample to sample; infinite where it does not matter.
    """

    basis: Float[Array, "time k"]
    low: Float[Array, " n"]
    high: Float[Array, " n"]
    step: Float[Array, " n"]

    @classmethod
    def within(
        cls, basis: Float[np.ndarray, "time k"], low: np.ndarray, high: np.ndarray, step: np.ndarray
    ) -> Shapes:
        """A family that leaves room for what a loop overshoots."""
        room = 0.5 * _ROOM * (high - low)
        values = (basis, low + room, high - room, (1 - _ROOM) * step)
        return cls(*(jnp.asarray(v, dtype=float) for v in values))

    def __call__(self, p: Float[Array, " p"]) -> Float[Array, "time n"]:
        """The signal of some numbers: weights by joint, then centres, then the amplitude."""
        n, k = self.low.size, self.basis.shape[1]
        x = self.basis @ p[: n * k].reshape(n, k).T
        half = 0.5 * (self.high - self.low)
        centre = self.low + half * (1 + _CENTRE * jnp.tanh(p[n * k : n * k + n]))
        steps = jnp.diff(x, axis=0) / self.step
        needs = jnp.concatenate([x / (self.high - centre), -x / (centre - self.low), steps, -steps])
        scale = 1.0 / largest(needs)
        return centre + jax.nn.sigmoid(p[-1]) * scale * x

    def signal(self, p: Float[np.ndarray, " p"]) -> Float[np.ndarray, "time n"]:
        """The signal of some numbers, compiled."""
        return np.asarray(_signal(self, jnp.asarray(p)))

    def numbers(self, weights: Float[np.ndarray, " k"], centre: float = 0.0) -> np.ndarray:
        """Numbers of a signal in which all joints have the same weights; 0.98 of the amplitude."""
        n = self.low.size
        return np.concatenate([np.tile(weights, n), np.full(n, np.arctanh(centre / _CENTRE)), [4.0]])

    def smaller(self, p: Float[np.ndarray, " p"], factor: float) -> np.ndarray:
        """The same signal with its amplitude times a factor below one."""
        amplitude = factor / (1 + np.exp(-p[-1]))
        return np.append(p[:-1], np.log(amplitude / (1 - amplitude)))


_signal = eqx.filter_jit(lambda shapes, p: shapes(p))


def largest(x: Float[Array, "time *n"]) -> Float[Array, "*n"]:
    """Norm of the positive values along the first axis: smooth, and never below the largest."""
    # Any scale gives the same norm; this one keeps its powers from overflowing.
    top = jax.lax.stop_gradient(jnp.maximum(x.max(axis=0), 1e-300))
    return top * jnp.sum(jax.nn.relu(x / top) ** _ORDER, axis=0) ** (1 / _ORDER)


def basis(
    samples: int,
    period: float,
    fastest_hz: float,
    ways: tuple[float, float, float],
    own: np.ndarray | None,
) -> tuple[Float[np.ndarray, "time k"], list[np.ndarray]]:
    """Basis functions, and weights to start a search from.

    Args:
        samples: Length of the signal.
        period: Between its samples [s].
        fastest_hz: Highest frequency.
        ways: Stroke, speed and acceleration of a tour from end to end.
        own: The log's own signal, (samples,); None where it has none.

    Returns:
        Sines and cosines of frequencies a constant factor apart, a tour at several speeds, and the
        log's own signal; starts are the log's own, the tour, slow sines, all sines and fast sines.
    """
    time = period * np.arange(samples)
    slowest = 1.0 / time[-1]
    frequency = np.geomspace(slowest, max(fastest_hz, 2 * slowest), _SINES)
    angle = 2 * np.pi * frequency * time[:, None]
    columns = [np.sin(angle), np.cos(angle), _tour(time, *ways)[:, None]]
    columns += [] if own is None else [own[:, None]]
    whole = np.concatenate(columns, axis=1) * _rise(time)[:, None]
    whole /= np.maximum(np.abs(whole).max(axis=0), 1e-300)
    return whole, _starts(whole.shape[1], frequency, own is not None)


def _starts(k: int, frequency: np.ndarray, has_own: bool) -> list[np.ndarray]:
    place = np.arange(_SINES)
    # Phases that do not pile up; every sine at the same peak speed, so that slow ones go far.
    phase = -np.pi * place * (place - 1) / _SINES
    flat = np.concatenate([np.cos(phase), np.sin(phase), np.zeros(k - 2 * _SINES)])
    slow = np.tile(place < _SINES // 2, 2)
    fast = np.tile(frequency / frequency[-1], 2)
    starts = [np.eye(k)[2 * _SINES]]
    for weight in (slow, np.tile(frequency[0] / frequency, 2), fast):
        weights = flat.copy()
        weights[: 2 * _SINES] *= weight
        starts.append(weights)
    return [*starts, np.eye(k)[-1]] if has_own else starts


def _rise(time: np.ndarray) -> np.ndarray:
    """From zero to one and back to zero, smooth in velocity and acceleration."""
    s = np.clip(np.minimum(time, time[-1] - time) / (_RISE * time[-1]), 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


def _tour(time: np.ndarray, stroke: float, speed: float, acceleration: float) -> np.ndarray:
    """There and back at one speed after the other, from end to end where there is time."""
    out, now, turn = np.full(time.size, -0.5 * stroke), 0.0, 0
    while now < time[-1]:
        pace = speed * _SPEEDS[turn // 2 % len(_SPEEDS)]
        # The fastest may take half of the time, and the others share the rest.
        longest = time[-1] / (4 if turn < 2 else 4 * (len(_SPEEDS) - 1))
        way = min(stroke, pace * longest) * (1 if turn % 2 == 0 else -1)
        move = plan_move(way, pace, acceleration)
        out += move.position(time - now)
        now, turn = now + move.duration, turn + 1
    return out
