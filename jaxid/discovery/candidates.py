"""A model with every effect that the plant might be missing, each of them neutral at first.

One superset is compiled once, and the choice of unknowns to fit is data. Compiling each candidate separately
would take longer than the whole search.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.discovery.bounded_fit import bounded_fit
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, Parameters, scatter, seeds
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import in_threads
from jaxid.own_values import OwnValues
from jaxid.simulation.force_balance import ForceData, force_and_columns, force_residual, scale_columns

# A candidate with more starts than this is evaluated on a plant without other effects, all starts at once.
_FEW = 8
# A search uses at most this many kept samples of a long log, summed over the joints, in this many pieces
# spread over the log.
_MOST = 8_000
_PIECES = 4
# Number of directions in which the superset is differentiated at once. It is small, so that the intermediate
# arrays of a long log stay in the processor's cache.
_COLUMNS = 4
# Largest number of evaluations of a refit.
_EVALUATIONS = 25
# Latest points of the superset whose residual and columns are kept: a search asks for most of them again.
_POINTS = 8
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
        unscaled: The same without the change of the drives' ratio, by which the whole residual is divided;
            None: the candidate does not change the ratio.
    """

    candidate: Candidate
    start: int
    offset: Float[np.ndarray, "kept n"]
    columns: Float[np.ndarray, "kept n k"]
    unscaled: Float[np.ndarray, "kept n k"] | None = None

    @property
    def explaining(self) -> Float[np.ndarray, "kept n k"]:
        """Columns that may explain a residual: a mere scale of it explains nothing."""
        return self.columns if self.unscaled is None else self.unscaled

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


