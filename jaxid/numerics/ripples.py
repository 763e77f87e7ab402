"""Ripples of a force over the position, found in the spectrum of its samples over the position."""

from __future__ import annotations

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.signal
from jaxtyping import Float

# Bins in the shortest period, so that rounding of a position to its bin takes 2 % off an amplitude.
_BINS = 8
# Lines of the spectrum in the width of a peak, and in the stretch whose median is the level around a peak.
_FINE, _AROUND = 4, 201
# Largest number of bins: a spectrum over more takes more than 0.2 s.
_MOST = 2**18


def strongest_ripples(
    position: Float[np.ndarray, " samples"],
    force: Float[np.ndarray, " samples"],
    most_per_unit: float,
    count: int,
) -> Float[np.ndarray, "found 4"]:
    """Find the ripples A cos(2 pi q / P + phase) that stand out of a force over the position.

    The samples need not be even over the position.

    Args:
        position: Position of each sample [m or rad].
        force: Force at each sample.
        most_per_unit: Largest number of periods in a unit of the position.
        count: Number of ripples that stand out most, and of the largest ones.

    Returns:
        Amplitude, period and phase of each, and how many times its line exceeds those around it.
    """
    stroke = float(np.ptp(position)) if len(position) else 0.0
    most = min(most_per_unit, _MOST / _BINS / stroke) if stroke > 0 else 0.0
    if most * stroke < 1.0:
        return np.zeros((0, 4))

    begin, width = float(position.min()), 1.0 / (_BINS * most)
    bins = int(stroke / width) + 1
    # Without weights that fade at both ends each peak has smaller ones beside it.
    weight = np.sin(np.pi * (position - begin) / stroke) ** 2
    sums = np.bincount(((position - begin) / width).astype(int), weight * force, minlength=bins)
    points = scipy.fft.next_fast_len(_FINE * bins, real=True)
    lines, frequency = scipy.fft.rfft(sums, points), scipy.fft.rfftfreq(points, width)
    # The centre of a bin stands for its samples.
    lines *= 2.0 / np.sum(weight) * np.exp(-2j * np.pi * frequency * (begin + 0.5 * width))

    size = np.abs(lines)
    level = scipy.ndimage.median_filter(size, _AROUND, mode="nearest")
    above = np.where((frequency * stroke >= 1.0) & (frequency <= most), size / np.maximum(level, 1e-300), 0.0)
    peaks, _ = scipy.signal.find_peaks(above, distance=2 * _FINE)
    # A ripple that leaves the band at high speed spreads over its neighbours, which raise their level.
    best = np.unique([peaks[np.argsort(-by[peaks])[:count]] for by in (above, size)])
    # The vertex of a parabola through the logarithms of three lines, and the phase that the shift costs
    # half a stroke away from the first sample, where the weights are centred.
    low, top, high = (np.log(np.maximum(size[best + k], 1e-300)) for k in (-1, 0, 1))
    shift = 0.5 * (low - high) / (low - 2.0 * top + high) * frequency[1]
    phase = np.angle(lines[best] * np.exp(-2j * np.pi * shift * (begin + 0.5 * stroke)))
    return np.stack([size[best], 1.0 / (frequency[best] + shift), phase, above[best]], axis=1)
