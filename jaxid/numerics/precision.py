"""Precision of estimated parameters: covariance under coloured noise, and unidentifiable directions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.signal
import scipy.sparse
from jaxtyping import Bool, Float

from jaxid.arrays import Array, library
from jaxid.numerics.fft import fast_length, irfft, rfft

# A combination of parameters counts as unidentifiable if its standard deviation, expressed as force or
# position, exceeds this part of the measured signal.
_UNTOLD = 0.5
# An eigenvalue of the scaled information below this part of the largest one is rounding.
_ROUNDING = 1e-12
# An eigenvalue of one log's information below this part of its largest one says nothing about its noise.
_CLEAR = 1e-8
# Entries of a combination below this are omitted from its description.
_NEGLIGIBLE = 0.1
# Samples over which a residual may be correlated; beyond them its covariance may wrap around.
_REMEMBERED = 4096
# Samples over which the innovations of two residuals may be correlated.
_COMMON = 40
# Kinds of covariance in results, and in words where its numbers come from.
GAUSS_NEWTON, FULL_HESSIAN = "gauss_newton", "full_hessian"
POSTERIOR, LAPLACE, ROUNDING = "posterior_draws", "laplace", "simulated_rounding"
FISHER, WINDOWED = "fisher_information", "window_noise"
# Matrices that a full Hessian stands in place of, in words.
_PLAIN = {GAUSS_NEWTON: "the Gauss-Newton matrix", FISHER: "Fisher's information"}
KINDS = {
    GAUSS_NEWTON: "the Gauss-Newton matrix and the colour of the residual",
    FULL_HESSIAN: "the full Hessian and the colour of the residual",
    POSTERIOR: "draws from the posterior and the colour of the residual",
    LAPLACE: "the Gauss-Newton matrix with the prior, and the colour of the residual",
    ROUNDING: "simulated rounding of the readings",
    WINDOWED: "the noise and the friction at halts that each window holds",
    FISHER: "the Fisher information of the innovations, widened where these are coloured",
}


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


@dataclass(frozen=True)
class Precision:
    """Precision of the parameters from a Jacobian and a residual.

    Args:
        covariance: Covariance of the identifiable parameters, (p, p); rows of the others are NaN.
        identifiable: Mask of the identifiable parameters, (p,).
        unidentifiable: Unidentifiable combinations, each a dictionary from name to weight
            in the scaled parameters.
        information: Eigenvalues of the scaled information matrix, relative to the largest, (p,).
        kind: Kind of the covariance, one of `KINDS`; empty if the method has its own.
        curvature: Smallest and largest ratio of the full Hessian to Gauss-Newton's over all directions, (2,);
            None if no Hessian was computed.
        equivalent_variance: Variance of the white residual that would give each parameter its variance by
            Gauss-Newton, (p,) [unit of the residual, squared]; None if not computed.
    """

    covariance: Float[np.ndarray, "p p"]
    identifiable: Bool[np.ndarray, " p"]
    unidentifiable: list[dict[str, float]]
    information: Float[np.ndarray, " p"]
    kind: str = ""
    curvature: Float[np.ndarray, " 2"] | None = None
    equivalent_variance: Float[np.ndarray, " p"] | None = None

    @classmethod
    def unknown(cls, names: list[str]) -> Precision:
        """Return the precision of a fit of which nothing is identifiable."""
        p = len(names)
        return cls(np.full((p, p), np.nan), np.zeros(p, bool), [{n: 1.0} for n in names], np.zeros(p))

    @property
    def std(self) -> Float[np.ndarray, " p"]:
        """Standard deviations, (p,); NaN for parameters that are not identifiable."""
        return np.sqrt(np.diag(self.covariance))

    def widened(self, factor: Float[np.ndarray, " p"]) -> Precision:
        """Return the precision with each standard deviation multiplied by a factor, (p,)."""
        white = self.equivalent_variance
        return replace(
            self,
            covariance=self.covariance * np.outer(factor, factor),
            equivalent_variance=None if white is None else white * factor**2,
        )

    def first(self, names: list[str]) -> Precision:
        """Return the precision of the first parameters, which have these names, without the nuisances."""
        p = len(names)
        told = [c for c in self.unidentifiable if any(n in names for n in c)]
        return replace(
            self,
            covariance=self.covariance[:p, :p],
            identifiable=self.identifiable[:p],
            unidentifiable=told,
            equivalent_variance=None if self.equivalent_variance is None else self.equivalent_variance[:p],
        )

    def with_at_least(self, covariance: Float[np.ndarray, "p p"]) -> Precision:
        """Return the precision with another covariance, or a larger multiple where this one's std is larger.

        Args:
            covariance: Covariance of all parameters, (p, p); that of a parameter that is not identifiable is
                not taken over.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = self.std / np.sqrt(np.diag(covariance))
        factor = np.where(np.isfinite(factor), np.maximum(factor, 1.0), 1.0)
        both = np.outer(self.identifiable, self.identifiable)
        whole = np.where(both, covariance * np.outer(factor, factor), self.covariance)
        white = self.equivalent_variance
        if white is not None:
            white = white * np.where(self.identifiable, np.diag(whole) / np.diag(self.covariance), 1.0)
        return replace(self, covariance=whole, equivalent_variance=white)

    def at_least(self, std: Float[np.ndarray, " p"]) -> Precision:
        """Return the precision with standard deviations of at least these, (p,); NaN sets no limit."""
        with np.errstate(divide="ignore", invalid="ignore"):
            factor = std / self.std
        return self.widened(np.where(np.isfinite(factor), np.maximum(factor, 1.0), 1.0))

    def beside(self, std: float) -> Precision:
        """Return the precision with one more parameter, whose standard deviation is known independently."""
        p = len(self.covariance)
        covariance = np.zeros((p + 1, p + 1))
        covariance[:p, :p], covariance[p, p] = self.covariance, std**2
        return Precision(
            covariance, np.append(self.identifiable, True), self.unidentifiable, self.information
        )


