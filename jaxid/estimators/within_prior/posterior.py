"""Where guesses and log together say that the unknowns are, and how far off they may be.

Combinations that the log tells little better than the guesses do are not fitted, but where the guesses are
wrong they are seen in the residual all the same, and what is fitted leans to make up for them. In the end
each is therefore moved to where guess and log agree, and intervals are drawn from guess and log together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.within_prior.problem import DRAWN, Problem, RoundsResult, at_each, read
from jaxid.numerics.lanes import Steps

# Of damping: the first, by how much it changes, and where no step helps.
_DAMPED, _BY, _STALLED = 1e-3, 8.0, 100.0
# Steps of the way to the most probable point; it ends where one gains less than this [nats], and has settled
# where the next promises less than that.
_MOST_STEPS, _LEAST_GAIN, _NEAR = 25, 1e-3, 0.5
# Where a kink ends the way, points are drawn about it within these parts of what is as probable, and the way
# goes on from the best of them, so many times at most.
_ABOUT, _KINKS = (1.0, 0.5, 0.25, 0.125), 6
# Of the points drawn so many must simulate.
_COUNTING = 30
# Moves of each point whenever the log counts more, and when it counts in full; moves reach so far, over what
# the points scatter by and the root of the unknowns, and so many of them should be taken.
_MOVES, _LAST_MOVES = 6, 12
_REACH, _ACCEPTED = 2.38, 0.25
# Of a scatter that is none: of what ends at a bound.
_LEAST = 1e-12
# Halvings of the interval in which the next count of the log lies.
_HALVED = 40


def most_probable(
    problem: Problem,
    noise: float,
    w: Float[np.ndarray, " q"],
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
        # The guesses are rows below the log's. Squared, a steep log would swallow them.
        rows = np.concatenate([np.asarray(here.jacobian) @ across / noise, np.eye(across.shape[1])])
        left = np.concatenate([np.asarray(here.residual).ravel() / noise, across.T @ w])
        promised = 0.5 * float(np.sum((rows @ np.linalg.lstsq(rows, left)[0]) ** 2))
        if promised < _LEAST_GAIN or steps > _MOST_STEPS:
            break
        damped = np.concatenate([rows, np.sqrt(damping) * np.diag(np.linalg.norm(rows, axis=0))])
        step = -across @ np.linalg.lstsq(damped, np.concatenate([left, np.zeros(across.shape[1])]))[0]
        there = yield from read(problem, problem.ladder[-1], w + step)
        steps += 1
        lower = loss - loss_of(noise, there, w + step)
        if lower > 0.0:
            w, here, loss, gained, damping = w + step, there, loss - lower, lower, damping / _BY
        else:
            damping *= _BY
    return w, replace(here, theta=w, steps=np.asarray(steps)), bool(promised < _NEAR)


def past_kinks(
    problem: Problem, noise: float, w: Float[np.ndarray, " q"]
) -> Steps[tuple[Float[np.ndarray, " q"], Minimum, bool]]:
    """As `most_probable`, on from where that does not settle by the best of points drawn about it.

    Where friction begins to stick elsewhere the cost has kinks, and slopes lead over them nowhere. It has
    settled too where none of the points is more probable.
    """
    rng, steps = np.random.default_rng(0), 0
    for _ in range(_KINKS):
        w, here, settled = yield from most_probable(problem, noise, w)
        loss, steps = loss_of(noise, here, w), steps + int(here.steps)
        if settled or not np.isfinite(loss):
            break
        axes, left = _picture(np.asarray(here.jacobian) / noise)
        about = np.resize(_ABOUT, DRAWN)[:, None] * rng.standard_normal((DRAWN, w.size))
        points = w + (about * np.sqrt(left / w.size)) @ axes
        losses = (yield from _against(problem, points, noise)) + 0.5 * np.sum(points**2, axis=1)
        settled = bool(np.isfinite(losses.min()) and loss - losses.min() < _NEAR)
        if settled or not np.isfinite(losses.min()):
            break
        w = points[np.argmin(losses)]
    return here.theta, replace(here, steps=np.asarray(steps)), settled


def loss_of(noise: float, here: Minimum, w: Float[np.ndarray, " q"]) -> float:
    """Nats by which a point is less probable than a perfect fit at the guesses."""
    if not np.all(np.isfinite(here.jacobian)):
        return np.inf
    e = np.asarray(here.residual) / noise
    return 0.5 * float(e @ e) + 0.5 * float(w @ w)


def quadratic(found: RoundsResult, noise: float) -> Float[np.ndarray, "q q"]:
    """What `spread` draws, by the quadratic picture at the fit."""
    axes, left = _picture(np.asarray(found.minimum.jacobian) @ found.vectors.T / noise)
    return (axes.T * left) @ axes


def _picture(
    jacobian: Float[np.ndarray, "rows q"],
) -> tuple[Float[np.ndarray, "q q"], Float[np.ndarray, " q"]]:
    """Axes, as rows, and variances along them, of guesses and log; of the log's slopes over its noise."""
    _, told, axes = np.linalg.svd(np.linalg.qr(jacobian, mode="r"))
    left = np.ones(len(axes))
    left[: told.size] = 1.0 / (1.0 + told**2)
    return axes, left


