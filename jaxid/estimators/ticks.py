"""Delays of a sampled loop: fitted between two of its ticks, and compared at those nearby."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.estimate import Estimate
from jaxid.estimators.mean_readings import noise_of_parts
from jaxid.estimators.output_fit import OutputFit, outputs_of
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics, position_gap, position_jacobian
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.lanes import Steps
from jaxid.simulation.noisy_loop import ReadingNoise
from jaxid.simulation.replay import Numerics
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import TooStiffError

# Ticks beside the best one that are compared, and parts of a row of the log: a command that is held from row
# to row leaves the cost several minima along the delay.
_TICKS, _ROWS = (-2, -1, 1, 2), (-1.0, -0.5, 0.5, 1.0)
# Most ticks that are compared.
_MOST = 24
# Number of times that the noise of the encoder is estimated, and the unknowns refitted.
_RENEWALS = 4
# Rise of the squared residual, in variances of a reading: up to which a tick explains a log about as well,
# below which it has settled, and beyond which a tick is out of the question.
_EQUAL, _SAME, _FAR = 6.0, 0.3, 50.0
# Squared residual without noise, as a multiple of the least one, up to which mean readings are fitted.
_NEARLY = 1.5
# Most ticks by which the delays of several joints are moved, and the gain in minus twice the logarithm of the
# likelihood that calls for another tick: the larger of a number and a part of the number of readings.
_ROUNDS, _GAIN, _PART = 6, 4.0, 0.01
# Most moves of a delay that are tried in a round.
_TRIED = 2


def at_ticks(machine: Machine, theta: Float[np.ndarray, " p"], step: int = 0) -> Float[np.ndarray, " p"]:
    """Return values with each unknown delay at the nearest tick of the loop, or some ticks from there.

    Args:
        machine: The machine, with its controller.
        theta: Values of the unknowns, (p,).
        step: Number of ticks from the nearest one; no delay becomes negative.
    """
    assert machine.controller is not None, "an unknown delay is one of the controller"
    period, delays = machine.controller.period, _delays(machine) & np.isfinite(theta)
    ticks = np.round(np.where(delays, theta, 0.0) / period) + step
    return np.where(delays, np.maximum(ticks, 0.0) * period, theta)


def best_ticks(
    machine: Machine, parts: Sequence[Part], theta: Float[np.ndarray, " p"], numerics: Numerics | None = None
) -> Steps[list[Float[np.ndarray, " p"]]]:
    """Find the ticks of the unknown delays at which the mean readings of the loop are nearest to the logs.

    At each tick the delays are held while the others are fitted. Fits in which they are free end in the
    minimum that is next to their start, and each tick may have its own.

    Args:
        machine: Machine of all logs, with its controller.
        parts: The logs, without a force.
        theta: Values of a fit, (p,).
        numerics: Settings of the integration; None: chosen from machines and logs.

    Returns:
        Values of the unknowns at the best ticks, (p,), and behind them those at others that explain the logs
        about as well; empty if there is no unknown delay, or nothing is known of the noise of the encoder.
    """
    if machine.controller is None or not np.any(_delays(machine)):
        return []
    period = machine.controller.period
    row = max(part.log.period for part in parts) / period
    beside = sorted({*_TICKS, *(round(share * row) for share in _ROWS)} - {0}, key=abs)
    least = -float(np.min(np.round(theta[_delays(machine)] / period)))

    fits = _HeldFits(machine, parts, numerics)
    found = {0: (yield from fits.at(at_ticks(machine, theta)))}
    best = 0
    while True:
        near = [best + step for step in beside if best + step not in found and best + step >= least]
        for step in near[: _MOST - len(found)]:
            start = at_ticks(machine, theta, step)
            found[step] = yield from fits.at(start, list(found.values()))
        before, best = best, min(found, key=lambda step: found[step].chi)
        if best == before or len(found) >= _MOST:
            break
    ranked = sorted(found.values(), key=lambda fit: fit.chi)
    return [fit.theta for fit in ranked if fit.chi - ranked[0].chi < _EQUAL]


def best_ticks_of_joints(
    machine: Machine, parts: Sequence[Part], theta: Float[np.ndarray, " p"], numerics: Numerics | None = None
) -> Steps[Float[np.ndarray, " p"]]:
    """Find the tick of each joint's delay at which a loop without noise is nearest to the logs.

    The delay of one joint is moved by a tick, while all other unknowns are fitted. Of all joints and both
    sides, those moves are tried that the derivatives promise most of. A few moves are made at most: a fit is
    near before it comes here.

    Args:
        machine: Machine of all logs, with its controller.
        parts: The logs, without a force.
        theta: Values of a fit, (p,).
        numerics: Settings of the integration; None: chosen from machines and logs.

    Returns:
        Values of the unknowns at the best ticks, (p,); those of the fit if there is no unknown delay, or the
        fit at its ticks does not converge.
    """
    if machine.controller is None or not np.any(_delays(machine)):
        return theta
    fits = _HeldFits(machine, parts, numerics)
    best, least = yield from fits.without_noise(at_ticks(machine, theta))
    if not np.isfinite(least):
        return theta
    gain = max(_GAIN, _PART * fits.samples)
    for _ in range(_ROUNDS):
        before = least
        for start in fits.promising(best)[:_TRIED]:
            values, chi = yield from fits.without_noise(start)
            if chi < least - gain:
                best, least = values, chi
                break
        if least == before:
            break
    return best


@dataclass(frozen=True)
class _HeldFit:
    """A fit with its delays held.

    Args:
        theta: Values of all unknowns, (p,).
        plain: Minus twice the logarithm of the likelihood of the loop without noise, but for a constant.
        chi: The same of its mean readings; infinite if they were not fitted.
    """

    theta: Float[np.ndarray, " p"]
    plain: float
    chi: float


@dataclass(frozen=True)
class _HeldFits:
    """Fits of logs with the unknown delays of the loop held.

    Args:
        machine: Machine of all logs.
        parts: The logs.
        numerics: Settings of the integration; None: chosen from machines and logs.
    """

    machine: Machine
    parts: Sequence[Part]
    numerics: Numerics | None

    def at(self, start: Float[np.ndarray, " p"], others: Sequence[_HeldFit] = ()) -> Steps[_HeldFit]:
        """Fit all but the delays from a start: without noise, then the mean readings.

        Mean readings are left out where the loop without noise is far from that of other fits, and are not
        refined where they are.
        """
        theta, plain = yield from self.without_noise(start)
        nearest = min((fit.plain for fit in others), default=np.inf)
        least = min((fit.chi for fit in others), default=np.inf)
        out = _HeldFit(theta, plain, np.inf)
        if not np.isfinite(plain) or plain > nearest + self.samples * np.log(_NEARLY):
            return out
        noise: list[ReadingNoise | None] = []
        for _ in range(_RENEWALS):
            noise = noise_of_parts(self.parts, out.theta, self.numerics, before=noise)
            if not any(noise):
                break
            theta, chi = yield from self._fitted(out.theta, noise)
            settled = abs(chi - out.chi) < _SAME
            out = _HeldFit(theta, plain, chi)
            if settled or chi > least + _FAR:
                break
        return out

    def without_noise(self, start: Float[np.ndarray, " p"]) -> Steps[tuple[Float[np.ndarray, " p"], float]]:
        """Return the fit of one run of each loop without noise; see `_fitted`."""
        try:
            return (yield from self._fitted(start, []))
        except TooStiffError:
            return start, np.inf

    def promising(self, theta: Float[np.ndarray, " p"]) -> list[Float[np.ndarray, " p"]]:
        """Return values with the delay of one joint a tick off that promise a better fit, the best first.

        The other unknowns are those of a step of Gauss and Newton, with the derivatives at the given values.

        Args:
            theta: Values of a fit with the delays held at ticks, (p,).
        """
        delays, controller = _delays(self.machine), self.machine.controller
        assert controller is not None, "checked by best_ticks_of_joints"
        at = [part.at(theta) for part in self.parts]
        every = [self.numerics or choose_numerics(m, p.log) for m, p in zip(at, self.parts, strict=True)]
        noises = [position_noise(m, p.log) for m, p in zip(at, self.parts, strict=True)]
        # A constant reading has no noise that could be estimated, and does not count.
        scales = [np.where(noise > 0, 1.0 / np.where(noise > 0, noise, 1.0), 0.0) for noise in noises]
        rows = [
            part.widened(scale[:, None] * position_jacobian(m, part.log, numerics), len(theta))
            for m, part, numerics, scale in zip(at, self.parts, every, scales, strict=True)
        ]
        jacobian = np.concatenate([row.reshape(-1, len(theta)) for row in rows])[:, ~delays]
        if not np.all(np.isfinite(jacobian)):
            return []
        sizes = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
        lower, upper = self.machine.with_estimate(theta).parameters.bounds

        def step(values: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
            gaps = [
                (scale * position_gap(part.at(values), part.log, numerics)).ravel()
                for part, numerics, scale in zip(self.parts, every, scales, strict=True)
            ]
            gap = np.concatenate(gaps)
            change = np.linalg.lstsq(jacobian / sizes, gap, rcond=None)[0]
            moved = values.copy()
            moved[~delays] += change / sizes
            within = (moved >= lower) & (moved <= upper) | delays
            moved = np.where(within, moved, values)
            return float(np.sum(np.square(gap - jacobian / sizes @ change))), moved

        here, _ = step(theta)
        moves = []
        for k in np.flatnonzero(delays):
            for tick in (-controller.period, controller.period):
                if theta[k] + tick > -0.5 * controller.period:
                    moves.append(step(theta + tick * (np.arange(len(theta)) == k)))
        return [moved for left, moved in sorted(moves, key=lambda m: m[0]) if left < here]

    @property
    def samples(self) -> int:
        """Number of readings in all logs."""
        return sum(part.log.samples * sum(part.log.measured) for part in self.parts)

    def _fitted(
        self, start: Float[np.ndarray, " p"], noise: Sequence[ReadingNoise | None]
    ) -> Steps[tuple[Float[np.ndarray, " p"], float]]:
        """Return the values of a fit, and minus twice the logarithm of its likelihood but for a constant."""
        parts = [replace(part, machine=part.at(start)) for part in self.parts]
        outputs = outputs_of(parts, numerics=self.numerics, noise=noise or None)
        fit = OutputFit(self.machine.with_estimate(start), outputs, "position")
        moving = fit.active.copy()
        moving[: len(start)] &= ~_delays(self.machine)
        end = yield from fit.steps(start, active=moving)
        if not end.converged:
            return end.theta, np.inf
        # The noise of each log is that of its residual.
        counts = [int(rows.counts.sum()) for rows in end.logs]
        left = [float(np.sum(np.square(rows.residual))) / n for rows, n in zip(end.logs, counts, strict=True)]
        return end.theta, float(np.dot(counts, np.log(np.maximum(left, 1e-300))))


def with_equal_ticks(estimate: Estimate, equal: Sequence[Float[np.ndarray, " p"]]) -> Estimate:
    """Return an estimate whose 95 % intervals hold the values of fits at other ticks, with a note on them.

    Args:
        estimate: The estimate.
        equal: Values of the unknowns at ticks that explain the log about as well, (p,) each.
    """
    if not equal:
        return estimate
    delays = _delays(estimate.machine)
    sizes = ", ".join(" and ".join(f"{1e3 * delay:.3g} ms" for delay in theta[delays]) for theta in equal)
    note = (
        f"with a delay of {sizes} the loop explains the log about as well: "
        "the 95 % intervals hold the values of these fits too"
    )
    held = estimate.holding(*equal)
    return replace(held, notes=(*held.notes, note))


def with_std_of_ticks(estimate: Estimate) -> Estimate:
    """Return an estimate whose delays have the standard deviation of a uniform error of one tick at least.

    A loop takes its reference at its ticks. Between two of them the delay of the simulation is interpolated,
    which no loop does.
    """
    machine = estimate.machine
    if machine.controller is None or not np.any(_delays(machine)):
        return estimate
    return replace(estimate, precision=estimate.precision.at_least(std_of_ticks(machine)))


def std_of_ticks(machine: Machine) -> Float[np.ndarray, " p"]:
    """Return the standard deviation of a uniform error of one tick for each unknown delay, else NaN, (p,)."""
    assert machine.controller is not None, "an unknown delay is one of the controller"
    return np.where(_delays(machine), machine.controller.period / np.sqrt(12), np.nan)


def _delays(machine: Machine) -> Bool[np.ndarray, " p"]:
    """Return the mask of the unknown delays of the loop."""
    return np.array([f.path == (CONTROLLER, "delay") for f in machine.parameters.free], bool)
