"""Noise of the logged force, estimated from the log; and stated noise that the log contradicts."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.logs.soundness import position_levels
from jaxid.machine import Machine
from jaxid.numerics import filters as signals
from jaxid.numerics.fft import rfft
from jaxid.simulation.sensor_noise import position_density

# Samples before and after, up to which a force may be a linear function of positions and reference: the law
# of a sampled controller, with an average or a filter in it, and the inertia of a motion near the band's top.
_BEFORE, _AFTER = 8, 4
# Samples of a log for each of these coefficients.
_SAMPLES_EACH = 40
# A loop is faster than its log if the reading of the same row explains the high band of its force nearly as
# well as all readings around it do: it leaves less than this factor times their remainder.
_NO_MORE = 1.1
# Rows before the same one that may explain more: the loop of a log's rate differentiates over them.
_PAST = 2
# The whole band is more than the first factor times that remainder, and these rows explain less than the
# second part of all that is explained (in squares). A loop of the log's rate with a filtered derivative comes
# near both limits. They are wider for a force that plainly does not act for a row: no loop of that rate makes
# it.
_SOME, _OTHER_ROWS = 1.2, 0.06
_SOME_AT_LEAST, _OTHER_ROWS_AT_MOST = 1.05, 0.2
# Part of the band of inverse dynamics in which its residual bounds the noise of the force.
_BAND = (0.3, 0.8)
# Fewest frequencies that give a median.
_FREQUENCIES = 20
# Numbers of levels between which a force counts as quantised: fewer are a switched command, and the steps of
# more are as small as any noise.
_LEVELS = (8, 1000)
# Factor between stated and estimated noise from which they contradict each other.
_FACTOR = 3.0
# Largest ratio of two estimates in different bands of one white noise.
_ALIKE = 1.5


class ForceNoise(NamedTuple):
    """Noise of the logged forces.

    Args:
        std: Standard deviation of white noise of each force, in units of the command, (m,).
        faster_loop: Whether a controller that is faster than the log made one of the forces.
        answer: Answer of each force to the noise of its own row's reading, in units of the command per m or
            rad, (m,); zero where the loop is not faster; None: none has one.
    """

    std: Float[np.ndarray, " m"]
    faster_loop: bool = False
    answer: Float[np.ndarray, " m"] | None = None


def estimated_force_noise(
    machine: Machine,
    log: Log,
    data: Prepared,
    fit: BalanceFit,
    law: Float[np.ndarray, "time m"] | None = None,
    *,
    fast: bool | None = False,
) -> ForceNoise:
    """Estimate the standard deviation of white noise of each logged force.

    Each of the following is an upper bound for it, and the lowest counts:

    - the force in the high band that is no linear function of positions and reference around the sample. The
      rest comes from the controller, which differentiates the noise of its encoder: it is a force, and the
      log has it exactly. If the loop is faster than the log, it is all of the high band.
    - the residual of inverse dynamics in the upper part of its band, position noise subtracted. It excludes a
      rough force that was commanded and logged exactly.
    - the high band of the logged force minus that of the declared control law, if that reproduces it.
    - the changes within the stretches of a command that is constant but for a few steps, whose edges are in
      every band.

    A force on few levels has at least the noise of its rounding, step / sqrt(12).

    Args:
        machine: The machine at its guesses.
        log: The log.
        data: The prepared log.
        fit: Balance of the prepared log.
        law: Command of the declared control law at the logged readings, in units of the command; None: there
            is none that reproduces the logged one.
        fast: Whether the loop is known to be faster than the log; None: it is known not to be.
    """
    high, in_band = _beyond_controller(machine, log, fast=fast), _in_band(machine, log, data, fit)
    # The high band has more frequencies than the band of a balance, and so the better estimate of one noise.
    alike = high.noise < _ALIKE * in_band
    in_band = np.where(high.faster & alike, np.maximum(in_band, high.noise), in_band)
    bounds = [high.noise, in_band, signals.noise_within_stretches(log.force)]
    if law is not None:
        bounds.append(signals.high_band_std(log.force - law))
    if data.recipe.median:
        white = signals.median_noise(data.recipe.median)
        bounds = [b if k == 1 else b / white for k, b in enumerate(bounds)]
    noise = np.min(bounds, axis=0)
    steps = np.array([_step(u) for u in log.force.T])
    return ForceNoise(
        std=np.maximum(noise, steps / np.sqrt(12)),
        faster_loop=high.faster,
        answer=high.answer if high.answer.any() else None,
    )


def _step(u: np.ndarray) -> float:
    """Return the step of a force on few levels; 0 if it is not quantised so coarsely."""
    levels, step = position_levels(u)
    return step if _LEVELS[0] <= levels <= _LEVELS[1] else 0.0


def loop_is_faster(machine: Machine, log: Log, *, likely: bool = False) -> bool:
    """Check whether a controller that is faster than the log made a force, by its answer to noise.

    Args:
        machine: The machine.
        log: The log.
        likely: Whether the force plainly does not act for a row of the log.
    """
    return _beyond_controller(machine, log, likely=likely).faster


class _HighBand(NamedTuple):
    """High bands of the forces.

    Args:
        noise: Standard deviation of each that counts as noise, (m,).
        answer: Answer of each force to the noise of its row's reading, (m,); zero where the loop is not
            faster than the log, or none of the bands shows it.
        faster: Whether the loop is faster than the log.
    """

    noise: np.ndarray
    answer: np.ndarray
    faster: bool


def _beyond_controller(
    machine: Machine, log: Log, *, fast: bool | None = False, likely: bool = False
) -> _HighBand:
    """Return the noise of each force that no controller of the log's rate makes of its readings.

    A controller of the log's rate differentiates the noise of its readings over rows, and the force that it
    makes of it acts. In a log of a faster loop only the noise of the same row is in the force. It acts for a
    tick, and the rows do not show the others: the whole high band is then noise of the force. A declared
    controller has its own rate. All drives of a machine have one loop, whose rate the noise of one may show.
    """
    driven, each = machine.plant.driven(machine.plant.joints), []
    for k, j in enumerate(driven):
        of = [log.readings[:, int(j)]]
        if log.reference is not None:
            of.append(log.reference[:, min(k, log.reference.shape[1] - 1)])
        each.append(_unexplained(log.force[:, k], of))

    shown = fast is not None and machine.controller is None
    shown = shown and any(found.of_same_row(likely=bool(fast) or likely) for found in each)
    faster = bool(fast) or shown
    return _HighBand(
        noise=np.array([found.total if faster else found.left for found in each]),
        answer=np.array([found.factor if shown else 0.0 for found in each]),
        faster=faster,
    )


class _Unexplained(NamedTuple):
    """Noise in the high band of a signal, as the deviation of a white noise, by the signals that explain it.

    Args:
        left: The part that no linear filter of the other signals explains.
        same_row: The part that the first of them does not explain at the same row.
        total: The whole band.
        factor: Factor from the first of the others to the signal, at the same row.
        other_rows: Part that the same row does not explain of the squares that its last three rows explain.
    """

    left: float
    same_row: float
    total: float
    factor: float
    other_rows: float

    def of_same_row(self, *, likely: bool) -> bool:
        """Check that the first of the others explains much of the signal, and by its same row alone."""
        some, rows = (_SOME_AT_LEAST, _OTHER_ROWS_AT_MOST) if likely else (_SOME, _OTHER_ROWS)
        much = self.total > some * self.left and self.same_row < _NO_MORE * self.left
        return much and self.other_rows < rows


def _unexplained(u: np.ndarray, of: list[np.ndarray]) -> _Unexplained:
    """Compare the high band of a signal with that of other signals.

    Args:
        u: The signal.
        of: The others.
    """
    room = max(u.size // (_SAMPLES_EACH * len(of)), 1)
    share = min(1.0, room / (_BEFORE + _AFTER + 1))
    before, after = int(_BEFORE * share), int(_AFTER * share)
    size = u.size - before - after

    def spectra(x: np.ndarray, lags: range) -> np.ndarray:
        shifted = np.stack([x[before - lag : before - lag + size] for lag in lags], axis=1)
        return _high_band(shifted)

    target = spectra(u, range(1))
    around = np.concatenate([spectra(x, range(-after, before + 1)) for x in of], axis=1)
    left = _deviation(_left_by(target, around)[0])
    same_row, factor = _left_by(target, spectra(of[0], range(1)))
    three, _ = _left_by(target, spectra(of[0], range(min(before, _PAST) + 1)))
    squares = [float(np.linalg.norm(x) ** 2) for x in (target, same_row, three)]
    return _Unexplained(
        left=left,
        same_row=_deviation(same_row),
        total=_deviation(target),
        factor=float(factor[0]),
        other_rows=(squares[1] - squares[2]) / max(squares[0] - squares[2], 1e-300),
    )


def _left_by(target: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the remainder of a spectrum after the best real combination of others, and the combination."""
    power = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(power > 0, power, 1.0)

    # Real coefficients for complex spectra: both parts are rows.
    rows, right = (np.concatenate([np.real(x), np.imag(x)]) for x in (scaled, target))
    solved = np.linalg.lstsq(rows, right, rcond=1e-10)[0]
    return target - scaled @ solved, solved[:, 0] / np.where(power > 0, power, 1.0)