def assess(
    names: list[str],
    jacobian: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    signal: float,
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    crossed: bool = False,
    solved: Float[np.ndarray, "p p"] | None = None,
    covariance: scipy.sparse.csr_array | None = None,
) -> Precision:
    """Return the precision of a least-squares fit under coloured noise, with its unidentifiable directions.

    Args:
        names: Names of the p parameters.
        jacobian: Jacobian of the residual, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        signal: 2-norm of the measured signal that the residual belongs to.
        scale: Natural size of each parameter, (p,), which decides whether its column counts as zero.
        hessian: Full Hessian of half the sum of squares, for the covariance by `hessian_covariance`, (p, p).
            It is not used if it is not positive definite; `kind` of the result says which matrix was.
        solved: Matrix of the equations that gave the estimate, (p, p), if it is not J'J, as with weights or
            instruments.
        crossed: Whether the columns of the residual have common noise, such as a reading and the command
            that a loop computes from it; otherwise they count as independent.
        covariance: Covariance of the residual at the samples that count, if it is known.

    Returns:
        The precision. Without a known covariance each column of the residual gets an autoregressive noise
        model.
    """
    if not names:
        return Precision(np.zeros((0, 0)), np.zeros(0, bool), [], np.zeros(0))
    rows = jacobian if counts.all() else np.where(counts[..., None], jacobian, 0.0)
    flat, meat = rows.reshape(-1, len(names)), _of_gradient(rows, residual, counts, crossed, covariance)
    found = assess_from_sums(names, flat.T @ flat, meat, signal, scale, hessian, solved)
    return found if covariance is None else replace(found, kind=WINDOWED)


