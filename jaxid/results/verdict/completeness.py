"""Tests of a force residual against the sensors' noise: its colour by a cumulated periodogram, and its size.

The residual is whitened by the spectrum that the sensors' noise has in it. If the model is complete, the
result is white; missing physics follows the motion and so adds power at low frequencies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.discovery.evidence import Whitener
from jaxid.discovery.noise import NUMERICS, sensor_colour
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.gap import ForceGap, SimulationGap, noise_density, row_noise
from jaxid.logs.soundness import position_levels
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.filters import high_band_std
from jaxid.session import OpenedLog
from jaxid.simulation.force_balance import ForceData, inertial_force
from jaxid.simulation.noisy_loop import noisy_readings
from jaxid.simulation.replay import make_replay
from jaxid.simulation.sensor_noise import high_band_force_noise, position_noise

# Part of the half sampling rate of positions that counts.
_BAND = 0.8
# Part of the filter's band that counts for a force: up to there a tenth of the noise's power passes.
_INSIDE = 0.7
# A systematic part below this many `NUMERICS` of the force may be an error of filtering and integration.
_NUMERICS = 2.0
# Fewer frequencies than this in the band show no colour.
_FEWEST = 20
# Excess of the cumulated periodogram over a white one that counts, as a part of the power: on the fitted log,
# and on others, whose residual also holds the error of the parameters.
_EXCESS, _EXCESS_ELSEWHERE = 0.05, 0.1
# Factor in RMS over the noise of an encoder beyond which its effect in a loop decides nothing: of an arm half
# of the noise, and of one joint, whose command the noise may drive into its limit.
_NEAR, _NEAR_ALONE = 3.0, 20.0
# Least periodograms in each value of the spectrum of drawn readings.
_PERIODOGRAMS = 100
# Probability that the periodogram of white noise exceeds the limit; there is one test for each joint and log.
_RARELY = 1e-3
# Factor in RMS by which a residual of the right colour may exceed the noise, which is known to a few tenths,
# and standard deviations of its scatter beyond that.
_LOUDER, _SCATTER = 1.3, 4.0
# Factor in RMS over the noise floor of the tables beyond which a residual is noise only if the force is read
# with far more of it than was estimated.
_ABOVE = 1.6
# Part of a count that a joint must move in a sample, so that rounding is white.
_ROUNDS_WHITE = 0.3
# Parts of the high band of the logged force that may be noise of its reading. In a loop the rest is the
# controller's answer to the encoder's noise, which really acts.
_SHARES = (1.0, 0.3, 0.1, 0.03, 0.0)


@dataclass(frozen=True)
class Residual:
    """Comparison of one joint's force residual on one log with the noise.

    Args:
        log: Name of the log.
        joint: Index of the joint, 0-based.
        complete: Whether the residual is noise; None if that cannot be decided.
        rms: RMS of the residual [N or N m].
        floor: RMS that the noise leaves in the band [N or N m]; NaN if the noise is not known.
        excess: Largest excess of the cumulated periodogram over that of noise, as a part of the power.
        limit: Excess that noise alone exceeds once in a thousand logs.
        systematic: RMS of the part at low frequencies that is not noise [N or N m].
        numerics: RMS that errors of filtering and integration may have [N or N m].
        reason: Reason why `complete` is None; empty if it is not.
        quantity: Quantity of the residual, "force" or "position"; its unit is that of rms and floor.
        quiet: RMS of what the loop without noise leaves, where mean readings count in its place; NaN: they do
            not.
    """

    log: str
    joint: int
    complete: bool | None
    rms: float
    floor: float
    excess: float = 0.0
    limit: float = 1.0
    systematic: float = 0.0
    numerics: float = 0.0
    reason: str = ""
    quantity: str = "force"
    quiet: float = np.nan

    @property
    def coloured(self) -> bool:
        """True if the residual has clearly more power at low frequencies than the noise."""
        return self.excess > self.limit and self.systematic > self.numerics

    @property
    def above_floor(self) -> bool:
        """True if it is undecided because it is far above the estimated noise, though it has its colour."""
        return self.complete is None and self.rms > _ABOVE * self.floor

    @property
    def within_numerics(self) -> bool:
        """True if it passes for complete, but is more than noise: errors of filtering may be as large."""
        small = self.rms <= self.numerics or self.excess > self.limit
        return self.complete is True and small and self.rms > _LOUDER * self.floor


def residuals_of(machine: Machine, run: OpenedLog, gap: ForceGap, *, fitted: bool = True) -> list[Residual]:
    """Compare the force residual of each joint that moves with the sensors' noise.

    Force noise that the case does not state is at most the high band of the logged force; of all levels up to
    there the one under which the residual is most like noise counts.

    Args:
        machine: The fitted machine.
        run: The log.
        gap: Its gap in force.
        fitted: Whether the machine was fitted to this log.
    """
    joints = np.flatnonzero(np.isfinite(gap.rms)).tolist()
    if run.log.steady is not None:
        return [_of_rows(machine, run, gap, k, fitted=fitted) for k in joints]
    middle = 0.0 if run.log.stepped else run.data.force.mean(axis=0)
    force = run.data.at_kept(run.data.force - middle)
    if run.log.passive:
        force = np.asarray(_inertial(machine.plant, ForceData.of(run.data)))
    size = float(np.sqrt(np.mean(force**2))) if force.size else 0.0
    if size == 0:
        reason = "the log has no force to compare with"
        return [Residual(run.name, k, None, float(gap.rms[k]), np.nan, reason=reason) for k in joints]

    stated = machine.sensor.force_noise is not None
    most = high_band_force_noise(run.log, run.data)
    # What a loop that is faster than its log makes of noise acts for a tick of several, and is noise here.
    shares = _SHARES if run.data.answer is None else _SHARES[:1]
    levels = [None] if stated else [share * most for share in shares]
    colours = [sensor_colour(machine, run.log, run.data, level) for level in levels]
    whitened = [_whitened(colour, run, gap) for colour in colours]
    # The number that is printed is that of the tables, whatever level explains the residual best.
    floor = _floor(machine, run)

    # A joint of an arm may have a thousandth of another's torque; a joint without a drive has none.
    sizes = np.sqrt(np.mean(gap.measured**2, axis=0))
    numerics = _NUMERICS * NUMERICS * np.where(sizes > 0, sizes, size)
    # Near the edge of the filter's band and beyond, the residual is rounding and errors of numerics.
    band = _INSIDE * run.data.recipe.filled
    least = _EXCESS if fitted else _EXCESS_ELSEWHERE
    out = []
    for joint in joints:
        tests = [cumulated_excess(z[joint], band=band) for z in whitened]
        best = int(np.argmin([excess for excess, *_ in tests]))
        excess, count, power = tests[best]
        found = Residual(
            log=run.name,
            joint=joint,
            complete=True,
            rms=float(gap.rms[joint]),
            floor=float(floor[joint]),
            excess=excess,
            limit=max(least, float(np.sqrt(-0.5 * np.log(_RARELY) / max(count, 1)))),
            systematic=systematic_rms(whitened[best][joint], colours[best][joint], band),
            numerics=float(numerics[joint]),
        )
        loud = power > _LOUDER**2 + _SCATTER / np.sqrt(max(count, 1))
        decided = _decided(found, count, loud=loud, stated=stated)
        estimated = not stated and run.data.answer is None
        out.append(_unlike_floor(decided) if estimated else decided)
    return out


def _unlike_floor(found: Residual) -> Residual:
    """Return the comparison undecided if only noise far above the estimated one explains the residual."""
    if found.complete is not True or found.rms <= found.numerics or not found.rms > _ABOVE * found.floor:
        return found
    reason = (
        f"the force gap is {found.rms / found.floor:.2g} times the noise floor; it is noise only if the "
        "force is read with far more noise than the log shows, and [sensor] does not state that"
    )
    return replace(found, complete=None, reason=reason)


_inertial = eqx.filter_jit(inertial_force)


def _of_rows(machine: Machine, run: OpenedLog, gap: ForceGap, joint: int, *, fitted: bool) -> Residual:
    """Compare the residual of a steady table with the stated scatter of its rows, by chi-square."""
    std = None if run.log.steady is None else run.log.steady.std
    rms = float(gap.rms[joint])
    if std is None:
        reason = "[log] states no scatter of the rows"
        return Residual(run.name, joint, None, rms, np.nan, reason=reason)
    z = (gap.residual / (std * np.abs(machine.gain)))[:, joint]
    z = z[np.isfinite(z)]
    freedom = z.size - (len(machine.parameters.free) if fitted else 0)
    floor = float(row_noise(machine, run.log)[joint])
    if freedom < 1:
        return Residual(run.name, joint, None, rms, floor, reason="the table has no rows to spare")
    fits = bool(scipy.stats.chi2.sf(np.sum(z**2), freedom) > _RARELY)
    return Residual(run.name, joint, fits, rms, floor)


def _noise_shows(machine: Machine, run: OpenedLog, gap: SimulationGap, floor: np.ndarray) -> bool:
    """Check that noise in the loop could decide a residual.

    Along an arm of many joints a run with each draw of noise takes minutes.
    """
    near = gap.rms <= (_NEAR_ALONE if machine.gain.size == 1 else _NEAR) * floor
    return bool(np.any(near[list(run.log.measured)])) and machine.plant.filters_fast


def position_residuals(
    machine: Machine, run: OpenedLog, gap: SimulationGap | None, *, fitted: bool = True
) -> list[Residual]:
    """Compare the position that a simulated loop leaves of a log without a force with the encoder's noise.

    The mean readings of a loop that reads a noisy encoder count, since the noise moves them; see
    `jaxid.simulation.noisy_loop`. The noise also shakes the machine, so that readings scatter about their
    mean with the colour of the loop: the residual is whitened by the spectrum of drawn readings. Rounding to
    a count is white only while the joint moves by a good part of a count in a sample. Slower samples do not
    count.

    Args:
        machine: The fitted machine.
        run: The log.
        gap: Its gap in simulation; None: the simulation diverges.
        fitted: Whether the machine was fitted to this log.
    """
    joints = np.flatnonzero(run.log.measured).tolist()
    machine = run.machine(machine)
    floor = position_noise(machine, run.log)
    if gap is None:
        return [
            Residual(run.name, k, False, np.nan, float(floor[k]), excess=1.0, quantity="position")
            for k in joints
        ]

    found = _positions_left(machine, run, gap.position, fitted=fitted)
    # The runs with noise take most of the time of a verdict: without them a residual may be noise already.
    noise_decides = any(r.complete is False for r in found) and _noise_shows(machine, run, gap, floor)
    if not machine.unforced(run.log) or not noise_decides:
        return found
    numerics = choose_numerics(machine, run.log)
    noisy = noisy_readings(machine, run.log, make_replay(machine, run.log, numerics))
    if noisy is None:
        return found
    by_mean = _positions_left(machine, run, *noisy, fitted=fitted)
    return [replace(mean, quiet=quiet.rms) for mean, quiet in zip(by_mean, found, strict=True)]


def _positions_left(
    machine: Machine,
    run: OpenedLog,
    simulated: Float[np.ndarray, "time n"],
    drawn: Float[np.ndarray, "runs time n"] | None = None,
    *,
    fitted: bool,
) -> list[Residual]:
    """Compare the position that a simulation leaves of a log with the encoder's noise, by joint.

    The noise is white, or else that of drawn readings.
    """
    floor, least = position_noise(machine, run.log), _EXCESS if fitted else _EXCESS_ELSEWHERE
    out = []
    for k in np.flatnonzero(run.log.measured).tolist():
        e = (run.log.position - simulated)[:, k]
        rms = float(np.sqrt(np.mean(e**2)))
        step = position_levels(run.log.position[:, k])[1]
        moving = np.abs(run.data.qd[:, k]) >= _ROUNDS_WHITE * step * run.log.rate_hz
        size = max(float(floor[k]), 1e-300)
        level = size if machine.sensor.position_std is not None else None
        colour = 1.0 if drawn is None else spectrum_of_draws(drawn[:, :, k], moving, level)
        excess, count, power = cumulated_excess(e[moving] / size, colour)
        found = Residual(
            log=run.name,
            joint=k,
            complete=True,
            rms=rms,
            floor=float(floor[k]),
            excess=excess,
            limit=max(least, float(np.sqrt(-0.5 * np.log(_RARELY) / max(count, 1)))),
            systematic=rms,
            quantity="position",
        )
        loud = power > _LOUDER**2 + _SCATTER / np.sqrt(max(count, 1))
        out.append(_decided(found, count, loud=loud, stated=True))
    return out


def spectrum_of_draws(
    drawn: Float[np.ndarray, "runs time"], moving: np.ndarray, level: float | None
) -> Float[np.ndarray, " f"]:
    """Return the spectrum of drawn readings at the samples in motion, over that of white noise.

    Args:
        drawn: Readings less their mean.
        moving: Samples that count, (time,).
        level: Standard deviation of the white noise; None: that which the high band of a draw shows, as a
            log's does.
    """
    if level is None:
        level = float(np.sqrt(np.mean(np.square(high_band_std(drawn.T)))))
    power = np.mean(np.abs(np.fft.rfft(drawn[:, moving])) ** 2, axis=0)[1:]
    width = min(-(-_PERIODOGRAMS // len(drawn)), max(len(power), 1))
    ones = np.ones(width)
    smooth = np.convolve(power, ones, "same") / np.convolve(np.ones_like(power), ones, "same")
    return smooth / (max(int(moving.sum()), 1) * max(level, 1e-300) ** 2)


def _decided(found: Residual, count: int, *, loud: bool, stated: bool) -> Residual:
    """Return the comparison with its decision; `loud` says that the residual exceeds the noise."""
    if found.rms <= found.numerics:
        return found
    if count < _FEWEST:
        return replace(found, complete=None, reason="the log has too few samples in motion")
    if found.coloured or (loud and stated):
        return replace(found, complete=False)
    if loud:
        reason = (
            "the residual is louder than the noise of the logged force seems, and [sensor] does not state it"
        )
        return replace(found, complete=None, reason=reason, floor=np.nan)
    return found


def cumulated_excess(
    z: Float[np.ndarray, " row"], colour: Float[np.ndarray, " f"] | float = 1.0, band: float = _BAND
) -> tuple[float, int, float]:
    """Return the largest excess of a series' cumulated periodogram over a white one in a band.

    Of a white series the excess stays below sqrt(-ln(p) / 2 m) with probability 1 - p, m being the number of
    frequencies.

    Args:
        z: Whitened residual, (row,).
        colour: Spectrum by which it is whitened further, at its frequencies above zero, (f,); 1: not at all.
        band: Part of the half sampling rate that counts.

    Returns:
        The excess as a part of the power, the number of frequencies, and the mean power in the band.

    Source:
        Bartlett (1955), An Introduction to Stochastic Processes; Durbin (1969), Biometrika 56, 1-15; the
        one-sided limit is that of Kolmogorov and Smirnov.
    """
    power = np.abs(np.fft.rfft(z))[1:] ** 2 / np.maximum(colour, 1e-300)
    power = power[: int(band * len(power))]
    count, total = len(power), float(power.sum())
    if count == 0 or total <= 0:
        return 0.0, count, 0.0
    excess = np.max(np.cumsum(power) / total - np.arange(1, count + 1) / count)
    return float(excess), count, total / count / len(z)


def systematic_rms(z: Float[np.ndarray, " row"], noise: NoiseModel, band: float = _BAND) -> float:
    """Return the RMS of what a residual holds beyond its noise at low frequencies, in the residual's unit.

    Args:
        z: Whitened residual, (row,).
        noise: Model of the noise by which it was whitened.
        band: Part of the half sampling rate that counts.
    """
    power = np.abs(np.fft.rfft(z))[1:] ** 2 / len(z)
    count = int(band * len(power))
    if count == 0:
        return 0.0
    beyond = power[:count] - 1.0
    end = int(np.argmax(np.cumsum(power[:count] - np.mean(power[:count])))) + 1
    density = noise.density(len(z))[1 : count + 1]
    return float(np.sqrt(max(2 * np.sum((beyond * density)[:end]) / len(z), 0.0)))


def _whitened(
    colour: tuple[NoiseModel, ...], run: OpenedLog, gap: ForceGap
) -> list[Float[np.ndarray, " row"]]:
    """Return the whitened residual of each joint; samples beside a gap follow each other."""
    e, moving = np.nan_to_num(gap.residual), run.data.moving
    return [
        Whitener((colour[k],), moving[:, [k]])(e[:, [k], None])[:, 0] if moving[:, k].any() else np.zeros(0)
        for k in range(e.shape[1])
    ]


def _floor(machine: Machine, run: OpenedLog) -> Float[np.ndarray, " n"]:
    """Return the RMS force that the noise leaves in the band [N or N m], by joint."""
    f, power = noise_density(machine, run.log, run.data)
    return np.sqrt(np.trapezoid(power, f, axis=0))
