"""Calibration of intervals: where the truth lies in the distribution that an estimate reports."""

from __future__ import annotations

import functools

import numpy as np
import scipy.stats
from jaxtyping import Float

# Nominal coverage of the intervals that are counted.
COVERAGES = (0.5, 0.68, 0.8, 0.95)
# Nominal coverage of the verdict, and probability with which sound intervals pass it.
JUDGED, ACCEPTED = 0.95, 0.99
# Simultaneous probability of the ECDF's band, points at which it is evaluated at most, and simulations.
BAND = 0.95
_POINTS, _SIMULATIONS = 100, 4000
# Fewer intervals do not support a verdict.
FEWEST = 20


def normal_pit(
    error: Float[np.ndarray, " runs"], std: Float[np.ndarray, " runs"]
) -> Float[np.ndarray, " runs"]:
    """Return where the truth lies in the normal distribution that each run reports, from 0 to 1.

    It is the limit of the rank of the truth among draws from that distribution. Sound intervals give uniform
    values.

    Args:
        error: Estimate minus truth.
        std: Reported standard deviations.

    Source:
        Talts, Betancourt, Simpson, Vehtari and Gelman (2018), "Validating Bayesian inference algorithms with
        simulation-based calibration", arXiv:1804.06788.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return scipy.stats.norm.cdf(-error / std)


def coverage_of(pit: Float[np.ndarray, " runs"], level: float) -> float:
    """Return the fraction of central intervals of a nominal level that hold the truth; NaN without runs."""
    return float(np.mean(np.abs(2.0 * pit - 1.0) <= level)) if len(pit) else np.nan


def accepted_range(runs: int, level: float = JUDGED, probability: float = ACCEPTED) -> tuple[float, float]:
    """Return the central range of the coverage of sound intervals: binomial counts over the runs.

    Args:
        runs: Number of intervals, at least one.
        level: Nominal coverage.
        probability: Probability of the range.
    """
    low, high = scipy.stats.binom.interval(probability, runs, level)
    return float(low) / runs, float(high) / runs


@functools.lru_cache(maxsize=64)
def ecdf_band(runs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points, and the lower and upper band of the ECDF of uniform values minus the diagonal there.

    Uniform samples stay inside the band at all points at once with probability `BAND`. At each point the band
    is a central interval of the binomial count; its level is adjusted by simulation.

    Args:
        runs: Number of values, at least one.

    Source:
        Säilynoja, Bürkner and Vehtari (2022), Statistics and Computing 32, 32: graphical test for discrete
        uniformity; section 2.2, the adjustment by simulation.
    """
    points = np.arange(1, min(runs, _POINTS)) / min(runs, _POINTS) if runs > 1 else np.array([0.5])
    cells = np.diff(np.concatenate([[0.0], points, [1.0]]))
    rng = np.random.default_rng(0)
    counts = np.cumsum(rng.multinomial(runs, cells, _SIMULATIONS), axis=1)[:, :-1]
    # Twice the smaller tail at each point; the smallest of a sample says at which level it is outside.
    below = scipy.stats.binom.cdf(counts, runs, points)
    above = scipy.stats.binom.sf(counts - 1, runs, points)
    smallest = 2.0 * np.minimum(below, above).min(axis=1)
    gamma = np.quantile(smallest, 1.0 - BAND, method="lower")
    low = scipy.stats.binom.ppf(gamma / 2, runs, points) / runs - points
    high = scipy.stats.binom.isf(gamma / 2, runs, points) / runs - points
    return points, low, high


def ecdf_difference(
    pit: Float[np.ndarray, " runs"], points: Float[np.ndarray, " k"]
) -> Float[np.ndarray, " k"]:
    """Return the ECDF of values from 0 to 1 minus the diagonal, at some points."""
    return np.searchsorted(np.sort(pit), points, side="right") / len(pit) - points


def leaves_band(pit: Float[np.ndarray, " runs"]) -> bool:
    """Check that the ECDF leaves its simultaneous band at any point."""
    points, low, high = ecdf_band(len(pit))
    off = ecdf_difference(pit, points)
    rounding = 1e-12
    return bool(np.any((off < low - rounding) | (off > high + rounding)))


def verdict_of(pit: Float[np.ndarray, " runs"]) -> str | None:
    """Return the verdict on intervals: "hold", "too narrow" or "too wide"; None for too few runs."""
    if len(pit) < FEWEST:
        return None
    low, high = accepted_range(len(pit))
    held = coverage_of(pit, JUDGED)
    return "too narrow" if held < low else "too wide" if held > high else "hold"


def calibration_of(pit: Float[np.ndarray, " runs"]) -> dict[str, object]:
    """Return coverages, number of intervals and verdict as entries of a row of a summary."""
    names = {level: f"coverage_{round(100 * level)}" for level in COVERAGES}
    low, high = accepted_range(len(pit)) if len(pit) else (np.nan, np.nan)
    return {
        **{name: coverage_of(pit, level) for level, name in names.items()},
        "intervals": len(pit),
        "accepted_95": [low, high],
        "verdict": verdict_of(pit),
        "pit_uniform": None if len(pit) < FEWEST else not leaves_band(pit),
    }


def verdict_words(what: str, row: dict) -> str:
    """Return a verdict as a sentence; empty if there are no intervals.

    Args:
        what: Parameter or combination that the intervals are of.
        row: Entries of `calibration_of`.
    """
    if not row["intervals"]:
        return ""
    held = f"{100 * row['coverage_95']:.1f} % of 95 % intervals contain the truth"
    low, high = (100 * x for x in row["accepted_95"])
    accepted = f"the range of {row['intervals']} sound ones, {low:.1f} to {high:.1f} % (99 % binomial)"
    if row["verdict"] is None:
        return f"{what}: {held}; {row['intervals']} intervals are too few for a verdict"
    if row["verdict"] == "too narrow":
        return f"do not rely on the intervals of {what}: {held}, below {accepted}"
    if row["verdict"] == "too wide":
        return f"intervals of {what} are wider than needed: {held}, above {accepted}"
    if row["pit_uniform"] is False:
        return (
            f"intervals of {what} hold at 95 %: {held}, within {accepted}; not at every level: the place of "
            "the truth in the reported distribution is not uniform"
        )
    return f"intervals of {what} hold: {held}, within {accepted}"
