"""Coloured noise as an autoregression, and the covariance of a gradient under it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import scipy.linalg
import scipy.signal
from jaxtyping import Bool, Float

from jaxid.arrays import Array, library
from jaxid.numerics.fft import fast_length, irfft, rfft

# Samples over which a residual may be correlated; beyond them its covariance may wrap around.
_REMEMBERED = 4096
# Samples over which the innovations of two residuals may be correlated.
_COMMON = 40


@dataclass(frozen=True)
class NoiseModel:
    """Autoregressive model of a residual: e[k] = sum a[i] e[k-i] + innovation.

    Args:
        coefficients: Coefficients a of the model, (order,).
        innovation: Standard deviation of the innovation, in the unit of the residual.
    """

    coefficients: Float[np.ndarray, " order"]
    innovation: float

    @classmethod
    def fit(
        cls, e: Float[np.ndarray, " time"], counts: Bool[np.ndarray, " time"], largest: int = 40
    ) -> NoiseModel:
        """Fit a model by the Yule-Walker equations, with the order by Akaike's criterion.

        Args:
            e: Residual, (time,); entries that do not count are ignored.
            counts: Mask of the samples that count, (time,); lags across gaps use pairs that both count.
            largest: Highest order that is tried.
        """
        e = np.where(counts, e, 0.0)
        samples = max(int(counts.sum()), 1)
        largest = int(min(largest, samples // 10))
        whole = len(e) - np.arange(largest + 1.0)
        pairs = whole if counts.all() else np.maximum(_lagged(counts.astype(float), largest), 1.0)
        coefficients, order, innovation = _by_yule_walker((_lagged(e, largest) / pairs)[None], samples)
        return cls(np.asarray(coefficients[0, : order[0]]), float(innovation[0]))

    @classmethod
    def of_density(cls, power: Float[np.ndarray, " f"], rate_hz: float, order: int) -> NoiseModel:
        """Return the model of noise with a known spectrum.

        Args:
            power: One-sided density at equal steps from zero to half the sampling rate [1/Hz].
            rate_hz: Sampling rate [Hz].
            order: Order of the model.
        """
        r = np.fft.irfft(power)[: order + 1] * rate_hz / 2
        a = scipy.linalg.solve_toeplitz(r[:-1], r[1:])
        return cls(a, float(np.sqrt(r[0] - a @ r[1:])))

    def whiten(self, x: Float[np.ndarray, "time k"]) -> Float[np.ndarray, "time k"]:
        """Return the innovation of each column divided by its standard deviation."""
        out = x.copy()
        for i, a in enumerate(self.coefficients, start=1):
            out[i:] -= a * x[:-i]
        return out / self.innovation

    def whitened_counts(self, counts: Bool[np.ndarray, " time"]) -> Bool[np.ndarray, " time"]:
        """Return the mask of samples that count together with all past samples that the model uses."""
        out = counts.copy()
        for i in range(1, len(self.coefficients) + 1):
            out[i:] &= counts[:-i]
            out[:i] = False
        return out

    def density(self, size: int) -> Float[np.ndarray, " frequency"]:
        """Return the variance per rfft bin of a unit-normalised transform of length `size`."""
        a = np.concatenate([np.ones(1), -self.coefficients])
        return self.innovation**2 / np.abs(np.fft.rfft(a, size)) ** 2

    def sample(self, rng: np.random.Generator, size: int, runs: int) -> np.ndarray:
        """Draw residuals with the spectrum of this model, (runs, size)."""
        burn = 20 * (len(self.coefficients) + 5)
        white = self.innovation * rng.standard_normal((runs, size + burn))
        a = np.concatenate([np.ones(1), -self.coefficients])
        return np.asarray(scipy.signal.lfilter([1.0], a, white, axis=1))[:, burn:]


def autoregressions(
    e: Float[Array, "runs time"], largest: int = 40
) -> tuple[Float[Array, "runs largest"], Float[Array, " runs"]]:
    """Fit a `NoiseModel` to each of several residuals, of which every sample counts.

    Args:
        e: Residuals, (runs, time).
        largest: Highest order that is tried.

    Returns:
        Coefficients, zero beyond the order of a model, and the standard deviations of the innovations.
    """
    samples = e.shape[1]
    largest = int(min(largest, samples // 10))
    covariance = _lagged(e, largest) / (samples - np.arange(largest + 1.0))
    coefficients, _, innovation = _by_yule_walker(covariance, samples)
    return coefficients, innovation


def _lagged(x: Array, largest: int) -> Array:
    """Return the sums of x[k] x[k + lag] along the last axis for lags up to `largest`."""
    size = fast_length(x.shape[-1] + largest + 1)
    spectrum = rfft(x, size)
    return irfft(spectrum.real**2 + spectrum.imag**2, size)[..., : largest + 1]


def _by_yule_walker(r: Float[Array, "runs lags"], samples: int) -> tuple[Array, Array, Array]:
    """Return the models of residuals with these covariances, each of the order that Akaike's criterion takes.

    Levinson's recursion, for all residuals side by side.

    Args:
        r: Covariance of each residual at the lags from zero.
        samples: Number of samples that count.

    Returns:
        Coefficients (runs, lags - 1), zero beyond the order; orders (runs,); and standard deviations of the
        innovations (runs,).
    """
    xp, (runs, lags) = library(r), r.shape
    largest = lags - 1
    places, going = np.arange(largest), r[:, 0] > 0
    # Taper, because long lags have few pairs and an untapered estimate need not be a covariance.
    r = r * (1 - np.arange(lags) / lags * 1e-3)
    variance = xp.where(going, r[:, 0], 1.0)

    def longer(order: Any, state: tuple) -> tuple:
        a, variance, going, best, best_score, best_variance, orders = state
        mirrored = xp.take(a, (order - 2 - places) % largest, axis=1) * (places < order - 1)
        k = (xp.take(r, order, axis=1) - xp.sum(mirrored * r[:, 1:], axis=1)) / variance
        going = going & (xp.abs(k) < 1)
        k = xp.where(going, k, 0.0)[:, None]
        a = xp.where(places == order - 1, k, a - k * mirrored)
        variance = variance * (1 - k[:, 0] ** 2)
        score = samples * xp.log(variance) + 2 * order
        better = going & (score < best_score)
        held = lambda new, old: xp.where(better, new, old)
        best = xp.where(better[:, None], a, best)
        ends = held(score, best_score), held(variance, best_variance), held(order, orders)
        return a, variance, going, best, *ends

    none = np.zeros((runs, largest))
    state = (none, variance, going, none, samples * xp.log(variance), xp.where(going, r[:, 0], 0.0))
    state = (*state, np.zeros(runs, int))
    if xp is np:
        for order in range(1, lags):
            state = longer(order, state)
    else:
        state = jax.lax.fori_loop(1, lags, longer, state)
    *_, best, _, best_variance, orders = state
    return best, orders, xp.sqrt(best_variance)


def sandwich(jacobian: Float[np.ndarray, "time p"], noise: NoiseModel) -> Float[np.ndarray, "p p"]:
    """Return J' R J with J the Jacobian and R the covariance of the residual."""
    if not noise.coefficients.size:
        return noise.innovation**2 * (jacobian.T @ jacobian)
    # By rows, of which the transforms are faster.
    rows = np.ascontiguousarray(jacobian.T)[None]
    return np.asarray(sandwiches(rows, noise.coefficients[None], np.array([noise.innovation]))[0])


