"""The positions of a simulated loop as the domain of a search, for logs without a force.

The residual is measured minus simulated position, and its derivatives are sensitivities of the simulated loop
at the fitted parameters. A candidate at no strength that cannot move the simulated position explains nothing;
what the fitted parameters could do in its place is projected off by the search, as in the domain of forces.
"""

from __future__ import annotations

from collections.abc import Sequence
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
# Part of the motion that integration leaves wrong in any model.
NUMERICS = 1e-5


@dataclass(frozen=True)
class LoopSamples:
    """A log whose loop is simulated; see `jaxid.discovery.domain.Samples`.

    Args:
        log: The log.
        quiet: The simulation without noise: without effects that add a spring, and with them.
        calm, sprung: The same, shifted to the mean readings of a loop with noise, if that is known.
        moving: Mask of the samples that count: all of joints with an encoder.
        weight: The same as numbers.
        noise: The noise of the encoder; None before it is estimated.
    """

    log: Log
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

    @classmethod
    def of(cls, machine: Machine, log: Log, numerics: Numerics) -> LoopSamples:
        """Return the samples of a log that a machine follows.

        Args:
            machine: The machine with the disturbance of the log, without candidates.
            log: The log.
            numerics: Settings of the integration without an added spring.
        """
        moving = np.tile(np.array(log.measured), (log.samples, 1))
        finer = replace(numerics, substeps=max(_SPRUNG, numerics.substeps))
        calm, sprung = (make_replay(machine, log, n) for n in (numerics, finer))
        return cls(log, (calm, sprung), calm, sprung, moving, moving.astype(float))

    def with_noise(self, noise: ReadingNoise | None) -> LoopSamples:
        """Return the samples whose loops are shifted to the mean readings with a noise of the encoder."""
        if noise is None:
            return self
        calm, sprung = (noise.on(replay) for replay in self.quiet)
        return replace(self, calm=calm, sprung=sprung, noise=noise)


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

    def noisier(self, samples: LoopSamples, theta: np.ndarray) -> np.ndarray:
        """Refuse: the loop's reference has no noise, so that no search asks for this."""
        raise NotImplementedError

    def evaluate(
        self, samples: LoopSamples, theta: np.ndarray, wanted: Sequence[int] | np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual, (time, n), and its derivatives, (time, n, p); columns not wanted are zero."""
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
        machine = self.superset.machine
        places, plant = machine.parameters.places, machine.plant
        if not self.springs:
            return samples.calm, plant, places
        of_springs = np.concatenate([c.index for c in self.superset.candidates[-self.springs :]])
        neutral = self.superset.neutral
        if np.isin(of_springs, ask).any() or np.any(theta[of_springs] != neutral[of_springs]):
            return samples.sprung, plant, places
        calm = replace(plant, effects=plant.effects[: -self.springs])
        return samples.calm, calm, places[: of_springs[0]]

    def points(
        self, rest: list[cand.Candidate], samples: LoopSamples, theta: np.ndarray, residual: np.ndarray
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

    def _followed(self, c: cand.Candidate, start: int, samples: LoopSamples) -> bool:
        """Check that the steps follow the frequency of a spring at one of its starts."""
        effect = cand.effect_at(self.superset, c, c.starts[start])
        alone = replace(self.superset.machine.plant, effects=(effect,))
        still = np.zeros((1, len(self.superset.machine.gain)))
        return float(fastest_rate(alone, samples.measured[:1], still)) * self.step < _TURN


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
        logs: Samples of the fitted log, then of the validation logs.
    """

    positions: PositionDomain | None = None
    logs: tuple[LoopSamples, ...] = ()

    # The noise of an encoder is known better than that of a force.
    least_gap: ClassVar[float] = 0.05

    def __post_init__(self) -> None:
        assert self.positions is not None, "given by the search"
        self.domain: Domain = self.positions
        self.samples, *self.others = self.logs
        moving = self.samples.moving
        spread = np.std(self.samples.measured, axis=0)
        self._numerics = float(np.sum(moving * np.square(NUMERICS * spread)))
        self._noise = float(np.sum(moving.sum(axis=0) * np.square(self.floor)))

    @property
    def _independent(self) -> float:
        return 1.0

    def at_floor(self, theta: np.ndarray) -> bool:
        """Return False: an effect may show by its colour below the scatter of the noise's size."""
        return False


@dataclass
class LoopSearch(Search):
    """A search whose models are compared with positions.

    Args:
        positions, logs: Those of `LoopAcceptance`.
        machine: The fitted machine, without candidates. The noise in its loop takes hundreds of runs, which
            the superset would make slow.
    """

    positions: PositionDomain | None = None
    logs: tuple[LoopSamples, ...] = ()
    machine: Machine | None = None

    def _acceptance(self) -> Acceptance:
        shared = (self.superset, self.data, self.validation, self.floor, self.colour)
        return LoopAcceptance(*shared, positions=self.positions, logs=self.logs)

    def renewed(self, model: Model) -> Model:
        """Return a model refitted with the noise of the encoder and the starts as they are beside it."""
        for _ in range(_RENEWALS):
            at = [(samples, *self._alone(samples, model)) for samples in self.logs]
            noises = [estimated_noise(m, samples.log, replay, follows=False) for samples, m, replay in at]
            self.logs = tuple(s.with_noise(noise) for s, noise in zip(self.logs, noises, strict=True))
            self.samples, *others = self.logs
            self.acceptance.samples, self.acceptance.others = self.samples, others
            model = replace(model, theta=self.fit(model.theta, self.fitted_by(model.added)))
        return model

    def drawn_noise(self, model: Model, runs: int) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals of the fitted log by the noise in its loop."""
        noise = self.samples.noise
        if noise is None:
            return None
        machine, replay = self._alone(self.samples, model)
        replay = replay.following(machine.parameters.places, machine.parameters.guess)
        return drawn_readings(noise, replay, machine.plant, runs)

    def _alone(self, samples: LoopSamples, model: Model) -> tuple[Machine, Replay]:
        """Return the machine of a model without the other candidates, and its loop without noise."""
        assert self.machine is not None, "given by the search"
        machine, _ = machine_with(self.machine, self.superset, model.added, model.theta)
        springs = any(cand.effect_of(self.superset, c).adds_spring for c in model.added)
        return machine, samples.quiet[springs]