@dataclass(frozen=True)
class View:
    """Unknowns and plant of the superset as one of several logs has them.

    Args:
        known: Values of unknowns that are known in this log, by index.
        values: Other values of the plant that are known in this log, by their places.
        shared: For each unknown with a value in each log, the indices of all of them.
        own: For each of these, the index of that of this log; None: it has none, and takes their mean.
        scale: Factor of the residual by joint, with which its noise is that of the first log, (n,).
    """

    known: Mapping[int, float]
    values: Mapping[tuple, float]
    shared: tuple[tuple[int, ...], ...]
    own: tuple[int | None, ...]
    scale: Float[np.ndarray, " n"]

    @classmethod
    def of(cls, machine: Machine, own: OwnValues, scale: Float[np.ndarray, " n"]) -> View:
        """Return the view of a log on a machine with all candidates."""
        free = machine.parameters.free
        known = {k: own.plant[f.path, f.index] for k, f in enumerate(free) if (f.path, f.index) in own.plant}
        unknown = {(f.path, f.index) for f in free}
        groups: dict[tuple, list[int]] = {}
        for k, f in enumerate(free):
            if f.log is not None:
                groups.setdefault((f.path, f.index), []).append(k)
        mine = [next((k for k in group if free[k].log == own.log), None) for group in groups.values()]
        values = {place: value for place, value in own.plant.items() if place not in unknown}
        return cls(known, values, tuple(map(tuple, groups.values())), tuple(mine), scale)

    def unscaled(self) -> View:
        """Return the view with residuals in their unit."""
        return replace(self, scale=np.ones_like(self.scale))

    def superset(self, superset: CandidateModel) -> CandidateModel:
        """Return the superset with the values of the plant that are known in this log."""
        if not self.values:
            return superset
        machine = superset.machine
        plant = scatter(tuple(self.values), machine.plant, np.array(list(self.values.values())))
        return replace(superset, machine=machine.with_plant(plant, machine.parameters))

    def wanted(self, wanted: Sequence[int] | np.ndarray) -> list[int]:
        """Return indices of unknowns, with those whose derivatives `jacobian` takes for them."""
        indices = {int(k) for k in wanted}
        return sorted(indices | {group[-1] for group in self.shared if indices & set(group)})

    def theta(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return all unknowns as they hold in this log."""
        out = theta.copy()
        for group, own in zip(self.shared, self.own, strict=True):
            out[list(group)] = np.mean(theta[list(group)]) if own is None else theta[own]
        for k, value in self.known.items():
            out[k] = value
        return out

    def jacobian(self, jacobian: Float[np.ndarray, "kept n p"]) -> Float[np.ndarray, "kept n p"]:
        """Return derivatives by the unknowns of all logs, from those by the unknowns as they hold here."""
        out = jacobian.copy()
        for group, own in zip(self.shared, self.own, strict=True):
            # The plant holds one value, the last that was put there.
            out[..., list(group)] = 0.0
            if own is not None:
                out[..., own] = jacobian[..., group[-1]]
        out[..., list(self.known)] = 0.0
        return out * self.scale[:, None]


class Viewed(NamedTuple):
    """A log or a piece of one, and its view of the superset.

    Args:
        data: Its arrays.
        view: The view; None: the log is the only one.
    """

    data: ForceData
    view: View | None


class CandidateSamples:
    """The samples of a log, or of several, that a search uses: all, or pieces spread over a long log.

    Args:
        data: The log, prepared.
        force_noise: Standard deviation of the declared force, (m,); None if it is not known.
        view: Its view of the superset; None: it is the only one.
        more: Further logs with their views, whose samples follow.
    """

    def __init__(
        self,
        data: Prepared,
        force_noise: Float[np.ndarray, " m"] | None = None,
        view: View | None = None,
        more: Sequence[tuple[Prepared, View]] = (),
    ) -> None:
        logs = [(data, view), *more]
        most = _MOST // data.q.shape[1] // len(logs)
        cut = [(part, own) for log, own in logs for part in log.parts(most, _PIECES)]
        self.parts = [part for part, _ in cut]
        self.arrays = [Viewed(ForceData.of(part), own) for part, own in cut]
        self.noisier = (
            []
            if force_noise is None
            else [Viewed(_noisier(a.data, force_noise), a.view) for a in self.arrays]
        )
        moving = [p.moving.copy() for p in self.parts]
        for m in moving[1:]:
            m[0] = False  # a piece does not continue the one before it
        self.moving = np.concatenate(moving)
        self.weight = np.concatenate([np.asarray(a.data.weight) for a in self.arrays])
        self._latest: OrderedDict[tuple, _Point] = OrderedDict()

    def evaluated(
        self, superset: CandidateModel, theta: Float[np.ndarray, " p"], wanted: frozenset[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return residual and Jacobian as `evaluate` does, from a recent call if one had the same columns."""
        key = (id(superset), theta.tobytes())
        point = self._latest.setdefault(key, _Point(superset, {}))
        self._latest.move_to_end(key)
        if len(self._latest) > _POINTS:
            self._latest.popitem(last=False)
        found = next((known for asked, known in point.known.items() if wanted <= asked), None)
        if found is None:
            found = point.known[wanted] = evaluate_on(superset, self.arrays, theta, sorted(wanted))
        return found


class _Point(NamedTuple):
    """Evaluations at one point of a superset: residual and Jacobian, by the unknowns of its columns.

    The superset is kept, so that no other one gets its identity.
    """

    superset: CandidateModel
    known: dict[frozenset[int], tuple[np.ndarray, np.ndarray]]


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
    asked = range(len(theta)) if wanted is None else np.asarray(wanted, int).tolist()
    return samples.evaluated(superset, theta, frozenset(asked))


def evaluate_on(
    superset: CandidateModel,
    logs: Sequence[Viewed],
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | np.ndarray | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """Compute residual and Jacobian, as `evaluate` does, on several logs or pieces, one after the other."""
    colours = np.asarray(superset.colours, int)
    directions = seeds(superset.colours)
    views = [log.view for log in logs]
    if wanted is not None:
        wanted = [k for view in views for k in (wanted if view is None else view.wanted(wanted))]
    # The choice of directions is data: with a fixed number of columns one compiled function serves all.
    ask = np.unique(colours if wanted is None else colours[np.asarray(wanted, int)])
    parts = [ask[k : k + _COLUMNS] for k in range(0, max(len(ask), 1), _COLUMNS)]
    calls = []
    for log in logs:
        own = superset if log.view is None else log.view.superset(superset)
        at = theta if log.view is None else log.view.theta(theta)
        calls += [(own, log.data, at, directions, part) for part in parts]
    results = in_threads(_directional_derivatives, calls)

    by_log = [results[k : k + len(parts)] for k in range(0, len(results), len(parts))]
    scales = [1.0 if view is None else view.scale for view in views]
    e = np.concatenate([some[0][0] * scale for some, scale in zip(by_log, scales, strict=True)])
    derivatives = np.concatenate([np.concatenate([c for _, c in some], axis=-1) for some in by_log])
    jacobian = np.zeros((*e.shape, directions.shape[1]))
    jacobian[..., ask] = derivatives
    # From colours to unknowns: an unknown has the column of its colour, in the balances that it enters.
    jacobian = jacobian[..., colours]
    jacobian = jacobian if directions.shape[1] == len(theta) else jacobian * superset.enters
    if not any(views):
        return e, jacobian
    ends = np.cumsum([len(some[0][0]) for some in by_log])[:-1]
    rows = zip(np.split(jacobian, ends), views, strict=True)
    return e, np.concatenate([part if view is None else view.jacobian(part) for part, view in rows])


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
    superset: CandidateModel,
    data: Any,
    theta: Float[np.ndarray, " p"],
    moving: np.ndarray,
    at_point: Callable[..., tuple[np.ndarray, np.ndarray]] | None = None,
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Fit some unknowns of the superset, with the others fixed.

    The superset's Jacobian is compiled already; calling it from a host solver costs less than compiling a
    second one inside a loop.

    Args:
        superset: Machine with all candidates.
        data: Samples of the log.
        theta: All unknowns at the start.
        moving: Indices of the unknowns to fit.
        at_point: Function of samples, unknowns and wanted derivatives that computes residual and Jacobian;
            None: `evaluate`, in forces.

    Returns:
        All unknowns, and whether the solver converged.
    """
    if not len(moving):
        return theta.copy(), True
    some = free_of(superset, moving)
    evaluated = at_point or (lambda data, at, wanted: evaluate(superset, data, at, wanted))
    weight = data.weight[..., None]

    def at(values: np.ndarray) -> np.ndarray:
        out = theta.copy()
        out[moving] = values
        return out

    def rows(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        e, jacobian = evaluated(data, at(values), moving)
        with np.errstate(invalid="ignore", over="ignore"):  # diverged values are made finite by the fit
            columns = (jacobian[..., moving] * weight).reshape(-1, len(moving))
            return (e * weight[..., 0]).ravel(), columns

    values, converged = bounded_fit(some, theta[moving], rows, most=_EVALUATIONS)
    return at(values), converged


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
                shift, unscaled = np.zeros_like(e), None
                if not group[0].amplitude.any():
                    joints = slice(None) if len(group) == 1 else slice(c.port, c.port + 1)
                    shift[:, joints] = (e - residual)[:, joints]
                if group is not faint:
                    # At a neutral start, as of a gain, only the ratio keeps zeros from solving the balance.
                    scale = _changes_of_scale(superset, data.arrays, at, c.index)
                    unscaled = jacobian[..., c.index] + e[..., None] * scale
                results.append(Point(c, k, shift, jacobian[..., c.index], unscaled))
    return results


def _changes_of_scale(
    superset: CandidateModel, logs: Sequence[Viewed], theta: Float[np.ndarray, " p"], index: np.ndarray
) -> Float[np.ndarray, "kept n k"]:
    """Compute the derivatives of the logarithm of the drives' ratio in some unknowns, for every sample."""
    directions = np.eye(len(theta))[:, index]
    parts = []
    for log in logs:
        own = superset if log.view is None else log.view.superset(superset)
        at = theta if log.view is None else log.view.theta(theta)
        machine = own.machine
        slopes = scale_columns(
            machine.plant, machine.parameters.places, log.data, jnp.asarray(at), directions
        )
        parts.append(np.broadcast_to(np.asarray(slopes), (len(log.data.weight), *slopes.shape)))
    return np.concatenate(parts)


def grid_points(superset: CandidateModel, candidate: Candidate, data: CandidateSamples) -> list[Point]:
    """Linearise a candidate with many starts at each of them, on a plant without other effects."""
    effect: Effect = superset.machine.plant.effects[position(superset, candidate)]
    alone = eqx.tree_at(lambda p: p.effects, superset.machine.plant, (effect,))
    names = user_effect_names(effect)
    places = tuple((("effects", 0, n), None) for n in names)
    probes = np.stack([candidate.probe(k) for k in range(len(candidate.starts))])
    results = []
    for arrays, view in data.arrays:
        chunks = [np.asarray(_columns(alone, places, arrays, jnp.asarray(s))) for s in _chunks(probes)]
        columns = np.concatenate(chunks)[: len(candidate.starts)]
        results.append(columns if view is None else columns * view.scale[:, None])
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
