"""The region in which simulation and measurement differ, found without any physics.

The residual is regressed on one variable at a time with a curve of arbitrary shape. The curve is scored as
candidates are: on held-out blocks of time, against surrogates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxid.discovery import evidence as ev
from jaxid.discovery.noise import fit_whitener
from jaxid.logs.prepare import Prepared
from jaxid.model.plant import Plant
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.ripples import strongest_ripples

# Knots of the curve, at quantiles of the variable.
_KNOTS = 12
# A window of this many samples is loud if its energy exceeds the median's by this factor: in stationary noise
# that happens less than once in 10^9 windows. It must also reach this part of the loudest window's energy.
_WINDOW = 20
_LOUD = 8.0
_QUIET = 0.02
# Measured acceleration and force carry the noise of the residual, and a feedback loop passes disturbances on
# to them: the residual depends on them even if they are not its cause. One of them is named if it explains
# more than the other variables by this factor, but it never decides if the residual is significant.
_NOISY = ("acceleration", "force")
_FAR_MORE = 2.0
# Intervals of time are named if they hold at least this part of the residual's sum of squares, and more than
# this factor times the part that a curve over the motion explains, at most the last value.
_MOSTLY = 0.5
_CURVE_FACTOR = 2.0
_NEARLY_ALL = 0.95
# A spectral line must carry this part of the variance, and exceed the median of its neighbours by a factor
# that white noise exceeds once in 10^8.
_LINE_PART = 0.05
_LINE_FACTOR = 25.0
# Most intervals of time, and most periods over the position, that are listed in words.
_LISTED = 3
# Least number of periods in the stroke: a smooth force over the position looks like fewer. Up to the second
# number a ripple must carry most of the variance: a force at some places of the stroke has such lines too.
# Of more periods it must carry this part.
_TURNS, _MANY_TURNS = 3, 30
_RIPPLE_PART = 0.1
# Quantile of the speed at which a ripple over the position must be in the band of the filter.
_SLOW = 0.05


@dataclass(frozen=True)
class Where:
    """Region and intervals in which a residual lies.

    Args:
        joint: Joint of the residual, counted from 1.
        variable: Variable on which the residual depends most.
        region: Range of that variable in which the residual is largest.
        intervals: Intervals of time in which the residual is loud [s].
        text: The finding as a sentence.
        explained: Part of the residual's variance that the variable explains on held-out time.
        evidence: Held-out gain in log-likelihood [nats].
        threshold: Evidence that noise alone exceeds once in a thousand logs [nats].
        clear: Whether position, elongation, velocity or time exceed that threshold.
        x, mean, low, high: The curve over the variable and its 95 % band, in units of force.
        frequency_hz: Frequency of a spectral line; None without one.
        periods: Periods of the ripples over the position that explain more than anything else, the largest
            one first [m or rad]; empty without one.
    """

    joint: int
    variable: str
    region: tuple[float, float]
    intervals: tuple[tuple[float, float], ...]
    text: str
    explained: float
    evidence: float
    threshold: float
    clear: bool
    x: Float[np.ndarray, " bin"]
    mean: Float[np.ndarray, " bin"]
    low: Float[np.ndarray, " bin"]
    high: Float[np.ndarray, " bin"]
    frequency_hz: float | None = None
    periods: tuple[float, ...] = ()

    @classmethod
    def in_time(cls, joint: int, region: tuple[float, float], text: str, explained: float) -> Where:
        """Return a stretch of time as the place of a residual that no curve over a variable describes.

        Args:
            joint, region, text, explained: See `Where`.
        """
        none = np.zeros(0)
        return cls(
            joint=joint,
            variable="time",
            region=region,
            intervals=(region,),
            text=text,
            explained=explained,
            evidence=0.0,
            threshold=0.0,
            clear=True,
            x=none,
            mean=none,
            low=none,
            high=none,
        )

    @property
    def significant(self) -> bool:
        """True if the residual holds more than noise."""
        loud = bool(self.intervals) and self.variable == "time"
        return self.clear or self.frequency_hz is not None or loud


def variables(
    data: Prepared, joint: int, plant: Plant | None = None
) -> dict[str, Float[np.ndarray, " kept"]]:
    """Collect the variables on which a residual may depend, at the kept samples.

    Args:
        data: The prepared log.
        joint: Index of the joint, from 0.
        plant: Adds elongations of springs, and knows which joints have a drive; None: a single axis.
    """
    v = data.at_kept(data.qd)[:, joint]
    time = data.times
    # Time of the last reversal at every sample.
    flips = np.flatnonzero(np.diff(np.sign(v)) != 0)
    last = np.maximum.accumulate(np.where(np.isin(np.arange(len(v)), flips + 1), time, time[0]))

    drive = 0 if plant is None else plant.drive_of(joint, data.force.shape[1])
    force = {} if drive is None else {"force": data.at_kept(data.force)[:, drive]}
    return {
        "velocity": v,
        "position": data.at_kept(data.q)[:, joint],
        "acceleration": data.at_kept(data.qdd)[:, joint],
        **force,
        **({} if plant is None else _elongations(plant, data.at_kept(data.q), joint)),
        "time since reversal": time - last,
        "time": time,
    }


def _elongations(
    plant: Plant, q: Float[np.ndarray, "kept n"], joint: int
) -> dict[str, Float[np.ndarray, " kept"]]:
    """Return the elongations of springs between two joints; that of a spring to a wall is the position."""
    n = q.shape[1]
    if plant.springs(n) == 0:
        return {}
    ports = np.asarray(jax.vmap(plant.ports)(q))
    slope = np.asarray(jax.jacfwd(plant.ports)(q[0]))
    between = [k for k in range(n, ports.shape[1]) if slope[k, joint] and np.count_nonzero(slope[k]) > 1]
    return {f"elongation of spring {k - n + 1}": ports[:, k] for k in between}


def locate(
    residual: Float[np.ndarray, "kept n"],
    jacobian: Float[np.ndarray, "kept n p"],
    data: Prepared,
    colour: tuple[NoiseModel, ...],
    units: Sequence[str],
    wanted: Float[np.ndarray, "kept n"] | None = None,
    plant: Plant | None = None,
) -> Where:
    """Find the joint and variable that explain most of a residual.

    Args:
        residual: Measured minus modelled force at the kept samples.
        jacobian: Derivatives of the residual in the model's unknowns; what these can absorb does not count.
        data: The prepared log.
        colour: Noise expected from the sensors, by joint.
        units: Unit of the position by joint, for words.
        wanted: Velocity of the reference at the kept samples; None: the measured velocity.
        plant: The plant, as in `variables`.
    """
    wanted = data.at_kept(data.qd) if wanted is None else wanted
    by_joint = [
        _locate(residual[:, i], jacobian[:, i], data, colour[i], wanted[:, i], i, units[i], plant)
        for i in range(residual.shape[1])
    ]
    return max(by_joint, key=lambda w: w.explained * float(np.nanvar(residual[:, w.joint - 1])))


def _locate(
    e: np.ndarray,
    jacobian: np.ndarray,
    data: Prepared,
    colour: NoiseModel,
    wanted: np.ndarray,
    joint: int,
    unit: str,
    plant: Plant | None,
) -> Where:
    """Find the variable that explains most of the residual of one joint."""
    counts = data.moving[:, joint]
    named = variables(data, joint, plant)
    gains, limit = _gains(e, jacobian, named, counts, colour)
    clean = max((n for n in gains if n not in _NOISY), key=lambda n: gains[n])
    explained = _explained(gains[clean], counts)
    clear = gains[clean] > limit

    intervals = _loud(e, counts, data)
    # A fitted colour would whiten a line away; the colour expected from the sensors keeps it.
    sensors = ev.Whitener((colour,), counts[:, None])
    line, part = _spectral_line(_unexplained(sensors, e, jacobian), sensors, data, wanted)
    # A line or intervals are named only if they explain more than position or velocity do.
    line = line if part > explained else None
    periods, share = _ripples(e, counts, data, joint)
    periods = periods if share > max(explained, part) else ()

    # A curve over the motion is more informative than the times at which it is far from zero.
    over_motion = clear and not clean.startswith("time")
    needed = min(_CURVE_FACTOR * explained, _NEARLY_ALL) if over_motion else explained
    if periods:
        best, line = "position", None
    elif line is not None or _share_inside(e, counts, data, intervals) > max(needed, _MOSTLY):
        best = "time"
    else:
        best = _best(gains, clean)
    found = _describe(e, counts, named[best], best, joint, gains[best], limit, clear, intervals, line)
    return replace(found, periods=periods, text=_in_periods(periods, joint, unit)) if periods else found


def _ripples(
    e: np.ndarray, counts: np.ndarray, data: Prepared, joint: int
) -> tuple[tuple[float, ...], float]:
    """Find ripples over the position in a residual: their periods, and the part of the variance they carry.

    Each must stand out as a spectral line must.
    """
    speed = np.abs(data.at_kept(data.qd)[counts, joint])
    if len(speed) < 100:
        return (), 0.0

    band = data.recipe.band_hz(1.0 / data.period)
    most = band / max(float(np.quantile(speed, _SLOW)), 1e-300)
    position, left = data.at_kept(data.q)[counts, joint], e[counts] - np.mean(e[counts])
    found = strongest_ripples(position, left, most, _LISTED)
    parts = 0.5 * found[:, 0] ** 2 / np.mean(left**2)
    turns = np.ptp(position) / found[:, 1]
    clear = (found[:, 3] ** 2 > _LINE_FACTOR) & (turns > _TURNS)
    clear &= parts > np.where(turns < _MANY_TURNS, _MOSTLY, _RIPPLE_PART)
    order = np.argsort(-parts[clear])[:_LISTED]
    return tuple(found[clear, 1][order].tolist()), float(np.sum(parts[clear][order]))


def _gains(
    e: np.ndarray, jacobian: np.ndarray, named: dict[str, np.ndarray], counts: np.ndarray, colour: NoiseModel
) -> tuple[dict[str, float], float]:
    """Compute the held-out evidence of a curve over each variable, and the threshold of noise [nats]."""
    hats = {name: _hat_functions(x, counts) for name, x in named.items()}
    every = np.concatenate(list(hats.values()), axis=1)
    whitener, _ = fit_whitener(e[:, None], jacobian[:, None], every[:, None], counts[:, None], (colour,))
    blocks = whitener.blocks()
    base = _independent(whitener(jacobian[:, None]))
    white = whitener(e[:, None, None])

    # Surrogates of the residual itself: the remainder after curves of six variables would be too small.
    remainder = _unexplained(whitener, e, jacobian)
    rng = np.random.default_rng(20240501)
    surrogates = ev.flipped(remainder, ev.stretch(len(remainder)), 100, rng)

    before = _held_out(base, np.concatenate([white, surrogates], axis=1), blocks)
    largest = np.full(100, -np.inf)
    gains = {}
    for name, hat in hats.items():
        both = np.concatenate([base, _independent(whitener(hat[:, None]))], axis=1)
        after = _held_out(both, np.concatenate([white, surrogates], axis=1), blocks)
        gain = ev.log_evidence(len(blocks), before, after)
        gains[name] = float(gain[0])
        if name not in _NOISY:
            largest = np.maximum(largest, gain[1:])
    return gains, ev.threshold(largest)


def _best(gains: dict[str, float], clean: str) -> str:
    """Choose the variable to name: one that carries the residual's noise must explain far more."""
    other = max((n for n in _NOISY if n in gains), key=lambda n: gains[n])
    return other if gains[other] > _FAR_MORE * max(gains[clean], 0.0) else clean


