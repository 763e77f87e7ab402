"""Periodic sums of sines with a flat spectrum."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.references.family import Family, Grid, is_number_list, number_list
from jaxid.schema import Key, choice, flag, number, whole

if TYPE_CHECKING:
    from jaxtyping import Float


def _lines(values: dict[str, Any], samples: int, grid: Grid) -> np.ndarray:
    """Return the harmonics of the period that lie in the band."""
    if len(values["band_hz"]) != 2:
        raise grid.fault("band_hz must hold two frequencies", "band_hz = [lowest, highest]")
    low, high = values["band_hz"]
    if not 0 <= low < high < grid.rate_hz / 2.0:
        hint = f"0 <= lowest < highest < {grid.rate_hz / 2.0:g} Hz, half the sampling rate"
        raise grid.fault(f"band_hz = [{low:g}, {high:g}] Hz is no band", hint)
    spacing = grid.rate_hz / samples
    # A bound that is meant to be a line stays one despite its rounding.
    first = max(1, int(np.ceil(low / spacing - 1e-9)))
    harmonics = np.arange(first, int(np.floor(high / spacing + 1e-9)) + 1)
    harmonics = harmonics[harmonics % 2 == 1] if values["odd"] else harmonics
    if not harmonics.size:
        hint = "widen band_hz or lengthen period"
        raise grid.fault(f"no line in the band: they are {spacing:g} Hz apart", hint)
    return harmonics


def _phases(count: int, values: dict[str, Any], joint: int) -> Float[np.ndarray, " lines"]:
    if values["phases"] == "schroeder":
        k = np.arange(1, count + 1)
        return -np.pi * k * (k - 1) / count
    # The joint is part of the seed: joints with equal motions could not be separated.
    return np.random.default_rng([values["seed"], joint]).uniform(0.0, 2.0 * np.pi, count)


def _sample(values: dict[str, Any], grid: Grid) -> np.ndarray:
    samples = round((values["period"] or grid.duration) * grid.rate_hz)
    if samples < 4:
        raise grid.fault("period is shorter than four samples", "lengthen period")
    harmonics = _lines(values, samples, grid)
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    spectrum[harmonics] = np.exp(1j * _phases(harmonics.size, values, grid.joint))
    one = np.fft.irfft(spectrum, samples)
    one *= values["amplitude"] / np.abs(one).max()
    return values["offset"] + one[np.arange(grid.samples) % samples]


MULTISINE = Family(
    kind="multisine",
    doc="a periodic sum of equally strong sines, at every (odd) line of a band",
    keys={
        "band_hz": Key(number_list(2), "lowest and highest frequency", True, "Hz", single=is_number_list),
        "amplitude": Key(number("positive"), "largest excursion from the offset", True, "position"),
        "offset": Key(number(), "mean", unit="position", default=0.0),
        "period": Key(number("positive"), "period, to a whole sample", unit="s", note="the duration"),
        "odd": Key(flag, "only odd harmonics of the period", default=False),
        "phases": Key(choice(("random", "schroeder")), "schroeder for a low crest", default="random"),
        "seed": Key(whole(0), "seed of the random phases", default=0),
    },
    sample=_sample,
)
