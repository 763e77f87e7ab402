"""Cut-off and decimation for a minimal model: from the dynamics to be identified and the noise."""

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

# The band ends so many times above the highest natural frequency, as published (60 for 30 Hz).
_ABOVE = 2.0
# Noise may cut it down to this, not below: without the resonance there is no stiffness.
_AT_LEAST = 1.2
# Power of a signal over its noise at which the band ends.
_OVER_NOISE = 4.0
# Periods of the band's edge that are left out at each end: the higher derivatives forget slowly.
_ENDS = 6


@dataclass(frozen=True)
class Spectrum:
    """What a model compares, over frequency, at some plant.

    Args:
        frequency: [Hz], (f,).
        force: Density of the declared force [N^2/Hz].
        noise: Of the encoders' noise as the model's derivatives amplify it, and the force's own [N^2/Hz].
        natural: Natural frequencies [Hz].
    """

    frequency: Float[np.ndarray, " f"]
    force: Float[np.ndarray, " f"]
    noise: Float[np.ndarray, " f"]
    natural: Float[np.ndarray, " modes"]

    @property
    def limit_hz(self) -> float:
        """Where the force is lost in the noise for good above the resonance, or the last frequency."""
        above = self.force > _OVER_NOISE * self.noise
        top = self.natural.max(initial=0.0)
        lost = np.flatnonzero(~above & (self.frequency > top))
        return float(self.frequency[lost[0]] if lost.size else self.frequency[-1])


def spectrum_of(
    log: Log,
    machine: Machine,
    structure: Structure,
    coefficients: np.ndarray,
    known: np.ndarray,
    natural: np.ndarray,
    median: int | None = None,
) -> Spectrum:
    """Force and noise over frequency, the noise as a row of the model amplifies it.

    Args:
        log: The log.
        machine: Its gain and sensor.
        structure: The model; of its rows the first that holds a force counts.
        coefficients: Its unknown coefficients at some plant.
        known: Its known ones.
        natural: Natural frequencies of that plant [Hz].
        median: Samples of the running median that the force has passed.
    """
    rate = log.rate_hz
    length = int(min(log.samples, max(256, 2 * rate)))
    force = log.force * machine.gain
    f, density = scipy.signal.welch(force, rate, nperseg=length, detrend="linear", axis=0)
    white = signals.high_band_std(force) / (signals.median_noise(median) if median else 1.0)
    floor = 2 * white**2 / rate
    own = 2 * position_noise(machine, log) ** 2 / rate
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
        noise += np.abs(gain) ** 2 * (own[i] if signal == "position" else floor[i])
    scale = np.abs(by_joint[lead.signal, lead.index]) ** 2
    part = slice(1, None)
    return Spectrum(
        f[part], density[part, lead.index], noise[part] / np.maximum(scale[part], 1e-300), natural
    )


def highest_order(structure: Structure) -> int:
    """Order of the highest derivative of a position in a model."""
    return max((t.order for _, t in structure.unknown if t.signal == "position"), default=2)


def choose_filtering(
    log: Log, stated: Preprocess, structure: Structure, spectrum: Spectrum
) -> tuple[Recipe, tuple[str, ...]]:
    """The recipe of a minimal model, and what a user should know of it.

    A stated cut-off is taken to the letter: a zero-phase Butterworth filter of the order of the
    highest derivative and two more, central differences, and a parallel filter that ends at the
    cut-off. Else the band ends at twice the highest natural frequency, or earlier where noise takes
    over, and derivatives are exact in it.

    Args:
        log: The log.
        stated: The case's `[preprocess]`.
        structure: The model.
        spectrum: At the plant as it is known so far.
    """
    order = highest_order(structure) + 2 if stated.order is None else stated.order
    if stated.cutoff_hz is not None:
        recipe = replace(choose_recipe(log, stated), order=order)
        if stated.trim is None:
            trim = trimmed(log, recipe.cutoff_hz, recipe.decimation, literal=True, periods=_ENDS)
            recipe = replace(recipe, trim=trim)
        return recipe, _folds(recipe, log.rate_hz)
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
        amplified = f"noise, as derivatives up to order {highest_order(structure)} amplify it"
        why += f": {amplified}, takes over at {limit:.3g} Hz"
    notes = [f"{why}; one sample in {decimation} is kept, {A_PERIOD:g} periods of that"]
    if limit < _AT_LEAST * top:
        notes.append(
            "that is within the band: stiffness and inertias may be biased; take a finer encoder, or excite "
            "the resonance more"
        )
    return recipe, tuple(notes)


def _folds(recipe: Recipe, rate_hz: float) -> tuple[str, ...]:
    nyquist = rate_hz / (2 * recipe.decimation)
    if nyquist >= recipe.cutoff_hz:
        return ()
    most = spaced(rate_hz, recipe.cutoff_hz)
    return (
        f"warning: cutoff_hz = {recipe.cutoff_hz:g} with one sample in {recipe.decimation} folds what lies "
        f"above {nyquist:.3g} Hz, half the rate that is kept; decimation = {most} does not",
    )
