"""The positions of a simulated loop as the domain of a search, for logs without a force.

The residual is measured minus simulated position, and its derivatives are sensitivities of the simulated loop
at the fitted parameters. A candidate at no strength that cannot move the simulated position explains nothing;
what the fitted parameters could do in its place is projected off by the search, as in the domain of forces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.discovery import candidates as cand
from jaxid.discovery.acceptance import Acceptance
from jaxid.discovery.domain import Domain
from jaxid.discovery.final import machine_with
from jaxid.discovery.in_loop.candidates import loop_columns
from jaxid.discovery.search import Model, Search
from jaxid.estimators.simulated_output import output_residual
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import in_threads
from jaxid.session import OpenedLog
from jaxid.simulation.noisy_loop import ReadingNoise, drawn_readings, estimated_noise
from jaxid.simulation.replay import Numerics, Replay, make_replay
from jaxid.simulation.step_size import fastest_rate

# Number of directions in which the loop is differentiated at once.
_COLUMNS = 4
# Least steps of integration a tick with effects that put inertia behind a spring, and the largest product of
# a step and the spring's frequency [rad] that is followed.
_SPRUNG, _TURN = 4, 0.25
# Number of times that noise and starts are estimated, and the unknowns refitted.
_RENEWALS = 2
# Delays beside that of a fit from which it is tried again, in rows of the log.
_DELAYS = (-1.0, -0.5, -0.25, 0.25, 0.5, 1.0)
# Part of the motion that integration leaves wrong in any model.
NUMERICS = 1e-5


@dataclass(frozen=True)
class LoopSamples:
    """A log whose loop is simulated; see `jaxid.discovery.domain.Samples`.

    Args:
        log: The log.
        machine: The machine of this log at fitted values, without candidates. The noise in its loop takes
            hundreds of runs, which the superset would make slow.
        view: The unknowns of the superset as this log has them; None: it is the only one.
        quiet: The simulation without noise: without effects that add a spring, and with them.
        calm, sprung: The same, shifted to the mean readings of a loop with noise, if that is known.
        moving: Mask of the samples that count: all of joints with an encoder.
        weight: The same as numbers.
        noise: The noise of the encoder; None before it is estimated.
    """

    log: Log
    machine: Machine
    view: cand.View | None
    quiet: tuple[Replay, Replay]
    calm: Replay
    sprung: Replay
    moving: Bool[np.ndarray, "time n"]
    weight: Float[np.ndarray, "time n"]
    noise: ReadingNoise | None = None
    noisier: list[Any] = field(default_factory=list)

    @property
    def measured(self) -> Float[np.ndarray, "time n"]:
        """Measured position, (time, n)."""
        return self.log.filled

    @property
    def parts(self) -> tuple[LoopSamples, ...]:
        """The logs: this one."""
        return (self,)

    @classmethod
    def of(
        cls,
        run: OpenedLog,
        machine: Machine,
        superset: cand.CandidateModel,
        numerics: Numerics,
        view: cand.View | None = None,
    ) -> LoopSamples:
        """Return the samples of a log whose loop is simulated.

        Args:
            run: The log.
            machine: The machine of the case at fitted values, without candidates.
            superset: The machine with all candidates.
            numerics: Settings of the integration without an added spring.
            view: The unknowns of the superset as this log has them; None: it is the only one.
        """
        log, mine = run.log, superset if view is None else view.superset(superset)
        moving = np.tile(np.array(log.measured), (log.samples, 1))
        finer = replace(numerics, substeps=max(_SPRUNG, numerics.substeps))
        calm, sprung = (make_replay(run.machine(mine.machine), log, n) for n in (numerics, finer))
        replays = ((calm, sprung), calm, sprung)
        return cls(log, run.machine(machine), view, *replays, moving, moving.astype(float))

    def with_noise(self, noise: ReadingNoise | None) -> LoopSamples:
        """Return the samples whose loops are shifted to the mean readings with a noise of the encoder."""
        if noise is None:
            return self
        calm, sprung = (noise.on(replay) for replay in self.quiet)
        return replace(self, calm=calm, sprung=sprung, noise=noise)

    def renewed(
        self, superset: cand.CandidateModel, added: Sequence[cand.Candidate], theta: np.ndarray
    ) -> LoopSamples:
        """Return the samples with the noise of the encoder as it is beside a model.

        Args:
            superset: The machine with all candidates.
            added: Effects of the model.
            theta: All unknowns of the superset.
        """
        machine, replay = self._alone(superset, added, theta)
        return self.with_noise(estimated_noise(machine, self.log, replay, follows=False))

    def drawn_noise(
        self, superset: cand.CandidateModel, added: Sequence[cand.Candidate], theta: np.ndarray, runs: int
    ) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals of a model by the noise in its loop; None if nothing is known of the noise.

        Args:
            superset, added, theta: As in `renewed`.
            runs: Number of draws.
        """
        if self.noise is None:
            return None
        machine, replay = self._alone(superset, added, theta)
        replay = replay.following(machine.parameters.places, machine.parameters.guess)
        scale = 1.0 if self.view is None else self.view.scale
        return drawn_readings(self.noise, replay, machine.plant, runs) * scale

    def _alone(
        self, superset: cand.CandidateModel, added: Sequence[cand.Candidate], theta: np.ndarray
    ) -> tuple[Machine, Replay]:
        """Return the machine with some effects only, and its loop without noise."""
        springs = any(cand.effect_of(superset, c).adds_spring for c in added)
        names, known = superset.machine.parameters.names, self.machine.parameters.names
        mine = replace(superset, base=np.array([names.index(name) for name in known], int))
        at = theta if self.view is None else self.view.theta(theta)
        return machine_with(self.machine, mine, added, at)[0], self.quiet[springs]


