"""Effect of the noise of a logged force on output error in open loop, whose simulation takes it as exact.

The simulated machine is pushed by the noise, the real one was not. Friction loses the difference again, but a
speed that is off for a while leaves a position that is off for good, so that the residual is no stationary
noise and its colour gives no standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.scores import Scores, changes_by_pairs
from jaxid.estimators.simulated_output import output_residual
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.rows import Rows
from jaxid.simulation.replay import Replay, noise_of_command

# Pairs of simulated noise: a standard deviation from so many draws is itself within 9 %.
_PAIRS = 64


@dataclass(frozen=True)
class Pushed:
    """Effect of the noise of force and readings on the estimates.

    Args:
        bias: Mean change of the estimates by noise of the force, (q,).
        covariance: Covariance of the estimates by both, (q, q).
    """

    bias: Float[np.ndarray, " q"]
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
) -> tuple[Array, Array]:
    """Return the even and the odd change of the residual by each pair of noise of the force."""

    def residual(noise: Array) -> Array:
        assert replay.command is not None, "make_replay gives an open loop its command"
        pushed = eqx.tree_at(lambda r: r.command, replay, replay.command + noise)
        return output_residual(pushed, places, plant, measured, weight, on)(theta)

    return changes_by_pairs(residual, noise)


def pushed_steps(
    logs: Sequence[tuple[tuple, Float[np.ndarray, " m"], Float[np.ndarray, " k"], Rows]],
    on: str,
    pairs: int = _PAIRS,
) -> Steps[Pushed]:
    """Simulate how the noise of the logged force moves the estimates, by one step of Gauss-Newton.

    Args:
        logs: For each log the arguments of its residual as of `output_residual`, with the values of its
            unknowns in place of `on`; the standard deviations of its forces in units of the command, (m,),
            and of its outputs, (k,); and its residual at the fit.
        on: Kind of the outputs.
        pairs: Number of pairs of opposite noise.

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    rng = np.random.default_rng(0)
    none = Scores.none(logs[0][3], pairs)
    even, odd = none, none
    of_readings = np.zeros_like(odd.normal)
    for (replay, *others), force_std, output_std, rows in logs:
        noise = noise_of_command(replay, force_std, rng, pairs)
        found = yield SolveRequest(_changes, (replay, *others, on, noise))
        even, odd = (s.with_log(rows, np.asarray(x)) for s, x in zip((even, odd), found, strict=True))
        counted = np.where(rows.counts[..., None], rows.jacobian, 0.0)
        loud = (counted * output_std[:, None]).reshape(-1, len(of_readings))
        of_readings += rows.weight**2 * loud.T @ loud
    steps = odd.steps()
    covariance = steps.T @ steps / pairs + odd.inverse @ of_readings @ odd.inverse
    return Pushed(even.steps().mean(axis=0), covariance)
