"""Likelihood of the innovations of a log: its maximum, its second derivative, and its profiles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.estimators.common.profile import BETTER, OFFSETS, falls_below, profile_entry, profiled
from jaxid.estimators.common.scoring import Scored, maximise_likelihood, observed_information
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.full_hessian import profiled_out
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision
from jaxid.simulation.kalman import KalmanFilter

# Evaluations of a fit.
STEPS = 80
# A noise within this part of a bound rests there, and is no unknown of the likelihood.
_AT_BOUND = 1e-3


class Innovations(NamedTuple):
    """A likelihood.

    Args:
        kalman: Filter of the log.
        places: Places of the unknowns in the plant.
        plant: The plant.
        counts: Mask of the innovations that count, (time, k).
        transform: Scale of the unknowns in the solver.
        bounds: Bounds on the unknowns, (p,) each.
        low, high: Bounds on the logarithms of the noise, of the force and then of the readings, (m + k,).
    """

    kalman: KalmanFilter
    places: tuple
    plant: Plant
    counts: Array
    transform: Transform
    bounds: tuple[Array, Array]
    low: Array
    high: Array

    def outputs(self, theta: Array, noise: Array) -> tuple[Array, Array]:
        """Return innovations and variances by physical values and logarithms of the noise, (time, k) each."""
        m = self.kalman.command.shape[1]
        fitted = scatter(self.places, self.plant, theta)
        return self.kalman(fitted, jnp.exp(noise[:m]), jnp.exp(noise[m:]))


@kept_jit
def fit(problem: Innovations, theta: Array, noise: Array, max_steps: Array) -> Scored:
    """Maximise a likelihood from physical values and logarithms of the noise; one step only evaluates it."""
    transform, p = problem.transform, theta.size
    limits = transform.bounds(*(jnp.asarray(b) for b in problem.bounds))
    lower, upper = (
        jnp.concatenate([of_unknowns, of_noise])
        for of_unknowns, of_noise in zip(limits, (problem.low, problem.high), strict=True)
    )
    start = jnp.concatenate([transform.inward(theta), noise])
    outputs = lambda x: problem.outputs(transform.outward(x[:p]), x[p:])
    return maximise_likelihood(outputs, problem.counts, start, lower, upper, max_steps)


def fit_steps(problem: Innovations, theta: Array, noise: Array, max_steps: int) -> Steps[Scored]:
    """Run `fit` as a solve request; the result holds arrays of numpy, with which nothing more is compiled."""
    # Joints that push each other share the steps in which one of them turns, which take many times as long.
    # Side by side every fit takes them at every sample, and so it is behind a lag and under friction with
    # memory, where the force changes within a step.
    commands = np.zeros(problem.kalman.command.shape[1])
    remembers = bool(jax.tree.leaves(problem.plant.initial_states(commands)))
    request = SolveRequest(
        fit, (problem, theta, noise, np.asarray(max_steps)), alone=problem.plant.coupled or remembers
    )
    scored = yield request
    return jax.tree.map(np.asarray, scored)


@kept_jit
def whole_hessian(problem: Innovations, theta: Array, noise: Array) -> Float[Array, "q q"]:
    """Return the Hessian of the negative log-likelihood by physical values and logarithms of the noise."""
    p = theta.size
    outputs = lambda x: problem.outputs(x[:p], x[p:])
    return observed_information(outputs, problem.counts, jnp.concatenate([theta, noise]))


def noise_between_bounds(problem: Innovations, noise: Float[np.ndarray, " q"]) -> Bool[np.ndarray, " q"]:
    """Return the mask of the noises that do not rest at a bound; one that does counts as known."""
    return (noise > problem.low + _AT_BOUND) & (noise < problem.high - _AT_BOUND)


def hessian_steps(problem: Innovations, scored: Scored) -> Steps[Float[np.ndarray, "p p"] | None]:
    """Compute the Hessian by the unknowns at a fit, of the likelihood maximised over the noise.

    Args:
        problem: The likelihood.
        scored: The fit.

    Returns:
        The Hessian by physical values, (p, p); None if the likelihood has no maximum over the noise there. A
        noise at a bound counts as known.
    """
    p, x = problem.bounds[0].size, np.asarray(scored.x)
    whole = yield SolveRequest(whole_hessian, (problem, np.asarray(problem.transform.outward(x[:p])), x[p:]))
    free = np.concatenate([np.ones(p, bool), noise_between_bounds(problem, x[p:])])
    return profiled_out(np.asarray(whole)[np.ix_(free, free)], np.arange(free.sum()) < p)


def profile_steps(
    problem: Innovations,
    machine: Machine,
    theta: np.ndarray,
    scored: Scored,
    precision: Precision,
    asked: Sequence[str],
) -> Steps[tuple[dict[str, Any], list[str]]]:
    """Compute the profile likelihood of some unknowns, and notes about those that have none.

    The other unknowns and the noise are fitted again. The rise is divided by the factor by which lasting or
    coloured errors increase the variance. An unknown is held by equal bounds, so that every point runs the
    code of the fit, compiled once.

    Args:
        problem: The likelihood.
        machine: The machine, with its unknowns.
        theta: Estimates, (p,); if they are corrected, the profile moves with them.
        scored: The fit.
        precision: Precision of the unknowns.
        asked: Names of the unknowns.

    Source:
        Venzon and Moolgavkar (1988), Appl. Statist. 37, 87-94; for the factor Chandler and Bate (2007),
        Biometrika 94, 167-183.
    """
    profiles, notes, p = {}, [], len(theta)
    fitted = np.asarray(problem.transform.outward(scored.x[:p]))
    for name in asked:
        k = machine.parameters.names.index(name)
        if not precision.identifiable[k] or precision.equivalent_variance is None:
            notes.append(f"no profile of {name}: it is not identifiable from this log")
            continue
        std, factor = float(precision.std[k]), float(precision.equivalent_variance[k])
        rise = yield from profiled(_refit(problem, fitted, scored, k, std, factor), np.asarray(scored.x))
        notes += [BETTER.format(name)] if falls_below(rise) else []
        unit = machine.parameters.free[k].unit
        values = theta[k] + OFFSETS * std
        profiles[name] = profile_entry(float(theta[k]), std, values, rise, factor, unit)
    if profiles:
        notes.append("profiles: the noise was fitted again at each point")
    if profiles and np.any(theta != fitted):
        notes.append("profiles: moved by the correction for noise with which the command was read")
    return profiles, notes


def _refit(
    problem: Innovations, fitted: np.ndarray, scored: Scored, k: int, std: float, factor: float
) -> Callable[[np.ndarray, float], Steps[tuple[np.ndarray, float]]]:
    """Return the function that fits again with unknown k held at an offset from the fit, see `profiled`."""
    p, (lower, upper) = len(fitted), (np.asarray(b) for b in problem.bounds)
    own = np.arange(p) == k

    def refit(at: np.ndarray, offset: float) -> Steps[tuple[np.ndarray, float]]:
        held = fitted[k] + offset * std
        if not lower[k] < held < upper[k]:
            return at, np.nan
        bounds = (np.where(own, held, lower), np.where(own, held, upper))
        start = np.where(own, held, np.asarray(problem.transform.outward(at[:p])))
        there = yield from fit_steps(problem._replace(bounds=bounds), start, at[p:], STEPS)
        rise = 2 * (float(there.cost) - float(scored.cost)) / factor
        return np.asarray(there.x), rise if bool(there.converged) else np.nan

    return refit