def _deviation(spectrum: np.ndarray) -> float:
    """Return the standard deviation of the white noise whose spectrum this is, without outliers."""
    return float(np.sqrt(np.median(np.abs(spectrum) ** 2) / np.log(2.0)))


def _high_band(x: Float[np.ndarray, "time k"]) -> np.ndarray:
    """Return the spectra of signals in the band of `signals.high_band_std`, noise of deviation one at one."""
    window = np.hanning(len(x) + 2)[1:-1, None]
    line = np.linspace(-1.0, 1.0, len(x))[:, None] ** np.arange(2)
    flat = x - line @ np.linalg.lstsq(line, x, rcond=None)[0]
    spectrum = rfft(window * flat, axis=0)
    f = np.arange(len(spectrum)) / len(x)
    return spectrum[(f > 0.3) & (f < 0.475)] / np.linalg.norm(window)


def _in_band(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit, *, subtract: bool = True
) -> np.ndarray:
    """Return the white noise of each force that the residual of inverse dynamics allows; inf if unknown.

    Without `subtract` the residual counts with the noise of the positions in it: a bound that holds even if
    that is most of it.
    """
    out = np.full(log.force.shape[1], np.inf)
    if not all(log.measured):
        return out
    values, residual = fit.fit(bounded=False)
    machine = _with_position_noise_of_log(machine, log)
    rate = log.rate_hz / data.recipe.decimation
    top = data.recipe.edge * log.rate_hz / 2 if data.recipe.edge else data.recipe.band_hz(log.rate_hz)
    top = min(top, 0.5 * rate)
    # Guesses may be too large, and noise makes the values of a fit too small: the higher bound counts.
    f_all, at_guesses = position_density(machine, log, data)
    of_position = np.minimum(at_guesses, position_density(_at(machine, fit, values), log, data)[1])
    for k, joint in enumerate(machine.plant.driven(machine.plant.joints)):
        j = int(joint)
        f, power = _periodogram(residual[:, j], fit.counts[:, j], rate)
        band = (f > _BAND[0] * top) & (f < _BAND[1] * top)
        if band.sum() < _FREQUENCIES or machine.gain[k] == 0:
            continue
        excess = power[band] / np.log(2.0) - np.interp(f[band], f_all, of_position[:, j])
        excess = excess if subtract else power[band] / np.log(2.0)
        white = excess / np.square(data.recipe.decimator.response(f[band], log.rate_hz))
        density = max(float(np.median(white)), 0.0)
        out[k] = np.sqrt(density * log.rate_hz / 2) / abs(machine.gain[k])
    return out


