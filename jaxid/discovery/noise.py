"""The noise in a residual: what colour the sensors give it, and what the residual says of that."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxid.discovery.columns import left_over, span, stacked
from jaxid.discovery.evidence import Whitener
from jaxid.gap import noise_density
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.numerics import filters as signals
from jaxid.numerics.precision import NoiseModel

# Part of the force that filtering, holding and integrating leave wrong in any model: an effect
# that brings less (in RMS) cannot be told from them.
NUMERICS = 1e-3
# Order of the model of the sensors' noise, and points of its spectrum.
_ORDER = 30
_POINTS = 1024
# Times that the colour of the noise is fitted again after filling it up; more change nothing.
_FILLINGS = 2


def sensor_colour(machine: Machine, log: Log, data: Prepared) -> tuple[NoiseModel, ...]:
    """Model of the noise that the sensors leave in the balance at the kept samples, by joint.

    Position noise enters with the square of the frequency and spans four decades in power. From a
    short residual with gaps no such range can be estimated, and what it hides is what tells slow
    effects apart. Force noise that is not stated is read off the high band of the logged force;
    what numerics leave wrong counts as white.

    Args:
        machine: The machine; its parameters enter through the impedance only.
        log: The log.
        data: The same, prepared.
    """
    unstated = machine.sensor.force_noise is None
    force_noise = signals.high_band_std(log.force) if unstated else None
    if unstated and data.recipe.median:
        force_noise = force_noise / signals.median_noise(data.recipe.median)
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
    """A density over `step` bands as keeping one sample in `step` folds them into one."""
    bands = [density[k * _POINTS : (k + 1) * _POINTS + 1] for k in range(step)]
    return sum(band if k % 2 == 0 else band[::-1] for k, band in enumerate(bands))


def fit_whitener(
    e: Float[np.ndarray, "kept n"],
    base: Float[np.ndarray, "kept n p"],
    extra: Float[np.ndarray, "kept n k"],
    counts: Bool[np.ndarray, "kept n"],
    colour: tuple[NoiseModel, ...],
) -> tuple[Whitener, Float[np.ndarray, " row"]]:
    """Whitener for the noise in a residual, and that noise as whitened rows.

    The colour of the residual is partly the missing effect itself: whitened with that, the effect
    would vanish. So all that might explain it has its say first. But that takes noise away too,
    where it looks, and of a short log most: what it took is filled up with noise of unit variance,
    once a first model of its colour is known, and the colour fitted again.

    Args:
        e: Residual.
        base: Columns of the model.
        extra: Columns of what might be missing.
        counts: Which samples count.
        colour: What the sensors should leave, by joint.
    """
    scale = np.array([c.innovation for c in colour])
    ready = [stacked(x, counts, scale) for x in (base, extra, e[..., None])]
    left = np.zeros_like(e)
    left.T[counts.T] = left_over(span(*ready[:2]), ready[2][:, 0])
    left *= scale
    whitener = Whitener.of(left, counts, colour)
    for _ in range(_FILLINGS):
        filled = whitener.placed(_filled(whitener, e, base, extra))
        whitener = whitener.then(Whitener.of(filled, counts))
    return whitener, _filled(whitener, e, base, extra)


def _filled(
    whitener: Whitener, e: np.ndarray, base: np.ndarray, extra: np.ndarray
) -> Float[np.ndarray, " row"]:
    q = span(whitener(base), whitener(extra))
    left = left_over(q, whitener(e[..., None])[:, 0])
    spread = np.sqrt(np.sum(left**2) / max(len(left) - q.shape[1], 1))
    return left + q @ (spread * np.random.default_rng(20240501).standard_normal(q.shape[1]))
