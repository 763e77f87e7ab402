"""Where guesses and log together say that the unknowns are, and how far off they may be.

Combinations that the log tells little better than the guesses do are not fitted, but where the guesses are
wrong they are seen in the residual all the same, and what is fitted leans to make up for them. In the end
each is therefore moved to where guess and log agree, and intervals are drawn from guess and log together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.estimators.directions_problem import DRAWN, Found, Problem, at_each, read
from jaxid.estimators.least_squares import Minimum
from jaxid.estimators.steps import Steps

# Of damping: the first, by how much it changes, and where no step helps.
_DAMPED, _BY, _STALLED = 1e-3, 8.0, 100.0
# Steps of the way to the most probable point; it ends where one gains less than this [nats], and has settled
# where the next promises less than that.
_MOST_STEPS, _LEAST_GAIN, _NEAR = 25, 1e-3, 0.5
# Of the points drawn so many must count.
_COUNTING = 30
# Degrees of freedom of what they are drawn from: its tails are fatter than a normal's.
_FREEDOM = 7


def most_probable(
    problem: Problem, noise: float, w: Float[np.ndarray, " q"],
    held: Float[np.ndarray, " q"] | None = None,
) -> Steps[tuple[Float[np.ndarray, " q"], Minimum, bool]]:
    """Down to the most probable point, the guesses counted in.

    Args:
        problem: What is compared.
        noise: Standard deviation of its residual, white.
        w: Where to begin, in units of the prior.
        held: A direction, of length one, along which nothing moves.

    Returns:
        The point, the minimum there (its Jacobian in all coordinates, its steps those of the way), and
        whether it settled.
    """
    across = np.eye(w.size)
    if held is not None:
        across = np.linalg.svd(held[None, :])[2][1:].T
    here = yield from read(problem, problem.ladder[-1], w)
    loss, damping, steps, gained, promised = loss_of(noise, here, w), _DAMPED, 1, np.inf, np.inf
    # At a kink of the cost no step keeps its promise.
    while np.isfinite(loss) and gained > _LEAST_GAIN and damping < _STALLED:
        jacobian = np.asarray(here.jacobian) @ across / noise
        slope = jacobian.T @ (np.asarray(here.residual) / noise) + across.T @ w
        curvature = jacobian.T @ jacobian + np.eye(len(slope))
        promised = 0.5 * slope @ np.linalg.solve(curvature, slope)
        if promised < _LEAST_GAIN or steps > _MOST_STEPS:
            break
        damped = curvature + damping * np.diag(np.diag(curvature))
        step = -across @ np.linalg.solve(damped, slope)
        there = yield from read(problem, problem.ladder[-1], w + step)
        steps += 1
        lower = loss - loss_of(noise, there, w + step)
        if lower > 0.0:
            w, here, loss, gained, damping = w + step, there, loss - lower, lower, damping / _BY
        else:
            damping *= _BY
    return w, replace(here, theta=w, steps=np.asarray(steps)), bool(promised < _NEAR)


def loss_of(noise: float, here: Minimum, w: Float[np.ndarray, " q"]) -> float:
    """Nats by which a point is less probable than a perfect fit at the guesses."""
    if not np.all(np.isfinite(here.jacobian)):
        return np.inf
    e = np.asarray(here.residual) / noise
    return 0.5 * float(e @ e) + 0.5 * float(w @ w)


def spread(found: Found, noise: float) -> Steps[Float[np.ndarray, "q q"]]:
    """Mean square about the fit of what is as probable, given guesses and log, in units of the prior.

    What is held is drawn first, then what is fitted around the point to which it makes up for that: where the
    log ties the one to the other narrowly, and not along a line, points drawn at once would miss.

    Args:
        found: The fit, its minimum in the coordinates of all directions.
        noise: Standard deviation of its residual, white.

    Returns:
        The mean square; the quadratic picture's covariance where too few of the points drawn count.

    Source:
        Importance sampling, self-normalised; Owen, "Monte Carlo theory, methods and examples", chapter 9.
    """
    r, rng = found.count, np.random.default_rng(0)
    jacobian = np.asarray(found.minimum.jacobian) / noise
    quadratic = np.linalg.inv(jacobian.T @ jacobian + np.eye(len(found.vectors)))
    best = np.asarray(found.minimum.theta)
    z = np.tile(best, (DRAWN, 1))
    nats = np.zeros(DRAWN)
    for part in (slice(r, None), slice(0, r)):
        if part.stop:
            # A step of Gauss and Newton from the fit, with what is held elsewhere.
            e = yield from _drawn(found, z, noise)
            slope = e @ jacobian[:, part] + z[:, part]
            inner = np.linalg.inv(jacobian[:, part].T @ jacobian[:, part] + np.eye(r))
            z[:, part] -= slope @ inner
        else:
            inner = quadratic[part, part]
        size = len(inner)
        if not size:
            continue
        x = rng.standard_normal((DRAWN, size))
        x *= np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, (DRAWN, 1)))
        z[:, part] += x @ np.linalg.cholesky(inner).T
        nats += 0.5 * (_FREEDOM + size) * np.log1p(np.sum(x**2, axis=1) / _FREEDOM)
    e = yield from _drawn(found, z, noise)
    nats += -0.5 * np.sum(e**2, axis=1) - 0.5 * np.sum(z**2, axis=1)
    nats = np.where(np.isfinite(nats), nats, -np.inf)
    whole = quadratic
    if np.any(np.isfinite(nats)):
        weight = np.exp(nats - np.max(nats))
        weight /= weight.sum()
        off = np.where(weight[:, None] > 0.0, z - best, 0.0)
        if 1.0 / np.sum(weight**2) >= _COUNTING:
            whole = (off * weight[:, None]).T @ off
    return found.vectors @ whole @ found.vectors.T


def _drawn(
    found: Found, z: Float[np.ndarray, "draws q"], noise: float
) -> Steps[Float[np.ndarray, "draws rows"]]:
    """Residuals over the noise at some coordinates along the directions."""
    # Where nothing is finite nothing is asked for.
    w = np.where(np.isfinite(z), z, 0.0) @ found.vectors.T
    e = np.asarray((yield at_each(found.problem, w))).reshape(len(z), -1)
    return e / noise