def _of_gradient(
    rows: Float[np.ndarray, "time n p"],
    residual: Float[np.ndarray, "time n"],
    counts: Bool[np.ndarray, "time n"],
    crossed: bool,
    covariance: scipy.sparse.csr_array | None = None,
) -> Float[np.ndarray, "p p"]:
    """Return J'RJ, the covariance of the gradient, for a Jacobian that is zero where nothing counts."""
    if covariance is not None:
        return rows[counts].T @ (covariance @ rows[counts])
    meat = np.zeros((rows.shape[-1], rows.shape[-1]))
    noises = [NoiseModel.fit(e, c) for e, c in zip(residual.T, counts.T, strict=True)]
    for i, noise in enumerate(noises):
        # In a chain of many masses each balance contains few of the unknowns.
        own = np.flatnonzero(np.any(rows[:, i] != 0, axis=0))
        meat[np.ix_(own, own)] += sandwich(rows[:, i, own], noise)
    for i, j in itertools.combinations(range(len(noises)) if crossed else (), 2):
        if noises[i].innovation > 0 and noises[j].innovation > 0:
            pair = [(rows[:, k], noises[k], residual[:, k]) for k in (i, j)]
            both = cross_sandwich(*zip(*pair, strict=True))
            meat += both + both.T
    return meat


def assess_from_sums(
    names: list[str],
    gram: Float[np.ndarray, "p p"],
    meat: Float[np.ndarray, "p p"],
    signal: float,
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    solved: Float[np.ndarray, "p p"] | None = None,
) -> Precision:
    """Return the precision of a least-squares fit from its sums over the samples.

    Args:
        names: Names of the p parameters.
        gram: Matrix J'J, with J the Jacobian of the residual, (p, p).
        meat: Matrix J'RJ, with R the covariance of the residual, (p, p).
        signal, scale, hessian, solved: See `assess`.
    """
    norm = np.sqrt(np.diag(gram))
    # A column that is not finite says nothing, and would make all others not finite too.
    dead = ~np.isfinite(norm) | (norm * np.abs(scale) <= 1e-9 * signal)
    norm = np.where(dead, 1.0, norm)
    normal = (gram if solved is None else solved) / np.outer(norm, norm)
    normal[dead] = 0.0
    normal[:, dead] = 0.0
    meat = meat / np.outer(norm, norm)
    meat[dead] = 0.0
    meat[:, dead] = 0.0
    if np.all(dead) or not np.all(np.isfinite(normal)) or not np.all(np.isfinite(meat)):
        return Precision.unknown(names)
    return _precision(names, normal, meat, norm, signal, hessian)


