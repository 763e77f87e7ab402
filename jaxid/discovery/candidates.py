"""A model with every effect that the plant might be missing, each of them neutral at first.

One superset is compiled once, and the choice of unknowns to fit is data. Compiling each candidate separately
would take longer than the whole search.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, Parameters, scatter, seeds
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import in_threads
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_residual

# A candidate with more starts than this is evaluated on a plant without other effects, all starts at once.
_FEW = 8
# A search uses at most this many kept samples of a long log, summed over the joints, in this many pieces
# spread over the log.
_MOST = 8_000
_PIECES = 4
# Number of directions in which the superset is differentiated at once. It is small, so that the intermediate
# arrays of a long log stay in the processor's cache.
_COLUMNS = 4
# Strength at which the columns of an added force are computed, relative to the strength of its start.
_FAINT = 1e-6


@dataclass(frozen=True)
class Candidate:
    """One effect at one place that the plant might be missing.

    Args:
        kind: Kind of the effect, as in case files.
        label: Kind and place, as in results.
        port: Port at which the effect acts: joints from 0 on, then springs.
        index: Indices of its unknowns in the superset's vector.
        neutral: Values at which it has next to no effect.
        starts: Values from which a search starts, (starts, parameters).
        amplitude: Mask of its parameters that scale with its strength; none for a drive effect.
    """

    kind: str
    label: str
    port: int
    index: np.ndarray
    neutral: np.ndarray
    starts: np.ndarray
    amplitude: np.ndarray

    @property
    def has_grid(self) -> bool:
        """True if the starts are evaluated on a plant without other effects."""
        return len(self.starts) > _FEW

    def probe(self, start: int) -> np.ndarray:
        """Return the values at which its columns are computed: the shape of a start at a faint strength."""
        return np.where(self.amplitude, _FAINT, 1.0) * self.starts[start]


@dataclass(frozen=True)
class Point:
    """A candidate at one start: its change of the residual, and its columns.

    Args:
        candidate: The candidate that is linearised.
        start: Index of the start.
        offset: Residual at the start minus the residual of the current model, (kept, n).
        columns: Derivatives of the residual in the candidate's unknowns, (kept, n, parameters).
    """

    candidate: Candidate
    start: int
    offset: Float[np.ndarray, "kept n"]
    columns: Float[np.ndarray, "kept n k"]

    @property
    def strength(self) -> Float[np.ndarray, "kept n"] | None:
        """Change of the residual per unit of the start's strength; None for a drive effect."""
        c = self.candidate
        if not c.amplitude.any():
            return None
        return self.columns @ np.where(c.amplitude, c.starts[self.start], 0.0)


@dataclass(frozen=True)
class CandidateModel:
    """Machine with all candidates.

    Args:
        machine: Its plant has every candidate; its unknowns are those of the case, then those of candidates.
        base: Indices of the unknowns of the case.
        candidates: Candidates by kind, then by place.
        enters: Mask of the unknowns that occur in the balance of each joint, (joints, unknowns).
        colours: Colour of each unknown; no two unknowns of one colour occur in the same balance.
    """

    machine: Machine
    base: np.ndarray
    candidates: tuple[Candidate, ...]
    enters: Bool[np.ndarray, "n p"]
    colours: tuple[int, ...]

    @property
    def neutral(self) -> np.ndarray:
        """Vector of unknowns at which only the baseline acts."""
        return self.machine.parameters.guess


