"""Least squares on the host, between the bounds of unknowns, by a function that is compiled already."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.model.unknowns import Parameters

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
                latest[key] = (_finite(e), _finite(columns * slope))
        return latest[key]

    fit = scipy.optimize.least_squares(
        lambda x: both(x)[0],
        np.clip(np.asarray(transform.inward(jnp.asarray(start))), lower, upper),
        lambda x: both(x)[1],  # pyright: ignore[reportArgumentType] (SciPy's stubs know names of methods only)
        (lower, upper),
        x_scale="jac",
        ftol=1e-7,
        xtol=1e-7,
        gtol=1e-10,
        max_nfev=most,
    )
    return np.asarray(transform.outward(jnp.asarray(fit.x))), bool(fit.status > 0)


def _finite(x: np.ndarray) -> np.ndarray:
    """Replace diverged values by numbers so large that a solver turns back, yet small enough to square."""
    return np.clip(np.nan_to_num(x, nan=1e60), -1e60, 1e60)
