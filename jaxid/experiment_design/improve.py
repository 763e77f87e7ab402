"""Improve the shape of a signal by gradient descent with a fixed number of evaluations."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
import scipy.optimize


def improved(
    both: Callable[[np.ndarray], tuple[float, np.ndarray]],
    start: np.ndarray,
    first: tuple[float, np.ndarray],
    evaluations: int,
) -> tuple[float, np.ndarray]:
    """Minimise a function by L-BFGS-B and return the least value that was evaluated, and its point.

    Args:
        both: Function that returns value and gradient.
        start: Point to start from.
        first: Value and gradient at the start.
        evaluations: Largest number of further evaluations.
    """
    evaluated = [(first[0], start.copy())]

    def counted(p: np.ndarray) -> tuple[float, np.ndarray]:
        if np.array_equal(p, start):
            return first
        if len(evaluated) > evaluations:
            raise _Spent
        value, slope = both(p)
        evaluated.append((value, p.copy()))
        return value, slope

    # The solver's limit is checked between line searches only, and one takes up to twenty evaluations.
    with contextlib.suppress(_Spent):
        scipy.optimize.minimize(counted, start, jac=True, method="L-BFGS-B")
    return min(evaluated, key=lambda e: e[0])


class _Spent(Exception):
    """Raised when all evaluations are spent."""
