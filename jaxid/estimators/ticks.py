"""Delays of a sampled loop: fitted between two of its ticks, and compared at those nearby."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_fit import Output, OutputFit
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.lanes import Steps
from jaxid.simulation.noisy_loop import ReadingNoise, estimated_noise
from jaxid.simulation.replay import Numerics, make_replay

# Ticks beside the best one that are compared, and parts of a row of the log: a command that is held from row
# to row leaves the cost several minima along the delay.
_TICKS, _ROWS = (-2, -1, 1, 2), (-1.0, -0.5, 0.5, 1.0)
# Most ticks that are compared.
_MOST = 24
# Number of times that the noise of the encoder is estimated, and the unknowns refitted.
_RENEWALS = 4
# Rise of the squared residual, in variances of a reading, up to which a tick explains a log about as well.
_EQUAL = 6.0
# Cost of a fit without noise, as a multiple of the least one, up to which its mean readings are compared.
_NEARLY = 1.5


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
    machine: Machine, log: Log, theta: Float[np.ndarray, " p"], numerics: Numerics | None = None
) -> Steps[list[Float[np.ndarray, " p"]]]:
    """Find the ticks of the unknown delays at which the mean readings of the loop are nearest to a log.

    At each tick the delays are held while the others are fitted. Fits in which they are free end in the
    minimum that is next to their start, and each tick may have its own.

    Args:
        machine: The machine, with its controller.
        log: The log, without a force.
        theta: Values of a fit, (p,).
        numerics: Settings of the integration; None: chosen from machine and log.

    Returns:
        Values of the unknowns at the best ticks, (p,), and behind them those at others that explain the log
        about as well; empty if there is no unknown delay, or nothing is known of the noise of the encoder.
    """
    if machine.controller is None or not np.any(_delays(machine)):
        return []
    row, nearest = log.period / machine.controller.period, _Held.at(machine, theta, 0)
    beside = sorted({*_TICKS, *(round(part * row) for part in _ROWS)} - {0})
    least = float(np.min(np.round(theta[_delays(machine)] / machine.controller.period)))

    found = {0: (yield from nearest.fitted(log, numerics))}
    best = 0
    while True:
        near = [best + step for step in beside if best + step not in found and best + step >= -least]
        for step in near[: _MOST - len(found)]:
            held = _Held.at(machine, theta, step)
            limit = _NEARLY * min(fit.plain for fit in found.values())
            found[step] = yield from held.fitted(log, numerics, limit)
        before, best = best, min(found, key=lambda step: found[step].cost)
        if best == before or len(found) >= _MOST:
            break
    if not np.isfinite(found[best].cost):
        return []
    spare = max(int(np.sum(log.measured)) * log.samples - len(theta), 1)
    ranked = sorted(found.values(), key=lambda fit: fit.cost)
    return [fit.theta for fit in ranked if spare * (fit.cost / ranked[0].cost - 1) < _EQUAL]


@dataclass(frozen=True)
class _HeldFit:
    """A fit with its delays held.

    Args:
        theta: Values of all unknowns, (p,).
        plain: Half the sum of squares of the loop without noise.
        cost: The same of its mean readings; infinite if they were not fitted.
    """

    theta: Float[np.ndarray, " p"]
    plain: float
    cost: float


@dataclass(frozen=True)
class _Held:
    """A machine whose unknown delays are held at ticks of its loop."""

    machine: Machine
    theta: Float[np.ndarray, " p"]

    @classmethod
    def at(cls, machine: Machine, theta: Float[np.ndarray, " p"], step: int) -> _Held:
        """Hold the delays some ticks from the nearest ones."""
        return cls(machine, at_ticks(machine, theta, step))

    def fitted(self, log: Log, numerics: Numerics | None, limit: float = np.inf) -> Steps[_HeldFit]:
        """Fit the other unknowns, and if the cost without noise keeps a limit those of the mean readings."""
        plain, cost = yield from self._fitted(log, numerics, self.theta, None)
        if not np.isfinite(cost) or cost > limit:
            return _HeldFit(plain, cost, np.inf)
        theta, noise = plain, self._noise(log, numerics, plain)
        for _ in range(_RENEWALS):
            if noise is None:
                return _HeldFit(plain, cost, np.inf)
            theta, mean_cost = yield from self._fitted(log, numerics, theta, noise)
            noise = self._noise(log, numerics, theta)
        return _HeldFit(theta, cost, mean_cost)

    def _noise(
        self, log: Log, numerics: Numerics | None, theta: Float[np.ndarray, " p"]
    ) -> ReadingNoise | None:
        """Estimate the noise of the encoder at some values."""
        at = self.machine.with_estimate(theta)
        return estimated_noise(at, log, make_replay(at, log, numerics or choose_numerics(at, log)))

    def _fitted(
        self, log: Log, numerics: Numerics | None, start: Float[np.ndarray, " p"], noise: ReadingNoise | None
    ) -> Steps[tuple[Float[np.ndarray, " p"], float]]:
        """Return the values of a fit from a start, and its cost."""
        machine = self.machine.with_estimate(start)
        chosen = numerics or choose_numerics(machine, log)
        output = Output.of(Part.alone(machine, log), chosen, "position", True, noise)
        fit = OutputFit(machine, (output,), "position")
        moving = fit.active.copy()
        moving[: len(self.theta)] &= ~_delays(machine)
        end = yield from fit.steps(start, active=moving)
        return end.theta, end.cost if end.converged else np.inf


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
