"""Prepare a log for inverse dynamics: choose the filter, differentiate, and mark the samples that count.

A stated recipe is applied literally. If none is stated, cut-off, decimation and rest velocity follow from the
log's noise and are reported. A running median of the force is applied only if it is stated: it precedes all
other steps, see `Recipe.cleaned`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.signal

from jaxid.arrays import A, Array, library
from jaxid.errors import InputError
from jaxid.logs.log import Log, integral
from jaxid.numerics import filters as signals
from jaxid.settings import Preprocess

# Part of a force in rows to leave out that a kept sample may hold.
_CARRIED = 0.01
if TYPE_CHECKING:
    from jaxtyping import Bool, Float

# The omitted samples around reversals are at most this part of the motion.
_MOSTLY = 0.5
# Decimation keeps 1 / 0.4 samples in a period of the band's edge, and at least so many of a short log.
A_PERIOD = 0.4
_ENOUGH = 100
# Number of periods of the band's edge that are omitted at each end.
_ENDS = 3
# Largest ratio of the parallel filter's edge to the frequency at which a parabola passes half of a velocity:
# at this ratio it passes nine tenths.
_FLAT = 1 / 3


@dataclass(frozen=True)
class Recipe:
    """Settings of the filter of a log.

    Args:
        cutoff_hz: Cut-off of the zero-phase low-pass on the position [Hz]. With "parabolic" derivatives,
            which do not filter the position, the frequency at which half of the velocity passes.
        order: Order of the Butterworth filter, which is applied twice.
        decimation: One sample in so many is kept, after the parallel filter.
        trim: Number of samples omitted at each end, after decimation.
        rest_velocity: Velocity below which a sample counts as at rest [m/s or rad/s], by joint.
        align_hold: Whether the command is taken as it acts, half a sample late if it is held, and not at the
            instants at which it was logged.
        derivatives: "central" (differences), "spectral" (exact in the band) or "parabolic" (of the
            parabola through the neighbours, without a low-pass before it).
        keeps_reversals: Whether a fit uses samples that only pass through zero.
        edge: Edge of the parallel filter over half the sampling rate (see `signals.Decimator`); None:
            that of its decimation.
        reach: Number of samples on each side of a parabola.
        median: Number of samples of the running median of the force; None: the force as logged.
    """

    cutoff_hz: float
    order: int
    decimation: int
    trim: int
    rest_velocity: tuple[float, ...]
    align_hold: bool
    derivatives: str
    keeps_reversals: bool = False
    edge: float | None = None
    reach: int = 2
    median: int | None = None

    def cleaned(self, log: Log) -> Log:
        """Apply the running median of the force, which all other steps take as the logged force.

        Raises:
            InputError: If the log is shorter than the median or the parabola.
        """
        _require_length(log, self.median, self.reach if self.derivatives == "parabolic" else None)
        if self.median is None:
            return log
        return replace(log, force=signals.running_median(log.force, self.median))

    def band_hz(self, rate_hz: float) -> float:
        """Return the edge of the band in which forces are compared [Hz]."""
        return min(self.cutoff_hz, self.decimator.band_hz(rate_hz))

    def motion_hz(self, rate_hz: float) -> float:
        """Return the cut-off of the position [Hz], or the one that it would have if it were filtered."""
        if self.derivatives != "parabolic" or self.edge is None:
            return self.cutoff_hz
        return min(self.edge, 0.45) * rate_hz

    def response(self, frequency: np.ndarray, rate_hz: float, order: int = 0) -> np.ndarray:
        """Return the gain of a derivative over the exact one at each frequency, without the parallel filter.

        Args:
            frequency: Frequencies [Hz], (f,).
            rate_hz: Sampling rate of the log [Hz].
            order: Order of the derivative, 0 to 2; only a parabola treats them differently.
        """
        if self.derivatives == "parabolic":
            if order == 0:
                return np.ones_like(frequency)
            return signals.parabolic_response(frequency / rate_hz, self.reach, order)
        if self.derivatives == "spectral":
            return signals.roll_off(frequency, self.cutoff_hz)
        sos = scipy.signal.butter(self.order, self.cutoff_hz, fs=rate_hz, output="sos")
        response = scipy.signal.freqz_sos(sos, worN=frequency, fs=rate_hz)[1]  # pyright: ignore[reportArgumentType] (stub)
        return np.abs(response) ** 2

    def hold(self, log: Log, period: float | None = None) -> float:
        """Return the time for which each command of a log is held [s]; zero if the hold does not count.

        Args:
            log: The log with its kind of hold.
            period: Period of the controller [s]; None: the log's sampling time.
        """
        return self.hold_of(log.hold, period or log.period)

    def hold_of(self, hold: str, period: float) -> float:
        """Return the same as `hold` for a kind of hold and the period of the commands."""
        return period if self.align_hold and hold == "zero_order" else 0.0

    @property
    def filled(self) -> float:
        """Part of the half rate of the kept samples up to the band's edge; decimation leaves 0.8 or less."""
        most = 2 * A_PERIOD
        return most if self.edge is None else min(most, self.decimation * self.edge)

    @property
    def independent(self) -> float:
        """Part of the kept samples with independent noise: one half if the band fills the kept rate."""
        return 0.5 * self.filled / (2 * A_PERIOD)

    @property
    def decimator(self) -> signals.Decimator:
        """The parallel filter.

        For a stated recipe its edge is that of the decimation. Otherwise the band ends where the position's
        filter is still flat: beyond, the force would have no motion to be compared with.
        """
        return signals.Decimator(self.decimation, self.trim, self.edge)