def deviations(
    gram: Float[np.ndarray, "runs p p"],
    meat: Float[np.ndarray, "runs p p"],
    signal: Float[np.ndarray, " runs"],
    scale: Float[np.ndarray, "runs p"],
) -> tuple[Float[np.ndarray, "runs p"], Bool[np.ndarray, " runs"]]:
    """Return the standard deviations of many fits, and which of them identify all unknowns.

    The deviations of the others do not count: `assess_from_sums` says what such a fit identifies.

    Args:
        gram, meat, signal, scale: See `assess_from_sums`, of every fit.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        norm = np.sqrt(np.einsum("kii->ki", gram))
        known = np.all(norm * np.abs(scale) > 1e-9 * signal[:, None], axis=1)
        known &= np.all(np.isfinite(gram), axis=(1, 2)) & np.all(np.isfinite(meat), axis=(1, 2))
        norm = np.where(known[:, None], norm, 1.0)
        outer = norm[:, :, None] * norm[:, None]
        normal, meat = (np.where(known[:, None, None], x / outer, np.eye(len(norm.T))) for x in (gram, meat))
        values, vectors = np.linalg.eigh(normal)
        spread = _spread(vectors, meat)
        known &= ~np.any(_blind(values, spread, signal[:, None]), axis=1)
        inverse = (vectors / values[:, None]) @ np.swapaxes(vectors, 1, 2)
        return np.sqrt(np.einsum("kij,kjl,kli->ki", inverse, meat, inverse)) / norm, known


@dataclass(frozen=True)
class Rows:
    """Residual of one of several logs, at a fit of all of them.

    Args:
        jacobian: Jacobian of the residual by the unknowns of all logs, (time, n, p).
        residual: Residual at the fit, (time, n).
        counts: Mask of the samples that count, (time, n).
        signal: 2-norm of the measured signal that the residual belongs to.
        weight: Weight of the squared residual in the fit.
        covariance: Covariance of the residual at the samples that count; None: it follows from its colour.
    """

    jacobian: Float[np.ndarray, "time n p"]
    residual: Float[np.ndarray, "time n"]
    counts: Bool[np.ndarray, "time n"]
    signal: float
    weight: float = 1.0
    covariance: scipy.sparse.csr_array | None = None

    def matrices(self, norm: Float[np.ndarray, " p"], crossed: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """Return J'J and J'RJ by the unknowns over `norm`, (p, p) each, R being the residual's covariance."""
        rows = np.where(self.counts[..., None], self.jacobian, 0.0) / norm
        flat = rows.reshape(-1, len(norm))
        meat = _of_gradient(rows, self.residual, self.counts, crossed, self.covariance)
        return flat.T @ flat, meat

    @property
    def size(self) -> Float[np.ndarray, " p"]:
        """2-norm of each column of the Jacobian over the samples that count, (p,)."""
        return np.sqrt(np.sum(np.where(self.counts[..., None], self.jacobian, 0.0) ** 2, axis=(0, 1)))

    def of_one_fit(self) -> tuple[np.ndarray, int]:
        """Return the residual that a fit of this log alone would leave, (time, n), and its fitted directions.

        It is that of one Gauss-Newton step. A log that the common fit explains badly would else count as
        noisy, and be left out of it.
        """
        size = self.size
        seen = size > 0
        if not seen.any():
            return self.residual, 0
        columns = self.jacobian[self.counts][:, seen] / size[seen]
        values, vectors = np.linalg.eigh(columns.T @ columns)
        clear = values > _CLEAR * values[-1]
        basis = columns @ (vectors[:, clear] / np.sqrt(values[clear]))
        e = self.residual[self.counts]
        left = np.zeros_like(self.residual)
        left[self.counts] = e - basis @ (basis.T @ e)
        return left, int(clear.sum())

    def equivalent_variance(self) -> float:
        """Return the variance of the white residual that would inform as much as that of this log alone.

        It is the mean over the directions that the log shows; of a log that shows none, the mean square.
        """
        left, fitted = self.of_one_fit()
        count = int(self.counts.sum())
        white = float(np.sum(np.where(self.counts, left, 0.0) ** 2)) / max(count - fitted, 1)
        if not fitted:
            return white
        size = self.size
        own = replace(self, residual=left)
        normal, meat = own.matrices(np.where(size > 0, size, 1.0))
        values, vectors = np.linalg.eigh(normal)
        clear = values > _CLEAR * values[-1]
        spread = np.einsum("ik,ij,jk->k", vectors, meat, vectors)
        mean = float(np.mean(np.maximum(spread[clear], 0.0) / values[clear]))
        return mean * count / max(count - fitted, 1)


def assess_together(
    names: list[str],
    logs: Sequence[Rows],
    scale: Float[np.ndarray, " p"],
    hessian: Float[np.ndarray, "p p"] | None = None,
    crossed: bool = False,
) -> Precision:
    """Return the precision of one least-squares fit to one log or several, each with its noise and weight.

    Args:
        names: Names of the p parameters.
        logs: Residuals of the logs; of one alone the weight does not matter.
        scale: Natural size of each parameter, (p,).
        hessian: Full Hessian of half the weighted sum of squares, (p, p), see `assess`.
        crossed: Whether the columns of a residual have common noise, see `assess`.
    """
    if len(logs) == 1:
        [log] = logs
        shape = (log.jacobian, log.residual, log.counts, log.signal)
        full = None if hessian is None else hessian / log.weight
        return assess(names, *shape, scale, full, crossed, covariance=log.covariance)
    if not names:
        return Precision(np.zeros((0, 0)), np.zeros(0, bool), [], np.zeros(0))
    signal = float(np.sqrt(np.sum([log.weight * log.signal**2 for log in logs])))
    norm = np.sqrt(np.sum([log.weight * log.size**2 for log in logs], axis=0))
    dead = norm * np.abs(scale) <= 1e-9 * signal
    norm = np.where(dead, 1.0, norm)
    normal, meat = np.zeros((len(names),) * 2), np.zeros((len(names),) * 2)
    for log in logs:
        own, coloured = log.matrices(norm, crossed)
        normal += log.weight * own
        meat += log.weight**2 * coloured
    for matrix in (normal, meat):
        matrix[dead] = 0.0
        matrix[:, dead] = 0.0
    found = _precision(names, normal, meat, norm, signal, hessian)
    return found if logs[0].covariance is None else replace(found, kind=WINDOWED)