def sandwiches(
    rows: Float[Array, "runs p time"],
    coefficients: Float[Array, "runs order"],
    innovation: Float[Array, " runs"],
) -> Float[Array, "runs p p"]:
    """Return J' R J of many fits.

    Args:
        rows: Jacobian of each residual by rows, (runs, p, time).
        coefficients, innovation: Models of the residuals, see `NoiseModel`.
    """
    xp, time = library(rows), rows.shape[-1]
    size = fast_length(time + min(time, _REMEMBERED))
    gain = rfft(xp.concatenate([np.ones((len(coefficients), 1)), -coefficients], axis=1), size)
    # Negative frequencies count too.
    twice = np.full(gain.shape[1], 2.0)
    twice[0] = twice[(size + 1) // 2 :] = 1.0
    weight = innovation[:, None] * xp.sqrt(twice / (gain.real**2 + gain.imag**2))
    spectrum = rfft(rows, size) * weight[:, None]
    gram = lambda x: x @ xp.swapaxes(x, 1, 2)
    return (gram(spectrum.real) + gram(spectrum.imag)) / size


def cross_sandwich(
    jacobians: tuple[Float[np.ndarray, "time p"], Float[np.ndarray, "time p"]],
    noises: tuple[NoiseModel, NoiseModel],
    residuals: tuple[Float[np.ndarray, " time"], Float[np.ndarray, " time"]],
) -> Float[np.ndarray, "p p"]:
    """Return J1' R12 J2 with R12 the covariance between two residuals.

    Each residual is whitened by its model. The covariance of the two innovations is short and tapered; it
    is filtered by the two models.
    """
    time = len(jacobians[0])
    size = fast_length(time + min(time, _REMEMBERED))
    one, two = (n.whiten(e[:, None])[:, 0] for n, e in zip(noises, residuals, strict=True))
    product = rfft(one, 2 * size) * np.conj(rfft(two, 2 * size))
    lags = np.arange(-_COMMON, _COMMON + 1)
    common = np.zeros(size)
    common[lags] = irfft(product, 2 * size)[lags] / time * (1 - np.abs(lags) / (_COMMON + 1))
    first, second = (n.innovation / rfft(np.concatenate([np.ones(1), -n.coefficients]), size) for n in noises)
    weight = rfft(common) * first * np.conj(second)
    weight[1 : (size + 1) // 2] *= 2.0  # negative frequencies
    spectra = [rfft(j, size, axis=0) for j in jacobians]
    return np.real(np.conj(spectra[0]).T @ (weight[:, None] * spectra[1])) / size
