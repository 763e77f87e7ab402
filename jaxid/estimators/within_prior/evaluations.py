"""Compiled evaluations of the residual of a fit within a prior, and descents of its cost."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum, Progress, descend
from jaxid.estimators.common.minimise import minimise_on_scale
from jaxid.estimators.common.minimisers import Minimiser
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.within_prior.problem import Compared, Problem
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.numerics.lanes import ParallelCalls, Precompile, SolveRequest, Steps, side_by_side
from jaxid.simulation.replay import Numerics

# Decrease of the cost that still counts, as a fraction of the variance of one sample: at the end of a fit,
# and at an intermediate step of the continuation.
SETTLED = 0.02
NEAR = 1.0
# Bound on the coordinates of a fit, in standard deviations of the prior.
BOUND = 8.0
# The number of coordinates of a compiled fit is a multiple of this: few directions are identifiable, and
# each costs as much as the simulation itself.
BLOCK = 4
# Number of random points, and of those that one compiled call simulates.
DRAWS, _CHUNK = 512, 128
# Weight of the prior in a descent without a prior.
NO_PRIOR = np.zeros(())
# Evaluations of a descent at one sharpness, at most.
_MAX_EVALUATIONS = 25
# Evaluations in a compiled call.
_EVALUATIONS_PER_CALL = 4
_ONCE = np.asarray(_EVALUATIONS_PER_CALL)


@side_by_side
def _residuals_at(compared: Compared, sharpness: Array, w: Array, starts: Array) -> Array:
    """Return the residuals at many whitened points, each from its initial positions, (draws, rows)."""
    compared = compared.at_sharpness(sharpness)

    def at(w: Array, start: Array) -> Array:
        return compared.from_start(start).along(jnp.eye(w.size))(w)

    return jax.vmap(at)(w, starts)


def residuals_at(
    problem: Problem, w: Float[np.ndarray, "draws q"], starts: Float[np.ndarray, "draws k"] | None = None
) -> Steps[Float[np.ndarray, "draws rows"]]:
    """Simulate at many whitened points and return the residuals.

    Args:
        problem: The problem to evaluate.
        w: Whitened points, `DRAWS` of them so that compiled code serves all calls.
        starts: Initial positions of the joints with an encoder, by point; zero if absent.
    """
    if starts is None:
        starts = _zero_starts(problem, len(w))
    cut = range(_CHUNK, len(w), _CHUNK)
    chunks = zip(np.split(w, cut), np.split(starts, cut), strict=True)
    residuals = yield ParallelCalls(
        _residuals_at, [(problem.residual, problem.sharpnesses[-1], *chunk) for chunk in chunks]
    )
    return np.concatenate([np.asarray(e) for e in residuals]).reshape(len(w), -1)


def precompile_residuals_at(problem: Problem) -> Precompile:
    """Return the compiled call of `residuals_at`, to compile ahead of time in the background."""
    points = np.zeros((_CHUNK, problem.prior.base.size))
    args = (problem.residual, problem.sharpnesses[-1], points, _zero_starts(problem, _CHUNK))
    return Precompile(_residuals_at, args, (_residuals_at, jax.tree.structure(args), problem.measured.shape))


def _zero_starts(problem: Problem, draws: int) -> np.ndarray:
    return np.zeros((draws, problem.replay.follow.shape[1]))


def _with_prior(
    compared: Compared, sharpness: Array, prior_weight: Array, origin: Array, vectors: Array
) -> Callable[[Array], Array]:
    """Return the residual as a function of the coordinates, followed by the rows of the prior."""
    along = compared.at_sharpness(sharpness).along(vectors, origin)
    return jax.jit(lambda z: jnp.concatenate([along(z).ravel(), prior_weight * z]))


def _advance(
    compared: Compared,
    sharpness: Array,
    prior_weight: Array,
    origin: Array,
    vectors: Array,
    active: Array,
    tolerance: Array | float,
    max_evaluations: Array | int,
    progress: Progress,
) -> Progress:
    """Advance a descent of the cost.

    Args:
        compared: The residual whose squares are minimised.
        sharpness: Sharpness of the smoothed sign.
        prior_weight: Standard deviation of the noise: coordinates times this are rows of the residual too,
            and hold the descent near the guesses. Zero: without a prior.
        origin: Whitened point from which coordinates are counted, (q,).
        vectors: Directions as columns, (q, k).
        active: Mask of the coordinates that move, (k,).
        tolerance: Relative decrease of the cost at which the descent has converged.
        max_evaluations: Evaluations at which to stop, those so far among them.
        progress: State of the descent.
    """
    bound = jnp.full(active.shape, BOUND)
    residual = _with_prior(compared, sharpness, prior_weight, origin, vectors)
    return descend(residual, progress, (-bound, bound), max_evaluations, active, tolerance)


_advance_compiled = eqx.filter_jit(_advance)


@eqx.filter_jit
def _by_minimiser(
    minimiser: Minimiser,
    compared: Compared,
    sharpness: Array,
    prior_weight: Array,
    origin: Array,
    vectors: Array,
    active: Array,
    z: Array,
) -> Minimum:
    """Minimise the cost from one start by a solver of optimistix; see `_advance` for the arguments."""
    bound = jnp.full(active.shape, BOUND)
    residual = _with_prior(compared, sharpness, prior_weight, origin, vectors)
    size = jnp.where(z == 0, 1.0, jnp.abs(z))
    progress, failure = minimise_on_scale(minimiser, residual, z, size, (-bound, bound), active)
    return replace(_minimum_of(progress), failure=failure)


def descent(
    problem: Problem,
    sharpness: np.ndarray,
    prior_weight: np.ndarray,
    origin: np.ndarray,
    vectors: np.ndarray,
    z: Float[np.ndarray, " k"],
    active: Bool[np.ndarray, " k"],
    settled: float = SETTLED,
) -> Steps[Minimum]:
    """Descend the cost from one start, a few evaluations at a time.

    Runs side by side in one compiled call then do not wait long for the slowest.

    Args:
        problem: The problem to fit.
        sharpness: Sharpness of the smoothed sign.
        prior_weight: Standard deviation of the noise, see `_advance`; `NO_PRIOR`: without a prior.
        origin: Whitened point from which coordinates are counted, (q,).
        vectors: Directions as columns, (q, k).
        z: Coordinates of the start, (k,).
        active: Mask of the coordinates that are fitted, (k,).
        settled: Decrease of the cost at which to stop, as a fraction of the variance of one sample.
    """
    if problem.minimiser is not None and np.any(active):
        args = (problem.residual, sharpness, prior_weight, origin, vectors, active, z)
        return (yield SolveRequest(_by_minimiser, (problem.minimiser, *args)))

    progress = _initial_progress(z, problem.measured.size)
    tolerance = np.asarray(0.1 * settled / len(problem.measured))
    args = (problem.residual, sharpness, prior_weight, origin, vectors, active, tolerance)
    while not progress.done and progress.steps < _MAX_EVALUATIONS:
        stop = np.minimum(progress.steps + _EVALUATIONS_PER_CALL, _MAX_EVALUATIONS)
        progress = yield SolveRequest(_advance_compiled, (*args, stop, progress))
    return _minimum_of(progress)


def _initial_progress(z: Array, size: int) -> Progress:
    xp = np if isinstance(z, np.ndarray) else jnp
    return Progress.at(z, xp.where(z == 0, 1.0, xp.abs(z)), size + z.size)


def _minimum_of(progress: Progress) -> Minimum:
    """Return the minimum without the rows of the prior; the solver's scale is that of the coordinates."""
    e, jacobian = (x[: -progress.x.size] for x in progress.kept)
    cost = 0.5 * e @ e
    sound = progress.done & (abs(cost) < np.inf)
    return Minimum(
        theta=progress.x,
        cost=cost,
        steps=progress.steps,
        converged=sound,
        residual=e,
        jacobian=jacobian,
    )


