"""Delays of a sampled loop: fitted between two of its ticks, and compared at those nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.estimators.estimate import Estimate
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER


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


def starts_beside(machine: Machine, theta: Float[np.ndarray, " p"]) -> list[Float[np.ndarray, " p"]]:
    """Return values with each unknown delay at the tick before the nearest one, and at the one after it."""
    if machine.controller is None or not np.any(_delays(machine)):
        return []
    return [at_ticks(machine, theta, step) for step in (-1, 1)]


def with_std_of_ticks(estimate: Estimate) -> Estimate:
    """Return an estimate whose delays have the standard deviation of a uniform error of one tick at least.

    A loop takes its reference at its ticks. Between two of them the delay of the simulation is interpolated,
    which no loop does.
    """
    machine = estimate.machine
    if machine.controller is None or not np.any(_delays(machine)):
        return estimate
    least = np.where(_delays(machine), machine.controller.period / np.sqrt(12), np.nan)
    return replace(estimate, precision=estimate.precision.at_least(least))


def _delays(machine: Machine) -> Bool[np.ndarray, " p"]:
    """Return the mask of the unknown delays of the loop."""
    return np.array([f.path == (CONTROLLER, "delay") for f in machine.parameters.free], bool)
