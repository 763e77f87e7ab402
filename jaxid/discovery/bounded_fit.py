"""Least squares on the host, between the bounds of unknowns, by a function that is compiled already."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.model.unknowns import Parameters

# Largest logarithm of an unknown at the start and at the end: one that makes no difference any more grows
# without end, and has no derivative at infinity.
_FARTHEST = 300.0
# Part of the largest column up to which one counts as zero. The solver scales each column to one: the trust
# region of an unknown without effect would be all that there is.
_NOTHING = 1e-30

Rows = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def bounded_fit(
    unknowns: Parameters, start: Float[np.ndarray, " k"], rows: Rows, *, most: int
) -> tuple[Float[np.ndarray, " k"], bool]:
    """Fit unknowns by least squares.

    Args:
        unknowns: The unknowns, with signs and bounds.
        start: Their values at the start.
        rows: Function of their values that returns the residual, (rows,), and its derivatives, (rows, k).
        most: Largest number of evaluations.

    Returns:
        Their values, and whether the solver converged.
    """
    transform = Transform.of(unknowns)
    lower, upper = (np.asarray(transform.inward(b)) for b in unknowns.bounds)
    farthest = np.where(transform.log, _FARTHEST, np.inf)
    begin = np.clip(np.asarray(transform.inward(jnp.asarray(start))), -farthest, farthest)
    latest: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    # The solver asks for residual and Jacobian at the same point one after the other.
    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        key = x.tobytes()
        if key not in latest:
            latest.clear()
            values = np.asarray(transform.outward(jnp.asarray(x)))
            e, columns = rows(values)
            slope = np.asarray(transform.slope(jnp.asarray(values)))
            with np.errstate(invalid="ignore", over="ignore"):  # diverged values are made finite below
                latest[key] = (_finite(e), _counted(_finite(columns * slope)))
        return latest[key]

    fit = scipy.optimize.least_squares(
        lambda x: both(x)[0],
        np.clip(begin, lower, upper),
        lambda x: both(x)[1],  # pyright: ignore[reportArgumentType] (SciPy's stubs know names of methods only)
        (lower, upper),
        x_scale="jac",
        ftol=1e-7,
        xtol=1e-7,
        gtol=1e-10,
        max_nfev=most,
    )
    end = np.clip(fit.x, -farthest, farthest)
    return np.asarray(transform.outward(jnp.asarray(end))), bool(fit.status > 0)


def _finite(x: np.ndarray) -> np.ndarray:
    """Replace diverged values by numbers so large that a solver turns back, yet small enough to square."""
    return np.clip(np.nan_to_num(x, nan=1e60), -1e60, 1e60)


def _counted(columns: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, "rows k"]:
    """Set columns to zero that are nothing beside the largest."""
    size = np.linalg.norm(columns, axis=0)
    return np.where(size > _NOTHING * size.max(initial=0.0), columns, 0.0)