def linearise(problem: Problem, sharpness: np.ndarray, w: Float[np.ndarray, " q"]) -> Steps[Minimum]:
    """Evaluate the residual and its Jacobian in all whitened coordinates at a point.

    The compiled descent does it with all coordinates inactive, a few columns at a time: separate code would
    take as long again to compile.

    Returns:
        The point as a minimum: `theta` is `w`, the Jacobian is (rows, q).
    """
    size, width = w.size, min(w.size, BLOCK)
    vectors = np.eye(size, -(-size // width) * width)
    begun, still = _begun(width, problem.measured.size), np.zeros(width, bool)
    tolerance = np.asarray(0.1 * SETTLED / len(problem.measured))

    parts = []
    for first in range(0, size, width):
        block = vectors[:, first : first + width]
        args = (problem.residual, sharpness, NO_PRIOR, w, block, still, tolerance)
        # With all coordinates at rest it ends after one evaluation.
        here = yield SolveRequest(_advance_compiled, (*args, _ONCE, begun))
        parts.append(here)

    columns = [np.asarray(p.kept[1])[:-width] for p in parts]
    return replace(_minimum_of(parts[0]), theta=w, jacobian=np.concatenate(columns, axis=1)[:, :size])


@functools.lru_cache(maxsize=8)
def _begun(width: int, size: int) -> Progress:
    """Return the state of a descent at coordinates of zero."""
    return _initial_progress(np.zeros(width), size)


@eqx.filter_jit
def fit_each(
    compared: Compared,
    sharpness: Array,
    prior_weight: Array,
    origin: Array,
    vectors: Array,
    z: Array,
    active: Array,
) -> tuple[Array, Array, Array, Array]:
    """Descend the cost from many starts.

    Args:
        compared: The residual whose squares are minimised.
        sharpness: Sharpness of the smoothed sign.
        prior_weight: Standard deviation of the noise, see `_advance`.
        origin: Whitened point from which coordinates are counted, (q,).
        vectors: Directions as columns, (q, k).
        z: Coordinates of the starts, (starts, k).
        active: Masks of the coordinates that are fitted, (starts, k).

    Returns:
        Coordinates, cost, convergence and number of evaluations, by start.
    """
    size, tolerance = compared.measured.size, 0.1 * SETTLED / len(compared.measured)

    def one(z: Array, active: Array) -> tuple:
        initial = _initial_progress(z, size)
        progress = _advance(
            compared,
            sharpness,
            prior_weight,
            origin,
            vectors,
            active,
            tolerance,
            _MAX_EVALUATIONS,
            initial,
        )
        minimum = _minimum_of(progress)
        return minimum.theta, minimum.cost, minimum.converged, minimum.steps

    return eqx.filter_vmap(one)(z, active)


def criterion_steps(
    machine: Machine,
    log: Log,
    theta: Float[np.ndarray, " p"],
    *,
    on: str = "position",
    numerics: Numerics | None = None,
) -> Steps[float]:
    """Compute the criterion of the same simulation at given unknowns, without a fit [%].

    Args:
        machine: The machine; its controller closes the loop, which begins at rest.
        log: The log to compare with.
        theta: Values of the unknowns, (p,).
        on: Output that is compared: "position", "force" or "both".
        numerics: Integration settings; chosen from machine and log if absent.
    """
    problem = Problem.of(machine, log, 1.0, on, numerics or choose_numerics(machine, log))
    w = problem.prior.inward(problem.padded(theta))
    return problem.criterion((yield from linearise(problem, problem.sharpnesses[-1], w)))
