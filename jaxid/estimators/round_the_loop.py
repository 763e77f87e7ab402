"""Bias and scatter of output error by the noise of the readings, which goes round the loop.

The simulated loop has no noise. That of a real one dithers the friction at every reversal, and moves the mean
of the position by the square of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.scores import Scores, changes_by_pairs
from jaxid.estimators.simulated_output import output_residual
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision
from jaxid.numerics.rows import Rows
from jaxid.simulation.replay import Replay

# Pairs of simulated noise.
_PAIRS = 32
# Standard deviations that are wider by less than this factor are no news.
_SLIGHTLY = 1.1


@dataclass(frozen=True)
class Shift:
    """Change of the estimates that removes a bias, and their scatter.

    Args:
        step: Mean change, (q,).
        covariance: Its covariance, because the simulated noise is finite, (q, q).
        scatter: Covariance of the estimates by the noise of the readings, which goes round the loop, (q, q).
    """

    step: Float[np.ndarray, " q"]
    covariance: Float[np.ndarray, "q q"]
    scatter: Float[np.ndarray, "q q"]


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
) -> tuple[Float[Array, "pairs time k"], Float[Array, "pairs time k"]]:
    """Return the even and the odd change of the residual by each pair of opposite noise."""
    residual = lambda noise: output_residual(replay, places, plant, measured, weight, on, noise)(theta)
    return changes_by_pairs(residual, noise)


def shift_steps(
    logs: Sequence[tuple[tuple, Float[np.ndarray, " n"], Rows]], on: str, pairs: int = _PAIRS
) -> Steps[Shift]:
    """Compute the change of the estimates that removes the bias, by one step of Gauss-Newton.

    The mean change of the residual by simulated noise is what a fit without noise leaves over. Pairs of
    opposite noise cancel in first order.

    Args:
        logs: For each log the arguments of its residual as of `output_residual`, with the values of its
            unknowns in place of `on`; the standard deviation of its readings; and its residual at the fit.
        on: Kind of the outputs.
        pairs: Number of pairs of opposite noise.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    rng, none = np.random.default_rng(0), Scores.none(logs[0][2], pairs)
    even, odd = none, none
    for (replay, *others), std, rows in logs:
        loud = replace(replay, sensor=replace(replay.sensor, position_noise=np.asarray(std)))
        ticks = len(replay.disturbance)
        noise = rng.standard_normal((pairs, ticks, len(std)))
        bent, shaken = yield SolveRequest(_changes, (loud, *others, on, noise))
        even = even.with_log(rows, np.asarray(bent))
        # A measured position holds its noise beside the motion that the noise has caused, and with a reversed
        # sign in the residual. A command is computed from the noisy reading, in the simulation too.
        beside = np.zeros_like(shaken)
        if on in ("position", "both"):
            beside[..., : len(std)] = std * noise[:, :: replay.every]
        odd = odd.with_log(rows, np.asarray(others[3]) * beside - np.asarray(shaken))
    steps, scatter = even.steps(), odd.steps()
    covariance = np.atleast_2d(np.cov(steps.T)) / pairs
    return Shift(steps.mean(axis=0), covariance, scatter.T @ scatter / pairs)


def with_lasting_errors(
    precision: Precision, lasting: Float[np.ndarray, " p"]
) -> tuple[Precision, list[str]]:
    """Return the precision of a fit of several joints in a loop, and a note if it is clearly wider.

    Noise that goes round the loop shakes the dry friction of every joint. One that halts a little sooner, or
    once more, moves the others for as long as their loops take: an error that lasts longer than a model of
    the residual's colour remembers.

    Args:
        precision: Precision by the colour of the residual.
        lasting: Standard deviations by the scores of long stretches of the log, (p,).
    """
    wider = precision.at_least(lasting)
    with np.errstate(invalid="ignore"):
        ratio = wider.std / precision.std
    most = float(np.max(ratio[np.isfinite(ratio)], initial=1.0))
    if most < _SLIGHTLY:
        return wider, []
    note = (
        "noise that goes round the loop shakes the dry friction of the joints, an error that lasts: the "
        f"standard deviations are those of long stretches of the log, up to {most:.2g} times as large"
    )
    return wider, [note]
