"""Test of residuals for whiteness, and the band of the spectrum in which those that are coloured lie."""

from __future__ import annotations

import numpy as np
import scipy.signal
import scipy.stats
from jaxtyping import Float

# Lags of the test, and the probability at which it rejects.
LAGS, REJECTS = 20, 1e-3
# Bins of the spectrum at the least, samples of a segment at the most, and the widest band that is one.
_FEWEST_BINS, _SEGMENT, _WIDEST = 16, 512, 0.2
# Factor over the median of the spectrum beyond which a bin is no scatter of white noise, and the least part
# of the power that such bins must hold beyond the median.
_SCATTER, _LEAST = 2.0, 0.05


def whiteness(z: Float[np.ndarray, " time"], lags: int = LAGS) -> float:
    """Return the probability that white noise has autocorrelations as large as these.

    Source:
        Ljung & Box (1978), Biometrika 65, statistic of the first `lags` autocorrelations.
    """
    samples, z = len(z), z - z.mean()
    lags = min(lags, samples // 5)
    power = z @ z
    if lags < 1 or power <= 0:
        return 1.0
    r = np.array([z[k:] @ z[:-k] for k in range(1, lags + 1)]) / power
    statistic = samples * (samples + 2) * np.sum(r**2 / (samples - np.arange(1, lags + 1)))
    return float(scipy.stats.chi2.sf(statistic, lags))


def band_of_half_the_excess(z: Float[np.ndarray, " time"], rate: float) -> tuple[float, float] | None:
    """Return the narrowest band that holds half of the power beyond that of white noise.

    The median of the spectrum is taken for the white noise.

    Args:
        z: Residuals at equal intervals, (time,); zero where a sample does not count.
        rate: Samples per second [Hz].

    Returns:
        Lower and upper edge [Hz]; None if the band takes more than a fifth of the spectrum, if less than a
        twentieth of the power is beyond the white noise, or if there are too few samples.

    Source:
        Welch (1967), IEEE Trans. Audio and Electroacoustics 15, for the spectrum.
    """
    segment = min(len(z) // 4, _SEGMENT)
    if segment < 2 * _FEWEST_BINS:
        return None
    frequency, power = scipy.signal.welch(
        z,
        rate,
        nperseg=segment,
        detrend=False,  # pyright: ignore[reportArgumentType] (SciPy's stubs know names only)
    )
    white = np.median(power)
    excess = np.where(power > _SCATTER * white, power - white, 0.0)
    bins, total = len(power), np.sum(excess)
    if not total > _LEAST * np.sum(power):
        return None
    before = np.concatenate([[0.0], np.cumsum(excess)]) / total

    # For each first bin, the last one with which half of the excess is reached.
    last = np.searchsorted(before, before[:-1] + 0.5 - 1e-12)
    width = np.where(last <= bins, last - np.arange(bins), bins)
    first = int(np.argmin(width))
    if width[first] > _WIDEST * bins:
        return None
    half = 0.5 * (frequency[1] - frequency[0])
    edges = (frequency[first] - half, frequency[first + width[first] - 1] + half)
    return max(float(edges[0]), 0.0), min(float(edges[1]), rate / 2)
