"""Posterior of the unknowns: its maximum, by Levenberg-Marquardt, and its width, by tempering.

Directions that the log identifies little better than the prior are not fitted in the subspace. If their
guesses are wrong, they still show in the residual, and the fitted directions are biased to make up for them.
The fit is therefore moved to the maximum a posteriori in all directions, and standard deviations are those
of the posterior.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.within_prior.evaluations import DRAWS, linearise, residuals_at
from jaxid.estimators.within_prior.problem import Problem
from jaxid.estimators.within_prior.subspace import SubspaceFit
from jaxid.numerics.lanes import Steps

# Levenberg-Marquardt damping: the first value, the factor by which it changes, and the value at which no
# step helps any more.
_DAMPING, _FACTOR, _STALLED = 1e-3, 8.0, 100.0
# Evaluations of a descent at most; the decrease of the negative log-posterior below which it stops [nats];
# and the predicted decrease below which it has converged [nats].
_MAX_EVALUATIONS, _LEAST_GAIN, _CONVERGED = 25, 1e-3, 0.5
# At a kink, points are drawn with these multiples of the posterior's standard deviations, and the descent
# restarts from the best of them; so many descents at most.
_SCALES, _DESCENTS = (1.0, 0.5, 0.25, 0.125), 6
# Least number of points drawn from the prior whose simulation is finite.
_LEAST_FINITE = 30
# Metropolis moves of each point at every tempering step, and at full weight of the likelihood.
_MOVES, _LAST_MOVES = 6, 12
# Width of a move over the scatter of the points and the square root of the number of unknowns; and the
# acceptance rate at which that width is held.
_WIDTH, _ACCEPTANCE = 2.38, 0.25
# Variance added to the scatter of the points, which is zero along an unknown at its bound.
_JITTER = 1e-12
# Bisections of the interval that holds the next tempering step.
_BISECTIONS = 40


def maximum_a_posteriori(
    problem: Problem,
    noise: float,
    w: Float[np.ndarray, " q"],
    held: Float[np.ndarray, " q"] | None = None,
) -> Steps[tuple[Float[np.ndarray, " q"], Minimum, bool]]:
    """Descend to the maximum a posteriori by Levenberg-Marquardt.

    Args:
        problem: The problem to fit.
        noise: Standard deviation of its residual, taken as white.
        w: Start in whitened coordinates, (q,).
        held: Unit vector along which nothing moves, (q,); absent: all directions move.

    Returns:
        The point; the minimum there, with the Jacobian in all coordinates and the number of evaluations as
        its steps; and whether the descent converged.
    """
    across = np.eye(w.size)
    if held is not None:
        across = np.linalg.svd(held[None, :])[2][1:].T

    here = yield from linearise(problem, problem.sharpnesses[-1], w)
    loss, damping, steps = negative_log_posterior(noise, here, w), _DAMPING, 1
    gained, predicted = np.inf, np.inf
    # At a kink of the cost no step achieves its predicted decrease.
    while np.isfinite(loss) and gained > _LEAST_GAIN and damping < _STALLED:
        # The prior adds rows below those of the log. In the normal matrix, the square of a steep Jacobian
        # would swallow them.
        rows = np.concatenate([np.asarray(here.jacobian) @ across / noise, np.eye(across.shape[1])])
        target = np.concatenate([np.asarray(here.residual).ravel() / noise, across.T @ w])
        predicted = 0.5 * float(np.sum((rows @ np.linalg.lstsq(rows, target)[0]) ** 2))
        if predicted < _LEAST_GAIN or steps > _MAX_EVALUATIONS:
            break

        damped = np.concatenate([rows, np.sqrt(damping) * np.diag(np.linalg.norm(rows, axis=0))])
        step = -across @ np.linalg.lstsq(damped, np.concatenate([target, np.zeros(across.shape[1])]))[0]
        there = yield from linearise(problem, problem.sharpnesses[-1], w + step)
        steps += 1
        lower = loss - negative_log_posterior(noise, there, w + step)
        if lower > 0.0:
            w, here, loss, gained, damping = w + step, there, loss - lower, lower, damping / _FACTOR
        else:
            damping *= _FACTOR
    return w, replace(here, theta=w, steps=np.asarray(steps)), bool(predicted < _CONVERGED)


def restarted_maximum_a_posteriori(
    problem: Problem, noise: float, w: Float[np.ndarray, " q"]
) -> Steps[tuple[Float[np.ndarray, " q"], Minimum, bool]]:
    """Descend like `maximum_a_posteriori`, and restart from random points if it stalls at a kink.

    The cost has kinks at values for which friction begins to stick at another time, and gradients do not
    lead across them. The descent has also converged if none of the random points is more probable.

    Args:
        problem: The problem to fit.
        noise: Standard deviation of its residual, taken as white.
        w: Start in whitened coordinates, (q,).

    Returns:
        The same as `maximum_a_posteriori`; the steps are those of all descents.
    """
    rng, steps = np.random.default_rng(0), 0
    here, settled = None, False
    for _ in range(_DESCENTS):
        w, here, settled = yield from maximum_a_posteriori(problem, noise, w)
        loss, steps = negative_log_posterior(noise, here, w), steps + int(here.steps)
        if settled or not np.isfinite(loss):
            break

        axes, variances = _laplace_axes(np.asarray(here.jacobian) / noise)
        about = np.resize(_SCALES, DRAWS)[:, None] * rng.standard_normal((DRAWS, w.size))
        points = w + (about * np.sqrt(variances / w.size)) @ axes
        nats = yield from _negative_log_likelihoods(problem, points, noise)
        losses = nats + 0.5 * np.sum(points**2, axis=1)
        settled = bool(np.isfinite(losses.min()) and loss - losses.min() < _CONVERGED)
        if settled or not np.isfinite(losses.min()):
            break
        w = points[np.argmin(losses)]
    assert here is not None, "there is at least one descent"
    return np.asarray(here.theta), replace(here, steps=np.asarray(steps)), settled


def negative_log_posterior(noise: float, here: Minimum, w: Float[np.ndarray, " q"]) -> float:
    """Return the negative log-posterior, relative to a perfect fit at the guesses [nats]."""
    if not np.all(np.isfinite(here.jacobian)):
        return np.inf
    e = np.asarray(here.residual) / noise
    return 0.5 * float(e @ e) + 0.5 * float(w @ w)


def laplace_covariance(fit: SubspaceFit, noise: float) -> Float[np.ndarray, "q q"]:
    """Return the posterior covariance in whitened coordinates by Laplace's approximation at the fit.

    Args:
        fit: The fit, its minimum in the coordinates of all directions.
        noise: Standard deviation of its residual, taken as white.
    """
    axes, variances = _laplace_axes(np.asarray(fit.minimum.jacobian) @ fit.vectors.T / noise)
    return (axes.T * variances) @ axes


def _laplace_axes(
    jacobian: Float[np.ndarray, "rows q"],
) -> tuple[Float[np.ndarray, "q q"], Float[np.ndarray, " q"]]:
    """Return the principal axes of the posterior, as rows, and the variances along them.

    Args:
        jacobian: Jacobian of the residual in whitened coordinates over the noise.
    """
    _, values, axes = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    variances = np.ones(len(axes))
    variances[: values.size] = 1.0 / (1.0 + values**2)
    return axes, variances


def posterior_second_moment(
    fit: SubspaceFit, noise: float
) -> Steps[tuple[Float[np.ndarray, "q q"], Float[np.ndarray, " q"]]]:
    """Sample the posterior by tempering and return its second moment about the fit.

    Points are drawn from the prior, and the weight of the likelihood rises from zero to one. If the log
    ties combinations to one another narrowly along a curve, or leaves several local minima, points drawn
    about the fit by Laplace's approximation would miss most of the posterior.

    Args:
        fit: The fit, its minimum in the coordinates of all directions.
        noise: Standard deviation of its residual, taken as white.

    Returns:
        The second moment in whitened coordinates, or Laplace's covariance if too few simulations are
        finite; and the most probable point, the fit among them.

    Source:
        Sequential Monte Carlo by tempering; Del Moral, Doucet and Jasra (2006), "Sequential Monte Carlo
        samplers".
    """
    rng, size = np.random.default_rng(0), len(fit.vectors)
    best, least = fit.point, negative_log_posterior(noise, fit.minimum, fit.point)
    w = rng.standard_normal((DRAWS, size))
    nats = yield from _negative_log_likelihoods(fit.problem, w, noise)
    if np.sum(np.isfinite(nats)) < _LEAST_FINITE:
        return laplace_covariance(fit, noise), best

    exponent, width, kept = 0.0, _WIDTH / np.sqrt(size), []
    while exponent < 1.0:
        step = _tempering_step(nats, 1.0 - exponent)
        weights = np.exp(-step * (nats - nats.min()))
        # Systematic resampling: each point as often as its weight says, rounded up or down.
        even = (np.arange(DRAWS) + rng.random()) / DRAWS
        chosen = np.minimum(np.searchsorted(np.cumsum(weights) / weights.sum(), even), DRAWS - 1)
        w, nats, exponent = w[chosen], nats[chosen], min(exponent + step, 1.0)

        # Random-walk Metropolis moves, scaled by the scatter of the points.
        factor = np.linalg.cholesky(np.cov(w.T).reshape(size, size) + _JITTER * np.eye(size))
        for move in range(_MOVES if exponent < 1.0 else _LAST_MOVES):
            proposed = w + width * rng.standard_normal(w.shape) @ factor.T
            proposed_nats = yield from _negative_log_likelihoods(fit.problem, proposed, noise)
            log_ratio = exponent * (nats - proposed_nats) + 0.5 * np.sum(w**2 - proposed**2, axis=1)
            accepted = np.log(rng.random(DRAWS)) < log_ratio
            w = np.where(accepted[:, None], proposed, w)
            nats = np.where(accepted, proposed_nats, nats)
            width *= np.exp(np.mean(accepted) - _ACCEPTANCE)

            if exponent == 1.0 and move >= _MOVES:
                kept.append(w)
                loss = nats + 0.5 * np.sum(w**2, axis=1)
                if loss.min() < least:
                    best, least = w[np.argmin(loss)], loss.min()
    off = np.concatenate(kept) - fit.point
    return off.T @ off / len(off), best


def _tempering_step(nats: Float[np.ndarray, " draws"], most: float) -> float:
    """Return the largest tempering step that keeps the effective sample size above one half of the points.

    Args:
        nats: Negative log-likelihood of each point.
        most: Largest step, to the full weight of the likelihood.
    """
    low, high = 0.0, most
    off = nats - nats.min()

    def effective_sample_size(step: float) -> float:
        weights = np.exp(-step * off)
        return weights.sum() ** 2 / np.sum(weights**2)

    if effective_sample_size(most) >= 0.5 * DRAWS:
        return most
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if effective_sample_size(middle) >= 0.5 * DRAWS else (low, middle)
    return high


def _negative_log_likelihoods(
    problem: Problem, w: Float[np.ndarray, "draws q"], noise: float
) -> Steps[Float[np.ndarray, " draws"]]:
    """Return the negative log-likelihood of each point, infinite if its simulation is not finite [nats]."""
    e = yield from residuals_at(problem, w)
    with np.errstate(over="ignore", invalid="ignore"):
        nats = 0.5 * np.sum((e / noise) ** 2, axis=1)
    return np.where(np.isfinite(nats), nats, np.inf)
