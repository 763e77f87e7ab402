"""Bias that the noise of a measured velocity causes in inverse dynamics, and its removal.

Velocity and acceleration are regressors of the balance of forces. Their noise makes the estimates too small,
although it does not correlate with the force.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.estimators.estimate import Estimate
from jaxid.logs.prepare import prepare
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.session import Session
from jaxid.simulation.force_balance import ForceData, force_and_columns, sharpened
from jaxid.simulation.sensor_noise import position_noise

# Pairs of simulated noise.
_PAIRS = 8
# Eigenvalue of the scaled normal matrix, relative to the largest, below which a direction is not corrected.
_BLIND = 1e-8


def without_velocity_noise(session: Session, estimate: Estimate) -> Steps[Estimate]:
    """Return an estimate of inverse dynamics without the bias by noise of the measured velocity.

    As much noise again, simulated, shifts the optimum once more by the same amount, which is subtracted.
    Pairs of opposite noise cancel in first order.

    Args:
        session: Case and logs; the fitted log is one of velocities.
        estimate: Estimate of `inverse_dynamics`.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation, by one step of Gauss-Newton.
    """
    run, machine = session.fit, session.machine
    log, data, plant = run.log, run.data, sharpened(session.machine.plant, session.fit.data)
    places, theta, rows = machine.parameters.places, np.asarray(estimate.theta), data.fitted
    if not estimate.converged or not np.any(estimate.identifiable):
        return estimate

    def at(velocity: np.ndarray) -> SolveRequest:
        noisy = replace(log, velocity=velocity)
        motion = prepare(noisy, machine.gain, data.recipe, machine.hold_period)
        motion = replace(motion, moving=data.moving, fitted=rows, hold=data.hold)
        return SolveRequest(force_and_columns, (plant, places, ForceData.of(motion, rows), theta))

    def gradient(of: tuple) -> tuple[np.ndarray, np.ndarray]:
        e, columns = (np.asarray(x)[rows] for x in of)
        return columns.T @ e, columns.T @ columns

    velocity = np.asarray(log.readings)
    first, normal = gradient((yield at(velocity)))
    noise, rng, more = position_noise(machine, log), np.random.default_rng(0), []
    for _ in range(_PAIRS):
        drawn = noise * rng.standard_normal(velocity.shape)
        for sign in (1.0, -1.0):
            more.append(gradient((yield at(velocity + sign * drawn)))[0])

    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=_BLIND, hermitian=True)
    shift = inverse @ ((np.mean(more, axis=0) - first) / size) / size
    if not np.all(np.isfinite(shift)):
        return estimate
    theta = np.clip(theta + np.where(estimate.identifiable, shift, 0.0), *machine.parameters.bounds)
    note = "the bias by the noise of the measured velocity was removed, by simulating as much noise again"
    return replace(estimate, theta=theta, machine=machine.with_estimate(theta), notes=(*estimate.notes, note))
