"""What a fit within a prior compares: a residual in units of the prior, and the way down its cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum, Progress, descend
from jaxid.estimators.common.minimise import minimise_on_scale
from jaxid.estimators.common.minimisers import Minimiser
from jaxid.estimators.output_error import (
    choose_numerics,
    measured_output,
    output_residual,
    turning_steps,
)
from jaxid.estimators.within_prior.prior import Prior
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.lanes import ParallelCalls, Precompile, SolveRequest, Steps
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.replay import Numerics, Replay, from_rest, make_replay, with_sensor
from jaxid.simulation.step_size import steps_with_numerical_damping, with_numerical_damping

# In parts of the variance of one sample: where a fit has settled, and where it is near enough to go on
# sharper.
SETTLED = 0.02
NEAR = 1.0
# Farther from its guess than so many priors no unknown is taken.
FAR = 8.0
# Coordinates of a compiled fit come in multiples of this: few directions are told, and each costs as much
# as the simulation itself.
AT_ONCE = 4
# What is left of the prior along a direction that was fitted and stays.
STAYS = 0.6
# Points that are drawn at a time, and those at which one compiled call simulates.
DRAWN, _PART = 512, 128
# No pull towards the guesses.
NO_PULL = np.zeros(())
# Friction that rises with speeding up lets a velocity stand, and costs have a kink wherever it does: such
# a machine is fitted with that rounded over these parts of it. At most so many evaluations at each.
_LADDER = (1.0, 0.3, 0.1)
_A_RUNG = 25
# Evaluations in a compiled call.
_A_CALL = 4


@dataclass(frozen=True)
class Problem:
    """What is compared, as arrays.

    Args:
        replay: The loop, or the input.
        places, plant: Of the unknowns.
        measured, weight: (time, k).
        prior: Of the unknowns, nuisances behind them.
        on: What of the simulation is compared.
        ladder: Sharpnesses at which to fit, one after the other.
        encoders: Joints that have one.
        minimiser: A solver of optimistix for `descent`; None: jaxid's Levenberg-Marquardt.
    """

    replay: Replay
    places: tuple
    plant: Plant
    measured: np.ndarray
    weight: np.ndarray
    prior: Prior
    on: str
    ladder: tuple[np.ndarray, ...]
    encoders: tuple[int, ...]
    minimiser: Minimiser | None = None

    @property
    def args(self) -> tuple:
        """For the compiled functions."""
        return (self.replay, self.places, self.plant, self.measured, self.weight, self.prior, self.on)

    @classmethod
    def of(
        cls,
        machine: Machine,
        log: Log,
        prior: float,
        on: str,
        numerics: Numerics,
        widths: Mapping[str, float] | None = None,
    ) -> Problem:
        """Of a machine and its log, from rest; see `jaxid.estimators.within_prior.fit.directions_steps`.

        Raises:
            InputError: If a guess is zero, or the loop cannot be simulated.
        """
        n, encoders = log.position.shape[1], tuple(np.flatnonzero(log.measured).tolist())
        plant = with_numerical_damping(machine.plant, jnp.asarray(log.filled[0]), log.period)
        if plant is not machine.plant and numerics.set_valued:
            fewer = max(steps_with_numerical_damping(numerics.substeps, on), turning_steps(machine, log))
            numerics = replace(numerics, substeps=min(fewer, numerics.substeps))
        replay = from_rest(make_replay(machine, log, numerics))
        if on != "position":
            replay = with_sensor(replay, Sensor())
        measured, counts = measured_output(machine, log, on)
        std = machine.sensor.position_std
        start = np.zeros(0) if std is None else np.broadcast_to(np.asarray(std), n)[[*encoders]]
        whole = Prior.of(machine, prior, start, widths)
        weight = np.tile(counts.astype(float), (len(measured), 1))
        m = log.force.shape[1]
        ladder = _LADDER if _rises(plant, np.zeros(n), np.zeros(m)) else (plant.sharpness,)
        sharp = tuple(np.asarray(s) for s in ladder)
        places = machine.parameters.places
        return cls(replay, places, plant, measured, weight, whole, on, sharp, encoders)

    @property
    def nuisances(self) -> list[str]:
        """Names of what is unknown behind the machine's own unknowns."""
        count = self.prior.base.size - len(self.places)
        return [f"start position {k + 1}" for k in self.encoders[:count]]

    def padded(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " q"]:
        """Unknowns with all nuisances at zero."""
        return np.concatenate([theta, np.zeros(self.prior.base.size - len(theta))])

    def weighed(self, minimum: Minimum) -> tuple[Problem, Minimum]:
        """Columns of the residual by their own spread, where there are several; the minimum likewise."""
        counts = self.weight[0] > 0
        if counts.sum() == 1:
            return self, minimum
        e = np.asarray(minimum.residual).reshape(self.measured.shape)[:, counts] / self.weight[0, counts]
        least = 1e-12 * np.std(self.measured[:, counts], axis=0)
        row, factor = np.zeros(len(counts)), np.zeros(len(counts))
        row[counts] = 1.0 / np.maximum(np.std(e, axis=0), least)
        factor[counts] = row[counts] / self.weight[0, counts]
        by = np.tile(factor, len(self.measured))
        e, jacobian = by * np.asarray(minimum.residual), by[:, None] * np.asarray(minimum.jacobian)
        weighed = replace(minimum, residual=e, jacobian=jacobian, cost=np.asarray(0.5 * e @ e))
        return replace(self, weight=np.tile(row, (len(self.measured), 1))), weighed

    def noise(self, minimum: Minimum, count: float) -> float:
        """Standard deviation of a weighted residual of which so many unknowns are fitted."""
        samples = int(np.sum(self.weight > 0))
        return float(np.sqrt(2 * float(minimum.cost) / max(samples - count, 1)))

    def criterion(self, minimum: Minimum) -> float:
        """(11) of Bogdan and Abba: squared residual over squared deviation from the mean, percent."""
        spread = np.sum((self.weight * (self.measured - self.measured.mean(axis=0))) ** 2)
        return float(100 * 2 * float(minimum.cost) / spread)