def _precision(
    names: list[str],
    normal: Float[np.ndarray, "p p"],
    meat: Float[np.ndarray, "p p"],
    norm: Float[np.ndarray, " p"],
    signal: float,
    hessian: Float[np.ndarray, "p p"] | None,
) -> Precision:
    """Return the precision by the normal matrix, the covariance of the gradient, and the scale of both."""
    values, vectors = np.linalg.eigh(normal)
    blind = _blind(values, _spread(vectors, meat), signal)
    seen, strength = vectors[:, ~blind], values[~blind]
    inverse = seen @ np.diag(1 / strength) @ seen.T if strength.size else 0 * normal
    covariance, kind, curvature = inverse @ meat @ inverse, GAUSS_NEWTON, None
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.diag(covariance) / np.diag(inverse)
    if hessian is not None and strength.size:
        inner = seen.T @ (hessian / np.outer(norm, norm)) @ seen
        curved, curvature = hessian_covariance(np.diag(strength), seen.T @ meat @ seen, inner)
        if curved is not None:
            covariance, kind = seen @ curved @ seen.T, FULL_HESSIAN
    covariance = covariance / np.outer(norm, norm)
    identifiable = ~held(vectors[:, blind])
    covariance[~identifiable] = np.nan
    covariance[:, ~identifiable] = np.nan
    untold = named_directions(names, vectors[:, blind])
    information = values / max(values[-1], 1e-300)
    return Precision(covariance, identifiable, untold, information, kind, curvature, white)


def _spread(vectors: Float[np.ndarray, "... p p"], meat: Float[np.ndarray, "... p p"]) -> np.ndarray:
    """Return the standard deviation of the gradient along each direction, (..., p)."""
    return np.sqrt(np.maximum(np.einsum("...ik,...ij,...jk->...k", vectors, meat, vectors), 0.0))


def _blind(values: Float[np.ndarray, "... p"], spread: np.ndarray, signal: np.ndarray | float) -> np.ndarray:
    """Mark the directions that are not identifiable, by the eigenvalues of the information, (..., p)."""
    loud = spread > _UNTOLD * signal * np.maximum(values, 1e-300)
    return (values < _ROUNDING * values[..., -1:]) | loud


def hessian_covariance(
    normal: Float[np.ndarray, "p p"], meat: Float[np.ndarray, "p p"], hessian: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, "p p"] | None, Float[np.ndarray, " 2"]]:
    """Return the covariance by the full Hessian, widened by the colour of the residual.

    With V the directions in which normal matrix N and Hessian H are both diagonal, V' N V = 1 and
    V' H V = L, Gauss-Newton's covariance N^-1 M N^-1 is V (V' M V) V'. By the Hessian it is
    V L^(-1/2) (V' M V) L^(-1/2) V'. For white noise M is the variance times N, and this is the variance times
    H^-1, the inverse of the observed information.

    Args:
        normal: Gauss-Newton's matrix J'J, positive definite, (p, p).
        meat: Covariance J'RJ of the gradient, with R that of the residual, (p, p).
        hessian: Full Hessian of half the sum of squares, (p, p).

    Returns:
        The covariance, (p, p), None if the Hessian is not positive definite; and the smallest and the largest
        element of L, (2,).

    Source:
        Efron and Hinkley (1978), Biometrika 65, 457-482: the observed information, and not the expected one,
        gives the variance of an estimate that its own log supports.
    """
    ratio, directions = scipy.linalg.eigh(0.5 * (hessian + hessian.T), normal)
    curvature = np.array([ratio[0], ratio[-1]])
    if not ratio[0] > 0.0:
        return None, curvature
    curved = directions / np.sqrt(ratio)
    return curved @ (directions.T @ meat @ directions) @ curved.T, curvature