def _with_position_noise_of_log(machine: Machine, log: Log) -> Machine:
    """Return a machine without the stated noise of positions, if that is far above what the log can have."""
    stated = machine.sensor.position_noise
    if stated is None or log.integrated:
        return machine
    shown = signals.high_band_std(log.filled)
    if not np.any((np.asarray(stated) > _FACTOR * shown) & np.array(log.measured)):
        return machine
    return replace(machine, sensor=replace(machine.sensor, position_noise=None))


def _at(machine: Machine, fit: BalanceFit, values: np.ndarray) -> Machine:
    """Return a machine at the values of a balance, which the guesses may be far from.

    A value that its unknown cannot have leaves it at its guess.
    """
    theta, (lower, upper) = np.array(machine.parameters.guess, dtype=np.float64), machine.parameters.bounds
    for free, value in zip(fit.unknowns, values, strict=False):
        k = machine.parameters.names.index(free.name)
        theta[k] = value if lower[k] < value < upper[k] else theta[k]
    return machine.with_estimate(theta)


def _periodogram(
    e: Float[np.ndarray, " kept"], counts: Bool[np.ndarray, " kept"], rate_hz: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies [Hz] and the one-sided density of a residual with gaps."""
    window = np.hanning(e.size + 2)[1:-1] * counts
    spectrum = rfft((window * np.where(counts, e, 0.0))[:, None], axis=0)[:, 0]
    size = max(float(np.sum(window**2)), 1e-300)
    return np.arange(spectrum.size) * rate_hz / e.size, 2 * np.abs(spectrum) ** 2 / (rate_hz * size)


def noise_findings(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit, estimate: np.ndarray
) -> list[Finding]:
    """Find stated noise and resolution that the log contradicts by a factor of three.

    Args:
        machine: The machine with its stated sensor.
        log: The log.
        data: The prepared log.
        fit: Balance of the prepared log.
        estimate: Standard deviations by `estimated_force_noise`, (m,).
    """
    of_position = [] if log.integrated else _position(machine, log)
    return [*_force(machine, log, data, fit, estimate), *of_position]


def _force(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit, estimate: np.ndarray
) -> list[Finding]:
    """Compare the stated noise of each force with the estimate."""
    if machine.sensor.force_noise is None:
        return []
    stated = np.broadcast_to(np.asarray(machine.sensor.force_noise), estimate.shape)
    high, low = _beyond_controller(machine, log).noise, _in_band(machine, log, data, fit)
    white = (high < _ALIKE * low) & (low < _ALIKE * high)
    most = np.maximum(estimate, np.minimum(high, _in_band(machine, log, data, fit, subtract=False)))
    findings = []
    for k, of in enumerate(stated):
        more = estimate[k] > _FACTOR * of and white[k]
        if not more and not of > _FACTOR * most[k]:
            continue
        bound, found = ("about", estimate[k]) if more else ("at most", most[k])
        what = f"force_noise = {of:.3g} is stated, and the log has {bound} {found:.2g}"
        number = f" {k + 1}" if estimate.size > 1 else ""
        hint = f"set force_noise = {found:.2g} in [sensor], in units of the logged column, or remove it"
        hint = hint if found > 0 else "remove it from [sensor]"
        findings.append(Finding("warning", what, f"{log.source}, force{number}", hint))
    return findings


def _position(machine: Machine, log: Log) -> list[Finding]:
    """Compare the stated resolution and noise of each position with the log."""
    sensor, findings = machine.sensor, []
    joints = log.position.shape[1]

    def stated(value: object) -> np.ndarray:
        return np.broadcast_to(np.nan if value is None else np.asarray(value, float), joints)

    resolution, noise = stated(sensor.position_resolution), stated(sensor.position_noise)
    found = signals.high_band_std(log.filled)
    for j in np.flatnonzero(log.measured):
        where = f"{log.source}, position" + (f" of joint {j + 1}" if joints > 1 else "")
        step = position_levels(log.position[:, j])[1]
        if np.isfinite(resolution[j]) and not resolution[j] / _FACTOR < step < _FACTOR * resolution[j]:
            finer = step < resolution[j]
            # Readings off every grid contradict a coarse step only; rounded ones may have a finer one.
            if finer or np.isnan(noise[j]) or noise[j] < step:
                lie = f"lie on steps of {step:.3g}" if step else "lie on no steps"
                what = f"position_resolution = {resolution[j]:.3g} is stated, and the readings {lie}"
                hint = "correct position_resolution in [sensor], or remove it"
                findings.append(Finding("warning", what, where, hint))
        if np.isfinite(noise[j]) and noise[j] > _FACTOR * found[j]:
            what = f"position_noise = {noise[j]:.3g} is stated, and the log has about {found[j]:.2g}"
            hint = f"set position_noise = {found[j]:.2g} in [sensor], or remove it"
            findings.append(Finding("warning", what, where, hint))
        rounding = step / np.sqrt(12)
        if np.isnan(resolution[j]) and rounding > _FACTOR * noise[j] > 0:
            what = (
                f"position_noise = {noise[j]:.3g} is stated, and the readings lie on steps of {step:.3g}, "
                f"whose rounding alone is {rounding:.2g}"
            )
            hint = f"state position_resolution = {step:.3g} in [sensor] too, or remove position_noise"
            findings.append(Finding("warning", what, where, hint))
    return findings
