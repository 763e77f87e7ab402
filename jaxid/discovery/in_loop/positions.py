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

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.acceptance import Acceptance
from jaxid.discovery.domain import Domain
from jaxid.discovery.final import machine_with
from jaxid.discovery.in_loop.afar import Afar
from jaxid.discovery.in_loop.model_fit import STEPS, ModelFit, SimulatedLog
from jaxid.discovery.score import Score
from jaxid.discovery.screen import SURROGATES, Screen
from jaxid.discovery.search import Model, Search, Step
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.lanes import in_threads
from jaxid.session import OpenedLog
from jaxid.simulation.noisy_loop import ReadingNoise, drawn_readings, estimated_noise, mean_readings
from jaxid.simulation.replay import Numerics, Replay, make_replay
from jaxid.simulation.step_size import fastest_rate

# Least steps of integration a tick with effects that put inertia behind a spring, and the largest product of
# a step and the spring's frequency [rad] that is followed.
_SPRUNG, _TURN = 4, 0.25
# Number of times that noise and starts are estimated, and the unknowns refitted.
_RENEWALS = 2
# Delays beside that of a fit from which it is tried again, in rows of the log.
_DELAYS = (-1.0, -0.5, -0.25, 0.25, 0.5, 1.0)
# RMS of a shift of the mean readings, in standard deviations of a reading, from which a loop is unstable.
_SHAKEN = 3.0
# Squared residual, relative to the noise's, beyond which candidates are fitted from afar too.
_FAR = 1.5
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
        moving: Mask of the samples that count: all of joints with an encoder.
        weight: The same as numbers.
        noise: The noise of the encoder; None before it is estimated.
    """

    log: Log
    machine: Machine
    view: cand.View | None
    quiet: tuple[Replay, Replay]
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
        own = run.machine(mine.machine)
        quiet = make_replay(own, log, numerics), make_replay(own, log, finer)
        return cls(log, run.machine(machine), view, quiet, moving, moving.astype(float))

    def with_noise(self, noise: ReadingNoise | None) -> LoopSamples:
        """Return the samples whose loops are shifted to the mean readings with a noise of the encoder."""
        return self if noise is None else replace(self, noise=noise)

    def simulated(self, superset: cand.CandidateModel, acting: Sequence[cand.Candidate]) -> SimulatedLog:
        """Return the loop of a model along this log, shifted to its mean readings if its noise is known.

        Args:
            superset: The machine with all candidates.
            acting: Effects of the model.
        """
        machine, replay = self._alone(superset, acting, superset.neutral)
        names = superset.machine.parameters.names
        base = [names.index(name) for name in self.machine.parameters.names]
        scale = 1.0 if self.view is None else self.view.scale
        return SimulatedLog(
            replay=replay if self.noise is None else self.noise.on(replay),
            plant=machine.plant,
            places=machine.parameters.places,
            index=np.concatenate([base, *[c.index for c in acting]]).astype(int),
            view=self.view,
            measured=self.measured,
            weight=self.weight * scale,
        )

    def renewed(
        self,
        superset: cand.CandidateModel,
        added: Sequence[cand.Candidate],
        theta: np.ndarray,
        *,
        by_mean: bool = False,
    ) -> LoopSamples:
        """Return the samples with the noise of the encoder as it is beside a model.

        The loop of an incomplete model may be unstable, so that noise moves it far. Its mean readings say
        nothing of other models, whose loops then have none.

        Args:
            superset: The machine with all candidates.
            added: Effects of the model.
            theta: All unknowns of the superset.
            by_mean: Whether these are of a fit of mean readings: then noise stays that brings them nearer.
        """
        machine, replay = self._alone(superset, added, theta)
        noise = estimated_noise(machine, self.log, replay, follows=False)
        if noise is None:
            return self
        astray = _shaken(noise) and not (by_mean and _nearer(noise, machine, self.log, replay))
        return replace(self, noise=None if astray else noise)

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
        weighted = (replace(p, weight=m.astype(float)) for p, m in zip(parts, moving, strict=True))
        joined = np.concatenate(moving)
        return cls(tuple(weighted), joined, joined.astype(float))

    def with_parts(self, parts: Sequence[LoopSamples]) -> JoinedLoops:
        """Return the same logs with other simulations."""
        return replace(self, parts=tuple(parts))


Loops = LoopSamples | JoinedLoops


@dataclass(frozen=True)
class PositionDomain:
    """Measured positions against those of the simulated loop.

    Args:
        superset: Machine with all candidates.
        step: Step of integration with springs [s].
    """

    superset: cand.CandidateModel
    step: float

    @classmethod
    def of(cls, superset: cand.CandidateModel, period: float, numerics: Numerics) -> PositionDomain:
        """Return the domain of a superset, for a loop with a period [s] and these settings."""
        return cls(superset, period / max(_SPRUNG, numerics.substeps))

    def noisier(self, samples: Loops, theta: np.ndarray) -> np.ndarray:
        """Refuse: the loop's reference has no noise, so that no search asks for this."""
        raise NotImplementedError

    def evaluate(
        self, samples: Loops, theta: np.ndarray, wanted: Sequence[int] | np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual, (time, n), and its derivatives, (time, n, p); columns not wanted are zero.

        Those of several logs follow each other, on the scale of their views.
        """
        ask = np.arange(len(theta)) if wanted is None else np.unique(np.asarray(wanted, int))
        model = self.model(samples, self.acting(theta, ask))
        (e,), (columns,) = model.linearised(theta[None], ask)
        jacobian = np.zeros((len(e), len(theta)))
        jacobian[:, ask] = columns
        joints = samples.moving.shape[1]
        return e.reshape(-1, joints), jacobian.reshape(-1, joints, len(theta))

    def acting(self, theta: np.ndarray, ask: np.ndarray) -> tuple[cand.Candidate, ...]:
        """Return the effects that are not neutral at some values, or whose unknowns are asked for."""
        acts = theta != self.superset.neutral
        acts[ask] = True
        return tuple(c for c in self.superset.candidates if acts[c.index].any())

    def model(self, samples: Loops, acting: Sequence[cand.Candidate]) -> ModelFit:
        """Return a model with its effects only, to be fitted to logs."""
        return ModelFit(self.superset, tuple(part.simulated(self.superset, acting) for part in samples.parts))

    def points(
        self, rest: list[cand.Candidate], samples: Loops, theta: np.ndarray, residual: np.ndarray
    ) -> list[cand.Point]:
        """Linearise candidates at each of their starts, beside a model."""
        found = in_threads(self._points_of, [(c, samples, theta, residual) for c in rest]) if rest else []
        points = [point for some in found for point in some]
        return [p for p in points if np.all(np.isfinite(p.columns)) and np.all(np.isfinite(p.offset))]

    def _points_of(
        self, c: cand.Candidate, samples: Loops, theta: np.ndarray, residual: np.ndarray
    ) -> list[cand.Point]:
        """Linearise a candidate at each of its starts."""
        starts = [k for k in range(len(c.starts)) if not self._spring(c) or self._followed(c, k, samples)]
        if not starts:
            return []
        at = np.tile(theta, (len(starts), 1))
        at[:, c.index] = [c.probe(k) for k in starts]
        joints, out = samples.moving.shape[1], []
        model = self.model(samples, self.acting(theta, c.index))
        for k, e, columns in zip(starts, *model.linearised(at, c.index), strict=True):
            # Faint forces leave the motion as it is.
            shift = np.zeros_like(residual) if c.amplitude.any() else e.reshape(-1, joints) - residual
            out.append(cand.Point(c, k, shift, columns.reshape(-1, joints, len(c.index))))
        return out

    def _spring(self, c: cand.Candidate) -> bool:
        return cand.effect_of(self.superset, c).adds_spring

    def _followed(self, c: cand.Candidate, start: int, samples: Loops) -> bool:
        """Check that the steps follow the frequency of a spring at one of its starts."""
        effect = cand.effect_at(self.superset, c, c.starts[start])
        alone = replace(self.superset.machine.plant, effects=(effect,))
        still = np.zeros((1, len(self.superset.machine.gain)))
        return float(fastest_rate(alone, samples.parts[0].measured[:1], still)) * self.step < _TURN


def _shaken(noise: ReadingNoise) -> bool:
    """Check that noise of an encoder moves the mean readings of a loop by far more than its size."""
    if noise.shift is None:
        return False
    size = np.hypot(noise.std, noise.count / np.sqrt(12))
    return bool(np.any(np.sqrt(np.mean(np.square(noise.shift), axis=0)) > _SHAKEN * size))


def _nearer(noise: ReadingNoise, machine: Machine, log: Log, replay: Replay) -> bool:
    """Check that mean readings are nearer to a log than the positions of the loop without noise."""
    replay = replay.following(machine.parameters.places, machine.parameters.guess)
    left = [
        np.sum(np.square((log.filled - np.asarray(mean_readings(run, machine.plant)))[:, list(log.measured)]))
        for run in (noise.on(replay), replay)
    ]
    return bool(left[0] < left[1])


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
            np.sum(part.moving * np.square(NUMERICS * _scaled(part, np.std(part.measured, axis=0))), axis=0)
            for part in self.samples.parts
        )
        self._numerics_of_joints = self._numerics
        self._noise = self.samples.moving.sum(axis=0) * np.square(self.floor)

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
        afar: Starts far from where an incomplete model ends; None: there are none.
        by_mean_readings: Function of a model that returns all unknowns of the superset as a fit of its mean
            readings gives them; None if there is no such fit.
        to_spring: Whether the search ends with the first effect that adds a spring.
    """

    positions: PositionDomain | None = None
    logs: tuple[Loops, ...] = ()
    coarse: Callable[[Model], list[np.ndarray]] = lambda model: []
    afar: Afar | None = None
    by_mean_readings: Callable[[Model], np.ndarray | None] = lambda model: None
    to_spring: bool = False
    _fits: dict[frozenset[int], np.ndarray] = field(default_factory=dict)
    _searched: set[frozenset[int]] = field(default_factory=set)
    _drawn: dict[tuple[bytes, int], np.ndarray | None] = field(default_factory=dict)

    def _acceptance(self) -> Acceptance:
        shared = (self.superset, self.data, self.validation, self.floor, self.colour)
        return LoopAcceptance(*shared, guess=self.guess, positions=self.positions, logs=self.logs)

    def fit(self, theta: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Fit the active unknowns to the log, from and beside the others, and from earlier fits of them."""
        return self.fit_from([theta], active)

    def fit_from(
        self, starts: Sequence[np.ndarray] | np.ndarray, active: np.ndarray, steps: int = STEPS
    ) -> np.ndarray:
        """Fit the active unknowns from each of several starts and earlier fits, and return the best fit."""
        assert self.positions is not None, "given by the search"
        if not len(active):
            return min(starts, key=self.acceptance.squares)
        key = frozenset(active.tolist())
        earlier = [self._fits[key]] if key in self._fits else []
        acting = self.positions.acting(starts[0], active)
        ends, squares = self.positions.model(self.samples, acting).fit(
            np.array([*starts, *earlier]), active, steps=steps
        )
        best = ends[int(np.argmin(squares))]
        self._fits[key] = best
        return best

    def widened(self, model: Model, screened: Screen) -> Screen:
        """Return a screen with what candidates gain at fits from afar, if a model leaves more than noise."""
        assert self.positions is not None, "given by the search"
        if self.afar is None or self.acceptance.squares(model.theta) < _FAR * self._noise_of(model):
            return screened
        rest = self.rest(model)
        if not rest:
            return screened
        self.progress(f"fitting {len(rest)} effects from afar")
        begun = in_threads(self._begun, [(model, c) for c in rest])
        # A candidate that is not ahead by then is fitted from its best start only.
        order = np.argsort([squares[0] for _, squares in begun], kind="stable")
        ahead = self.afar.effort.ahead
        calls = [
            (model, rest[i], begun[i][0][: None if k < ahead else 1], screened) for k, i in enumerate(order)
        ]

        scores = {id(s.candidate): s for s in screened.scores}
        for score in in_threads(self._scored, calls):
            known = scores.get(id(score.candidate))
            if known is None or score.evidence > known.evidence:
                scores[id(score.candidate)] = score if known is None else replace(score, start=known.start)
        return replace(screened, scores=sorted(scores.values(), key=lambda s: -s.evidence))

    def _begun(self, model: Model, c: cand.Candidate) -> tuple[np.ndarray, np.ndarray]:
        """Return the best first fits of a model with a candidate, and their squares; see `Afar.begun`."""
        assert self.positions is not None, "given by the search"
        assert self.afar is not None, "asked only of a search that has it"
        added = (*model.added, c)
        active = self.fitted_by(added)
        fit, key = self.positions.model(self.samples, added), frozenset(active.tolist())
        if key in self._searched:
            known = self._fits[key][None]
            return known, fit.squares(known)
        self._searched.add(key)
        return self.afar.begun(fit, added, model.theta, active)

    def _scored(self, model: Model, c: cand.Candidate, starts: np.ndarray, screened: Screen) -> Score:
        """Fit a model with a candidate from some starts, and score what the best fit gains."""
        assert self.afar is not None, "asked only of a search that has it"
        active = self.fitted_by((*model.added, c))
        theta = self.fit_from(starts, active, self.afar.effort.steps)
        e, jacobian = self.domain.evaluate(self.samples, theta, active)
        gained = -np.inf
        if np.all(np.isfinite(e)) and np.all(np.isfinite(jacobian)):
            after = screened.held_out(e, jacobian[..., active])
            gained = float(ev.log_evidence(screened.rows, screened.before, after)[0])
        return Score(c, 0, theta[c.index], gained)

    def _noise_of(self, model: Model) -> float:
        """Return the sum of squares that noise leaves: of the readings, and of the loop that answers them."""
        drawn = self.drawn_noise(model, SURROGATES)
        if drawn is None:
            return self.acceptance.noise
        counts = self.samples.moving
        answered = float(np.sum(np.where(counts, np.mean(np.square(drawn), axis=0), 0.0)))
        return max(self.acceptance.noise, answered)

    def rest(self, model: Model | None = None) -> list[cand.Candidate]:
        """Return the candidates that a model may still get: a joint has one added spring at most."""
        known = (self.model if model is None else model).added
        sprung = {c.port for c in known if cand.effect_of(self.superset, c).adds_spring}
        return [
            c
            for c in super().rest(model)
            if not (c.port in sprung and cand.effect_of(self.superset, c).adds_spring)
        ]

    def ends_with(self, best: Sequence[Score]) -> bool:
        """Check for an effect that adds a spring, in a search up to there."""
        return self._adds_spring([s.candidate for s in best])

    @property
    def ended_early(self) -> bool:
        """True if the search ended with a spring, so that what else is missing is not known."""
        return self._adds_spring(self.model.added)

    def _adds_spring(self, added: Sequence[cand.Candidate]) -> bool:
        return self.to_spring and any(cand.effect_of(self.superset, c).adds_spring for c in added)

    def finer(self, model: Model) -> bool:
        """Return False: each start is a simulation here."""
        return False

    def alternatives(self, steps: list[Step]) -> dict[int, tuple[Score, ...]]:
        """Find the effects that could replace those that were added, and one that explains two of them.

        A limit by the supply's voltage looks like a saturation beside a drag, which are added one by one.
        """
        out = super().alternatives(steps)
        if not self._joined(out, steps):
            return out
        return super().alternatives(steps)

    def _joined(self, rivals: dict[int, tuple[Score, ...]], steps: list[Step]) -> bool:
        """Take a rival of an effect beside which another one is superfluous; return whether there is one.

        Args:
            rivals: Equivalent effects by index of the added effect.
            steps: Steps of the search; those of the exchange are appended.
        """
        for k, scores in rivals.items():
            named = self.model.added[k]
            for score in scores if len(self.model.added) > 1 else ():
                self.progress(f"fitting {score.candidate.label} in place of {named.label}")
                added = tuple(score.candidate if c is named else c for c in self.model.added)
                model = Model(added, self.fit(score.refitted, self.fitted_by(added)))
                others = [c for c in added if c is not score.candidate]
                fewer, dropped = self.drop_superfluous(model, self.limit, others)
                if dropped:
                    steps.append(self.step(model, added=score, dropped=named, threshold=self.limit))
                    steps.extend(dropped)
                    self.model = fewer
                    return True
        return False

    def renewed(self, model: Model) -> Model:
        """Return a model refitted from many starts, with the noise of the encoder as it is beside it."""
        index = self.fitted_by(model.added)
        starts = [model.theta]
        for values in self.coarse(model) if model.added else []:
            theta = model.theta.copy()
            theta[index] = values
            starts.append(theta)
        if len(starts) > 1:
            model = replace(model, theta=self.fit_from(starts, index))
        for _ in range(_RENEWALS):
            self._renew_noise(model)
            if model.added and any(part.noise is None for part in self.samples.parts):
                # The noise moves this loop far: a fit without it has other values, and no mean readings.
                theta = self.by_mean_readings(model)
                if theta is not None:
                    model = replace(model, theta=theta)
                    self._renew_noise(model, by_mean=True)
            model = replace(model, theta=self.fit(model.theta, index))
            if model.added:
                model = replace(model, theta=self._at_other_delays(model.theta, index))
        return model

    def _renew_noise(self, model: Model, *, by_mean: bool = False) -> None:
        """Estimate the noise of the encoder in the loops of all logs anew, beside a model."""
        renewed: list[Loops] = []
        for samples in self.logs:
            parts = [
                part.renewed(self.superset, model.added, model.theta, by_mean=by_mean)
                for part in samples.parts
            ]
            renewed.append(samples.with_parts(parts) if isinstance(samples, JoinedLoops) else parts[0])
        self.logs, self._drawn = tuple(renewed), {}
        self.samples, *others = self.logs
        self.acceptance.samples, self.acceptance.others = self.samples, others

    def _at_other_delays(self, theta: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Return the best fit from other delays about that of a fit.

        A command that is held from row to row, or has quantised readings beside it, leaves the cost several
        minima along the delay, about a row apart.
        """
        assert self.positions is not None, "given by the search"
        free = self.superset.machine.parameters.free
        row = float(self.samples.parts[0].log.period)
        model = self.positions.model(self.samples, self.positions.acting(theta, index))
        starts = [theta]
        for k in (k for k in index if free[k].path[-1] == "delay"):
            moved = [theta[k] + step * row for step in _DELAYS if theta[k] + step * row > 0]
            at = np.tile(theta, (len(moved), 1))
            at[:, k] = moved
            # The others first: together with them it would return to where it came from.
            starts += list(model.fit(at, index[index != k])[0]) if len(moved) else []
        return self.fit_from(starts, index)

    def drawn_noise(self, model: Model, runs: int) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals of the fitted logs by the noise in their loops; None if it is not known of one."""
        key = model.theta.tobytes(), runs
        if key not in self._drawn:
            drawn = [
                part.drawn_noise(self.superset, model.added, model.theta, runs) for part in self.samples.parts
            ]
            known = [one for one in drawn if one is not None]
            whole = np.concatenate(known, axis=1) if len(known) == len(drawn) else None
            # Of the latest model only.
            self._drawn = {key: whole}
        return self._drawn[key]
