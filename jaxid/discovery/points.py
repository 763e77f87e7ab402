"""Points of candidates: their columns in the residual at each of their starts, beside a model."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.candidates import (
    Candidate,
    CandidateModel,
    CandidateSamples,
    Point,
    evaluate,
    position,
    user_effect_names,
    without_effects,
)
from jaxid.model.balance import BarePlant
from jaxid.model.effect import Effect
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.force_balance import ForceData, force_residual


def start_points(
    superset: CandidateModel,
    rest: list[Candidate],
    data: CandidateSamples,
    theta: Float[np.ndarray, " p"],
    residual: Float[np.ndarray, "kept n"],
) -> list[Point]:
    """Linearise every candidate that has few starts at each of its starts, through the superset.

    Args:
        superset: Machine with all candidates.
        rest: Candidates to evaluate.
        data: Samples of the log.
        theta: All unknowns of the current model.
        residual: Residual of the current model.
    """
    results = []
    with_few_starts = [c for c in rest if not c.has_grid]
    for k in range(max((len(c.starts) for c in with_few_starts), default=0)):
        now = [c for c in with_few_starts if k < len(c.starts)]
        # Added forces are faint and can share one evaluation. A drive effect shifts the residual of its
        # joint, and shares an evaluation with its kind on other joints only.
        faint = [c for c in now if c.amplitude.any() or np.allclose(c.starts[k], c.neutral)]
        shifting = [c for c in now if all(c is not f for f in faint)]
        kinds = dict.fromkeys(c.kind for c in shifting)
        for group in (faint, *([c for c in shifting if c.kind == kind] for kind in kinds)):
            if not group:
                continue
            at = theta.copy()
            for c in group:
                at[c.index] = c.probe(k)
            e, jacobian = evaluate(superset, data, at, np.concatenate([c.index for c in group]))
            for c in group:
                # Nothing that is faint or neutral shifts the residual. The sum of all of them may: that of a
                # spring does if a short stroke lies far from the origin.
                shift, unscaled = np.zeros_like(e), None
                if group is not faint:
                    joints = slice(None) if len(group) == 1 else slice(c.port, c.port + 1)
                    shift[:, joints] = (e - residual)[:, joints]
                    # At a neutral start, as of a gain, only the ratio keeps zeros from solving the balance.
                    scale = _changes_of_scale(superset, data, at, c.index)
                    unscaled = jacobian[..., c.index] + e[..., None] * scale
                results.append(Point(c, k, shift, jacobian[..., c.index], unscaled))
    return results


def _changes_of_scale(
    superset: CandidateModel, samples: CandidateSamples, theta: Float[np.ndarray, " p"], index: np.ndarray
) -> Float[np.ndarray, "kept n k"]:
    """Compute the derivatives of the logarithm of the drives' ratio in some unknowns, for every sample."""
    found = samples.evaluated(superset, theta, frozenset(index.tolist()))
    parts = zip(found.scales, found.lengths, strict=True)
    return np.concatenate([np.repeat(slopes[None, :, index], rows, axis=0) for slopes, rows in parts])


def grid_points(superset: CandidateModel, candidate: Candidate, data: CandidateSamples) -> list[Point]:
    """Linearise a candidate with many starts at each of them, on a plant without other effects."""
    effect: Effect = superset.machine.plant.effects[position(superset, candidate)]
    alone = without_effects(superset.machine.plant).with_effect(effect)
    names = user_effect_names(effect)
    places = tuple((("effects", 0, n), None) for n in names)
    probes = np.stack([candidate.probe(k) for k in range(len(candidate.starts))])
    results = []
    for log in data.arrays:
        known = log.bare(superset, log.theta(superset.neutral))
        bare = None if known is None else known.along
        chunks = [
            np.asarray(_columns(alone, places, log.data, jnp.asarray(s), bare)) for s in _chunks(probes)
        ]
        columns = np.concatenate(chunks)[: len(candidate.starts)]
        results.append(columns if log.view is None else columns * log.view.scale[:, None])
    columns = np.concatenate(results, axis=1)
    zero = np.zeros(columns.shape[1:3])
    return [Point(candidate, k, zero, c) for k, c in enumerate(columns)]


def _chunks(starts: np.ndarray, size: int = 37) -> Iterator[np.ndarray]:
    """Yield chunks of equal size, the last one padded: one compiled shape, and memory for one chunk only."""
    for k in range(0, len(starts), size):
        chunk = starts[k : k + size]
        fill = np.repeat(chunk[-1:], size - len(chunk), axis=0)
        yield np.concatenate([chunk, fill])


@kept_jit
def _columns(plant: Plant, places: tuple, data: ForceData, starts: Array, bare: BarePlant | None) -> Array:
    def columns(start: Array) -> Array:
        return jax.jacfwd(lambda s: force_residual(scatter(places, plant, s), data, bare))(start)

    return jax.lax.map(columns, starts)
