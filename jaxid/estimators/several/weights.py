"""Weights of logs that are fitted together: one over the variance of the noise that each shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.estimators.several.descent import Descent
from jaxid.numerics.lanes import Steps
from jaxid.numerics.rows import Rows

T = TypeVar("T")
# Rounds of fit and weights, and the relative change of all weights at which they end.
_ROUNDS, _SETTLED = 8, 0.02
# Probability with which chance alone makes logs contradict each other.
_CONTRARY = 1e-6
# Least variance of a log's noise, as a part of the mean square of its signal: a log without noise would else
# count alone, by its rounding.
_LEAST = 1e-18


def start_weights(signals: Sequence[float], samples: Sequence[int]) -> Float[np.ndarray, " logs"]:
    """Return the first weights, of which every log has the same for the mean square of its signal.

    Args:
        signals: 2-norm of the measured signal of each log.
        samples: Number of samples of each log that count.
    """
    squares = np.square(np.asarray(signals)) / np.maximum(np.asarray(samples), 1)
    return 1.0 / np.where(squares > 0, squares, 1.0)


def noise_weights(logs: Sequence[Rows]) -> Float[np.ndarray, " logs"]:
    """Return one over the variance of each log's residual, its colour counted by what it costs."""
    least = [_LEAST * log.signal**2 / max(int(log.counts.sum()), 1) for log in logs]
    variance = [log.equivalent_variance() for log in logs]
    return 1.0 / np.maximum(np.maximum(variance, least), 1e-300)


def weighted_steps(
    fit: Callable[[np.ndarray, np.ndarray], Steps[T]],
    rows: Callable[[T], list[Rows] | None],
    values: Callable[[T], np.ndarray],
    x: Float[np.ndarray, " q"],
    weights: Float[np.ndarray, " logs"],
) -> Steps[tuple[T, Float[np.ndarray, " logs"]]]:
    """Fit in turn the unknowns with given weights, and the weights from the residuals.

    Args:
        fit: Function that fits from a start with weights.
        rows: Function that returns the residuals of all logs at the end of a fit; None if it failed.
        values: Function that returns the values at which a fit ended, where the next one starts.
        x: Start.
        weights: First weights; that of a single log stays.

    Source:
        Aitken (1936), Proc. Roy. Soc. Edinburgh 55, for the weights; Oberhofer and Kmenta (1974),
        Econometrica 42, 579-590, for their iteration, which maximises the likelihood.
    """
    found = yield from fit(x, weights)
    for _ in range(_ROUNDS if len(weights) > 1 else 0):
        logs = rows(found)
        if logs is None:
            break
        new = noise_weights(logs)
        settled = np.all(np.abs(np.log(new / weights)) < _SETTLED)
        weights = new
        found = yield from fit(values(found), weights)
        if settled:
            break
    return found, weights


def descended_steps(
    fit: Callable[[np.ndarray, np.ndarray], Steps[Descent]],
    x: Float[np.ndarray, " q"],
    weights: Float[np.ndarray, " logs"],
) -> Steps[tuple[Descent, Float[np.ndarray, " logs"]]]:
    """Run `weighted_steps` on descents, whose models hold the residuals of the logs."""
    rows = lambda end: end.model.content if end.model.finite else None
    return (yield from weighted_steps(fit, rows, lambda end: end.x, x, weights))


def disagreement(logs: Sequence[Rows], unknowns: int) -> list[str]:
    """Return a note if no one set of unknowns explains all logs; empty if one does.

    Each log's residual at the common fit is compared with that of a fit of its own. The difference over the
    variance of its noise is distributed as chi-squared if the logs agree.

    Args:
        logs: Residuals at the common fit, (time, n) each, with their Jacobians.
        unknowns: Number of directions that the common fit determines.

    Source:
        Chow (1960), Econometrica 28, 591-605, with a variance for each log.
    """
    total, freedom, worst = 0.0, -unknowns, 0
    parts = []
    for log in logs:
        left, fitted = log.of_one_fit()
        more = float(np.sum(np.where(log.counts, log.residual**2 - left**2, 0.0)))
        parts.append(more / max(log.equivalent_variance(), 1e-300))
        total, freedom = total + parts[-1], freedom + fitted
    if freedom < 1 or scipy.stats.chi2.sf(total, freedom) > _CONTRARY:
        return []
    worst = int(np.argmax(parts)) + 1
    return [
        f"the logs contradict each other: no one set of values explains them all (chi-squared {total:.3g} "
        f"with {freedom} degrees of freedom, most of it in log {worst} of {len(logs)}); state what differs "
        "by set in [[fit]], or by per_log in [identification]"
    ]