def profiled_out(
    hessian: Float[np.ndarray, "q q"], kept: Bool[np.ndarray, " q"]
) -> Float[np.ndarray, "p p"] | None:
    """Return the Hessian of a cost that is minimised over all unknowns but the kept ones, (p, p).

    It is the Schur complement of the block of the others. With that block positive definite, it is positive
    definite if and only if the whole Hessian is.

    Args:
        hessian: Hessian over all unknowns at a minimum, (q, q).
        kept: Mask of the p kept unknowns, (q,).

    Returns:
        The Hessian; None if the block of the others is not positive definite, or a number is not finite.
    """
    if not np.all(np.isfinite(hessian)):
        return None
    own, others, between = (hessian[np.ix_(a, b)] for a, b in ((kept, kept), (~kept, ~kept), (~kept, kept)))
    if not others.size:
        return own
    try:
        half = scipy.linalg.solve_triangular(np.linalg.cholesky(others), between, lower=True)
    except np.linalg.LinAlgError:
        return None
    return own - half.T @ half


def held(directions: Float[np.ndarray, "p k"]) -> Bool[np.ndarray, " p"]:
    """Return the mask of unknowns that occur in unidentifiable orthonormal directions, (p,)."""
    return np.linalg.norm(directions, axis=1) > _NEGLIGIBLE


def named_directions(names: Sequence[str], directions: Float[np.ndarray, "p k"]) -> list[dict[str, float]]:
    """Return unidentifiable orthonormal directions as combinations of the unknowns by name."""
    untold = _sparse(directions)
    weight = np.abs(untold)
    # An unknown may occur only with many small weights; it is still named at least once.
    named = weight > _NEGLIGIBLE
    named |= held(directions)[:, None] & (weight >= weight.max(axis=1, keepdims=True, initial=0.0))
    return [
        {n: float(w) for n, w, there in zip(names, _signed(v), k, strict=True) if there}
        for v, k in zip(untold.T, named.T, strict=True)
    ]


def _sparse(vectors: Float[np.ndarray, "p k"]) -> Float[np.ndarray, "p k"]:
    """Return a basis of the same space in which each vector contains an unknown that no other contains.

    Eigenvectors of one eigenvalue are arbitrary mixtures: for an arm each of two dozen would name every link.
    """
    if vectors.shape[1] < 2:
        return vectors
    factors = scipy.linalg.qr(vectors.T, mode="r", pivoting=True)
    order = np.asarray(factors[-1])
    chosen = np.sort(order[: vectors.shape[1]])
    basis = np.linalg.solve(vectors[chosen].T, vectors.T).T
    return basis / np.linalg.norm(basis, axis=0)


def _signed(v: np.ndarray) -> np.ndarray:
    """Return the direction with its first named entry positive; the sign of an eigenvector is arbitrary."""
    first = v[np.argmax(np.abs(v) > _NEGLIGIBLE)]
    return v if first > 0 else -v


def hessian_notes(precision: Precision, asked: bool, plain: str = GAUSS_NEWTON) -> list[str]:
    """Return the note that says which matrix the covariance comes from, if the full Hessian was asked for.

    Args:
        precision: Precision of the unknowns.
        asked: Whether the full Hessian was asked for.
        plain: Kind of the covariance without it.
    """
    if not asked:
        return []
    if precision.curvature is None:
        return ["the full Hessian was not used: no direction is identifiable"]
    low, high = precision.curvature
    if precision.kind != FULL_HESSIAN:
        return [
            "the full Hessian is not positive definite and was not used; the covariance comes from "
            f"{KINDS[precision.kind]}"
        ]
    return [f"the full Hessian is {low:.3g} to {high:.3g} times {_PLAIN[plain]}, by direction"]


def full_hessian(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]], theta: Float[Array, " p"]
) -> Float[Array, "p p"]:
    """Return the Hessian of half the sum of squares, with the curvature of the residual."""

    def gradient(theta: Array) -> Array:
        e, push = jax.linearize(residual, theta)
        return jax.vmap(lambda b: jnp.vdot(push(b), e))(jnp.eye(theta.size))

    return jax.jacfwd(gradient)(theta)
