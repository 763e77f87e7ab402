"""Lines with thousands of samples, thinned to the resolution of a drawing."""

from __future__ import annotations

import numpy as np

# Chosen: a step longer than this many usual steps is a gap, not jitter.
_GAP = 1.5
# Beyond this a diverged simulation would only overflow the drawing [any unit].
_DRAWABLE = 1e30


def drawable(values: np.ndarray) -> np.ndarray:
    """Replace values that cannot be drawn by NaN, which matplotlib omits."""
    values = np.asarray(values, dtype=float)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(values) < _DRAWABLE, values, np.nan)


def segments(time: np.ndarray) -> np.ndarray:
    """Assign a number to each run of samples between gaps in time, from 0."""
    steps = np.diff(time)
    if steps.size == 0:
        return np.zeros(len(time), dtype=int)
    return np.concatenate([[0], np.cumsum(steps > _GAP * np.median(steps))])


def envelope(time: np.ndarray, values: np.ndarray, buckets: int) -> tuple[np.ndarray, np.ndarray]:
    """Thin a line to its smallest and largest sample in each of many short buckets.

    Args:
        time: Increasing instants, (N,); the line is broken at gaps.
        values: The line, (N,).
        buckets: Number of buckets into which the whole time is cut.

    Returns:
        Instants and values of the thinned line, with NaN in the gaps.
    """
    time, values = np.asarray(time, dtype=float), drawable(values)
    if time.size == 0:
        return time, values
    segment = segments(time)
    kept = np.arange(time.size)
    if time.size > 2 * buckets:
        # The last instant falls on the edge and shares the last bucket.
        span = time[-1] - time[0]
        bucket = np.minimum((time - time[0]) / span * buckets, buckets - 1).astype(int)
        # With more runs than buckets, single runs are too short to be visible.
        key = bucket + segment * buckets if segment[-1] <= buckets else bucket
        order = np.lexsort((values, key))
        first = np.flatnonzero(np.diff(key[order], prepend=-1))
        last = np.append(first[1:], time.size) - 1
        kept = np.unique(np.concatenate([order[first], order[last]]))
    cuts = np.flatnonzero(np.diff(segment[kept])) + 1
    return np.insert(time[kept], cuts, np.nan), np.insert(values[kept], cuts, np.nan)


def binned_mean(
    x: np.ndarray,
    y: np.ndarray,
    *,
    bins: int = 40,
    least: int = 5,
    group: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Average y over bins of equal width in x.

    Args:
        x: Abscissa, (K,).
        y: Values, (K,).
        bins: Number of bins.
        least: A bin with fewer samples is left out.
        group: Number of the group to which each sample belongs, rising with x, (K,); groups
            are averaged apart and the line is broken between them. None: one group.

    Returns:
        Mean x and mean y of each bin that is left, in order, NaN between groups.
    """
    x, y = drawable(x), drawable(y)
    group = np.zeros(x.size, dtype=int) if group is None else np.asarray(group)
    good = np.isfinite(x) & np.isfinite(y)
    x, y, group = x[good], y[good], group[good]
    if x.size < least:
        return x[:0], y[:0]
    if group.max() > bins:  # too many groups to see any
        group = np.zeros(x.size, dtype=int)
    span = np.ptp(x) or 1.0
    index = np.minimum((x - x.min()) / span * bins, bins - 1).astype(int) + group * bins
    count = np.bincount(index)
    kept = np.flatnonzero(count >= least)
    cuts = np.flatnonzero(np.diff(kept // bins)) + 1
    means = (np.bincount(index, v)[kept] / count[kept] for v in (x, y))
    mean_x, mean_y = (np.insert(mean, cuts, np.nan) for mean in means)
    return mean_x, mean_y


def thinned(size: int, most: int) -> np.ndarray:
    """Choose at most so many samples of a cloud, evenly but without a beat, the same each time."""
    if size <= most:
        return np.arange(size)
    # A regular stride could fall in step with a periodic reference.
    return np.sort(np.random.default_rng(0).choice(size, most, replace=False))