@dataclass(frozen=True)
class JoinedLoops:
    """Several logs whose loops are simulated, one behind the other; see `jaxid.discovery.domain.Samples`.

    Args:
        parts: The logs; each has a view.
        moving: Mask of the samples that count; the first of each further log does not, as it does not
            continue the one before it.
        weight: The same as numbers.
    """

    parts: tuple[LoopSamples, ...]
    moving: Bool[np.ndarray, "time n"]
    weight: Float[np.ndarray, "time n"]
    noisier: list[Any] = field(default_factory=list)

    @classmethod
    def of(cls, parts: Sequence[LoopSamples]) -> JoinedLoops:
        """Join logs."""
        moving = [part.moving.copy() for part in parts]
        for mask in moving[1:]:
            mask[0] = False
        joined = np.concatenate(moving)
        return cls(tuple(parts), joined, joined.astype(float))

    def with_parts(self, parts: Sequence[LoopSamples]) -> JoinedLoops:
        """Return the same logs with other simulations."""
        return replace(self, parts=tuple(parts))


Loops = LoopSamples | JoinedLoops


@dataclass(frozen=True)
class PositionDomain:
    """Measured positions against those of the simulated loop.

    Args:
        superset: Machine with all candidates, those that add a spring last.
        springs: Number of effects at the end of the plant that add a spring.
        step: Step of integration with springs [s].
    """

    superset: cand.CandidateModel
    springs: int
    step: float

    @classmethod
    def of(cls, superset: cand.CandidateModel, period: float, numerics: Numerics) -> PositionDomain:
        """Return the domain of a superset, for a loop with a period [s] and these settings."""
        springs = sum(cand.effect_of(superset, c).adds_spring for c in superset.candidates)
        return cls(superset, springs, period / max(_SPRUNG, numerics.substeps))

    def noisier(self, samples: Loops, theta: np.ndarray) -> np.ndarray:
        """Refuse: the loop's reference has no noise, so that no search asks for this."""
        raise NotImplementedError

    def evaluate(
        self, samples: Loops, theta: np.ndarray, wanted: Sequence[int] | np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual, (time, n), and its derivatives, (time, n, p); columns not wanted are zero.

        Those of several logs follow each other, on the scale of their views.
        """
        found = []
        for part in samples.parts:
            view = part.view
            if view is None:
                found.append(self._evaluate(part, theta, wanted))
                continue
            asked = None if wanted is None else view.wanted(wanted)
            e, jacobian = self._evaluate(part, view.theta(theta), asked)
            found.append((e * view.scale, view.jacobian(jacobian)))
        if len(found) == 1:
            return found[0]
        return np.concatenate([e for e, _ in found]), np.concatenate([j for _, j in found])

    def _evaluate(
        self, samples: LoopSamples, theta: np.ndarray, wanted: Sequence[int] | np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute residual and derivatives of one log, at unknowns as they hold in it."""
        ask = np.arange(len(theta)) if wanted is None else np.unique(np.asarray(wanted, int))
        replay, plant, places = self._simulated(samples, theta, ask)
        known = theta[: len(places)]
        problem = (replay, places, plant, samples.measured, samples.weight)
        jacobian = np.zeros((*samples.measured.shape, len(theta)))
        if not len(ask):
            return np.asarray(_only_residual(*problem, known)), jacobian

        calls = []
        for k in range(0, len(ask), _COLUMNS):
            part = ask[k : k + _COLUMNS]
            directions = np.zeros((len(places), _COLUMNS))
            directions[part, np.arange(len(part))] = 1.0
            calls.append((*problem, "position", known, directions))
        results = in_threads(loop_columns, calls)
        columns = np.concatenate([np.asarray(c) for _, c in results], axis=1)[:, : len(ask)]
        jacobian[..., ask] = columns.reshape(*samples.measured.shape, -1)
        return np.asarray(results[0][0]).reshape(samples.measured.shape), jacobian

    def _simulated(
        self, samples: LoopSamples, theta: np.ndarray, ask: np.ndarray
    ) -> tuple[Replay, Plant, tuple]:
        """Return the simulation with plant and unknowns, without springs if none of them acts."""
        superset = self.superset if samples.view is None else samples.view.superset(self.superset)
        places, plant = superset.machine.parameters.places, superset.machine.plant
        if not self.springs:
            return samples.calm, plant, places
        of_springs = np.concatenate([c.index for c in self.superset.candidates[-self.springs :]])
        neutral = self.superset.neutral
        if np.isin(of_springs, ask).any() or np.any(theta[of_springs] != neutral[of_springs]):
            return samples.sprung, plant, places
        calm = replace(plant, effects=plant.effects[: -self.springs])
        return samples.calm, calm, places[: of_springs[0]]

    def points(
        self, rest: list[cand.Candidate], samples: Loops, theta: np.ndarray, residual: np.ndarray
    ) -> list[cand.Point]:
        """Linearise candidates at each of their starts, beside a model."""
        out = []
        faint = [c for c in rest if c.amplitude.any() and not self._spring(c)]
        for k in range(max((len(c.starts) for c in faint), default=0)):
            # Faint forces leave the motion as it is, and share an evaluation.
            now = [c for c in faint if k < len(c.starts)]
            at = theta.copy()
            for c in now:
                at[c.index] = c.probe(k)
            _, jacobian = self.evaluate(samples, at, np.concatenate([c.index for c in now]))
            out += [cand.Point(c, k, np.zeros_like(residual), jacobian[..., c.index]) for c in now]
        for c in rest:
            if any(c is f for f in faint):
                continue
            for k in range(len(c.starts)):
                if self._spring(c) and not self._followed(c, k, samples):
                    continue
                at = theta.copy()
                at[c.index] = c.probe(k)
                e, jacobian = self.evaluate(samples, at, c.index)
                shift = np.zeros_like(e) if c.amplitude.any() else e - residual
                out.append(cand.Point(c, k, shift, jacobian[..., c.index]))
        return [p for p in out if np.all(np.isfinite(p.columns)) and np.all(np.isfinite(p.offset))]

    def _spring(self, c: cand.Candidate) -> bool:
        return cand.effect_of(self.superset, c).adds_spring

    def _followed(self, c: cand.Candidate, start: int, samples: Loops) -> bool:
        """Check that the steps follow the frequency of a spring at one of its starts."""
        effect = cand.effect_at(self.superset, c, c.starts[start])
        alone = replace(self.superset.machine.plant, effects=(effect,))
        still = np.zeros((1, len(self.superset.machine.gain)))
        return float(fastest_rate(alone, samples.parts[0].measured[:1], still)) * self.step < _TURN


@kept_jit
def _only_residual(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array
) -> Array:
    return output_residual(replay, places, plant, measured, weight)(theta)


@dataclass
class LoopAcceptance(Acceptance):
    """Tests of models by the positions of their simulated loops.

    Args:
        positions: The domain.
        logs: Samples of the fitted logs, then of each validation log.
    """

    positions: PositionDomain | None = None
    logs: tuple[Loops, ...] = ()

    # The noise of an encoder is known better than that of a force.
    least_gap: ClassVar[float] = 0.05

    def __post_init__(self) -> None:
        assert self.positions is not None, "given by the search"
        self.domain: Domain = self.positions
        self.samples, *self.others = self.logs
        self._numerics = sum(
            float(np.sum(part.moving * np.square(NUMERICS * _scaled(part, np.std(part.measured, axis=0)))))
            for part in self.samples.parts
        )
        self._noise = float(np.sum(self.samples.moving.sum(axis=0) * np.square(self.floor)))

    @property
    def _independent(self) -> float:
        return 1.0

    def at_floor(self, theta: np.ndarray) -> bool:
        """Return False: an effect may show by its colour below the scatter of the noise's size."""
        return False


def _scaled(part: LoopSamples, values: np.ndarray) -> np.ndarray:
    """Return values by joint on the scale of a log's view."""
    return values if part.view is None else values * part.view.scale


@dataclass
class LoopSearch(Search):
    """A search whose models are compared with positions.

    Args:
        positions, logs: Those of `LoopAcceptance`.
        coarse: Function of a model that returns values of its unknowns from which fits start, beside those
            of the model: an incomplete model fits best in another valley than a complete one.
    """

    positions: PositionDomain | None = None
    logs: tuple[Loops, ...] = ()
    coarse: Callable[[Model], list[np.ndarray]] = lambda model: []

    def _acceptance(self) -> Acceptance:
        shared = (self.superset, self.data, self.validation, self.floor, self.colour)
        return LoopAcceptance(*shared, positions=self.positions, logs=self.logs)

    def renewed(self, model: Model) -> Model:
        """Return a model refitted from many starts, with the noise of the encoder as it is beside it."""
        index = self.fitted_by(model.added)
        fits = [model.theta]
        for values in self.coarse(model) if model.added else []:
            theta = model.theta.copy()
            theta[index] = values
            fits.append(self.fit(theta, index))
        model = replace(model, theta=min(fits, key=self.acceptance.squares))
        for _ in range(_RENEWALS):
            renewed: list[Loops] = []
            for samples in self.logs:
                parts = [part.renewed(self.superset, model.added, model.theta) for part in samples.parts]
                renewed.append(samples.with_parts(parts) if isinstance(samples, JoinedLoops) else parts[0])
            self.logs = tuple(renewed)
            self.samples, *others = self.logs
            self.acceptance.samples, self.acceptance.others = self.samples, others
            theta = self.fit(model.theta, index)
            others = self._at_other_delays(theta, index) if model.added else []
            model = replace(model, theta=min([theta, *others], key=self.acceptance.squares))
        return model

    def _at_other_delays(self, theta: np.ndarray, index: np.ndarray) -> list[np.ndarray]:
        """Return fits from other delays about that of a fit.

        A command that is held from row to row, or has quantised readings beside it, leaves the cost several
        minima along the delay, about a row apart.
        """
        free = self.superset.machine.parameters.free
        row = float(self.samples.parts[0].log.period)
        out = []
        for k in (k for k in index if free[k].path[-1] == "delay"):
            for step in _DELAYS:
                if theta[k] + step * row > 0:
                    at = theta.copy()
                    at[k] += step * row
                    # The others first: together with them it would return to where it came from.
                    out.append(self.fit(self.fit(at, index[index != k]), index))
        return out

    def drawn_noise(self, model: Model, runs: int) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals of the fitted logs by the noise in their loops; None if it is not known of one."""
        drawn = [
            part.drawn_noise(self.superset, model.added, model.theta, runs) for part in self.samples.parts
        ]
        known = [one for one in drawn if one is not None]
        return np.concatenate(known, axis=1) if len(known) == len(drawn) else None
