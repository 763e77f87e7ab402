"""A model with every effect that the plant might be missing, each of them neutral at first.

One superset is compiled once, and the choice of unknowns to fit is data. Compiling each candidate separately
would take longer than the whole search.
"""

from __future__ import annotations

import functools
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.discovery.bounded_fit import bounded_fit
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.balance import BarePlant
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import Free, Parameters, scatter, seeds
from jaxid.numerics.affine import Dependence, dependences
from jaxid.numerics.lanes import in_threads
from jaxid.own_values import OwnValues
from jaxid.simulation.force_balance import (
    ForceData,
    Linearised,
    bare_plant,
    force_linearised,
    inertial_columns,
    knows_bare_plant,
)

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
        finer_starts: Values from which it starts where nothing else explains the log, (more, parameters);
            None: there are none.
    """

    kind: str
    label: str
    port: int
    index: np.ndarray
    neutral: np.ndarray
    starts: np.ndarray
    amplitude: np.ndarray
    finer_starts: np.ndarray | None = None

    @property
    def has_grid(self) -> bool:
        """True if the starts are evaluated on a plant without other effects.

        An effect in the drive is not: what it does depends on the force at hand.
        """
        return len(self.starts) > _FEW and bool(self.amplitude.any())

    def finer(self) -> Candidate:
        """Return the candidate with its finer starts, if it has any, after the others."""
        if self.finer_starts is None:
            return self
        return replace(self, starts=np.concatenate([self.starts, self.finer_starts]), finer_starts=None)

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

    @functools.cached_property
    def own(self) -> np.ndarray:
        """Indices of the unknowns that belong to the plant itself, and to no effect."""
        return np.flatnonzero([f.effect is None for f in self.machine.parameters.free])

    @functools.cached_property
    def own_enter(self) -> Dependence | None:
        """Dependence of the inertial forces on these; None if the ports or anything else depend on them."""
        plant, free = without_effects(self.machine.plant), self.machine.parameters.free
        if not len(self.own):
            return Dependence.CONSTANT
        places = tuple((free[k].path, free[k].index) for k in self.own)
        motion = plant.any_motion(np.random.default_rng(20240501))
        bare = lambda theta: BarePlant.of(scatter(places, plant, theta), *motion)
        inertial, *others = dependences(bare, (self.neutral[self.own],))
        return None if plant.geared or any(others) else inertial


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


@dataclass(frozen=True)
class Viewed:
    """A log or a piece of one, and its view of the superset.

    Args:
        data: Its arrays.
        view: The view; None: the log is the only one.
    """

    data: ForceData
    view: View | None
    _bare: OrderedDict[tuple, _Bare] = field(default_factory=OrderedDict, repr=False, compare=False)

    def superset(self, superset: CandidateModel) -> CandidateModel:
        """Return the superset as this log has it."""
        return superset if self.view is None else self.view.superset(superset)

    def theta(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return all unknowns as they hold in this log."""
        return theta if self.view is None else self.view.theta(theta)

    def noisier(self, force_noise: np.ndarray) -> Viewed:
        """Return the log with a second draw of force noise added, which leaves its motion as it is."""
        return replace(self, data=_noisier(self.data, force_noise))

    def bare(self, superset: CandidateModel, theta: Float[np.ndarray, " p"]) -> _Bare | None:
        """Return what the plant does here without its effects; None if that is not known beside them.

        It is computed once, since effects are added to it and fitted, but leave it as it is.

        Args:
            superset: Machine with all candidates.
            theta: All unknowns as they hold in this log.
        """
        own = self.superset(superset)
        if not knows_bare_plant(own.machine.plant, self.data):
            return None
        key = (id(superset), theta[superset.own].tobytes())
        if key not in self._bare:
            kept = next((b for b in self._bare.values() if b.superset is superset), None)
            self._bare[key] = _Bare.of(superset, own, self.data, theta, kept)
        self._bare.move_to_end(key)
        while len(self._bare) > _POINTS:
            self._bare.popitem(last=False)
        return self._bare[key]