@eqx.filter_jit
def _rises(plant: Plant, q: Array, u: Array) -> bool:
    """Whether any friction acts only while speed grows; known when it is compiled."""
    return bool(plant.balance(q, q, q, u, jnp.zeros(()), plant.initial_states(u)).rises)


def signed(vectors: Float[np.ndarray, "q k"]) -> Float[np.ndarray, "q k"]:
    """Columns that come with either sign, with their largest entry positive."""
    largest = np.argmax(np.abs(vectors), axis=0)
    return vectors * np.sign(vectors[largest, np.arange(vectors.shape[1])])


def columns(vectors: Float[np.ndarray, "q q"], count: int) -> Float[np.ndarray, "q k"]:
    """The first directions, so many at least, in a number that compiled code is made for."""
    return vectors[:, : AT_ONCE * max(1, -(-count // AT_ONCE))]


def residual_of(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    prior: Prior,
    on: str,
    vectors: Array,
    origin: Array | float = 0.0,
) -> Any:
    """Residual as a function of the directions' coordinates, counted from a point in units of the prior."""
    physical = output_residual(replay, places, plant, measured, weight, on)

    def residual(z: Array) -> Array:
        # Behind the unknowns stand positions at the start; velocities there are known to be those of the log.
        theta, start = jnp.split(prior.outward(origin + vectors @ z), [len(places)])
        if start.size:
            start = replay.follow @ start
        return physical(jnp.concatenate([theta, start, jnp.zeros_like(start)]))

    return residual


@eqx.filter_jit
def residual_at_each(*args: Any) -> Array:
    """Residuals at many points in units of the prior, from as many starts; `Problem.args` first."""
    *problem, sharpness, w, starts = args
    replay, places, plant, *rest = problem
    plant = replace(plant, sharpness=sharpness)
    at = lambda w, start: residual_of(replay.started(start), places, plant, *rest, jnp.eye(w.size))(w)
    return eqx.filter_vmap(at)(w, starts)


def at_each(
    problem: Problem, w: Float[np.ndarray, "draws q"], starts: Float[np.ndarray, "draws k"] | None = None
) -> Steps[Float[np.ndarray, "draws rows"]]:
    """Residuals at so many points as `DRAWN`, from rest at zero if no starts are given."""
    if starts is None:
        starts = _at_rest(problem, len(w))
    cut = range(_PART, len(w), _PART)
    some = zip(np.split(w, cut), np.split(starts, cut), strict=True)
    found = yield ParallelCalls(residual_at_each, [(*problem.args, problem.ladder[-1], *at) for at in some])
    return np.concatenate([np.asarray(e) for e in found]).reshape(len(w), -1)


def at_each_soon(problem: Problem) -> Precompile:
    """What `at_each` will ask for."""
    points = np.zeros((_PART, problem.prior.base.size)), _at_rest(problem, _PART)
    args = (*problem.args, problem.ladder[-1], *points)
    return Precompile(
        residual_at_each, args, (residual_at_each, jax.tree.structure(args), problem.measured.shape)
    )


def _at_rest(problem: Problem, draws: int) -> np.ndarray:
    return np.zeros((draws, problem.replay.follow.shape[1]))


def _pulled(args: tuple, sharpness: Array, pull: Array, origin: Array, vectors: Array) -> Any:
    """Return the residual as a function of the coordinates, and behind it their pull towards zero."""
    replay, places, plant, *rest = args
    compared = residual_of(replay, places, replace(plant, sharpness=sharpness), *rest, vectors, origin)
    return jax.jit(lambda z: jnp.concatenate([compared(z).ravel(), pull * z]))


def _goes_on(*args: Any) -> Progress:
    """Down the cost; `pull`, the noise that a prior is held against, keeps the way near the guesses."""
    *problem, sharpness, pull, origin, vectors, active, tolerance, stop, progress = args
    bound = jnp.full(active.shape, FAR)
    residual = _pulled(tuple(problem), sharpness, pull, origin, vectors)
    return descend(residual, progress, (-bound, bound), stop, active, tolerance)


_go_on = eqx.filter_jit(_goes_on)


@eqx.filter_jit
def _by_minimiser(*args: Any) -> Minimum:
    """Minimise from one start by a solver of optimistix; arguments as of `_goes_on`, that solver first."""
    minimiser, *problem, sharpness, pull, origin, vectors, active, z = args
    bound = jnp.full(active.shape, FAR)
    residual = _pulled(tuple(problem), sharpness, pull, origin, vectors)
    size = jnp.where(z == 0, 1.0, jnp.abs(z))
    progress, failure = minimise_on_scale(minimiser, residual, z, size, (-bound, bound), active)
    return replace(_compared(progress), failure=failure)


def descent(
    problem: Problem,
    sharpness: np.ndarray,
    pull: np.ndarray,
    origin: np.ndarray,
    vectors: np.ndarray,
    z: Float[np.ndarray, " k"],
    active: Bool[np.ndarray, " k"],
    settled: float = SETTLED,
) -> Steps[Minimum]:
    """Fit from one start, a few evaluations at a time: side by side no run then waits long for another.

    Args:
        problem: The problem.
        sharpness: Of the smoothed sign.
        pull: See `_goes_on`.
        origin: Point in units of the prior from which coordinates are counted.
        vectors: Directions, as columns.
        z: Coordinates along them.
        active: Which are fitted.
        settled: In parts of a sample's variance, what the cost may still fall.
    """
    if problem.minimiser is not None and np.any(active):
        args = (problem.minimiser, *problem.args, sharpness, pull, origin, vectors, active, z)
        return (yield SolveRequest(_by_minimiser, args))
    progress = _begun(z, problem.measured.size)
    tolerance = np.asarray(0.1 * settled / len(problem.measured))
    args = (*problem.args, sharpness, pull, origin, vectors, active, tolerance)
    while not progress.done and progress.steps < _A_RUNG:
        stop = np.minimum(progress.steps + _A_CALL, _A_RUNG)
        progress = yield SolveRequest(_go_on, (*args, stop, progress))
    return _compared(progress)


def _begun(z: Array, size: int) -> Progress:
    xp = np if isinstance(z, np.ndarray) else jnp
    return Progress.at(z, xp.where(z == 0, 1.0, xp.abs(z)), size + z.size)


def _compared(progress: Progress) -> Minimum:
    """The minimum, without the pull; the solver's scale is that of the coordinates."""
    e, jacobian = (x[: -progress.x.size] for x in progress.kept)
    cost = 0.5 * e @ e
    sound = progress.done & (abs(cost) < np.inf)
    return Minimum(progress.x, cost, progress.steps, sound, e, jacobian)


def read(problem: Problem, sharpness: np.ndarray, w: Float[np.ndarray, " q"]) -> Steps[Minimum]:
    """Residual and its Jacobian in all coordinates at a point in units of the prior; nothing moves.

    By the compiled fit, a few columns at a time: code of its own would take as long again to compile.
    """
    size, width = w.size, min(w.size, AT_ONCE)
    vectors = np.eye(size, -(-size // width) * width)
    still = (np.zeros(width), np.zeros(width, bool))
    found = []
    for first in range(0, size, width):
        some = vectors[:, first : first + width]
        found.append((yield from descent(problem, sharpness, NO_PULL, w, some, *still)))
    jacobian = np.concatenate([np.asarray(m.jacobian) for m in found], axis=1)[:, :size]
    return replace(found[0], theta=w, jacobian=jacobian)


@eqx.filter_jit
def fit_each(*args: Any) -> tuple[Array, Array, Array, Array]:
    """From many starts, or with many things held: coordinates, cost, convergence and steps of each.

    Args as of `descent`, with `Problem.args` first, and many of the last two.
    """
    *problem, z, active = args
    size, tolerance = problem[3].size, 0.1 * SETTLED / len(problem[3])

    def one(z: Array, active: Array) -> tuple:
        found = _compared(_goes_on(*problem, active, tolerance, _A_RUNG, _begun(z, size)))
        return found.theta, found.cost, found.converged, found.steps

    return eqx.filter_vmap(one)(z, active)


@dataclass(frozen=True)
class RoundsResult:
    """Where the rounds ended: problem, directions (columns), how many are fitted, and the minimum.

    The minimum is in the coordinates of the first directions, or of all; those of others are zero.
    Evaluations are those that it took.
    """

    problem: Problem
    vectors: np.ndarray
    count: int
    minimum: Minimum
    evaluations: int
    settled: bool

    @property
    def first(self) -> np.ndarray:
        """Directions that compiled code is made for."""
        return columns(self.vectors, self.count)

    @property
    def point(self) -> np.ndarray:
        """In units of the prior."""
        theta = np.asarray(self.minimum.theta)
        return self.vectors[:, : theta.size] @ theta

    @property
    def effective(self) -> float:
        """Effective number of parameters: of each direction the part in which it follows the log.

        Source:
            Hastie, Tibshirani and Friedman, "The elements of statistical learning", 7.6: the trace of what
            maps the measured to the fitted, here with the guesses as the penalty.
        """
        jacobian = np.asarray(self.minimum.jacobian) / self.problem.noise(self.minimum, self.count)
        if not np.all(np.isfinite(jacobian)):
            return 0.0
        told = np.linalg.svd(np.linalg.qr(jacobian, mode="r"), compute_uv=False) ** 2
        return float(np.sum(told / (1.0 + told)))

    @property
    def noise(self) -> float:
        """Standard deviation of the residual, white, of which so many parameters are effective."""
        return self.problem.noise(self.minimum, self.effective)


def criterion_steps(
    machine: Machine,
    log: Log,
    theta: Float[np.ndarray, " p"],
    *,
    on: str = "position",
    numerics: Numerics | None = None,
) -> Steps[float]:
    """Criterion of the same simulation at given unknowns, percent; nothing is fitted."""
    problem = Problem.of(machine, log, 1.0, on, numerics or choose_numerics(machine, log))
    w = problem.prior.inward(problem.padded(theta))
    return problem.criterion((yield from read(problem, problem.ladder[-1], w)))
