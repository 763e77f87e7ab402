"""Cut-off and decimation for a minimal model, chosen from its natural frequencies and the noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.signal
from jaxtyping import Float

from jaxid.estimators.minimal.models import Structure
from jaxid.logs.log import Log
from jaxid.logs.prepare import A_PERIOD, Recipe, choose_recipe, spaced, trimmed
from jaxid.machine import Machine
from jaxid.numerics import filters as signals
from jaxid.settings import Preprocess
from jaxid.simulation.sensor_noise import position_noise

# Edge of the band over the highest natural frequency, as published (60 for 30 Hz).
_ABOVE = 2.0
# Least value of that ratio when noise lowers the edge: the stiffness is identifiable by the resonance only.
_AT_LEAST = 1.2
# Signal-to-noise ratio of power at which the band ends.
_OVER_NOISE = 4.0
# Periods of the band's edge that are trimmed at each end: higher derivatives have long transients.
_ENDS = 6


@dataclass(frozen=True)
class Spectrum:
    """Spectra of force and noise in a row of a model, at some plant.

    Args:
        frequency: Frequencies, (f,) [Hz].
        force: Power spectral density of the declared force, (f,) [N^2/Hz].
        noise: Density of the noise of the force and of the encoders as the model's derivatives amplify it,
            (f,) [N^2/Hz].
        natural: Natural frequencies, (modes,) [Hz].
    """

    frequency: Float[np.ndarray, " f"]
    force: Float[np.ndarray, " f"]
    noise: Float[np.ndarray, " f"]
    natural: Float[np.ndarray, " modes"]

    @property
    def limit_hz(self) -> float:
        """Lowest frequency above the resonance at which noise hides the force, or the last frequency [Hz]."""
        above = self.force > _OVER_NOISE * self.noise
        top = self.natural.max(initial=0.0)
        hidden = np.flatnonzero(~above & (self.frequency > top))
        return float(self.frequency[hidden[0]] if hidden.size else self.frequency[-1])


def spectrum_of(
    log: Log,
    machine: Machine,
    structure: Structure,
    coefficients: np.ndarray,
    known: np.ndarray,
    natural: np.ndarray,
    median: int | None = None,
) -> Spectrum:
    """Compute the spectra of force and noise, the noise as amplified by a row of the model.

    Args:
        log: The log.
        machine: The machine, for gain and sensor.
        structure: The structure of the model; its first row with a force is used.
        coefficients: Its unknown coefficients at some plant, (terms,).
        known: Its known coefficients, (known,).
        natural: Natural frequencies of that plant, (modes,) [Hz].
        median: Number of samples of the running median that the force has passed.
    """
    rate = log.rate_hz
    length = int(min(log.samples, max(256, 2 * rate)))
    force = log.force * machine.gain
    f, density = scipy.signal.welch(force, rate, nperseg=length, detrend="linear", axis=0)
    white = signals.high_band_std(force) / (signals.median_noise(median) if median else 1.0)
    force_floor = 2 * white**2 / rate
    position_floor = 2 * position_noise(machine, log) ** 2 / rate

    # Transfer function of the row from each signal.
    row, lead = next((k[1].row, k[1]) for k in structure.leading if k is not None)
    s = 2j * np.pi * f
    by_joint: dict[tuple[str, int], np.ndarray] = {(lead.signal, lead.index): s**lead.order}
    every = zip((*structure.unknown, *structure.known), (*coefficients, *known), strict=True)
    for (_, t), c in every:
        if t.row == row and t.signal in ("position", "force"):
            at = (t.signal, t.index)
            by_joint[at] = by_joint.get(at, 0.0) + c * s**t.order

    noise = np.zeros_like(f)
    for (signal, i), gain in by_joint.items():
        noise += np.abs(gain) ** 2 * (position_floor[i] if signal == "position" else force_floor[i])
    scale = np.abs(by_joint[lead.signal, lead.index]) ** 2
    part = slice(1, None)
    return Spectrum(
        f[part], density[part, lead.index], noise[part] / np.maximum(scale[part], 1e-300), natural
    )


def highest_order(structure: Structure) -> int:
    """Return the order of the highest derivative of a position in a model."""
    return max((t.order for _, t in structure.unknown if t.signal == "position"), default=2)


def choose_filtering(
    log: Log, stated: Preprocess, structure: Structure, spectrum: Spectrum
) -> tuple[Recipe, tuple[str, ...]]:
    """Choose the filters for a minimal model.

    A stated cut-off is used as it is: a zero-phase Butterworth filter whose order is two above that of the
    highest derivative, central differences, and a parallel filter that ends at the cut-off. Else the band
    ends at twice the highest natural frequency, or at the frequency from which noise exceeds the signal, and
    derivatives are exact within it.

    Args:
        log: The log.
        stated: The case's `[preprocess]`.
        structure: The structure of the model.
        spectrum: Spectra at the estimate so far.

    Returns:
        The recipe, and notes about the choice.
    """
    order = highest_order(structure) + 2 if stated.order is None else stated.order
    if stated.cutoff_hz is not None:
        recipe = replace(choose_recipe(log, stated), order=order)
        if stated.trim is None:
            trim = trimmed(log, recipe.cutoff_hz, recipe.decimation, literal=True, periods=_ENDS)
            recipe = replace(recipe, trim=trim)
        return recipe, _folding_notes(recipe, log.rate_hz)

    recipe = replace(choose_recipe(log, stated), order=order)
    if not spectrum.natural.size:
        return recipe, ()
    top, limit = float(spectrum.natural.max()), spectrum.limit_hz
    edge = min(max(min(_ABOVE * top, limit), _AT_LEAST * top), 0.3 * log.rate_hz)
    decimation = spaced(log.rate_hz, edge) if stated.decimation is None else stated.decimation
    trim = stated.trim
    if trim is None:
        trim = trimmed(log, edge, decimation, literal=False, periods=_ENDS)
    recipe = replace(
        recipe,
        cutoff_hz=min(2 * edge, 0.45 * log.rate_hz),
        decimation=decimation,
        trim=trim,
        edge=2 * edge / log.rate_hz,
    )
    why = f"the band ends at {edge:.3g} Hz, {edge / top:.2g} times the natural frequency of {top:.3g} Hz"
    if limit < _ABOVE * top:
        amplified = f"noise, amplified by derivatives up to order {highest_order(structure)}"
        why += f": {amplified}, exceeds the signal from {limit:.3g} Hz on"
    notes = [f"{why}; one sample in {decimation} is kept, every {A_PERIOD:g} periods of that edge"]
    if limit < _AT_LEAST * top:
        notes.append(
            "that is within the band: stiffness and inertias may be biased; take a finer encoder, or excite "
            "the resonance more"
        )
    return recipe, tuple(notes)


def _folding_notes(recipe: Recipe, rate_hz: float) -> tuple[str, ...]:
    """Return a warning if decimation folds part of the band of a stated cut-off."""
    nyquist = rate_hz / (2 * recipe.decimation)
    if nyquist >= recipe.cutoff_hz:
        return ()
    most = spaced(rate_hz, recipe.cutoff_hz)
    return (
        f"warning: cutoff_hz = {recipe.cutoff_hz:g} with one sample in {recipe.decimation} folds frequencies "
        f"above {nyquist:.3g} Hz, half the rate that is kept; take decimation = {most}",
    )