@dataclass(frozen=True)
class _Bare:
    """The plant without effects along a log, at some values of its own unknowns.

    Args:
        superset: The superset that it belongs to; it is kept, so that no other one gets its identity.
        along: The part of the balance that is the plant's.
        columns: Derivatives of the filtered inertial forces by the plant's own unknowns, (kept, n, own); None
            if these enter anything else too.
    """

    superset: CandidateModel
    along: BarePlant
    columns: np.ndarray | None

    @classmethod
    def of(
        cls,
        superset: CandidateModel,
        own: CandidateModel,
        data: ForceData,
        theta: np.ndarray,
        kept: _Bare | None,
    ) -> _Bare:
        """Compute it for a log.

        Args:
            superset, own: Machine with all candidates, and as this log has it.
            data: Arrays of the log.
            theta: All unknowns as they hold in this log.
            kept: The same at other values; derivatives that do not depend on the values are taken from it.
        """
        free, values = own.machine.parameters.free, theta[superset.own]
        places = tuple((free[k].path, free[k].index) for k in superset.own)
        plant = scatter(places, without_effects(own.machine.plant), values)
        along = bare_plant(plant, data)
        assert along is not None, "asked of logs that determine it"
        enter, columns = superset.own_enter, None
        if not len(values):
            columns = np.zeros((*data.weight.shape, 0))
        elif kept is not None and enter is not Dependence.OTHER:
            columns = kept.columns
        elif enter is not None:
            columns = np.asarray(inertial_columns(plant, places, data, jnp.asarray(values)))
        return cls(superset, along, columns)


def without_effects(plant: Plant) -> Plant:
    """Return a plant without its effects."""
    return eqx.tree_at(lambda p: p.effects, plant, ())


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
        self.noisier = [] if force_noise is None else [a.noisier(force_noise) for a in self.arrays]
        moving = [p.moving.copy() for p in self.parts]
        for m in moving[1:]:
            m[0] = False  # a piece does not continue the one before it
        self.moving = np.concatenate(moving)
        self.weight = np.concatenate([np.asarray(a.data.weight) for a in self.arrays])
        self._latest: OrderedDict[tuple, _Point] = OrderedDict()

    def evaluated(
        self, superset: CandidateModel, theta: Float[np.ndarray, " p"], wanted: frozenset[int]
    ) -> _Rows:
        """Return residual and derivatives, from a recent call if one had the same columns."""
        key = (id(superset), theta.tobytes())
        point = self._latest.setdefault(key, _Point(superset, {}))
        self._latest.move_to_end(key)
        if len(self._latest) > _POINTS:
            self._latest.popitem(last=False)
        found = next((known for asked, known in point.known.items() if wanted <= asked), None)
        if found is None:
            found = point.known[wanted] = _rows(superset, self.arrays, theta, sorted(wanted))
        return found


