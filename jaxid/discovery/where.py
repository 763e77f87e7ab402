"""Where simulation and measurement part, explained without any physics.

The residual is regressed on one variable at a time with a curve of no particular form, and scored
like any candidate: on held-out time, against surrogates.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float

from jaxid.discovery import evidence as ev
from jaxid.discovery.noise import fit_whitener
from jaxid.logs.prepare import Prepared
from jaxid.model.plant import Plant
from jaxid.numerics.precision import NoiseModel

_KNOTS = 12
# A window of this many samples is loud where its energy exceeds the median's by this factor: in
# noise of one level that happens less than once in 10^9 windows.
_WINDOW = 20
_LOUD = 8.0
_QUIET = 0.02
# Measured acceleration and force carry the noise that the residual is made of, and a loop echoes
# in them whatever disturbs it: the residual depends on them even where they are not its cause. They
# describe, where they explain so much more than all else does, but decide nothing.
_OWN_NOISE = ("acceleration", "force")
_FAR_MORE = 2.0
# Intervals say where a residual lies if they hold most of its sum of squares.
_MOSTLY = 0.5
_SAYS_MORE = 2.0
_NEARLY_ALL = 0.95
# A spectral line must carry this part of the variance, and stand above the median of its
# neighbours by a factor that white noise exceeds once in 10^8.
_LINE_PART = 0.05
_LINE_FACTOR = 25.0


@dataclass(frozen=True)
class Where:
    """Region and intervals in which a residual lies.

    Args:
        joint: 1-based.
        variable: What the residual depends on most.
        region: Range of that variable in which it is largest.
        intervals: Times in which it is loud [s].
        text: The same in words.
        explained: Part of the residual's variance that the variable explains on held-out time.
        evidence: Held-out gain in log-likelihood [nats].
        threshold: What noise alone exceeds once in a thousand.
        clear: Whether position, elongation, velocity or time explain more than that.
        x, mean, low, high: The curve and its 95 % band, in force.
        frequency_hz: Of a spectral line; None without one.
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

    @property
    def significant(self) -> bool:
        """Whether anything but noise is there."""
        loud = bool(self.intervals) and self.variable == "time"
        return self.clear or self.frequency_hz is not None or loud


def variables(
    data: Prepared, joint: int, plant: Plant | None = None
) -> dict[str, Float[np.ndarray, " kept"]]:
    """What a residual may depend on, at the kept samples.

    Args:
        data: The prepared log.
        joint: 0-based.
        plant: Its springs stretch by more than one position, and not every joint need have a drive;
            left out: an axis.
    """
    v = data.at_kept(data.qd)[:, joint]
    time = data.times
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
    """Of the springs between a joint and another; of one to a wall it is the position."""
    n = q.shape[1]
    if plant.springs(n) == 0:
        return {}
    ports, slope = np.asarray(jax.vmap(plant.ports)(q)), np.asarray(jax.jacfwd(plant.ports)(q[0]))
    between = [k for k in range(n, ports.shape[1]) if slope[k, joint] and np.count_nonzero(slope[k]) > 1]
    return {f"elongation of spring {k - n + 1}": ports[:, k] for k in between}


def locate(
    residual: Float[np.ndarray, "kept n"],
    jacobian: Float[np.ndarray, "kept n p"],
    data: Prepared,
    colour: tuple[NoiseModel, ...],
    wanted: Float[np.ndarray, "kept n"] | None = None,
    plant: Plant | None = None,
) -> Where:
    """Find the joint and variable that explain most of a residual.

    Args:
        residual: Measured minus modelled force at the kept samples.
        jacobian: Of the residual in the model's unknowns: what they can absorb does not count.
        data: The prepared log.
        colour: Of the noise that the sensors leave, by joint.
        wanted: Velocity of the reference at the kept samples; absent: unknown.
        plant: As `variables` takes it.
    """
    wanted = data.at_kept(data.qd) if wanted is None else wanted
    found = [
        _locate(residual[:, i], jacobian[:, i], data, colour[i], wanted[:, i], i, plant)
        for i in range(residual.shape[1])
    ]
    return max(found, key=lambda w: w.explained * float(np.nanvar(residual[:, w.joint - 1])))


