"""Least squares of a residual that is affine in the parameters of real bodies, from its triangular factor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.model.unknowns import Parameters
from jaxid.numerics.kept import kept_jit


def best_bodies(
    parameters: Parameters,
    columns: Float[np.ndarray, "rows p"],
    e: Float[np.ndarray, " rows"],
    theta: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Minimise a sum of squares over real bodies and the other unknowns.

    Unidentifiable directions of bodies stay near the guess.

    Args:
        parameters: The unknowns; the guesses of the links are real bodies.
        columns: Jacobian of the residual, (rows, p).
        e: Residual at theta, (rows,).
        theta: Values of the unknowns, (p,).

    Returns:
        The unknowns at the minimum, (p,), and whether the search for it has converged.
    """
    # The triangular factor gives the same sum of squares with about as many rows as unknowns.
    triangle = np.asarray(np.linalg.qr(np.column_stack([columns, e - columns @ theta]), mode="r"))
    found = _best_bodies(triangle, Transform.of(parameters), parameters.guess, parameters.bounds)
    return np.asarray(found.theta), bool(found.converged)


@kept_jit
def _best_bodies(triangle: Array, transform: Transform, guess: Array, bounds: tuple[Array, Array]) -> Minimum:
    linear = replace(transform, log=np.zeros(guess.size, bool), affine=True)
    residual = lambda theta: triangle[:, :-1] @ theta + triangle[:, -1]
    return levenberg_marquardt(residual, guess, linear, *bounds)