@dataclass(frozen=True)
class Prepared:
    """A log that is filtered for inverse dynamics.

    Args:
        q, qd, qdd: Filtered motion at the log's rate, (time, n).
        force: Declared force, (time, m) [N or N m].
        period: Sampling time of the log [s].
        hold: Time for which each force is held from its sample on [s]; zero if that does not count (see
            `Recipe.align_hold`).
        recipe: Settings of the filter.
        moving: Mask of the kept samples that are not at rest, (kept, n).
        fitted: Mask of the kept samples that a fit uses, (kept, n): those that move; under a stated recipe
            also those that only pass through zero, as the published recipes omit nothing.
        kept: Indices of the kept samples in the arrays of motion.
        start: Time of the first sample, from the start of the log [s].
        measured: Whether each joint has an encoder; the motion of the others is that of `Log.filled`.
        steps: Integration steps in a sample for the motion of joints without an encoder (see
            `jaxid.dynamics.hidden_joints`).
        force_noise: Estimated standard deviation of the logged force, in units of the command, (m,); None:
            not estimated.
        faster_loop: Whether the log shows that a controller that is faster than its rows made the force.
        answer: Answer of each force to the noise of the reading of its row, in units of the command per m or
            rad, (m,), if that loop is faster; None: there is none.
        high_band: Noise of the force in its high band, as it was logged, (m,); None: that of the log. See
            `jaxid.simulation.sensor_noise.high_band_force_noise`.
        hold_std: Standard deviation of `hold`, if it was estimated from the log [s].
    """

    q: Float[np.ndarray, "time n"]
    qd: Float[np.ndarray, "time n"]
    qdd: Float[np.ndarray, "time n"]
    force: Float[np.ndarray, "time m"]
    period: float
    hold: float
    recipe: Recipe
    moving: Bool[np.ndarray, "kept n"]
    fitted: Bool[np.ndarray, "kept n"]
    kept: np.ndarray
    start: float = 0.0
    measured: tuple[bool, ...] = (True,)
    steps: int = 1
    force_noise: Float[np.ndarray, " m"] | None = None
    faster_loop: bool = False
    answer: Float[np.ndarray, " m"] | None = None
    high_band: Float[np.ndarray, " m"] | None = None
    hold_std: float = 0.0

    @property
    def times(self) -> Float[np.ndarray, " kept"]:
        """Time of the kept samples from the start of the log [s]."""
        return self.start + self.period * self.kept

    def parts(self, most: int, pieces: int) -> list[Prepared]:
        """Return the log itself or, if it keeps more than `most` samples, pieces spread over it.

        All pieces have one length, so that one compiled function serves them, and begin on a kept sample. For
        a joint that moves only between the pieces, a further piece is added.

        Args:
            most: Largest number of kept samples, all pieces together.
            pieces: Number of pieces.
        """
        if len(self.kept) <= most:
            return [self]
        step, trim = self.recipe.decimation, self.recipe.trim
        rows = most // pieces
        length = (rows + 2 * trim) * step
        last = (len(self.q) - length) // step
        starts = [int(k) for k in np.linspace(0, last, pieces)]
        for moving in self.moving.T:
            # The first sample of a piece does not continue another piece.
            covered = any(moving[k + 1 : k + rows].any() for k in starts)
            if moving.any() and not covered:
                moving_rows = np.flatnonzero(moving)
                starts.append(int(np.clip(moving_rows[len(moving_rows) // 2] - rows // 2, 0, last)))
        return [self._piece(k * step, length) for k in starts]

    def _piece(self, first: int, length: int) -> Prepared:
        """Cut out a piece that begins at a kept sample."""
        part = slice(first, first + length)
        kept = self.recipe.decimator.kept(length)
        at = first // self.recipe.decimation
        rows = slice(at, at + len(kept))
        return replace(
            self,
            q=self.q[part],
            qd=self.qd[part],
            qdd=self.qdd[part],
            force=self.force[part],
            moving=self.moving[rows],
            fitted=self.fitted[rows],
            kept=kept,
            start=self.start + first * self.period,
        )

    def at_kept(self, x: np.ndarray) -> np.ndarray:
        """Return the values of a signal of the log at the kept samples."""
        return x[self.kept]


# Everything is chosen from the log.
_CHOSEN = Preprocess()


def choose_recipe(log: Log, stated: Preprocess = _CHOSEN) -> Recipe:
    """Complete a stated recipe from the log, or choose all of it.

    The parallel filter ends at the first frequency at which the position is less than four times above its
    noise floor in power (a gap between the lines of a multisine is enough), at most at 0.3 of the sampling
    rate. The position's filter, with twice that cut-off, is flat over the band of the parallel filter. The
    rest velocity is five standard deviations of the velocity's noise in that band, at least half a percent of
    the RMS velocity.

    Parabolic derivatives do not filter the position, and the parallel filter ends where they are still flat,
    or earlier; with a stated decimation its edge is that of the decimation.

    Args:
        log: The log to filter.
        stated: The case's `[preprocess]`; its entries take precedence.

    Raises:
        InputError: If it states a cut-off that the log's sampling rate does not allow, or a median or a
            parabola that is longer than the log.
    """
    rate = log.rate_hz
    if stated.cutoff_hz is not None and stated.cutoff_hz >= 0.5 * rate:
        raise InputError(
            f"[preprocess] cutoff_hz = {stated.cutoff_hz:g} is not below half the sampling rate of "
            f"{rate:.6g} Hz",
            where=log.source,
            hint="lower it, or remove it: it is then chosen",
        )
    parabolic, reach = stated.derivatives == "parabolic", stated.reach
    _require_length(log, stated.median, reach if parabolic else None)

    # A literal recipe has no edge of its parallel filter beside that of the decimation.
    literal = stated.cutoff_hz is not None or (parabolic and stated.decimation is not None)
    how = stated.derivatives or ("central" if literal else "spectral")
    edge = None if literal else _noise_cutoff(log)
    if parabolic:
        cutoff = signals.parabolic_cutoff(reach) * rate
        edge = None if edge is None else min(edge, _FLAT * cutoff)
    else:
        cutoff = (
            stated.cutoff_hz if edge is None or stated.cutoff_hz is not None else min(2 * edge, 0.45 * rate)
        )
        assert cutoff is not None, "a literal recipe has a cut-off"
    band = cutoff if edge is None else edge
    decimation = _decimation(log, band) if stated.decimation is None else stated.decimation

    if stated.rest_velocity is not None:
        rest = np.full(log.position.shape[1], stated.rest_velocity, float)
    else:
        rest = _rest_velocity(log, cutoff, how, reach)
    trim = trimmed(log, band, decimation, literal=literal) if stated.trim is None else stated.trim
    return Recipe(
        cutoff_hz=cutoff,
        order=4 if stated.order is None else stated.order,
        decimation=decimation,
        trim=trim,
        rest_velocity=tuple(float(r) for r in rest),
        align_hold=not literal if stated.align_hold is None else stated.align_hold,
        derivatives=how,
        keeps_reversals=literal,
        edge=None if edge is None else 2 * edge / rate,
        reach=reach,
        median=stated.median,
    )


def _rest_velocity(log: Log, cutoff_hz: float, how: str, reach: int) -> np.ndarray:
    """Choose the velocity below which a sample counts as at rest, by joint: see `choose_recipe`."""
    _, qd, _ = motion(log, cutoff_hz, 4, how, reach)
    rate = log.rate_hz
    noise = signals.high_band_std(log.readings)
    if log.integrated:
        # White noise of density 2 sigma^2 / rate; a parabola does not filter a velocity.
        velocity_noise = noise * (1.0 if how == "parabolic" else np.sqrt(2 * cutoff_hz / rate))
    elif how == "parabolic":
        # Slope of a line through 2 k + 1 samples.
        velocity_noise = noise * rate * np.sqrt(3 / (reach * (reach + 1) * (2 * reach + 1)))
    else:
        # White noise of density 2 sigma^2 / rate, times (2 pi f)^2, integrated up to the cut-off.
        velocity_noise = noise * 2 * np.pi * np.sqrt(2 * cutoff_hz**3 / (3 * rate))
    return np.maximum(5 * velocity_noise, 5e-3 * np.sqrt(np.mean(qd**2, axis=0)))


def _require_length(log: Log, median: int | None, reach: int | None) -> None:
    """Refuse a window that is as long as the log."""
    windows = {"median": (median, median), "reach": (reach, None if reach is None else 2 * reach + 1)}
    for key, (value, width) in windows.items():
        if width is not None and width >= log.samples:
            raise InputError(
                f"[preprocess] {key} = {value} takes {width} samples, and the log has {log.samples}",
                where=log.source,
                hint="lower it, or take a longer log",
            )


def _decimation(log: Log, band_hz: float) -> int:
    """Choose the decimation that the band needs, or a smaller one for a short log.

    Other omissions (ends, stops, reversals) are whole kept samples; of twenty-five kept ones too few would
    remain. Noise of the additional samples is correlated, which whitening takes into account.
    """
    return max(1, min(spaced(log.rate_hz, band_hz), log.samples // _ENOUGH))


def spaced(rate_hz: float, band_hz: float) -> int:
    """Return the decimation that a band needs."""
    return max(1, int(A_PERIOD * rate_hz / band_hz))


def trimmed(log: Log, band_hz: float, decimation: int, *, literal: bool, periods: int = _ENDS) -> int:
    """Return the number of kept samples to omit at each end, as far as the ends of filters reach.

    Args:
        log: The log to filter.
        band_hz: Edge of the band [Hz].
        decimation: One sample in so many is kept.
        literal: Whether the recipe is stated; else at most an eighth of a short log is omitted.
        periods: Number of periods of the band's edge after which the effect of the ends has decayed.
    """
    reach = int(np.ceil(periods * log.rate_hz / (band_hz * decimation)))
    return reach if literal else min(reach, log.samples // decimation // 8)


def _noise_cutoff(log: Log) -> float:
    """Find the frequency up to which every joint's reading is above its noise without a gap [Hz]."""
    rate = log.rate_hz
    # Segments of two seconds: corners of friction recur over seconds, noise is everywhere.
    position = log.readings[:, list(log.measured)]
    length = int(min(len(position), max(256, 2 * rate)))
    f, p = scipy.signal.welch(position, rate, window="hann", nperseg=length, detrend="linear", axis=0)
    floor = 2 * signals.high_band_std(position) ** 2 / rate
    above = np.all(p > 4 * floor, axis=1) & (f < 0.3 * rate)
    first_lost = np.argmax(~above[1:]) + 1 if np.any(~above[1:]) else len(f) - 1
    lowest = 8.0 / (log.samples * log.period)
    # Two digits, rounded down: it is not known better, and similar logs share compiled code.
    digit = 10.0 ** (np.floor(np.log10(f[first_lost])) - 1)
    return float(np.clip(np.floor(f[first_lost] / digit) * digit, lowest, 0.3 * rate))


def differentiate(
    x: Float[np.ndarray, "time n"],
    period: float,
    cutoff_hz: float,
    order: int,
    how: str,
    orders: int = 2,
    reach: int = 2,
) -> tuple[np.ndarray, ...]:
    """Differentiate a signal up to an order; it is filtered unless `how` is "parabolic", see `Recipe`."""
    if how == "parabolic":
        if orders > 2:
            raise ValueError(f"a parabola has no derivative of order {orders}.")
        return (x, *signals.parabolic_derivatives(x, period, reach))[: orders + 1]
    if how == "spectral":
        return signals.spectral_derivatives(x, period, cutoff_hz, orders)
    out = [signals.butterworth_zero_phase(x, cutoff_hz, order, 1 / period)]
    for _ in range(orders):
        out.append(signals.central_difference(out[-1], period))
    return tuple(out)


def motion(
    log: Log, cutoff_hz: float, order: int, how: str, reach: int = 2
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return filtered position, velocity and acceleration of a log, (time, n) each; see `differentiate`.

    Where the velocity was measured, it is filtered and differentiated once, and the position is its integral.
    """
    if not log.integrated:
        q, qd, qdd = differentiate(log.filled, log.period, cutoff_hz, order, how, reach=reach)
        return q, qd, qdd
    qd, qdd = differentiate(log.readings, log.period, cutoff_hz, order, how, orders=1, reach=reach)
    return integral(log.time, qd), qd, qdd


def prepare(log: Log, gain: np.ndarray, recipe: Recipe, hold_period: float | None = None) -> Prepared:
    """Filter a log and mark the samples that count.

    Args:
        log: The log, from `Recipe.cleaned`.
        gain: Declared force per unit of command, (m,).
        recipe: Settings of the filter.
        hold_period: Time for which a held command is held [s]; None: the log's sampling time.
    """
    q, qd, qdd = motion(log, recipe.cutoff_hz, recipe.order, recipe.derivatives, recipe.reach)
    moving, fitted = counted(qd, recipe, log.measured)
    kept = recipe.decimator.kept(len(q))
    if log.clipped is not None:
        known = ~spread(log.clipped, recipe)[:, None]
        moving, fitted = moving & known, fitted & known
    return Prepared(
        q=q,
        qd=qd,
        qdd=qdd,
        force=log.force * gain,
        period=log.period,
        hold=recipe.hold(log, hold_period),
        recipe=recipe,
        moving=moving,
        fitted=fitted,
        kept=kept,
        measured=log.measured,
    )


def counted(
    qd: Float[np.ndarray, "time n"], recipe: Recipe, measured: tuple[bool, ...]
) -> tuple[Bool[np.ndarray, "kept n"], Bool[np.ndarray, "kept n"]]:
    """Return the masks `moving` and `fitted` of `Prepared`.

    Args:
        qd: Filtered velocity at the log's rate.
        recipe: Settings of the filter.
        measured: Whether each joint has an encoder.
    """
    kept, seen = recipe.decimator.kept(len(qd)), np.asarray(measured)
    at_rest = np.abs(qd) < np.asarray(recipe.rest_velocity)
    reach = recipe.decimator.reach
    if recipe.keeps_reversals:
        fitted = ~smeared(lasting(at_rest, 2 * recipe.decimation), reach)[kept] & seen
        return ~smeared(at_rest, reach)[kept] & seen, fitted
    turns = turning(qd)
    reach = affordable(at_rest, turns, max(reach, recipe.decimation - 1))
    # An axis that swings faster than the filter's reach has only reversals: they are kept.
    moving = ~smeared(at_rest | (turns & (reach > 0)), reach)[kept] & seen
    return moving, moving


def spread(rows: Bool[np.ndarray, "time m"], recipe: Recipe) -> Bool[np.ndarray, " kept"]:
    """Return the mask of the kept samples that hold more than a hundredth of some rows, (kept,)."""
    return np.any(np.abs(np.asarray(recipe.decimator(rows.astype(float)))) > _CARRIED, axis=1)


def counted_as(
    qd: Float[Array, "time n"], recipe: Recipe, reach: int
) -> tuple[Bool[Array, "kept n"], Bool[Array, ""]]:
    """Return the mask `fitted` of a log whose every joint has an encoder, around stops by a known reach.

    Args:
        qd: Filtered velocity at the log's rate.
        recipe: Settings of the filter, chosen from a log.
        reach: Number of samples to omit around stops and reversals, as `reach_around` has it of a like log.

    Returns:
        The mask, and whether this log has the same reach.
    """
    at_rest, turns = abs(qd) < np.asarray(recipe.rest_velocity), turning(qd)
    most = max(recipe.decimator.reach, recipe.decimation - 1)
    tried = [near for near in _nearer(most) if near >= reach]
    same = np.ones((), bool)
    for near in tried:
        same = same & (spares(at_rest, turns, near) == (near == reach))
    fitted = ~smeared(at_rest | turns if reach else at_rest, reach)[recipe.decimator.kept(len(qd))]
    return fitted, same


def reach_around(qd: Float[np.ndarray, "time n"], recipe: Recipe) -> int:
    """Return the number of samples that `counted` omits around stops and reversals."""
    at_rest = np.abs(qd) < np.asarray(recipe.rest_velocity)
    return affordable(at_rest, turning(qd), max(recipe.decimator.reach, recipe.decimation - 1))


def affordable(at_rest: np.ndarray, turning: np.ndarray, reach: int) -> int:
    """Return the number of samples to omit around stops and reversals, so that most of the motion remains."""
    return next((near for near in _nearer(reach) if spares(at_rest, turning, near)), 0)


def _nearer(reach: int) -> list[int]:
    """Return the numbers of samples around stops that are tried, from the largest."""
    return [int(np.ceil(part * reach)) for part in (1.0, 0.75, 0.5, 0.25)]


def spares(at_rest: Bool[Array, "time n"], turning: Bool[Array, "time n"], reach: int) -> Bool[Array, ""]:
    """Check that most of the motion remains if so many samples around stops and reversals are omitted."""
    lost = smeared(at_rest | turning, reach) & ~at_rest
    return (lost.sum(axis=0) < _MOSTLY * (~at_rest).sum(axis=0).clip(1)).all()


def turning(v: Float[A, "time n"]) -> Bool[A, "time n"]:
    """Mark the samples between which a velocity changes its sign: a fast reversal has none at rest."""
    xp = library(v)
    signs = xp.sign(v)
    turns = signs[1:] != signs[:-1]
    edge = np.zeros((1, v.shape[1]), bool)
    return xp.concatenate([turns, edge]) | xp.concatenate([edge, turns])


def smeared(flags: Bool[A, "time n"], reach: int) -> Bool[A, "time n"]:
    """Mark flags and their neighbours: the parallel filter spreads a stop over them."""
    width, beyond = 2 * reach + 1, np.zeros((reach, flags.shape[1]), bool)
    out, joined = library(flags).concatenate([beyond, flags, beyond]), 1
    # Each sample joins the windows of two samples, until one window is as wide as is asked.
    while joined < width:
        step = min(joined, width - joined)
        out, joined = out[:-step] | out[step:], joined + step
    return out


def lasting(flags: np.ndarray, length: int) -> np.ndarray:
    """Keep only those flags, (time, n), that are set for more than `length` consecutive samples."""
    out = np.zeros_like(flags)
    for i, f in enumerate(flags.T):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], f, [False]]).astype(int)))
        for start, end in edges.reshape(-1, 2):
            out[start:end, i] = end - start > length
    return out