class CandidateSamples:
    """The samples of a log that a search uses: all of them, or pieces spread over a long log.

    Args:
        data: The log, prepared.
        force_noise: Standard deviation of the declared force, (m,); None if it is not known.
    """

    def __init__(self, data: Prepared, force_noise: Float[np.ndarray, " m"] | None = None) -> None:
        self.parts = data.parts(_MOST // data.q.shape[1], _PIECES)
        self.arrays = [ForceData.of(p) for p in self.parts]
        self.noisier = [] if force_noise is None else [_noisier(a, force_noise) for a in self.arrays]
        moving = [p.moving.copy() for p in self.parts]
        for m in moving[1:]:
            m[0] = False  # a piece does not continue the one before it
        self.moving = np.concatenate(moving)
        self.weight = np.concatenate([np.asarray(a.weight) for a in self.arrays])


def _noisier(arrays: ForceData, force_noise: np.ndarray) -> ForceData:
    """Return a log with a second draw of force noise added."""
    draw = np.random.default_rng(20240501).standard_normal(arrays.force.shape)
    return eqx.tree_at(lambda a: a.force, arrays, arrays.force + force_noise * draw)


def evaluate(
    superset: CandidateModel,
    samples: CandidateSamples,
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | np.ndarray | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """Compute the residual of the superset and its Jacobian.

    Args:
        superset: Machine with all candidates.
        samples: Samples of the log.
        theta: All unknowns of the superset.
        wanted: Indices of the unknowns that need derivatives; columns of others may be zero. None: all.
    """
    return evaluate_on(superset, samples.arrays, theta, wanted)


def evaluate_on(
    superset: CandidateModel,
    logs: list[ForceData],
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | np.ndarray | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """Compute residual and Jacobian, as `evaluate` does, on several logs or pieces, one after the other."""
    colours = np.asarray(superset.colours, int)
    directions = seeds(superset.colours)
    # The choice of directions is data: with a fixed number of columns one compiled function serves all.
    ask = np.unique(colours if wanted is None else colours[np.asarray(wanted, int)])
    parts = [ask[k : k + _COLUMNS] for k in range(0, max(len(ask), 1), _COLUMNS)]
    calls = [(superset, log, theta, directions, part) for log in logs for part in parts]
    results = in_threads(_directional_derivatives, calls)

    by_log = [results[k : k + len(parts)] for k in range(0, len(results), len(parts))]
    e = np.concatenate([some[0][0] for some in by_log])
    derivatives = np.concatenate([np.concatenate([c for _, c in some], axis=-1) for some in by_log])
    jacobian = np.zeros((*e.shape, directions.shape[1]))
    jacobian[..., ask] = derivatives
    # From colours to unknowns: an unknown has the column of its colour, in the balances that it enters.
    jacobian = jacobian[..., colours]
    return e, jacobian if directions.shape[1] == len(theta) else jacobian * superset.enters


def _directional_derivatives(
    superset: CandidateModel, log: ForceData, theta: np.ndarray, directions: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the residual and its derivatives in some directions, padded to a fixed number of them."""
    padded = np.zeros((len(theta), _COLUMNS))
    padded[:, : len(part)] = directions[:, part]
    plant, places = superset.machine.plant, superset.machine.parameters.places
    e, columns = force_and_columns(plant, places, log, jnp.asarray(theta), padded)
    return np.asarray(e), np.asarray(columns)[..., : len(part)]


def refine(
    superset: CandidateModel, data: CandidateSamples, theta: Float[np.ndarray, " p"], moving: np.ndarray
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Fit some unknowns of the superset in the force domain, with the others fixed.

    The superset's Jacobian is compiled already; calling it from a host solver costs less than compiling a
    second one inside a loop.

    Args:
        superset: Machine with all candidates.
        data: Samples of the log.
        theta: All unknowns at the start.
        moving: Indices of the unknowns to fit.

    Returns:
        All unknowns, and whether the solver converged.
    """
    if not len(moving):
        return theta.copy(), True
    some = free_of(superset, moving)
    transform = Transform.of(some)
    lower, upper = (np.asarray(transform.inward(b)) for b in some.bounds)
    weight = data.weight[..., None]
    latest: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    # The solver asks for residual and Jacobian at the same point one after the other.
    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = x.tobytes()
        if key not in latest:
            latest.clear()
            at = theta.copy()
            at[moving] = np.asarray(transform.outward(jnp.asarray(x)))
            e, jacobian = evaluate(superset, data, at, moving)
            slope = np.asarray(transform.slope(jnp.asarray(at[moving])))
            with np.errstate(invalid="ignore", over="ignore"):  # diverged values are made finite below
                rows = (jacobian[..., moving] * slope * weight).reshape(-1, len(moving))
            latest[key] = (_finite(e * weight[..., 0]).ravel(), _finite(rows))
        return latest[key]

    start = np.clip(np.asarray(transform.inward(jnp.asarray(theta[moving]))), lower, upper)
    fit = scipy.optimize.least_squares(
        lambda x: both(x)[0],
        start,
        lambda x: both(x)[1],  # pyright: ignore[reportArgumentType] (SciPy's stubs know names of methods only)
        (lower, upper),
        x_scale="jac",
        ftol=1e-7,
        xtol=1e-7,
        gtol=1e-10,
        max_nfev=25,
    )
    out = theta.copy()
    out[moving] = np.asarray(transform.outward(jnp.asarray(fit.x)))
    return out, bool(fit.status > 0)


def _finite(x: np.ndarray) -> np.ndarray:
    """Replace diverged values by numbers so large that a solver turns back, yet small enough to square."""
    return np.clip(np.nan_to_num(x, nan=1e60), -1e60, 1e60)


def points(
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
                shift = np.zeros_like(e)
                if not group[0].amplitude.any():
                    joints = slice(None) if len(group) == 1 else slice(c.port, c.port + 1)
                    shift[:, joints] = (e - residual)[:, joints]
                results.append(Point(c, k, shift, jacobian[..., c.index]))
    return results


def grid_points(superset: CandidateModel, candidate: Candidate, data: CandidateSamples) -> list[Point]:
    """Linearise a candidate with many starts at each of them, on a plant without other effects."""
    effect: Effect = superset.machine.plant.effects[position(superset, candidate)]
    alone = eqx.tree_at(lambda p: p.effects, superset.machine.plant, (effect,))
    names = user_effect_names(effect)
    places = tuple((("effects", 0, n), None) for n in names)
    probes = np.stack([candidate.probe(k) for k in range(len(candidate.starts))])
    results = []
    for arrays in data.arrays:
        chunks = [np.asarray(_columns(alone, places, arrays, jnp.asarray(s))) for s in _chunks(probes)]
        results.append(np.concatenate(chunks)[: len(candidate.starts)])
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
def _columns(plant: Plant, places: tuple, data: ForceData, starts: Array) -> Array:
    def columns(start: Array) -> Array:
        return jax.jacfwd(lambda s: force_residual(scatter(places, plant, s), data))(start)

    return jax.lax.map(columns, starts)


def position(superset: CandidateModel, candidate: Candidate) -> int:
    """Return the index of a candidate among the effects of the superset's plant."""
    path = superset.machine.parameters.free[candidate.index[0]].path
    return int(path[1])


def effect_of(superset: CandidateModel, candidate: Candidate) -> Effect:
    """Return a candidate of the superset's plant, at its neutral values."""
    return superset.machine.plant.effects[position(superset, candidate)]


def effect_at(superset: CandidateModel, candidate: Candidate, values: Float[np.ndarray, " k"]) -> Effect:
    """Return a candidate as a separate effect with the given values of its unknowns."""
    effect = effect_of(superset, candidate)
    return type(effect)(**dict(zip(user_effect_names(effect), values, strict=True)), port=candidate.port)


def user_effect_names(effect: Effect) -> list[str]:
    """Return the names of the parameters that an effect has, without optional ones that are absent."""
    return [n for n in parameters_of(type(effect)) if getattr(effect, n) is not None]


def free_of(superset: CandidateModel, index: np.ndarray) -> Parameters:
    """Return some of the superset's unknowns."""
    free: list[Free] = [superset.machine.parameters.free[i] for i in index]
    return Parameters(tuple(free))