def _in_periods(periods: tuple[float, ...], joint: int, unit: str) -> str:
    """Return ripples over the position of a joint in words."""
    every = _listed([f"{p:.4g} {unit}" for p in periods])
    turns = _listed([f"{2 * np.pi / p:.4g}" for p in periods])
    times = f" ({turns} times a turn)" if unit == "rad" else ""
    return (
        f"joint {joint + 1}: the residual repeats over the position, every {every}{times}, as a ripple does"
    )


def _listed(words: Sequence[str]) -> str:
    """Return words with commas, and with "and" before the last one."""
    return " and ".join(part for part in (", ".join(words[:-1]), words[-1]) if part)


def _in_words(intervals: tuple[tuple[float, float], ...]) -> str:
    """Return intervals of time in words, the first few of many."""
    spans = [f"from {start:.4g} to {end:.4g} s" for start, end in intervals[:_LISTED]]
    more = len(intervals) - len(spans)
    return ", ".join(spans) + (f", and in {more} more intervals of time" if more else "")


def _describe(
    e: np.ndarray,
    counts: np.ndarray,
    x: np.ndarray,
    name: str,
    joint: int,
    gain: float,
    limit: float,
    clear: bool,
    intervals: tuple,
    line: float | None,
) -> Where:
    """Describe the residual over one variable: the curve, the region of its peak, and a sentence."""
    centre, mean, error, ends = _binned(e, counts, x)

    # The region around the peak with the same sign and at least half of its height.
    peak = int(np.argmax(np.abs(mean) - error))
    strong = np.abs(mean) > 0.5 * np.abs(mean[peak])
    lo, hi = peak, peak
    while lo > 0 and strong[lo - 1] and mean[lo - 1] * mean[peak] > 0:
        lo -= 1
    while hi < len(mean) - 1 and strong[hi + 1] and mean[hi + 1] * mean[peak] > 0:
        hi += 1
    region = float(ends[lo, 0]), float(ends[hi, 1])

    text = f"joint {joint + 1}: the residual depends on {name}"
    text += f", most between {region[0]:.3g} and {region[1]:.3g} (SI)"
    if line is not None:
        text = (
            f"joint {joint + 1}: the residual has a spectral line at {line:.3g} Hz that the reference lacks"
        )
    elif name == "time" and intervals:
        text = f"joint {joint + 1}: the residual is loud {_in_words(intervals)}"
    return Where(
        joint=joint + 1,
        variable=name,
        region=region,
        intervals=intervals,
        text=text,
        explained=_explained(gain, counts),
        evidence=gain,
        threshold=limit,
        clear=clear,
        x=centre,
        mean=mean,
        low=mean - 1.96 * error,
        high=mean + 1.96 * error,
        frequency_hz=line,
    )


