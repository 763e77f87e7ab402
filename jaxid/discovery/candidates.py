"""The plant with every effect it might be missing, each doing nothing yet.

One union is compiled once; which unknowns move is data. Compiling each candidate by itself would
take longer than all of the search.
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
from jaxid.numerics.lanes import in_threads
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_residual

# An effect with more starts than this is evaluated on a plant of its own, all starts at once.
_FEW = 8
# Of a long log a search looks at so many kept samples, those of all joints counted, in so many
# pieces spread over it.
_MOST = 8_000
_PIECES = 4
# A union is differentiated in so many columns at once, and only in those asked for: few, so that what a long
# log makes of each operation stays in the processor's cache.
_COLUMNS = 4
# Strength at which the columns of an added force are taken, relative to the log's force.
_FAINT = 1e-6


@dataclass(frozen=True)
class Candidate:
    """One effect in one place that the plant might be missing.

    Args:
        kind: Its name.
        label: Kind and place, as results name it.
        port: Where it acts: a joint from 0 on, or behind them a spring.
        index: Its unknowns in the union's vector.
        neutral: Values at which it does next to nothing.
        starts: Values to search from, (starts, parameters).
        amplitude: Which of its parameters scale with its strength; none for a drive effect.
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
        """Whether its starts are evaluated on a plant of their own."""
        return len(self.starts) > _FEW

    def probe(self, start: int) -> np.ndarray:
        """Values at which its columns are taken: the shape of a start, next to no strength."""
        return np.where(self.amplitude, _FAINT, 1.0) * self.starts[start]


@dataclass(frozen=True)
class Point:
    """A candidate at one start: how the residual differs there, and its columns.

    Args:
        candidate: Which.
        start: Index of the start.
        offset: Residual there minus residual of the current model, (kept, n).
        columns: Derivatives in the candidate's unknowns, (kept, n, parameters).
    """

    candidate: Candidate
    start: int
    offset: Float[np.ndarray, "kept n"]
    columns: Float[np.ndarray, "kept n k"]

    @property
    def strength(self) -> Float[np.ndarray, "kept n"] | None:
        """Residual per unit of the start's strength; None for a drive effect."""
        c = self.candidate
        if not c.amplitude.any():
            return None
        return self.columns @ np.where(c.amplitude, c.starts[self.start], 0.0)


@dataclass(frozen=True)
class CandidateModel:
    """Machine with all candidates.

    Args:
        machine: Its plant carries every candidate; its parameters are the case's own, then theirs.
        base: Indices of the case's own unknowns.
        candidates: By kind and place.
        enters: Which unknowns stand in the balance of which joints, (joints, unknowns).
        colours: Numbers of the unknowns such that no two of one number stand in one balance.
    """

    machine: Machine
    base: np.ndarray
    candidates: tuple[Candidate, ...]
    enters: Bool[np.ndarray, "n p"]
    colours: tuple[int, ...]

    @property
    def neutral(self) -> np.ndarray:
        """The vector at which only the baseline acts."""
        return self.machine.parameters.guess


class CandidateSamples:
    """What a search looks at of a log: all of it, or pieces spread over a long one.

    Args:
        data: The log, prepared.
        force_noise: Standard deviation of the declared force, (m,); None: not known.
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
    """A log with the noise of its force once more on top."""
    draw = np.random.default_rng(20240501).standard_normal(arrays.force.shape)
    return eqx.tree_at(lambda a: a.force, arrays, arrays.force + force_noise * draw)


def evaluate(
    union: CandidateModel,
    samples: CandidateSamples,
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """Residual of the union and its Jacobian in all unknowns, or at least in those wanted."""
    return evaluate_on(union, samples.arrays, theta, wanted)


def evaluate_on(
    union: CandidateModel,
    logs: list[ForceData],
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """The same on several logs or pieces, their rows in that order."""
    colours = np.asarray(union.colours, int)
    directions = seeds(union.colours)
    # Which are asked is data: one number of columns, and one compiled function.
    ask = np.unique(colours if wanted is None else colours[np.asarray(wanted, int)])
    parts = [ask[k : k + _COLUMNS] for k in range(0, max(len(ask), 1), _COLUMNS)]
    found = in_threads(_asked, [(union, log, theta, directions, part) for log in logs for part in parts])
    each = [found[k : k + len(parts)] for k in range(0, len(found), len(parts))]
    e = np.concatenate([some[0][0] for some in each])
    own = np.concatenate([np.concatenate([c for _, c in some], axis=-1) for some in each])
    jacobian = np.zeros((*e.shape, directions.shape[1]))
    jacobian[..., ask] = own
    jacobian = jacobian[..., colours]
    return e, jacobian if directions.shape[1] == len(theta) else jacobian * union.enters


def _asked(
    union: CandidateModel, log: ForceData, theta: np.ndarray, directions: np.ndarray, part: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Residual and derivatives in some directions, filled up to one number of them."""
    own = np.zeros((len(theta), _COLUMNS))
    own[:, : len(part)] = directions[:, part]
    plant, places = union.machine.plant, union.machine.parameters.places
    e, columns = force_and_columns(plant, places, log, jnp.asarray(theta), own)
    return np.asarray(e), np.asarray(columns)[..., : len(part)]


