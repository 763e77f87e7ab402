"""Balances of a servo's joint at its rows in motion: what starts of a joint and of an arm's links share.

The error of the position, by the delay of the reference, is a sum of columns with factors that are not
negative.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxid.logs.log import Log

# Delays that are tried, if the delay is unknown [s].
DELAYS = np.arange(0.0, 0.205, 0.005)
# Part of the spread of the velocity from which a joint counts as moving.
_MOVING = 0.2


class Reduced(NamedTuple):
    """Columns and errors of many rows, in the coordinates of the columns' space.

    Args:
        columns: Triangular matrix of the columns, (m, m).
        errors: Error of the position by delay, (delays, m).
        rest: Squares that no value explains, by delay, (delays,).
    """

    columns: Float[np.ndarray, "m m"]
    errors: Float[np.ndarray, "delays m"]
    rest: Float[np.ndarray, " delays"]

    @classmethod
    def of(cls, columns: Float[np.ndarray, "rows m"], errors: Float[np.ndarray, "delays rows"]) -> Reduced:
        """Reduce columns and errors."""
        basis, triangle = np.linalg.qr(columns)
        inside = errors @ basis
        rest = np.sum(errors**2, axis=1) - np.sum(inside**2, axis=1)
        return cls(triangle, inside, np.maximum(rest, 0.0))


def rows_in_motion(log: Log, v: Float[np.ndarray, " rows"]) -> Bool[np.ndarray, " rows"]:
    """Return the mask of the rows in which a joint moves, after the longest delay.

    At rest the balance gives no more than an interval for dry friction.
    """
    return (np.abs(v) > _MOVING * np.std(v)) & (log.time > log.time[0] + DELAYS[-1])


def errors_by_delay(
    log: Log, column: int, q: Float[np.ndarray, " rows"], counts: Bool[np.ndarray, " rows"]
) -> Float[np.ndarray, "delays counted"]:
    """Return the error of the position at the rows that count, by delay of a column of the reference."""
    assert log.reference is not None, "checked by is_arm_of_servos"
    late = [np.interp(log.time[counts] - d, log.time, log.reference[:, column]) for d in DELAYS]
    return np.stack(late) - q[counts]


def fit_nonnegative(
    columns: Float[np.ndarray, "rows m"], error: Float[np.ndarray, " rows"]
) -> tuple[Float[np.ndarray, " m"], float]:
    """Fit an error by factors of columns that are not negative; return them and the norm of the rest."""
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    values, left = scipy.optimize.nnls(columns / size, error)
    return values / size, float(left)