def spread(
    found: RoundsResult, noise: float
) -> Steps[tuple[Float[np.ndarray, "q q"], Float[np.ndarray, " q"]]]:
    """Mean square about the fit of what is as probable, given guesses and log, in units of the prior.

    Points are drawn as the guesses say and led to the log by letting it count more and more. Where it ties
    combinations to one another narrowly, and not along a line, or leaves several valleys, points drawn about
    the fit by the quadratic picture would miss most of what is probable.

    Args:
        found: The fit, its minimum in the coordinates of all directions.
        noise: Standard deviation of its residual, white.

    Returns:
        The mean square, the quadratic picture's covariance where too few simulations are finite; and the most
        probable of the points, the fit among them.

    Source:
        Sequential Monte Carlo by tempering; Del Moral, Doucet and Jasra (2006), "Sequential Monte Carlo
        samplers".
    """
    rng, size = np.random.default_rng(0), len(found.vectors)
    best, least = found.point, loss_of(noise, found.minimum, found.point)
    w = rng.standard_normal((DRAWN, size))
    against = yield from _against(found.problem, w, noise)
    if np.sum(np.isfinite(against)) < _COUNTING:
        return quadratic(found, noise), best
    counts, reach, kept = 0.0, _REACH / np.sqrt(size), []
    while counts < 1.0:
        more = _more(against, 1.0 - counts)
        part = np.exp(-more * (against - against.min()))
        # Evenly: each point as often as its part says, less than one more or less.
        even = (np.arange(DRAWN) + rng.random()) / DRAWN
        chosen = np.minimum(np.searchsorted(np.cumsum(part) / part.sum(), even), DRAWN - 1)
        w, against, counts = w[chosen], against[chosen], min(counts + more, 1.0)
        narrow = np.linalg.cholesky(np.cov(w.T).reshape(size, size) + _LEAST * np.eye(size))
        for move in range(_MOVES if counts < 1.0 else _LAST_MOVES):
            there = w + reach * rng.standard_normal(w.shape) @ narrow.T
            then = yield from _against(found.problem, there, noise)
            better = counts * (against - then) + 0.5 * np.sum(w**2 - there**2, axis=1)
            goes = np.log(rng.random(DRAWN)) < better
            w, against = np.where(goes[:, None], there, w), np.where(goes, then, against)
            reach *= np.exp(np.mean(goes) - _ACCEPTED)
            if counts == 1.0 and move >= _MOVES:
                kept.append(w)
                loss = against + 0.5 * np.sum(w**2, axis=1)
                if loss.min() < least:
                    best, least = w[np.argmin(loss)], loss.min()
    off = np.concatenate(kept) - found.point
    return off.T @ off / len(off), best


def _more(against: Float[np.ndarray, " draws"], most: float) -> float:
    """By how much more the log may count until half of the points do not any more."""
    low, high = 0.0, most
    off = against - against.min()

    def counting(more: float) -> float:
        part = np.exp(-more * off)
        return part.sum() ** 2 / np.sum(part**2)

    if counting(most) >= 0.5 * DRAWN:
        return most
    for _ in range(_HALVED):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if counting(middle) >= 0.5 * DRAWN else (low, middle)
    return high


def _against(
    problem: Problem, w: Float[np.ndarray, "draws q"], noise: float
) -> Steps[Float[np.ndarray, " draws"]]:
    """Nats by which the log speaks against each point; infinite where its simulation is not finite."""
    e = yield from at_each(problem, w)
    with np.errstate(over="ignore", invalid="ignore"):
        nats = 0.5 * np.sum((e / noise) ** 2, axis=1)
    return np.where(np.isfinite(nats), nats, np.inf)