def refine(
    union: CandidateModel, data: CandidateSamples, theta: Float[np.ndarray, " p"], moving: np.ndarray
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Fit some unknowns of the union in the force domain, the rest held.

    The union's Jacobian is compiled already; driving a host solver with it costs less than
    compiling a second one inside a loop.

    Args:
        union: The union.
        data: The log.
        theta: Start, all unknowns.
        moving: Indices of those that move.

    Returns:
        All unknowns, and whether the solver converged.
    """
    if not len(moving):
        return theta.copy(), True
    few = free_of(union, moving)
    transform = Transform.of(few)
    lower, upper = (np.asarray(transform.inward(b)) for b in few.bounds)
    weight = data.weight[..., None]
    latest: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = x.tobytes()
        if key not in latest:
            latest.clear()
            at = theta.copy()
            at[moving] = np.asarray(transform.outward(jnp.asarray(x)))
            e, jacobian = evaluate(union, data, at, moving)
            slope = np.asarray(transform.slope(jnp.asarray(at[moving])))
            with np.errstate(invalid="ignore", over="ignore"):  # what diverged is made finite below
                rows = (jacobian[..., moving] * slope * weight).reshape(-1, len(moving))
            latest[key] = (_finite(e * weight[..., 0]).ravel(), _finite(rows))
        return latest[key]

    start = np.clip(np.asarray(transform.inward(jnp.asarray(theta[moving]))), lower, upper)
    fit = scipy.optimize.least_squares(
        lambda x: both(x)[0],
        start,
        lambda x: both(x)[1],
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
    """What diverged, as a number so large that a solver turns back, yet not too large to square."""
    return np.clip(np.nan_to_num(x, nan=1e60), -1e60, 1e60)


def points(
    union: CandidateModel,
    rest: list[Candidate],
    data: CandidateSamples,
    theta: Float[np.ndarray, " p"],
    residual: Float[np.ndarray, "kept n"],
) -> list[Point]:
    """Every candidate that has few starts at each of them, all together through the union.

    Args:
        union: The union.
        rest: Candidates to evaluate.
        data: The log.
        theta: Current model, all unknowns.
        residual: Its residual.
    """
    found = []
    few = [c for c in rest if not c.has_grid]
    for k in range(max((len(c.starts) for c in few), default=0)):
        now = [c for c in few if k < len(c.starts)]
        # Added forces are faint and can share an evaluation. A drive effect shifts the residual of
        # its joint, and shares one with those of its kind on other joints.
        faint = [c for c in now if c.amplitude.any() or np.allclose(c.starts[k], c.neutral)]
        shifting = [c for c in now if all(c is not f for f in faint)]
        kinds = dict.fromkeys(c.kind for c in shifting)
        for group in (faint, *([c for c in shifting if c.kind == kind] for kind in kinds)):
            if not group:
                continue
            at = theta.copy()
            for c in group:
                at[c.index] = c.probe(k)
            e, jacobian = evaluate(union, data, at, np.concatenate([c.index for c in group]))
            for c in group:
                shift = np.zeros_like(e)
                if not group[0].amplitude.any():
                    own = slice(None) if len(group) == 1 else slice(c.port, c.port + 1)
                    shift[:, own] = (e - residual)[:, own]
                found.append(Point(c, k, shift, jacobian[..., c.index]))
    return found


def grid_points(union: CandidateModel, candidate: Candidate, data: CandidateSamples) -> list[Point]:
    """A candidate with many starts at each of them, on a plant that has nothing else."""
    effect: Effect = union.machine.plant.effects[position(union, candidate)]
    alone = eqx.tree_at(lambda p: p.effects, union.machine.plant, (effect,))
    names = user_effect_names(effect)
    places = tuple((("effects", 0, n), None) for n in names)
    probes = np.stack([candidate.probe(k) for k in range(len(candidate.starts))])
    found = []
    for arrays in data.arrays:
        chunks = [np.asarray(_columns(alone, places, arrays, jnp.asarray(s))) for s in _chunks(probes)]
        found.append(np.concatenate(chunks)[: len(candidate.starts)])
    columns = np.concatenate(found, axis=1)
    zero = np.zeros(columns.shape[1:3])
    return [Point(candidate, k, zero, c) for k, c in enumerate(columns)]


def _chunks(starts: np.ndarray, size: int = 37) -> Iterator[np.ndarray]:
    """Equal chunks, the last filled up: one compiled shape, and memory for one chunk only."""
    for k in range(0, len(starts), size):
        chunk = starts[k : k + size]
        fill = np.repeat(chunk[-1:], size - len(chunk), axis=0)
        yield np.concatenate([chunk, fill])


@eqx.filter_jit
def _columns(plant: Plant, places: tuple, data: ForceData, starts: Array) -> Array:
    def columns(start: Array) -> Array:
        return jax.jacfwd(lambda s: force_residual(scatter(places, plant, s), data))(start)

    return jax.lax.map(columns, starts)


def position(union: CandidateModel, candidate: Candidate) -> int:
    """Index of a candidate among the effects of the union's plant."""
    path = union.machine.parameters.free[candidate.index[0]].path
    return int(path[1])


def effect_of(union: CandidateModel, candidate: Candidate) -> Effect:
    """Return a candidate as it stands in the union's plant, at its neutral values."""
    return union.machine.plant.effects[position(union, candidate)]


def effect_at(union: CandidateModel, candidate: Candidate, values: Float[np.ndarray, " k"]) -> Effect:
    """A candidate as an effect of its own, at some values of its unknowns."""
    effect = effect_of(union, candidate)
    return type(effect)(**dict(zip(user_effect_names(effect), values, strict=True)), port=candidate.port)


def user_effect_names(effect: Effect) -> list[str]:
    """Parameters that an effect has, those that it leaves out apart."""
    return [n for n in parameters_of(type(effect)) if getattr(effect, n) is not None]


def free_of(union: CandidateModel, index: np.ndarray) -> Parameters:
    """Some unknowns of the union."""
    free: list[Free] = [union.machine.parameters.free[i] for i in index]
    return Parameters(tuple(free))
