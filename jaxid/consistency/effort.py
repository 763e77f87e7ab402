"""A current or load beside a log, held against the force that drives the machine: how far it agrees.

What a servo reports as its load is often a magnitude, smoothed and late, in a unit of its own. The effort
is therefore compared with g f behind a first-order lag and a delay, plus an offset. A magnitude is compared
with g E|f + n|, where the ripple n is noise. Gain and offset are linear, the others are searched for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.signal
import scipy.special
from jaxtyping import Float

from jaxid.numerics.misspecified import std_under_misspecification

# Longest delay and longest lag that are tried [s], and part of the log that they may be at most: servos
# smooth their current over tens of milliseconds.
_LONGEST, _PART = 0.5, 0.05
# Points of the search along each of the two, from which the best one is refined.
_POINTS = 13
# Ripples over the RMS of the force from which the search of a magnitude starts; the last one is the largest.
_RIPPLES = (0.0, 0.3, 1.0)
# Part of a range that counts as one of its ends, and step of the derivatives there; and part of a sample by
# which a delay must differ from none.
_END, _SAMPLE = 1e-3, 0.1
# Efforts with the spectrum of the logged one and random phases; the largest agreement of so many is passed by
# chance once in a hundred times.
_DRAWN = 99
# Agreement below which most of an effort is something else than the force; its part in the gain is not known.
ENOUGH = 0.5


@dataclass(frozen=True)
class Shape:
    """The way in which an effort follows a force, gain and offset aside.

    Args:
        unsigned: Whether the effort is a magnitude.
        delay: Delay behind the force [s].
        lag: Time constant of the smoothing [s].
        ripple: Standard deviation of the noise on the force whose magnitude is taken [N or N m]; zero for a
            signed effort.
    """

    unsigned: bool
    delay: float
    lag: float
    ripple: float = 0.0

    def of(self, force: Float[np.ndarray, " time"], period: float) -> Float[np.ndarray, " time"]:
        """Return the shape of a force at samples of a period [s]."""
        given = mean_magnitude(force, self.ripple) if self.unsigned else force
        return late(given, period, self.delay, self.lag)


@dataclass(frozen=True)
class Witness:
    """An effort compared with a force.

    Args:
        shape: How the effort follows the force.
        agreement: Share of the variance of the effort that the force explains.
        chance: Largest share among efforts of the same spectrum that have nothing to do with the force.
        gain: Effort over force, in the unit of the column per N or N m.
        offset: Effort without force.
        std: Standard deviations of gain, offset, delay, lag and ripple, (5,); NaN for one of the last
            three at zero or at the end of the search.
        bent: Whether the effort of a large force grows faster than in proportion, so that it has no one gain:
            the ripple, which makes a magnitude flat at small forces, is at the end of the search.
    """

    shape: Shape
    agreement: float
    chance: float
    gain: float
    offset: float
    std: Float[np.ndarray, " 5"]
    bent: bool = False

    @property
    def agrees(self) -> bool:
        """True if the effort follows the force by more than chance."""
        return self.agreement > self.chance

    def gain_of(
        self, effort: Float[np.ndarray, " time"], force: Float[np.ndarray, " time"], period: float
    ) -> float:
        """Return the gain of another force for an effort, in the shape that was found."""
        return _fitted(effort, self.shape.of(force, period))[1]


def is_unsigned(effort: Float[np.ndarray, " time"]) -> bool:
    """Check that an effort has one sign only, as a magnitude has."""
    return bool(np.all(effort >= 0.0))


def mean_magnitude(force: Float[np.ndarray, " time"], ripple: float) -> Float[np.ndarray, " time"]:
    """Return the mean of |f + n| for normal noise n of standard deviation `ripple` (the folded normal's)."""
    if ripple <= 0.0:
        return np.abs(force)
    over = force / ripple
    bell = np.sqrt(2.0 / np.pi) * np.exp(-0.5 * over**2)
    return ripple * bell + force * scipy.special.erf(over / np.sqrt(2.0))


def late(
    force: Float[np.ndarray, " time"], period: float, delay: float, lag: float
) -> Float[np.ndarray, " time"]:
    """Return a signal behind a first-order lag and a delay.

    The lag is exact for a signal that is linear between samples; before the log it has its first value.

    Args:
        force: The signal at the samples.
        period: Sampling time [s].
        delay: Delay [s].
        lag: Time constant [s].
    """
    keeps = np.exp(-period / lag) if lag > 0.0 else 0.0
    ahead = (1.0 - keeps) * lag / period
    past, now = ahead - keeps, 1.0 - ahead
    start = scipy.signal.lfiltic([now, past], [1.0, -keeps], force[:1], force[:1])
    smooth, _ = scipy.signal.lfilter([now, past], [1.0, -keeps], force, zi=start)
    time = period * np.arange(force.size)
    return np.interp(time - delay, time, smooth)


def witness(
    effort: Float[np.ndarray, " time"],
    force: Float[np.ndarray, " time"],
    period: float,
    unsigned: bool,
) -> Witness | None:
    """Compare an effort with a force.

    Args:
        effort: Current or load, in a unit of its own, signed or a magnitude.
        force: Force of the drive at the same samples [N or N m].
        period: Sampling time [s].
        unsigned: Whether the effort is a magnitude.

    Returns:
        The comparison; None if effort or force is constant.
    """
    if np.ptp(effort) == 0.0 or np.ptp(np.abs(force) if unsigned else force) == 0.0:
        return None
    longest = min(_LONGEST, _PART * period * effort.size)
    size = float(np.sqrt(np.mean(force**2)))
    ends = np.array([longest, longest, _RIPPLES[-1] * size][: 3 if unsigned else 2])
    steps = np.linspace(0.0, longest, _POINTS)
    ripples = size * np.array(_RIPPLES if unsigned else (0.0,))
    grid = np.array([(d, t, r)[: ends.size] for r in ripples for d in steps for t in steps])

    def shaped(at: np.ndarray) -> np.ndarray:
        return Shape(unsigned, *at).of(force, period)

    # A magnitude has a positive gain; a signed effort may have its axis the other way round.
    share = lambda r: np.square(np.maximum(r, 0.0) if unsigned else r)
    columns = np.stack([_standard(shaped(at)) for at in grid])
    best = grid[int(np.argmax(share(columns @ _standard(effort))))]
    drawn = share(columns @ _surrogates(effort).T)

    left = lambda at: _fitted(effort, shaped(at))[0]
    # The solver starts inside of its bounds.
    start = np.clip(best, _END * ends, (1.0 - _END) * ends)
    found = scipy.optimize.least_squares(left, start, bounds=(0.0, ends), x_scale=ends, diff_step=_END)
    at = min((best, found.x), key=lambda at: float(np.sum(left(at) ** 2)))
    # What cannot be distinguished from none is none.
    none = np.maximum(2.0 * _END * ends, np.array([_SAMPLE * period, _SAMPLE * period, 0.0])[: ends.size])
    at = np.where(at < none, 0.0, at)
    residual, gain, offset = _fitted(effort, shaped(at))
    agreement = 1.0 - float(np.mean(residual**2) / np.var(effort))
    if unsigned and gain <= 0.0:
        agreement = 0.0

    inside = (at > 0.0) & (at < (1.0 - 2.0 * _END) * ends)
    slopes = _slopes(shaped, at, ends)
    jacobian = np.stack([shaped(at), np.ones(effort.size), *(gain * slopes)], axis=1)
    kept = np.array([True, True, *inside])
    std = np.full(5, np.nan)
    counts = np.ones((effort.size, 1), bool)
    std[: kept.size][kept] = std_under_misspecification(jacobian[:, None, kept], residual[:, None], counts)
    bent = unsigned and bool(at[2] >= (1.0 - 2.0 * _END) * ends[2])
    shape = Shape(unsigned, *map(float, at))
    return Witness(shape, agreement, float(np.max(drawn)), gain, offset, std, bent)


def _fitted(effort: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Return what gain and offset leave of an effort, and the two."""
    table = np.stack([shape, np.ones_like(shape)], axis=1)
    (gain, offset), *_ = np.linalg.lstsq(table, effort, rcond=None)
    return effort - table @ (gain, offset), float(gain), float(offset)


def _slopes(shaped: Callable[[np.ndarray], np.ndarray], at: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the derivatives of a shape by its values, (values, time)."""
    slopes = []
    for k, end in enumerate(ends):
        step = _END * end * (np.arange(ends.size) == k)
        low, high = np.maximum(at - step, 0.0), np.minimum(at + step, ends)
        slopes.append((shaped(high) - shaped(low)) / (high[k] - low[k]))
    return np.stack(slopes)


def _standard(signal: np.ndarray) -> np.ndarray:
    """Return a signal without its mean and of norm one; zero where it is constant."""
    moved = signal - np.mean(signal)
    norm = np.linalg.norm(moved)
    return moved / norm if norm > 0.0 else moved


def _surrogates(effort: np.ndarray) -> np.ndarray:
    """Return standardised signals with the spectrum of an effort and random phases, (draws, time).

    Source:
        Theiler et al. (1992), Physica D 58, 77-94: phases are randomised to keep the autocorrelation.
    """
    spectrum = np.fft.rfft(_standard(effort))
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, (_DRAWN, spectrum.size))
    drawn = np.fft.irfft(np.abs(spectrum) * np.exp(1j * phases), effort.size, axis=1)
    return np.stack([_standard(signal) for signal in drawn])
