"""The noise in a residual: its colour expected from the sensors, and its colour fitted to the residual."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxid.discovery.columns import left_over, span, stacked
from jaxid.discovery.evidence import Whitener
from jaxid.gap import noise_density
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.simulation.sensor_noise import high_band_force_noise

# Part of the force that filtering, holding and integrating leave wrong in any model: an effect with a smaller
# RMS cannot be distinguished from these errors.
NUMERICS = 1e-3
# Order of the autoregressive model of the sensors' noise, and points of its spectrum.
_ORDER = 30
_POINTS = 1024
# Number of refits of the noise colour after the fitted part is filled up; further refits change nothing.
_FILLINGS = 2
# The fillings are steady if they leave the innovations above this part of those before.
_QUIETER = 0.9


def sensor_colour(
    machine: Machine, log: Log, data: Prepared, force_noise: Float[np.ndarray, " m"] | None = None
) -> tuple[NoiseModel, ...]:
    """Model the noise that the sensors cause in the balance at the kept samples, by joint.

    Position noise enters with the square of the frequency and spans four decades in power. A short residual
    with gaps does not allow an estimate of such a range, and the weak part of the spectrum distinguishes slow
    effects. Force noise that is not stated is estimated from the high band of the logged force; errors of
    numerics count as white noise.

    Args:
        machine: The machine; its parameters enter through the impedance only.
        log: The log before preparation.
        data: The prepared log.
        force_noise: Standard deviation of the logged force in its units, (m,), if the case states none; None:
            that of its high band.
    """
    if machine.sensor.force_noise is None and force_noise is None:
        force_noise = high_band_force_noise(log, data)
    f, power = noise_density(machine, log, data, force_noise)
    step = data.recipe.decimation
    rate = log.rate_hz / step
    grid = np.linspace(0, log.rate_hz / 2, step * _POINTS + 1)
    force = data.at_kept(data.force - data.force.mean(axis=0))
    numerics = NUMERICS**2 * float(np.mean(force**2))

    models = []
    for density in power.T:
        folded = _folded(np.interp(grid, f, density), step) + numerics / (rate / 2)
        models.append(NoiseModel.of_density(folded, rate, _ORDER))
    return tuple(models)


def _folded(density: np.ndarray, step: int) -> np.ndarray:
    """Fold a density over `step` bands into one band, as decimation by `step` does."""
    bands = [density[k * _POINTS : (k + 1) * _POINTS + 1] for k in range(step)]
    return sum((band if k % 2 == 0 else band[::-1] for k, band in enumerate(bands)), start=np.zeros(()))


def fit_whitener(
    e: Float[np.ndarray, "kept n"],
    base: Float[np.ndarray, "kept n p"],
    extra: Float[np.ndarray, "kept n k"],
    counts: Bool[np.ndarray, "kept n"],
    colour: tuple[NoiseModel, ...],
    noisy: Bool[np.ndarray, " k"] | None = None,
) -> tuple[Whitener, Float[np.ndarray, " row"]]:
    """Fit a whitener to the noise in a residual, and return that noise as whitened rows.

    The colour of the residual is partly the missing effect itself, which would vanish if it were whitened
    with that colour. So all columns that might explain it are fitted first. This also removes noise from
    their span, most of it in a short log. The removed part is filled up with noise of unit variance once a
    first model of the colour is known, and the colour is fitted again.

    Columns by derivatives of noisy readings may be a filter of the noise itself, in a loop that answers to
    its encoder. They then take away a whole band of it, which looks quieter after each filling. If the
    fillings are steady without these columns, they are left out.

    Args:
        e: Force residual of the model.
        base: Columns of the model.
        extra: Columns of effects that might be missing.
        counts: Mask of the samples that count.
        colour: Noise expected from the sensors, by joint.
        noisy: Mask of the columns by derivatives of readings; None: there are none.
    """
    whitener, noise, steady = _filled_up(e, base, extra, counts, colour)
    if steady or noisy is None or not noisy.any():
        return whitener, noise
    # The innovations fall if another effect is large too, and without these columns as well.
    without, other, steady = _filled_up(e, base, extra[..., ~noisy], counts, colour)
    return (without, other) if steady else (whitener, noise)


def _filled_up(
    e: np.ndarray, base: np.ndarray, extra: np.ndarray, counts: np.ndarray, colour: tuple[NoiseModel, ...]
) -> tuple[Whitener, Float[np.ndarray, " row"], bool]:
    """Return the whitener after the fillings, the noise as whitened rows, and if the fillings are steady."""
    scale = np.array([c.innovation for c in colour])
    ready = [stacked(x, counts, scale) for x in (base, extra, e[..., None])]

    remainder = np.zeros_like(e)
    remainder.T[counts.T] = left_over(span(*ready[:2]), ready[2][:, 0])
    remainder *= scale
    whitener = Whitener.of(remainder, counts, colour)
    before = _innovation(whitener)

    for _ in range(_FILLINGS):
        filled = whitener.placed(_filled(whitener, e, base, extra))
        whitener = whitener.then(Whitener.of(filled, counts))
    return whitener, _filled(whitener, e, base, extra), _innovation(whitener) > _QUIETER * before


def _innovation(whitener: Whitener) -> float:
    """Return the innovation of a whitener's noise, the geometric mean over the joints."""
    return float(np.exp(np.mean(np.log([model.innovation for model in whitener.noise]))))


def _filled(
    whitener: Whitener, e: np.ndarray, base: np.ndarray, extra: np.ndarray
) -> Float[np.ndarray, " row"]:
    """Whiten a residual and replace its part in the span of the columns by noise of equal variance."""
    q = span(whitener(base), whitener(extra))
    remainder = left_over(q, whitener(e[..., None])[:, 0])
    spread = np.sqrt(np.sum(remainder**2) / max(len(remainder) - q.shape[1], 1))
    return remainder + q @ (spread * np.random.default_rng(20240501).standard_normal(q.shape[1]))
