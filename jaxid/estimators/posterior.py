"""Draws from the posterior of a fit by the likelihood of its innovations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.innovations import STEPS, Innovations, fit_steps, noise_between_bounds
from jaxid.estimators.likelihood import Likelihood, likelihood_of
from jaxid.numerics.independence import Chains, independence_chains
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import run_alone

if TYPE_CHECKING:
    from jaxid.session import Session

# Points whose likelihood is computed side by side.
_LANES = 32


def posterior_chains(session: Session, estimate: Estimate, *, draws: int, chains: int, seed: int) -> Chains:
    """Draw from the posterior of the unknowns of a fit by `prediction_error`.

    The prior is flat within the bounds of the unknowns, and flat in the logarithms of the noise, which is
    drawn too and then left out. Lasting or coloured errors widen the draws by the factors of the standard
    deviations, and a correction of the estimates moves them.

    Args:
        session: Case and log.
        estimate: The fit.
        draws: Number of draws of each chain.
        chains: Number of chains.
        seed: Seed of the random numbers.

    Returns:
        Draws of all unknowns, in physical units.

    Raises:
        InputError: If the fit is by another method or of several logs, has not converged, or an unknown is
            not identifiable.
    """
    if estimate.method != "prediction_error":
        hint = 'identify with method="prediction_error", or leave exact out'
        raise InputError(
            f"exact draws are not made of {estimate.method}", where=session.case.where, hint=hint
        )
    session.need_one_log("a draw from the posterior")
    if not (estimate.converged and np.all(estimate.identifiable)):
        unknown = [n for n, seen in zip(estimate.names, estimate.identifiable, strict=True) if not seen]
        what = f"{', '.join(unknown)} not identifiable" if unknown else "the fit has not converged"
        raise InputError(
            f"{what}: the posterior has no finite width", where=session.case.where, hint="leave exact out"
        )
    likelihood, noise = _likelihood(session, estimate)
    problem, p = likelihood.problem, estimate.theta.size
    end = run_alone(fit_steps(problem, estimate.theta, noise, STEPS))
    fitted = np.asarray(problem.transform.outward(end.x[:p]))

    # The noise that rests at a bound is known.
    free = np.concatenate([np.ones(p, bool), noise_between_bounds(problem, np.asarray(end.x[p:]))])
    rows, logs = (
        np.hstack([np.asarray(problem.transform.physical(a[:, :p], fitted)), a[:, p:]])[:, free]
        for a in (np.asarray(a).reshape(-1, end.x.size) for a in (end.mean, end.log_variance))
    )
    whole = np.concatenate([fitted, end.x[p:]])
    lower, upper = (
        np.concatenate([np.asarray(of_unknowns), of_noise])[free]
        for of_unknowns, of_noise in zip(problem.bounds, (problem.low, problem.high), strict=True)
    )

    def log_density(points: Float[np.ndarray, "n p"]) -> Float[np.ndarray, " n"]:
        inside = np.all((points > lower) & (points < upper), axis=1)
        at = np.tile(whole, (len(points), 1))
        at[:, free] = np.where(inside[:, None], points, whole[free])
        return np.where(inside, np.asarray(log_likelihoods(problem, at)), -np.inf)

    found = independence_chains(
        log_density,
        whole[free],
        np.linalg.inv(rows.T @ rows + 0.5 * logs.T @ logs),
        draws=draws,
        chains=chains,
        rng=np.random.default_rng(seed),
    )
    variance = estimate.precision.equivalent_variance
    factor = np.ones(p) if variance is None else np.sqrt(variance)
    return replace(found, points=estimate.theta + factor * (found.points[..., :p] - fitted))


def _likelihood(session: Session, estimate: Estimate) -> tuple[Likelihood, np.ndarray]:
    """Return the likelihood of a fit at its lowest floor, and the logarithms of the noise that it found."""
    run, noise = session.fit, estimate.details["noise"]
    of_readings = noise["velocity" if "velocity" in noise else "position"]
    made = likelihood_of(
        estimate.machine,
        run.log,
        start=estimate.theta,
        rest_velocity=np.asarray(run.data.recipe.rest_velocity),
    )
    found, low = np.log(np.concatenate([noise["force"], of_readings])), made.floors[-1]
    if made.quietest is not None and np.any(found < low):
        low = made.quietest
    problem = made.problem._replace(low=low)
    if int(problem.counts.sum()) != estimate.samples:
        # The fit ended with the samples at rest.
        problem = made.at_rest_too(problem)
    return replace(made, problem=problem), found


@kept_jit
def log_likelihoods(problem: Innovations, points: Float[Array, "n q"]) -> Float[Array, " n"]:
    """Return the log-likelihood at physical values and logarithms of the noise, up to a constant."""
    p = problem.bounds[0].size

    def at(x: Array) -> Array:
        e, variance = problem.outputs(x[:p], x[p:])
        return -0.5 * jnp.sum(jnp.where(problem.counts, e**2 / variance + jnp.log(variance), 0.0))

    return jax.lax.map(at, points, batch_size=_LANES)