class _Rows(NamedTuple):
    """Residual of the superset along logs, one after the other, and its derivatives.

    Args:
        residual: The residual, (kept, n).
        jacobian: Its derivatives by all unknowns of the superset, (kept, n, p).
        scales: Derivatives of the logarithm of the drives' ratio, of each log, (n, p).
        lengths: Number of rows of each log.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    scales: list[np.ndarray]
    lengths: list[int]


class _Point(NamedTuple):
    """Evaluations at one point of a superset, by the unknowns of their columns.

    The superset is kept, so that no other one gets its identity.
    """

    superset: CandidateModel
    known: dict[frozenset[int], _Rows]


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
    found = samples.evaluated(superset, theta, frozenset(asked))
    return found.residual, found.jacobian


def evaluate_on(
    superset: CandidateModel,
    logs: Sequence[Viewed],
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | np.ndarray | None = None,
) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
    """Compute residual and Jacobian, as `evaluate` does, on several logs or pieces, one after the other."""
    found = _rows(superset, logs, theta, wanted)
    return found.residual, found.jacobian


def _rows(
    superset: CandidateModel,
    logs: Sequence[Viewed],
    theta: Float[np.ndarray, " p"],
    wanted: Sequence[int] | np.ndarray | None,
) -> _Rows:
    """Compute residual and derivatives on several logs or pieces; arguments are those of `evaluate_on`."""
    colours = np.asarray(superset.colours, int)
    views = [log.view for log in logs]
    if wanted is not None:
        wanted = [k for view in views for k in (wanted if view is None else view.wanted(wanted))]
    ask = np.unique(colours if wanted is None else colours[np.asarray(wanted, int)])
    jobs = [_Evaluation.of(superset, log, log.theta(theta), ask) for log in logs]
    results = iter(in_threads(_directional_derivatives, [call for job in jobs for call in job.calls]))

    residuals, jacobians, scales = [], [], []
    for job, log in zip(jobs, logs, strict=True):
        e, jacobian, slopes = job.joined([next(results) for _ in job.calls])
        residuals.append(e if log.view is None else e * log.view.scale)
        jacobians.append(jacobian if log.view is None else log.view.jacobian(jacobian))
        scales.append(slopes)
    lengths = [len(e) for e in residuals]
    return _Rows(np.concatenate(residuals), np.concatenate(jacobians), scales, lengths)


@dataclass(frozen=True)
class _Evaluation:
    """Calls of compiled code that evaluate a superset along one log.

    Args:
        superset: Machine with all candidates.
        bare: The plant without effects along the log; None: not known beside them.
        parts: Colours of the columns of each call.
        calls: Arguments of each call.
        kept: Whether the columns of the plant's own unknowns are those of `bare`.
    """

    superset: CandidateModel
    bare: _Bare | None
    parts: list[np.ndarray]
    calls: list[tuple]
    kept: bool

    @classmethod
    def of(cls, superset: CandidateModel, log: Viewed, theta: np.ndarray, ask: np.ndarray) -> _Evaluation:
        """Prepare the evaluation of some colours, at the unknowns as they hold in the log."""
        bare, directions = log.bare(superset, theta), seeds(superset.colours)
        own = np.unique(np.asarray(superset.colours, int)[superset.own])
        in_plant = np.isin(ask, own) if bare is not None else np.zeros(len(ask), bool)
        kept = bare is not None and bare.columns is not None
        # No effect is in the plant alone, and no unknown of the plant is in the effects.
        beside = _blocks(ask[~in_plant]) or ([] if in_plant.any() and not kept else [ask[:0]])
        within = [] if kept else _blocks(ask[in_plant])
        known = None if bare is None else bare.along
        machine = log.superset(superset).machine
        calls = [(machine, log.data, theta, directions, part, known) for part in beside]
        calls += [(machine, log.data, theta, directions, part, None) for part in within]
        return cls(superset, bare, [*beside, *within], calls, kept)

    def joined(self, results: Sequence[Linearised]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return residual, Jacobian and slopes of the drives' ratio by all unknowns, from the calls."""
        first, superset = results[0], self.superset
        by_colour = np.zeros((*first.residual.shape, max(superset.colours, default=-1) + 1))
        slopes = np.zeros((len(first.ratio), by_colour.shape[-1]))
        for part, found in zip(self.parts, results, strict=True):
            by_colour[..., part], slopes[:, part] = found.columns, found.slopes
        # From colours to unknowns: an unknown has the column of its colour, in the balances that it enters.
        colours = np.asarray(superset.colours, int)
        jacobian, slopes = by_colour[..., colours], slopes[:, colours]
        if by_colour.shape[-1] < len(colours):
            jacobian, slopes = jacobian * superset.enters, slopes * superset.enters
        if self.kept:
            assert self.bare is not None, "only a known plant has kept columns"
            assert self.bare.columns is not None, "they are kept"
            jacobian[..., superset.own] = self.bare.columns / first.ratio[:, None]
        return np.asarray(first.residual), jacobian, slopes


def _blocks(colours: np.ndarray) -> list[np.ndarray]:
    """Cut colours into blocks: with a fixed number of columns one compiled function serves all of them."""
    return [colours[k : k + _COLUMNS] for k in range(0, len(colours), _COLUMNS)]


def _directional_derivatives(
    machine: Machine,
    log: ForceData,
    theta: np.ndarray,
    directions: np.ndarray,
    part: np.ndarray,
    bare: BarePlant | None,
) -> Linearised:
    """Compute the residual and its derivatives in some directions, padded to a fixed number of them."""
    padded = np.zeros((len(theta), _COLUMNS))
    padded[:, : len(part)] = directions[:, part]
    places = machine.parameters.places
    found = force_linearised(machine.plant, places, log, jnp.asarray(theta), padded, bare)
    e, columns, ratio, slopes = (np.asarray(a) for a in found)
    return Linearised(e, columns[..., : len(part)], ratio, slopes[:, : len(part)])


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
