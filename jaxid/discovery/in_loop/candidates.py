"""Effects that a machine might lack, added to its simulated loop: linear looks at what each would gain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.discovery.candidates import Candidate, CandidateModel
from jaxid.discovery.score import Score
from jaxid.discovery.superset import build_candidate_model
from jaxid.discovery.where import Where
from jaxid.effects.coupling import Backlash, JointFlexibility
from jaxid.effects.friction import StaticFriction
from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import choose_numerics, output_residual
from jaxid.estimators.within_prior.posterior import most_probable
from jaxid.estimators.within_prior.problem import Problem, read
from jaxid.estimators.within_prior.rounding import drawn_roundings
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.lanes import run_alone
from jaxid.numerics.precision import NoiseModel
from jaxid.session import Session
from jaxid.simulation.replay import Replay
from jaxid.simulation.step_size import with_numerical_damping

# A smooth loop of fixed steps cannot take these in.
_LEFT_OUT = (StaticFriction, Backlash, JointFlexibility)
# Draws of noise; the best that the luckiest of them gains is the threshold.
_DRAWS = 1024
# Where fits of a candidate begin: at so many of its looks, the most promising, as far along as that of these
# parts of the way where it simulates best. A look is linear: strong friction that acts briefly promises most,
# and makes the machine stick; what acts longer may lie in another valley.
_LOOKS, _PARTS = 6, 0.5 ** np.arange(5)
# What acts in the drive goes no farther from a start than so many times its size, or that many powers of e.
_STRIDE = 3.0
# Lags whose correlation says whether a residual is noise.
_LAGS = 10


@dataclass(frozen=True)
class LoopFit:
    """A fit within the prior.

    Args:
        machine: What was fitted, at its guesses.
        widths: Standard deviations of those that have one of their own, by name; see `directions_steps`.
        estimate: What was found.
        problem: What it compared.
        point: Where its loop, which rounds no reading, follows the log best, in units of the prior.
        minimum: There.
    """

    machine: Machine
    widths: dict[str, float]
    estimate: Estimate
    problem: Problem
    point: Float[np.ndarray, " q"]
    minimum: Minimum

    @classmethod
    def of(cls, session: Session, machine: Machine, widths: dict[str, float], estimate: Estimate) -> LoopFit:
        """With the point anew: what rounding does on average was taken off the estimate."""
        settings, log = session.case.need_prior(), session.fit.log
        numerics = choose_numerics(machine, log)
        problem = Problem.of(machine, log, settings.prior, settings.on, numerics, widths)
        point = problem.prior.inward(problem.padded(estimate.theta))
        here = run_alone(read(problem, problem.ladder[-1], point))
        problem, here = problem.weighed(here)
        noise = problem.noise(here, len(estimate.details["directions"]))
        point, here, _ = run_alone(most_probable(problem, noise, point))
        return cls(machine, widths, estimate, problem, point, here)

    @property
    def noise(self) -> float:
        """Standard deviation of the weighted residual."""
        return self.problem.noise(self.minimum, len(self.estimate.details["directions"]))


@dataclass(frozen=True)
class LinearTrial:
    """A candidate at one start, in the loop: what it adds to the residual, over the noise.

    Args:
        candidate, start: Which.
        offset: Change of the residual, (rows,); zero for an added force.
        columns: Directions in which it may go from there, (rows, k).
        positive: Whether only forwards.
    """

    candidate: Candidate
    start: int
    offset: Float[np.ndarray, " rows"]
    columns: Float[np.ndarray, "rows k"]
    positive: bool


@dataclass(frozen=True)
class StartPoint:
    """Where a fit with a candidate begins.

    Args:
        start: Index of the candidate's start.
        values: Of its unknowns.
        point: The base's, in units of the prior.
        squares: What is left there, over the noise, squared; how far guesses are off included.
    """

    start: int
    values: Float[np.ndarray, " k"]
    point: Float[np.ndarray, " q"]
    squares: float


@dataclass(frozen=True)
class Loop:
    """A fitted machine in its loop, with every effect that it might lack doing nothing yet.

    Args:
        session: Case and log.
        union: With the effects.
        problem, point: Of the fit.
        residual: What it left, over the noise, by row of the log; behind them how far it is from its guesses.
        base: Derivatives of that in units of the prior, (rows, unknowns and starts).
        sigma: The noise, in units of the weighted residual.
    """

    session: Session
    union: CandidateModel
    problem: Problem
    point: Float[np.ndarray, " q"]
    residual: Float[np.ndarray, " rows"]
    base: Float[np.ndarray, "rows q"]
    sigma: float

    @classmethod
    def of(cls, session: Session, fit: LoopFit) -> Loop:
        """Of what a fit within a prior found."""
        sigma, point, here = fit.noise, fit.point, fit.minimum
        # Sizes of motion from all samples: those of a short log may hardly leave its rest.
        data = replace(session.fit.data, moving=np.ones_like(session.fit.data.moving))
        searched = [e for e in session.case.searched if e not in _LEFT_OUT]
        union = build_candidate_model(fit.estimate.machine, data, searched)
        residual = np.concatenate([np.asarray(here.residual).ravel() / sigma, point])
        base = np.concatenate([np.asarray(here.jacobian) / sigma, np.eye(point.size)])
        return cls(session, union, fit.problem, point, residual, base, sigma)

    @property
    def samples(self) -> int:
        """Rows of the residual that are the log's."""
        return self.residual.size - self.point.size

    @property
    def theta(self) -> np.ndarray:
        """All unknowns of the union, the effects doing nothing."""
        return self.union.neutral

    @property
    def rms(self) -> np.ndarray:
        """RMS of the residual, by column that counts, in its own units."""
        weight = self.problem.weight
        counts = weight[0] > 0
        e = self.sigma * self.residual[: self.samples].reshape(weight.shape)[:, counts] / weight[:, counts]
        return np.sqrt(np.mean(e**2, axis=0))

    def looks(self) -> list[LinearTrial]:
        """Every candidate at each of its starts; what cannot be simulated there is left out."""
        out = []
        free = self.union.machine.parameters.free
        for c in self.union.candidates:
            drive = not c.amplitude.any()
            positive = all(free[i].sign != "free" for i in c.index[c.amplitude])
            for k in range(len(c.starts)):
                e, columns = self._at(c, c.starts[k] if drive else c.probe(k), self.point)
                if drive:
                    look = LinearTrial(c, k, e - self.residual, columns * _size(c.starts[k]), False)
                else:
                    strength = columns @ np.where(c.amplitude, c.starts[k], 0.0)
                    look = LinearTrial(c, k, np.zeros_like(e), strength[:, None], positive)
                if np.all(np.isfinite(look.columns)) and np.all(np.isfinite(look.offset)):
                    out.append(look)
        return out

    def begins(self, c: Candidate, looks: list[LinearTrial]) -> list[StartPoint]:
        """Where looks at a candidate lead when they are simulated, the lowest first; those that lead down."""
        own = [x for x in looks if x.candidate is c]
        found = zip(own, self._gains(own, self.residual[:, None]), strict=True)
        out = []
        for look, (_, step) in sorted(found, key=lambda x: -float(x[1][0][0]))[:_LOOKS]:
            left = self.residual + look.offset + look.columns @ step[:, 0]
            moved = -self._giving_way(left[:, None])[:, 0]
            each = []
            for part in _PARTS:
                values, point = self._along(look, part * step[:, 0]), self.point + part * moved
                e, _ = self._at(c, values, point)
                each.append(StartPoint(look.start, values, point, float(np.nan_to_num(e @ e, nan=np.inf))))
            out.append(min(each, key=lambda b: b.squares))
        out.sort(key=lambda b: b.squares)
        return [b for b in out if b.squares < self.residual @ self.residual] or out[:1]

    def _along(self, look: LinearTrial, step: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Values of a candidate's unknowns where a step of its look leads."""
        c, start = look.candidate, look.candidate.starts[look.start]
        if c.amplitude.any():
            return np.where(c.amplitude, start * step[0], start)
        # Along a column that is next to nothing a line leads anywhere.
        step = np.clip(step, -_STRIDE, _STRIDE)
        parameters = self.union.machine.parameters
        grows = np.array([parameters.free[i].sign == "positive" for i in c.index])
        lower, upper = (b[c.index] for b in parameters.bounds)
        moved = np.where(grows, start * np.exp(np.where(grows, step, 0.0)), start + _size(start) * step)
        return np.clip(moved, lower, upper)

    def gained(self, after: LoopFit, before: LoopFit) -> float:
        """Nats by which a log and the base's guesses are likelier with another effect."""
        ratio, (then, now) = after.minimum.cost / before.minimum.cost, (before.point, after.point)
        known = len(self.problem.places)
        # The noise is that of either fit.
        guesses = then[:known] @ then[:known] - now[:known] @ now[:known]
        return 0.5 * float(guesses - self.samples * np.log(ratio))

    def _at(self, c: Candidate, values: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residual with a candidate at some values, and its derivatives in them, over the noise."""
        theta = self.theta.copy()
        theta[self.union.base] = np.asarray(self.problem.prior.outward(point))[: len(self.union.base)]
        theta[c.index] = values
        # Of one width for all: one compiled function.
        directions = np.zeros((len(theta), max(len(c.index) for c in self.union.candidates)))
        directions[c.index, np.arange(len(c.index))] = 1.0
        p, log = self.problem, self.session.fit.log
        plant = with_numerical_damping(self.union.machine.plant, jnp.asarray(log.filled[0]), log.period)
        plant = replace(plant, sharpness=p.ladder[-1])
        args = (p.replay, self.union.machine.parameters.places, plant, p.measured, p.weight, p.on)
        e, columns = _columns(*args, theta, directions)
        slope = np.zeros((self.residual.size, len(c.index)))
        slope[: self.samples] = np.asarray(columns)[:, : len(c.index)] / self.sigma
        return np.concatenate([np.asarray(e) / self.sigma, point]), slope

    def scored(self, looks: list[LinearTrial]) -> list[Score]:
        """Best start of every candidate by what it gains, the most first."""
        best: dict[int, Score] = {}
        for look, (gain, step) in zip(looks, self._gains(looks, self.residual[:, None]), strict=True):
            c = look.candidate
            score = Score(c, look.start, self._along(look, step[:, 0]), float(gain[0]))
            if id(c) not in best or score.evidence > best[id(c)].evidence:
                best[id(c)] = score
        return sorted(best.values(), key=lambda s: -s.evidence)

    def threshold(self, looks: list[LinearTrial]) -> tuple[float, bool]:
        """Evidence that noise alone reaches once in a thousand searches; whether the residual is noise."""
        white = self._white()
        left = lambda e: (e - self.base @ self._giving_way(e))[: self.samples]
        most = _correlation(left(white)).max()
        noisy = bool(_correlation(left(self.residual[:, None]))[0] <= most)
        # A position's own rounding is correlated where it moves slowly, and is not drawn.
        noisy |= self.problem.on == "position" and self.session.machine.sensor.position_resolution is not None
        if not looks:
            return 0.0, noisy
        # Colour that the best of them explains is none of the noise's.
        found = self._gains(looks, self.residual[:, None])
        look, (_, steps) = max(zip(looks, found, strict=True), key=lambda x: float(x[1][0][0]))
        beside = left(self.residual + look.offset + look.columns @ steps[:, 0])
        draws = np.concatenate([self._coloured(beside), white], axis=1)
        return max(float(gain.max()) for gain, _ in self._gains(looks, draws)), noisy

    def _coloured(self, e: Float[np.ndarray, " rows"]) -> Float[np.ndarray, "rows draws"]:
        """Noise of the colour of a residual."""
        rng, shape = np.random.default_rng(0), self.problem.weight.shape
        columns = e.reshape(shape)
        drawn = np.zeros((_DRAWS, *shape))
        for k in np.flatnonzero(self.problem.weight[0] > 0):
            model = NoiseModel.fit(columns[:, k], np.ones(shape[0], bool))
            drawn[:, :, k] = model.sample(rng, shape[0], _DRAWS)
        return self._beside_guesses(drawn.reshape(_DRAWS, -1), rng)

    def _beside_guesses(
        self, e: Float[np.ndarray, "draws samples"], rng: np.random.Generator
    ) -> Float[np.ndarray, "rows draws"]:
        """With guesses that are as far off as their prior says."""
        return np.concatenate([e, rng.standard_normal((len(e), self.point.size))], axis=1).T

    def _white(self) -> Float[np.ndarray, "rows draws"]:
        """What a residual may be that is nothing but white noise, and rounding in the loop where there is."""
        rng = np.random.default_rng(1)
        white = rng.standard_normal((_DRAWS, self.samples))
        rounded = drawn_roundings(self.session.machine, self.problem, _DRAWS)
        if rounded is not None:
            e = rounded / self.sigma
            share = min(float(np.mean(e**2)), 1.0)
            white = e + np.sqrt(1.0 - share) * white
        counts = np.tile(self.problem.weight[0] > 0, self.problem.weight.shape[0])
        return self._beside_guesses(white * counts, rng)

    def _giving_way(self, e: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "q k"]:
        """How far the unknowns go for some residuals, each held to its guess, with the sign turned."""
        return np.linalg.solve(self.base.T @ self.base, self.base.T @ e)

    def _gains(
        self, looks: list[LinearTrial], residuals: Float[np.ndarray, "rows k"]
    ) -> list[tuple[Float[np.ndarray, " k"], Float[np.ndarray, "own k"]]]:
        """Gain in log-likelihood of each look on some residuals, and its own steps."""
        squares = lambda e: np.sum((e - self.base @ self._giving_way(e)) * e, axis=0)
        before = squares(residuals)
        out = []
        for look in looks:
            e, x = residuals + look.offset[:, None], look.columns
            y = x - self.base @ self._giving_way(x)
            gram = x.T @ y
            gram = gram + 1e-9 * np.trace(gram) * np.eye(len(gram)) + 1e-300 * np.eye(len(gram))
            step = -np.linalg.solve(gram, y.T @ e)
            if look.positive:
                step = np.maximum(step, 0.0)
            after = squares(e) + 2 * np.sum((y.T @ e) * step, axis=0) + np.sum((gram @ step) * step, axis=0)
            out.append((0.5 * self.samples * np.log(before / np.maximum(after, 1e-12 * before)), step))
        return out

    def where(self) -> Where:
        """When the residual is largest; of a curve so few samples tell nothing."""
        log = self.session.fit.log
        e = self.residual[: self.samples].reshape(self.problem.weight.shape)
        power = np.convolve(np.sum(e**2, axis=1), np.ones(_LAGS), "valid")
        k = int(np.argmax(power))
        times = log.time[[k, k + _LAGS - 1]] - log.time[0]
        region, none = (float(times[0]), float(times[1])), np.zeros(0)
        text = f"the loop's residual is largest between {region[0]:.3g} and {region[1]:.3g} s"
        part = float(power[k] / np.sum(e**2))
        return Where(1, "time", region, (region,), text, part, 0.0, 0.0, True, none, none, none, none)


@eqx.filter_jit
def _columns(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    on: str,
    theta: Array,
    directions: Array,
) -> tuple[Array, Array]:
    residual = lambda t: output_residual(replay, places, plant, measured, weight, on)(t).ravel()
    slope = jax.vmap(lambda d: jax.jvp(residual, (theta,), (d,))[1], out_axes=1)
    return residual(theta), slope(jnp.asarray(directions).T)


def _size(start: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    return np.where(start != 0, np.abs(start), 1.0)


def _correlation(e: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, " k"]:
    """Sum of the squared autocorrelations at the first lags, of each column."""
    e = e - e.mean(axis=0)
    lags = range(1, _LAGS + 1)
    return sum((np.sum(e[k:] * e[:-k], axis=0) / np.sum(e**2, axis=0)) ** 2 for k in lags)