def _locate(
    e: np.ndarray,
    jacobian: np.ndarray,
    data: Prepared,
    colour: NoiseModel,
    wanted: np.ndarray,
    joint: int,
    plant: Plant | None,
) -> Where:
    counts = data.moving[:, joint]
    named = variables(data, joint, plant)
    hats = {name: _hats(x, counts) for name, x in named.items()}
    every = np.concatenate(list(hats.values()), axis=1)
    whitener, _ = fit_whitener(e[:, None], jacobian[:, None], every[:, None], counts[:, None], (colour,))
    blocks = whitener.blocks()
    base = _independent(whitener(jacobian[:, None]))
    white = whitener(e[:, None, None])
    # Of the residual itself: what curves of six variables leave of it would look too quiet.
    left = _beyond(whitener, e, jacobian)
    rng = np.random.default_rng(20240501)
    surrogates = ev.flipped(left, ev.stretch(len(left)), 100, rng)
    before = _held(base, np.concatenate([white, surrogates], axis=1), blocks)
    largest, gains = np.full(100, -np.inf), {}
    for name, hat in hats.items():
        both = np.concatenate([base, _independent(whitener(hat[:, None]))], axis=1)
        after = _held(both, np.concatenate([white, surrogates], axis=1), blocks)
        gain = ev.log_evidence(len(blocks), before, after)
        gains[name] = float(gain[0])
        if name not in _OWN_NOISE:
            largest = np.maximum(largest, gain[1:])
    intervals = _loud(e, counts, data)
    # A fitted colour would whiten a line away; the sensors' own leaves it standing.
    sensors = ev.Whitener((colour,), counts[:, None])
    line, part = _line(_beyond(sensors, e, jacobian), sensors, data, wanted)
    limit = ev.threshold(largest)
    # Position or velocity that explain more say more than a line in the spectrum, or than intervals.
    clean = max((n for n in gains if n not in _OWN_NOISE), key=lambda n: gains[n])
    explained = _explained(gains[clean], counts)
    line = line if part > explained else None
    clear = gains[clean] > limit
    # A curve over the motion says more than the times at which it is far from zero.
    over_motion = clear and not clean.startswith("time")
    said = min(_SAYS_MORE * explained, _NEARLY_ALL) if over_motion else explained
    if line is not None or _share(e, counts, data, intervals) > max(said, _MOSTLY):
        best = "time"
    else:
        best = _best(gains, clean)
    gain = gains[best]
    return _describe(e, counts, named[best], best, joint, gain, limit, clear, intervals, line)


def _best(gains: dict[str, float], clean: str) -> str:
    """The variable to name: one that carries the residual's noise must explain far more."""
    other = max((n for n in _OWN_NOISE if n in gains), key=lambda n: gains[n])
    return other if gains[other] > _FAR_MORE * max(gains[clean], 0.0) else clean


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
    centre, mean, error, ends = _binned(e, counts, x)
    peak = int(np.argmax(np.abs(mean) - error))
    strong = np.abs(mean) > 0.5 * np.abs(mean[peak])
    lo, hi = peak, peak
    while lo > 0 and strong[lo - 1] and mean[lo - 1] * mean[peak] > 0:
        lo -= 1
    while hi < len(mean) - 1 and strong[hi + 1] and mean[hi + 1] * mean[peak] > 0:
        hi += 1
    region = float(ends[lo, 0]), float(ends[hi, 1])
    explained = _explained(gain, counts)
    text = f"joint {joint + 1}: the residual depends on {name}"
    text += f", most between {region[0]:.3g} and {region[1]:.3g} (SI)"
    if line is not None:
        text = f"joint {joint + 1}: the residual holds a line at {line:.3g} Hz that the wanted motion lacks"
    elif name == "time" and intervals:
        text = f"joint {joint + 1}: the residual is loud in {len(intervals)} interval(s) of time"
    return Where(
        joint + 1,
        name,
        region,
        intervals,
        text,
        explained,
        gain,
        limit,
        clear,
        centre,
        mean,
        mean - 1.96 * error,
        mean + 1.96 * error,
        line,
    )


