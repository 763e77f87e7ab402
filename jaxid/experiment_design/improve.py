"""Improve the shape of a signal by a search without derivatives."""

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
    """The least value that so many evaluations beside the first find, and where."""
    seen = [(first[0], start.copy())]

    def counted(p: np.ndarray) -> tuple[float, np.ndarray]:
        if np.array_equal(p, start):
            return first
        if len(seen) > evaluations:
            raise _Spent
        value, slope = both(p)
        seen.append((value, p.copy()))
        return value, slope

    # The solver's own limit holds between line searches only, and one takes up to twenty.
    with contextlib.suppress(_Spent):
        scipy.optimize.minimize(counted, start, jac=True, method="L-BFGS-B")
    return min(seen, key=lambda found: found[0])


class _Spent(Exception):
    """The evaluations that may be spent are spent."""
