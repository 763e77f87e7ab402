"""The declared control law held against the logged command, and the law that fits it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.interpolate
from jaxtyping import Float

from jaxid.controllers import PD, PID, CascadePD, Controller, FrictionCompensation
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics import filters as signals
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.law_replay import commands
from jaxid.simulation.reference_course import reference_at
from jaxid.simulation.replay import start_velocity

# Part of the command that a law may leave: readings in the controller may differ from those in the log.
_LEFT = 0.05
# The same where the reference jumps at each sample of a slow log, and with it the acceleration: the law's
# velocity, by interpolated positions, is off there. At 20 ticks a sample the right law leaves 16 %.
_LEFT_AT_JUMPS = 0.2
# Part from which the log contradicts the law, if another one leaves at most a fifth of that.
_CONTRADICTED, _FIFTH = 0.1, 0.2
# Part of the command up to which a law reproduces it, so that the rest is noise of the logged command.
_EXACT = 0.02
# A residual within so many times the noise of the logged command is noise.
_NOISY = 2.0
# Largest average of velocities that is tried for a law.
_AVERAGES = (1, 2, 3, 4)
# A longer law is named only if it leaves less than this part of what a shorter one leaves.
_BETTER = 0.7
# First ticks at which the memory of the law is not known, unless the law explains them too: to within so
# many standard deviations of the noise.
_SETTLING, _SETTLED = 20, 4.0
# Largest autocorrelation of the difference between the logged command and that of the law, at lags 1 to 5, at
# which it counts as noise of the reading; and the largest such noise, as a part of the command.
_WHITE, _LAGS, _NOISE = 0.1, 5, 0.5
# Standard deviation of normal noise over its median size, and the largest excess of the difference's standard
# deviation over that which its median implies.
_NORMAL, _OUTLIERS = 1.4826, 0.2
# Both limits of a short log: so many times the standard deviation of an autocorrelation.
_SHORT = 4.0
# Least number of samples by which a law is judged, in settling times.
_JUDGED = 5
# A difference below this part of the command is rounding.
_ROUNDED = 1e-6
# Part of an inertia from which a delay of the loop's velocity is said.
_SEEN = 0.005
# Laws without a model of the plant.
_PLAIN = (CascadePD, PD, PID, FrictionCompensation)


@dataclass(frozen=True)
class Replayed:
    """A logged command beside that of the declared law at the logged readings.

    Args:
        command: Command of the law at the samples of the log, (time, m).
        relative: 2-norm of the difference over that of the logged command, by drive.
        exact: Whether the law reproduces every command up to noise.
        every: Number of the law's ticks per sample of the log.
    """

    command: Float[np.ndarray, "time m"]
    relative: Float[np.ndarray, " m"]
    exact: bool
    every: int


@dataclass(frozen=True)
class LawAtTicks:
    """Command of the declared law at every tick of its controller.

    Args:
        command: The command, (ticks, m).
        every: Number of ticks per sample of the log.
    """

    command: Float[np.ndarray, "ticks m"]
    every: int


@dataclass(frozen=True)
class LawCommand:
    """Command of a law that explains the logged one but for white noise of its reading.

    Args:
        command: The command at the samples of the log, (time, m).
        offset: Standard deviation of its constant error, (m,): the mean of the noise, if the law has an
            integral that began at an unknown value; None: it has no such error.
        logged: Number of first samples at which the logged command stands in its place, because the law
            began before the log.
    """

    command: Float[np.ndarray, "time m"]
    offset: Float[np.ndarray, " m"] | None
    logged: int


@dataclass(frozen=True)
class _Fitted:
    """A law with gains fitted to the logged command of one drive.

    Args:
        text: The law as the case would state it.
        remaining: 2-norm of the residual over that of the logged command.
    """

    text: str
    remaining: float


def replayed_law(machine: Machine, log: Log) -> Replayed | None:
    """Run the declared law along the logged readings and reference.

    Returns:
        The command beside the logged one; None without a controller or a logged reference, and for a law that
        has a model of the plant, reads other sensors, or has unknowns.
    """
    law = law_at_ticks(machine, log)
    if law is None:
        return None
    every, made = law.every, law.command[:: law.every]
    size = np.maximum(np.linalg.norm(log.force, axis=0), 1e-300)
    relative = np.linalg.norm(log.force - made, axis=0) / size
    return Replayed(made, relative, bool(np.all(relative < _EXACT)) and every == 1, every)


def law_at_ticks(machine: Machine, log: Log) -> LawAtTicks | None:
    """Run the declared law at every tick along the logged readings and reference, both interpolated.

    Returns:
        The command at every tick; None in the cases in which `replayed_law` returns None.
    """
    controller = machine.law
    if not isinstance(controller, _PLAIN) or log.reference is None or not all(log.measured):
        return None
    if machine.unknown_controller:
        return None
    if machine.sensor.inertial is not None or machine.sensor.hold > 1:
        return None
    ticks = _at_ticks(controller, machine, log)
    if ticks is None:
        return None
    position, reference, extra, every = ticks
    driven = machine.plant.driven(position.shape[1])
    own = None
    if controller.own_velocity and log.velocity is not None:
        own = log.velocity
        if every > 1:
            times = log.time[0] + controller.period * np.arange((log.samples - 1) * every + 1)
            own = scipy.interpolate.CubicSpline(log.time, own, axis=0)(np.minimum(times, log.time[-1]))
    made = np.asarray(commands(controller, driven, position, reference, extra, start_velocity(log), own=own))
    if isinstance(controller, PID):
        # The integral before the first row is not known.
        made = made + np.median(log.force - made[::every], axis=0)
        made = made if controller.limit is None else np.clip(made, -controller.limit, controller.limit)
    return LawAtTicks(made, every)


def _at_ticks(
    controller: Controller, machine: Machine, log: Log
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int] | None:
    """Return positions, reference and disturbance at every tick, and the ticks in a sample of the log."""
    every = max(1, round(log.period / controller.period))
    if abs(log.period / controller.period / every - 1) > 1e-3:
        return None
    assert log.reference is not None, "asked only with a reference"
    reference = np.broadcast_to(log.reference, log.force.shape)
    times = log.time[0] + controller.period * np.arange((log.samples - 1) * every + 1)
    position = log.position
    if every > 1:
        inside = np.minimum(times, log.time[-1])
        position = scipy.interpolate.CubicSpline(log.time, position, axis=0)(inside)
        reference = reference_at(log.time, reference, times, machine.reference_hold)
    extra = disturbance_at(machine.disturbance, log.time if every == 1 else times, log)
    return position, reference, np.broadcast_to(extra, reference.shape), every


def law_findings(
    machine: Machine, log: Log, replayed: Replayed | None, *, confirmed: bool = False
) -> list[Finding]:
    """Find drives whose logged command is not that of the declared law, and name the law that fits.

    Args:
        machine: The machine with its controller.
        log: The log.
        replayed: Result of `replayed_law`.
        confirmed: Whether the motion of a log slower than its loop confirms the law.

    Returns:
        A warning for each such drive; an error if another known law reproduces its command.
    """
    if replayed is None:
        return []
    off = replayed.command - log.force
    noise = signals.high_band_std(log.force)
    jumps = confirmed and machine.reference_hold == "zero_order"
    least, findings = _LEFT_AT_JUMPS if jumps else _LEFT, []
    for k, relative in enumerate(replayed.relative):
        if relative < least:
            continue
        best = _best_law(machine, log, k)
        # A coarse encoder makes the command rough, and a wrong gain then leaves no more than its high band.
        # Only a law that explains this too shows that it is no noise.
        size = max(float(np.linalg.norm(log.force[:, k])), 1e-300)
        settled = float(np.linalg.norm(off[_SETTLING:, k])) / size
        noisy = np.sqrt(np.mean(off[:, k] ** 2)) < _NOISY * noise[k]
        if noisy and (best is None or settled < _CONTRADICTED or best.remaining > _FIFTH * settled):
            continue
        number = f" {k + 1}" if len(replayed.relative) > 1 else ""
        what = f"the declared control law leaves {100 * relative:.3g} % of the logged command{number}"
        if best is None or not best.remaining < _BETTER * relative:
            hint = "check kind, gains, period and limit in [controller], and the column of the reference"
            severity = "warning"
        else:
            hint = f"take {best.text}, which leaves {100 * best.remaining:.2g} %"
            sure = relative > _CONTRADICTED and best.remaining < _FIFTH * relative
            severity = "error" if sure else "warning"
        findings.append(Finding(severity, what, f"{log.source}, [controller]", hint))
    return findings


def mass_of_late_velocity(machine: Machine, log: Log) -> float | None:
    """Return the mass by which a loop with a measured velocity differs from one that differences positions.

    A differenced position is half of its window late, which acts like a mass. Between the samples of a slow
    log the command does not show which of the two the loop uses.

    Args:
        machine: The machine at its guesses, with its controller.
        log: The log.

    Returns:
        The mass [kg or kg m^2]; None if it is a negligible part of the inertia, if the case states how the
        loop has its velocity, or if the log has a row for every tick.
    """
    controller, inertia = machine.controller, machine.plant.own_inertia()
    if not isinstance(controller, CascadePD | PD | PID) or controller.own_velocity or inertia is None:
        return None
    if log.reference is None or round(log.period / controller.period) <= 1:
        return None
    if controller.velocity_average > 1:
        # The case states how positions are differenced.
        return None
    damping = np.asarray(controller.kv if isinstance(controller, CascadePD) else controller.kd)
    late = 0.5 * controller.period * controller.velocity_average
    mass = float(np.max(np.abs(damping * machine.gain) * late))
    return mass if mass >= _SEEN * float(np.max(np.asarray(inertia))) else None


def loop_velocity_findings(machine: Machine, log: Log) -> list[Finding]:
    """Say that a loop may difference positions or take a velocity that its drive measures."""
    mass, inertia = mass_of_late_velocity(machine, log), machine.plant.own_inertia()
    if mass is None:
        return []
    part = mass / float(np.max(np.asarray(inertia)))
    what = (
        "the case does not state whether the loop differences positions or its drive measures the velocity: "
        f"they differ by {mass:.2g} {machine.unit('inertia')} of inertia, {100 * part:.2g} % of the guess; "
        "output_error of one log fits both, and takes the one that explains the command"
    )
    hint = "name the column of that velocity as loop_velocity in [log], or state velocity_average"
    return [Finding("warning", what, f"{log.source}, [controller]", hint)]


def law_of_rows(machine: Machine, log: Log) -> str | None:
    """Return the law of reference, position and measured velocity that gives the logged force of each row.

    Args:
        machine: A machine without a controller, of one driven joint.
        log: The log.

    Returns:
        The law as a case would state it; None if the log lacks reference or velocity, or no such law
        reproduces the force.
    """
    if log.reference is None or log.velocity is None or log.force.shape[1] != 1 or not all(log.measured):
        return None
    (joint,) = machine.plant.driven(log.position.shape[1])
    rows = np.stack([log.reference[:, 0] - log.position[:, joint], -log.velocity[:, joint]], axis=1)
    gains = np.linalg.lstsq(rows, log.force[:, 0], rcond=1e-12)[0]
    left = np.linalg.norm(log.force[:, 0] - rows @ gains) / max(np.linalg.norm(log.force), 1e-300)
    if not left < _EXACT or not np.all(gains > 0):
        return None
    return f"kind = 'pd' with derivative = 'velocity', kp = {gains[0]:.4g}, kd = {gains[1]:.4g}"


def _best_law(machine: Machine, log: Log, drive: int) -> _Fitted | None:
    """Return the known law that fits the command of a drive best; a longer one only if it fits far better."""
    by_length: dict[int, _Fitted] = {}
    for length, fitted in _fitted_laws(machine, log, drive):
        if length not in by_length or fitted.remaining < by_length[length].remaining:
            by_length[length] = fitted
    best = None
    for _, fitted in sorted(by_length.items()):
        if best is None or fitted.remaining < _BETTER * best.remaining:
            best = fitted
    return best


def _fitted_laws(machine: Machine, log: Log, drive: int) -> Iterator[tuple[int, _Fitted]]:
    """Yield known laws with gains fitted by least squares, each after its number of gains."""
    controller = machine.controller
    assert controller is not None, "asked only with a controller"
    ticks = _at_ticks(controller, machine, log)
    assert ticks is not None, "checked before"
    position, reference, extra, every = ticks
    joint = int(machine.plant.driven(position.shape[1])[drive])
    q, r, period = position[:, joint], reference[:, drive], controller.period
    u = log.force[:, drive] - extra[::every, drive]
    counts = np.ones(u.size, bool)
    # The first ticks depend on readings before the log.
    counts[: 2 * max(_AVERAGES)] = False
    if controller.limit is not None:
        limit = np.broadcast_to(np.asarray(controller.limit), log.force.shape[1])[drive]
        counts &= np.abs(log.force[:, drive]) < (1 - 1e-6) * limit
    size = float(np.linalg.norm(log.force[counts, drive]))
    error, slope = r - q, np.diff(r, prepend=r[0]) / period
    ones, integral = np.ones_like(q), period * np.cumsum(error)

    def fitted(*columns: np.ndarray) -> tuple[np.ndarray, float]:
        rows = np.stack(columns, axis=1)[::every][counts]
        gains = np.linalg.lstsq(rows, u[counts], rcond=1e-12)[0]
        return gains, float(np.linalg.norm(u[counts] - rows @ gains)) / max(size, 1e-300)

    for average in _AVERAGES:
        before = np.concatenate([np.full(average, q[0]), q[:-average]])
        velocity = (q - before) / (average * period)
        more = f", velocity_average = {average}" if average > 1 else ""
        (kp, kd), remaining = fitted(error, -velocity)
        if kp > 0 and kd > 0:
            text = f"kind = 'cascade_pd' with kp = {kp / kd:.4g}, kv = {kd:.4g}"
            if not isinstance(controller, CascadePD):
                plain = f"kind = 'pd' with derivative = 'velocity', kp = {kp:.4g}, kd = {kd:.4g}"
                text = f"{plain} (the same as {text})"
            yield 2, _Fitted(text + more, remaining)
        (kp, kd), remaining = fitted(error, slope - velocity)
        if kp > 0 and kd > 0:
            text = f"kind = 'pd' with kp = {kp:.4g}, kd = {kd:.4g}"
            yield 2, _Fitted(text + more, remaining)
        (kp, ki, kd, _), remaining = fitted(error, integral, slope - velocity, ones)
        if kp > 0 and ki > 0 and kd > 0:
            text = f"kind = 'pid' with kp = {kp:.4g}, ki = {ki:.4g}, kd = {kd:.4g}"
            yield 3, _Fitted(text + more, remaining)


def noise_free_command(machine: Machine, log: Log) -> LawCommand | None:
    """Return the command of the law if the logged one is the same but for white noise of its reading.

    The applied command is then known without that noise.

    Args:
        machine: The machine with its controller.
        log: The log.

    Returns:
        The command; None if the law cannot be computed, if the log is slower than the loop, or if the law
        does not explain the logged command.
    """
    replayed = replayed_law(machine, log)
    if replayed is None or replayed.every > 1 or log.samples < _JUDGED * _SETTLING:
        return None
    command = replayed.command
    if not np.all(np.isfinite(command)):
        return None
    integrates = _integrates(machine.law)
    if machine.law is not None and integrates:
        command = _from_mean(machine.law, command, log.force)
    off = log.force - command
    settled = off[_SETTLING:]
    size, noise = np.std(log.force, axis=0), np.sqrt(np.mean(settled**2, axis=0))
    if np.any(noise > _NOISE * size):
        return None
    exact = bool(np.all(noise <= _ROUNDED * size))
    if not exact and not _is_white(settled, noise):
        return None
    # The mean of the noise is in the integral, which began at an unknown value.
    offset = noise / np.sqrt(len(settled)) if integrates and not exact else None
    if exact or np.all(np.abs(off[:_SETTLING]) <= _SETTLED * noise):
        return LawCommand(command, offset, 0)
    return LawCommand(np.concatenate([log.force[:_SETTLING], command[_SETTLING:]]), offset, _SETTLING)


def _integrates(law: Controller | None) -> bool:
    """Check that a law has an integral."""
    return isinstance(law, PID) and bool(np.any(np.asarray(law.ki) != 0))


def _from_mean(law: Controller, command: np.ndarray, logged: np.ndarray) -> np.ndarray:
    """Return the command of a law whose integral begins so that the mean difference to the log is zero."""
    limit = np.inf if law.limit is None else np.asarray(law.limit)
    inside = (np.abs(command) < limit) & (np.arange(len(command)) >= _SETTLING)[:, None]
    off = np.sum(np.where(inside, logged - command, 0.0), axis=0) / np.maximum(np.sum(inside, axis=0), 1)
    return np.clip(command + off, -limit, limit)


def _is_white(off: np.ndarray, noise: np.ndarray) -> bool:
    """Check that the difference between a logged command and that of the law is white noise."""
    chance = _SHORT / np.sqrt(len(off))
    # A law that is right but for a few ticks, such as a pulse that begins a tick later, leaves outliers.
    middle = _NORMAL * np.median(np.abs(off), axis=0)
    if np.any(noise > (1 + max(_OUTLIERS, chance)) * middle):
        return False
    # The mean counts too: a disturbance is no noise.
    power = np.maximum(np.sum(off**2, axis=0), 1e-300)
    correlation = [np.sum(off[k:] * off[:-k], axis=0) / power for k in range(1, _LAGS + 1)]
    return bool(np.max(np.abs(correlation)) <= max(_WHITE, chance))
