"""Linear trials of candidate effects in the simulated loop: the gain that each would give."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.candidates import Candidate, CandidateModel
from jaxid.discovery.score import Score
from jaxid.discovery.superset import build_candidate_model
from jaxid.discovery.where import Where
from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.simulated_output import choose_numerics, output_residual
from jaxid.estimators.within_prior.evaluations import linearise
from jaxid.estimators.within_prior.posterior import maximum_a_posteriori
from jaxid.estimators.within_prior.problem import Problem
from jaxid.estimators.within_prior.quantisation import quantisation_samples
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.plant import Plant
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session
from jaxid.simulation.replay import Replay
from jaxid.simulation.step_size import with_numerical_damping

# Number of draws of noise; the best gain of the luckiest draw is the threshold.
_DRAWS = 1024
# Fits of a candidate begin at so many of its trials, the most promising, and at that of these parts of the
# step at which the simulation is closest. A trial is linear: strong friction that acts briefly promises most,
# and makes the machine stick; an effect that acts longer may lie in another minimum.
_TRIALS, _PARTS = 6, 0.5 ** np.arange(5)
# A drive effect moves at most this many times its size from a start, or by this power of e.
_LARGEST_STEP = 3.0
# Number of lags whose correlation decides if a residual is noise.
_LAGS = 10


@dataclass(frozen=True)
class LoopFit:
    """A fit within the prior.

    Args:
        machine: The fitted machine, at its guesses.
        widths: Standard deviations of unknowns that have a separate one, by name; see `within_prior_steps`.
        estimate: Result of the fit.
        problem: Residual, weights and prior of the fit.
        point: Optimum of the loop without rounding of readings, in units of the prior.
        minimum: Residual and Jacobian at that point.
    """

    machine: Machine
    widths: dict[str, float]
    estimate: Estimate
    problem: Problem
    point: Float[np.ndarray, " q"]
    minimum: Minimum

    @classmethod
    def of(cls, session: Session, machine: Machine, widths: dict[str, float], estimate: Estimate) -> LoopFit:
        """Refit the optimum of the loop without rounding, since the estimate is corrected for rounding."""
        settings, log = session.case.need_prior(), session.fit.log
        numerics = choose_numerics(machine, log, solver=settings.solver)
        problem = Problem.of(machine, log, settings.prior, settings.on, numerics, widths)
        point = problem.prior.inward(problem.padded(estimate.theta))

        here = run_alone(linearise(problem, problem.sharpnesses[-1], point))
        problem, here = problem.reweighted(here)
        noise = problem.noise(here, len(estimate.details["directions"]))
        point, here, _ = run_alone(maximum_a_posteriori(problem, noise, point))
        return cls(
            machine=machine, widths=widths, estimate=estimate, problem=problem, point=point, minimum=here
        )

    @property
    def noise(self) -> float:
        """Standard deviation of the weighted residual."""
        return self.problem.noise(self.minimum, len(self.estimate.details["directions"]))


@dataclass(frozen=True)
class LinearTrial:
    """A candidate at one start in the loop: its change of the residual, divided by the noise.

    Args:
        candidate: The candidate that is tried.
        start: Index of its start.
        offset: Change of the residual, (rows,); zero for an added force.
        columns: Derivatives in the directions in which it may move from there, (rows, k).
        positive: Whether the amplitude must be nonnegative.
    """

    candidate: Candidate
    start: int
    offset: Float[np.ndarray, " rows"]
    columns: Float[np.ndarray, "rows k"]
    positive: bool


@dataclass(frozen=True)
class StartPoint:
    """Point at which a fit with a candidate begins.

    Args:
        start: Index of the candidate's start.
        values: Values of the candidate's unknowns.
        point: Unknowns of the base model, in units of the prior.
        squares: Squared residual divided by the noise's variance, with the distance from the guesses.
    """

    start: int
    values: Float[np.ndarray, " k"]
    point: Float[np.ndarray, " q"]
    squares: float


@dataclass(frozen=True)
class Loop:
    """A fitted machine in its loop, with every effect that it might lack, each neutral at first.

    Args:
        session: Case and log.
        superset: Machine with the effects.
        problem: Problem of the fit.
        point: Optimum of the fit, in units of the prior.
        residual: Residual divided by the noise, the log's rows first, then the distance from the guesses.
        base: Derivatives of the residual in units of the prior, (rows, unknowns and starts).
        sigma: Standard deviation of the noise, in units of the weighted residual.
    """

    session: Session
    superset: CandidateModel
    problem: Problem
    point: Float[np.ndarray, " q"]
    residual: Float[np.ndarray, " rows"]
    base: Float[np.ndarray, "rows q"]
    sigma: float

    @classmethod
    def of(cls, session: Session, fit: LoopFit) -> Loop:
        """Build the loop at the result of a fit within a prior."""
        sigma, point, here = fit.noise, fit.point, fit.minimum
        # Scales of motion are taken from all samples: a short log may hardly leave its rest.
        data = replace(session.fit.data, moving=np.ones_like(session.fit.data.moving))
        searched = [e for e in session.case.searched if _follows(e)]
        superset = build_candidate_model(fit.estimate.machine, data, searched)
        residual = np.concatenate([np.asarray(here.residual).ravel() / sigma, point])
        base = np.concatenate([np.asarray(here.jacobian) / sigma, np.eye(point.size)])
        return cls(
            session=session,
            superset=superset,
            problem=fit.problem,
            point=point,
            residual=residual,
            base=base,
            sigma=sigma,
        )

    @property
    def samples(self) -> int:
        """Number of rows of the residual that belong to the log."""
        return self.residual.size - self.point.size

    @property
    def theta(self) -> np.ndarray:
        """All unknowns of the superset, with the effects neutral."""
        return self.superset.neutral

    @property
    def rms(self) -> np.ndarray:
        """RMS of the residual by column that counts, in the units of that column."""
        weight = self.problem.weight
        counts = weight[0] > 0
        e = self.sigma * self.residual[: self.samples].reshape(weight.shape)[:, counts] / weight[:, counts]
        return np.sqrt(np.mean(e**2, axis=0))

    def trials(self) -> list[LinearTrial]:
        """Linearise every candidate at each of its starts, except those that cannot be simulated."""
        out = []
        free = self.superset.machine.parameters.free
        for c in self.superset.candidates:
            drive = not c.amplitude.any()
            positive = all(free[i].sign != "free" for i in c.index[c.amplitude])
            for k in range(len(c.starts)):
                e, columns = self._at(c, c.starts[k] if drive else c.probe(k), self.point)
                if drive:
                    trial = LinearTrial(c, k, e - self.residual, columns * _size(c.starts[k]), False)
                else:
                    strength = columns @ np.where(c.amplitude, c.starts[k], 0.0)
                    trial = LinearTrial(c, k, np.zeros_like(e), strength[:, None], positive)
                if np.all(np.isfinite(trial.columns)) and np.all(np.isfinite(trial.offset)):
                    out.append(trial)
        return out

    def start_points(self, c: Candidate, trials: list[LinearTrial]) -> list[StartPoint]:
        """Simulate the steps of a candidate's trials; return the points that lower the residual, best first.

        The best point is returned in any case.
        """
        of_candidate = [x for x in trials if x.candidate is c]
        gains = self._gains(of_candidate, self.residual[:, None])
        ranked = sorted(zip(of_candidate, gains, strict=True), key=lambda x: -float(x[1][0][0]))
        out = []
        for trial, (_, step) in ranked[:_TRIALS]:
            remaining = self.residual + trial.offset + trial.columns @ step[:, 0]
            moved = -self._response(remaining[:, None])[:, 0]

            # A line search over parts of the step.
            points = []
            for part in _PARTS:
                values, point = self._step_along(trial, part * step[:, 0]), self.point + part * moved
                e, _ = self._at(c, values, point)
                squares = float(np.nan_to_num(e @ e, nan=np.inf))
                points.append(StartPoint(start=trial.start, values=values, point=point, squares=squares))
            out.append(min(points, key=lambda b: b.squares))
        out.sort(key=lambda b: b.squares)
        return [b for b in out if b.squares < self.residual @ self.residual] or out[:1]

    def _step_along(self, trial: LinearTrial, step: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return the values of a candidate's unknowns after a step of its trial."""
        c, start = trial.candidate, trial.candidate.starts[trial.start]
        if c.amplitude.any():
            return np.where(c.amplitude, start * step[0], start)

        # The step is bounded: along a negligible column a linear step has no meaning.
        step = np.clip(step, -_LARGEST_STEP, _LARGEST_STEP)
        parameters = self.superset.machine.parameters
        grows = np.array([parameters.free[i].sign == "positive" for i in c.index])
        lower, upper = (b[c.index] for b in parameters.bounds)
        moved = np.where(grows, start * np.exp(np.where(grows, step, 0.0)), start + _size(start) * step)
        return np.clip(moved, lower, upper)

    def gained(self, after: LoopFit, before: LoopFit) -> float:
        """Return the gain in log-posterior of the log and the base's guesses with another effect [nats]."""
        ratio = after.minimum.cost / before.minimum.cost
        then, now = before.point, after.point
        known = len(self.problem.places)
        # The noise is estimated by each fit separately, hence the logarithm of the ratio.
        guesses = then[:known] @ then[:known] - now[:known] @ now[:known]
        return 0.5 * float(guesses - self.samples * np.log(ratio))

    def _at(self, c: Candidate, values: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the residual with a candidate at some values, and its derivatives, divided by the noise."""
        theta = self.theta.copy()
        theta[self.superset.base] = np.asarray(self.problem.prior.outward(point))[: len(self.superset.base)]
        theta[c.index] = values

        # One number of directions for all candidates, so that one compiled function serves them.
        directions = np.zeros((len(theta), max(len(c.index) for c in self.superset.candidates)))
        directions[c.index, np.arange(len(c.index))] = 1.0

        p, log = self.problem, self.session.fit.log
        plant = with_numerical_damping(self.superset.machine.plant, jnp.asarray(log.filled[0]), log.period)
        plant = plant.smoothed(p.sharpnesses[-1])
        args = (p.replay, self.superset.machine.parameters.places, plant, p.measured, p.weight, p.on)
        e, columns = loop_columns(*args, theta, directions)

        slope = np.zeros((self.residual.size, len(c.index)))
        slope[: self.samples] = np.asarray(columns)[:, : len(c.index)] / self.sigma
        return np.concatenate([np.asarray(e) / self.sigma, point]), slope

    def scored(self, trials: list[LinearTrial]) -> list[Score]:
        """Score every candidate at its best start, the largest gain first."""
        best: dict[int, Score] = {}
        for trial, (gain, step) in zip(trials, self._gains(trials, self.residual[:, None]), strict=True):
            c = trial.candidate
            score = Score(c, trial.start, self._step_along(trial, step[:, 0]), float(gain[0]))
            if id(c) not in best or score.evidence > best[id(c)].evidence:
                best[id(c)] = score
        return sorted(best.values(), key=lambda s: -s.evidence)

    def threshold(self, trials: list[LinearTrial]) -> tuple[float, bool]:
        """Return the evidence that noise reaches once in a thousand searches, and if the residual is noise.

        The residual is noise if its autocorrelation does not exceed that of the draws of white noise.
        """
        white = self._white()

        def remaining(e: np.ndarray) -> np.ndarray:
            return (e - self.base @ self._response(e))[: self.samples]

        largest = _correlation(remaining(white)).max()
        noisy = bool(_correlation(remaining(self.residual[:, None]))[0] <= largest)
        # Rounding of a fitted position is correlated in slow motion, and is not drawn.
        noisy |= self.problem.on == "position" and self.session.machine.sensor.position_resolution is not None
        if not trials:
            return 0.0, noisy

        # Colour that the best trial explains does not belong to the noise.
        gains = self._gains(trials, self.residual[:, None])
        trial, (_, steps) = max(zip(trials, gains, strict=True), key=lambda x: float(x[1][0][0]))
        beside = remaining(self.residual + trial.offset + trial.columns @ steps[:, 0])
        draws = np.concatenate([self._coloured_noise(beside), white], axis=1)
        return max(float(gain.max()) for gain, _ in self._gains(trials, draws)), noisy

    def _coloured_noise(self, e: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows draws"]:
        """Draw noise with the colour of a residual."""
        rng, shape = np.random.default_rng(0), self.problem.weight.shape
        columns = e.reshape(shape)
        drawn = np.zeros((_DRAWS, *shape))
        for k in np.flatnonzero(self.problem.weight[0] > 0):
            model = NoiseModel.fit(columns[:, k], np.ones(shape[0], bool))
            drawn[:, :, k] = model.sample(rng, shape[0], _DRAWS)
        return self._with_guesses(drawn.reshape(_DRAWS, -1), rng)

    def _with_guesses(
        self, e: Float[np.ndarray, "draws samples"], rng: np.random.Generator
    ) -> Float[np.ndarray, "rows draws"]:
        """Append draws of the distance from the guesses, by their prior."""
        return np.concatenate([e, rng.standard_normal((len(e), self.point.size))], axis=1).T

    def _white(self) -> Float[np.ndarray, "rows draws"]:
        """Draw residuals of white noise, with the rounding in the loop if there is any."""
        rng = np.random.default_rng(1)
        white = rng.standard_normal((_DRAWS, self.samples))
        rounded = quantisation_samples(self.session.machine, self.problem, _DRAWS)
        if rounded is not None:
            e = rounded / self.sigma
            share = min(float(np.mean(e**2)), 1.0)
            white = e + np.sqrt(1.0 - share) * white
        counts = np.tile(self.problem.weight[0] > 0, self.problem.weight.shape[0])
        return self._with_guesses(white * counts, rng)

    def _response(self, e: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "q k"]:
        """Return minus the step of the unknowns, each held to its guess, that absorbs some residuals."""
        return np.linalg.solve(self.base.T @ self.base, self.base.T @ e)

    def _gains(
        self, trials: list[LinearTrial], residuals: Float[np.ndarray, "rows k"]
    ) -> list[tuple[Float[np.ndarray, " k"], Float[np.ndarray, "step k"]]]:
        """Compute the gain in log-likelihood of each trial on some residuals, and its steps."""

        def squares(e: np.ndarray) -> np.ndarray:
            return np.sum((e - self.base @ self._response(e)) * e, axis=0)

        before = squares(residuals)
        out = []
        for trial in trials:
            e, x = residuals + trial.offset[:, None], trial.columns
            y = x - self.base @ self._response(x)
            gram = x.T @ y
            gram = gram + 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-300 * np.eye(len(gram))
            step = -np.linalg.solve(gram, y.T @ e)
            if trial.positive:
                step = np.maximum(step, 0.0)
            after = squares(e) + 2 * np.sum((y.T @ e) * step, axis=0) + np.sum((gram @ step) * step, axis=0)
            out.append((0.5 * self.samples * np.log(before / np.maximum(after, 1e-12 * before)), step))
        return out

    def where(self) -> Where:
        """Return the time in which the residual is largest; so few samples show no curve over a variable."""
        log = self.session.fit.log
        e = self.residual[: self.samples].reshape(self.problem.weight.shape)
        power = np.convolve(np.sum(e**2, axis=1), np.ones(_LAGS), "valid")
        k = int(np.argmax(power))
        times = log.time[[k, k + _LAGS - 1]] - log.time[0]
        region = (float(times[0]), float(times[1]))
        text = f"the loop's residual is largest between {region[0]:.3g} and {region[1]:.3g} s"
        return Where.in_time(1, region, text, float(power[k] / np.sum(e**2)))


def _follows(effect: type[Effect]) -> bool:
    """Return whether a smooth loop of fixed steps can follow an effect."""
    return effect.break_away_level is None and not effect.adds_spring and not effect.opens_spring


@kept_jit
def loop_columns(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    on: str,
    theta: Array,
    directions: Array,
) -> tuple[Array, Array]:
    """Compute the weighted residual of the simulated loop, and its derivatives in some directions."""

    def residual(t: Array) -> Array:
        return output_residual(replay, places, plant, measured, weight, on)(t).ravel()

    slope = jax.vmap(lambda d: jax.jvp(residual, (theta,), (d,))[1], out_axes=1)
    return residual(theta), slope(jnp.asarray(directions).T)


def _size(start: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Return the magnitudes of a start's values; one for those that are zero."""
    return np.where(start != 0, np.abs(start), 1.0)


def _correlation(e: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, " k"]:
    """Sum the squared autocorrelations of each column at the first lags."""
    e = e - e.mean(axis=0)
    total = np.zeros(e.shape[1])
    for k in range(1, _LAGS + 1):
        total = total + (np.sum(e[k:] * e[:-k], axis=0) / np.sum(e**2, axis=0)) ** 2
    return total