def _explained(gain: float, counts: np.ndarray) -> float:
    """Part of the variance that a gain in log-likelihood amounts to."""
    return float(1 - np.exp(-2 * max(gain, 0.0) / max(int(counts.sum()), 1)))


def _hats(x: np.ndarray, counts: np.ndarray) -> Float[np.ndarray, "kept knot"]:
    """Piecewise-linear functions with knots at quantiles: any curve, of no particular form."""
    knots = np.unique(np.quantile(x[counts], np.linspace(0, 1, _KNOTS)))
    eye = np.eye(len(knots))
    return np.stack([np.interp(x, knots, row) for row in eye], axis=1)


def _independent(columns: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, s > 1e-8 * s[0]] if len(s) else columns


def _beyond(
    whitener: ev.Whitener, e: Float[np.ndarray, " kept"], jacobian: Float[np.ndarray, "kept p"]
) -> Float[np.ndarray, " row"]:
    """What a model cannot absorb of its residual, whitened."""
    base = _independent(whitener(jacobian[:, None]))
    white = whitener(e[:, None, None])[:, 0]
    return white - base @ np.linalg.lstsq(base, white, rcond=1e-9)[0]


def _held(columns: np.ndarray, e: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    return ev.held_out(ev.grams(columns, blocks), *ev.products(columns, e, blocks))


def _binned(
    e: np.ndarray, counts: np.ndarray, x: np.ndarray, bins: int = 30
) -> tuple[np.ndarray, np.ndarray, np.ndarray, Float[np.ndarray, "bin 2"]]:
    """Of bins of x with equal counts the median, the mean of e and its error, and both ends."""
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
    """Intervals in which the residual has far more energy than elsewhere."""
    energy = np.where(counts, e, 0.0) ** 2
    kernel = np.ones(_WINDOW)
    share = np.convolve(counts.astype(float), kernel, mode="same")
    local = np.convolve(energy, kernel, mode="same") / np.maximum(share, 1)
    usual = np.median(local[share > _WINDOW / 2])
    counted = share > _WINDOW / 2
    # What bends the fit leaves something everywhere: next to the loudest that is quiet.
    loud = counted & (local > np.maximum(_LOUD * usual, _QUIET * local[counted].max()))
    edges = np.flatnonzero(np.diff(np.concatenate([[False], loud, [False]]).astype(int)))
    time = data.times
    spans = [(float(time[a]), float(time[b - 1])) for a, b in edges.reshape(-1, 2)]
    if len(spans) > 20 or loud.mean() > 0.3:  # everywhere is nowhere
        return ()
    return tuple(spans)


def _share(
    e: np.ndarray, counts: np.ndarray, data: Prepared, intervals: tuple[tuple[float, float], ...]
) -> float:
    """Part of the residual's sum of squares that lies in some intervals."""
    inside = np.zeros(len(e), bool)
    for start, end in intervals:
        inside |= (data.times >= start) & (data.times <= end)
    return float(np.sum(e[counts & inside] ** 2) / np.sum(e[counts] ** 2))


def _line(
    left: Float[np.ndarray, " row"], whitener: ev.Whitener, data: Prepared, wanted: np.ndarray
) -> tuple[float | None, float]:
    """Frequency of a line in the whitened residual that the wanted motion lacks [Hz], and its part."""
    if len(left) < 100:
        return None, 0.0
    # Rows that are left out stay as gaps: closed up, a line would shift and smear.
    series = whitener.placed(left)[:, 0]
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
    return float((k + _between(power, k)) * rate / n), float(part)


def _between(power: Float[np.ndarray, " f"], k: int) -> float:
    """By what part of a bin a line lies beside its highest one: the vertex of a parabola."""
    if not 0 < k < len(power) - 1 or min(power[k - 1], power[k + 1]) <= 0:
        return 0.0
    low, top, high = np.log(power[k - 1 : k + 2])
    return float(0.5 * (low - high) / (low - 2 * top + high))


def _stands_out(power: np.ndarray, k: int) -> bool:
    around = power[max(5, k - 50) : k + 51]
    return bool(power[k] > _LINE_FACTOR * np.median(around))
