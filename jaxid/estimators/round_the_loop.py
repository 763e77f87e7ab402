"""Bias of output error by the noise of the readings, which goes round the loop, and its removal.

The simulated loop has no noise. That of a real one dithers the friction at every reversal, and moves the mean
of the position by the square of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.scores import Scores
from jaxid.estimators.simulated_output import output_residual
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Rows
from jaxid.simulation.replay import Replay

# Pairs of simulated noise.
_PAIRS = 16


@dataclass(frozen=True)
class Shift:
    """Change of the estimates that removes a bias.

    Args:
        step: Mean change, (q,).
        covariance: Its covariance, because the simulated noise is finite, (q, q).
    """

    step: Float[np.ndarray, " q"]
    covariance: Float[np.ndarray, "q q"]


@kept_jit
def _changes(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    theta: Array,
    on: str,
    noise: Array,
) -> Float[Array, "pairs time k"]:
    """Return the mean change of the residual by each pair of opposite noise, (pairs, ticks, n)."""
    residual = lambda noise: output_residual(replay, places, plant, measured, weight, on, noise)(theta)
    quiet = output_residual(replay, places, plant, measured, weight, on)(theta)
    return jax.lax.map(lambda noise: 0.5 * (residual(noise) + residual(-noise)) - quiet, noise)


def shift_steps(logs: Sequence[tuple[tuple, Float[np.ndarray, " n"], Rows]], on: str) -> Steps[Shift]:
    """Compute the change of the estimates that removes the bias, by one step of Gauss-Newton.

    The mean change of the residual by simulated noise is what a fit without noise leaves over. Pairs of
    opposite noise cancel in first order.

    Args:
        logs: For each log the arguments of its residual as of `output_residual`, with the values of its
            unknowns in place of `on`; the standard deviation of its readings; and its residual at the fit.
        on: Kind of the outputs.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    rng, scores = np.random.default_rng(0), Scores.none(logs[0][2], _PAIRS)
    for (replay, *others), std, rows in logs:
        loud = replace(replay, sensor=replace(replay.sensor, position_noise=np.asarray(std)))
        ticks = len(replay.disturbance)
        noise = rng.standard_normal((_PAIRS, ticks, len(std)))
        changes = np.asarray((yield SolveRequest(_changes, (loud, *others, on, noise))))
        scores = scores.with_log(rows, changes)
    steps = scores.steps()
    return Shift(steps.mean(axis=0), np.atleast_2d(np.cov(steps.T)) / _PAIRS)