def _explained(gain: float, counts: np.ndarray) -> float:
    """Convert a gain in log-likelihood to a part of the variance."""
    return float(1 - np.exp(-2 * max(gain, 0.0) / max(int(counts.sum()), 1)))


def _hat_functions(x: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, "kept knot"]:
    """Evaluate piecewise-linear basis functions with knots at quantiles, for a curve of arbitrary shape."""
    knots = np.unique(np.quantile(x[counts], np.linspace(0, 1, _KNOTS)))
    eye = np.eye(len(knots))
    return np.stack([np.interp(x, knots, row) for row in eye], axis=1)


def _independent(columns: np.ndarray) -> np.ndarray:
    """Return orthonormal columns that span the same space as the given ones."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-8 * s[0]] if len(s) else columns


def _unexplained(
    whitener: ev.Whitener, e: Float[np.ndarray, " kept"], jacobian: Float[np.ndarray, "kept p"]
) -> Float[np.ndarray, " row"]:
    """Return the whitened part of a residual that the model's unknowns cannot absorb."""
    base = _independent(whitener(jacobian[:, None]))
    white = whitener(e[:, None, None])[:, 0]
    return white - base @ np.linalg.lstsq(base, white, rcond=1e-9)[0]


def _held_out(columns: np.ndarray, e: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Return the held-out sums of squares of residuals after a fit of the columns."""
    return ev.held_out(ev.grams(columns, blocks), *ev.products(columns, e, blocks))


def _binned(
    e: np.ndarray, counts: np.ndarray, x: np.ndarray, bins: int = 30
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Float[np.ndarray, "bin 2"]]:
    """Bin e over x with equal counts: median of x, mean of e, its standard error, and both ends of x."""
    order = np.argsort(x[counts])
    parts = [p for p in np.array_split(order, bins) if len(p)]
    es, xs = e[counts], x[counts]
    centre = np.array([np.median(xs[p]) for p in parts])
    mean = np.array([np.mean(es[p]) for p in parts])
    # Neighbours in time are correlated: count a fifth of the samples as independent.
    error = np.array([np.std(es[p]) / np.sqrt(max(len(p) / 5, 1)) for p in parts])
    ends = np.array([(xs[p].min(), xs[p].max()) for p in parts])
    return centre, mean, error, ends


def _loud(e: np.ndarray, counts: np.ndarray, data: Prepared) -> tuple[tuple[float, float], ...]:
    """Find intervals in which the residual has far more energy than elsewhere."""
    energy = np.where(counts, e, 0.0) ** 2
    kernel = np.ones(_WINDOW)
    share = np.convolve(counts.astype(float), kernel, mode="same")
    local = np.convolve(energy, kernel, mode="same") / np.maximum(share, 1)
    counted = share > _WINDOW / 2
    if not np.any(counted):  # the joint never moves for as long as a window
        return ()
    usual = np.median(local[counted])
    # An effect that distorts the fit leaves some residual everywhere, but little beside the loudest window.
    loud = counted & (local > np.maximum(_LOUD * usual, _QUIET * local[counted].max()))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], loud, [False]]).astype(int)))
    time = data.times
    spans = [(float(time[a]), float(time[b - 1])) for a, b in edges.reshape(-1, 2)]
    if len(spans) > 20 or loud.mean() > 0.3:  # nearly everywhere is no region
        return ()
    return tuple(spans)


def _share_inside(
    e: np.ndarray, counts: np.ndarray, data: Prepared, intervals: tuple[tuple[float, float], ...]
) -> float:
    """Return the part of the residual's sum of squares that lies inside some intervals."""
    inside = np.zeros(len(e), bool)
    for start, end in intervals:
        inside |= (data.times >= start) & (data.times <= end)
    return float(np.sum(e[counts & inside] ** 2) / np.sum(e[counts] ** 2))


def _spectral_line(
    remainder: Float[np.ndarray, " row"], whitener: ev.Whitener, data: Prepared, wanted: np.ndarray
) -> tuple[float | None, float]:
    """Find the frequency of a line in the whitened residual that the reference lacks [Hz], and its part."""
    if len(remainder) < 100:
        return None, 0.0

    # Rows that do not count stay as gaps: if they were closed, a line would shift and smear.
    series = whitener.placed(remainder)[:, 0]
    n = len(series)
    window = np.hanning(n)
    power = np.abs(np.fft.rfft(series * window)) ** 2
    power[:5] = 0.0
    k = int(np.argmax(power))
    part = power[max(k - 2, 0) : k + 3].sum() / power.sum()

    moved = np.abs(np.fft.rfft((wanted - wanted.mean()) * window)) ** 2
    if part < _LINE_PART or _stands_out(moved, k) or not _stands_out(power, k):
        return None, 0.0
    rate = 1.0 / (data.period * data.recipe.decimation)
    return float((k + _bin_offset(power, k)) * rate / n), float(part)


def _bin_offset(power: Float[np.ndarray, " f"], k: int) -> float:
    """Return the offset of a spectral line from its highest bin, in bins: the vertex of a parabola."""
    if not 0 < k < len(power) - 1 or min(power[k - 1], power[k + 1]) <= 0:
        return 0.0
    low, top, high = np.log(power[k - 1 : k + 2])
    return float(0.5 * (low - high) / (low - 2 * top + high))


def _stands_out(power: np.ndarray, k: int) -> bool:
    """Check that a bin exceeds the median of its neighbours as noise would not."""
    around = power[max(5, k - 50) : k + 51]
    return bool(power[k] > _LINE_FACTOR * np.median(around))
