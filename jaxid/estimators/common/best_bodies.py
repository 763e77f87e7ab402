"""Least squares over real bodies: of an affine residual, and of the distance from a fit without bodies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.model.unknowns import Parameters
from jaxid.numerics.kept import kept_jit

# Note of a fit without the demand that ends at the nearest real bodies.
NEAREST = (
    "the links are those of the real bodies nearest to the fit without this demand, in the metric of the "
    "fit's information"
)
# Singular value of the scaled information's root, relative to the largest, below which a direction is not
# identified: its value, which may be huge, does not count.
_BLIND = 1e-10


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


def nearest_bodies(
    parameters: Parameters,
    columns: Float[np.ndarray, "rows p"],
    theta: Float[np.ndarray, " p"],
    rest: float = 0.0,
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Find the values nearest to an estimate whose links are real bodies.

    The distance is that of least squares: what the sum of squares grows by. Directions that are not
    identified stay near the guess.

    Args:
        parameters: The unknowns; the guesses of the links are real bodies.
        columns: R, with R'R the information of the fit, (rows, p).
        theta: Estimate without the demand, (p,).
        rest: 2-norm of the residual at the estimate, which says how small a distance is negligible.

    Returns:
        The values, (p,), and whether the search for them has converged.
    """
    size = _sizes(parameters)
    _, values, directions = np.linalg.svd(np.linalg.qr(columns * size, mode="r"), full_matrices=False)
    seen = values > _BLIND * values[0]
    root = values[seen, None] * directions[seen] / size
    root, e = np.vstack([root, np.zeros(len(theta))]), np.append(np.zeros(len(root)), rest)
    found, converged = best_bodies(parameters, root, e, theta)

    # Where another unknown ends at a bound, the bodies are found again with it there: an unknown without
    # effect keeps its guess.
    lower, upper = parameters.bounds
    held = ~parameters.in_bodies & ((found <= lower) | (found >= upper))
    if not held.any():
        return found, converged
    moved, guess = np.where(held, found, theta), np.where(held, found, parameters.guess)
    e = e + root[:, held] @ (found - theta)[held]
    return best_bodies(parameters.with_guess(guess.tolist()), np.where(held, 0.0, root), e, moved)


def _sizes(parameters: Parameters) -> Float[np.ndarray, " p"]:
    """Return natural sizes of the unknowns by their guesses, of which those of a body may be zero in part."""
    guess = parameters.guess
    size = np.where(guess != 0, np.abs(guess), 1.0)
    for body in parameters.bodies:
        ten = np.abs(guess[list(body.places)])
        mass, inertia = ten[0], ten[4:].max()
        size[list(body.places)] = np.repeat([mass, np.sqrt(mass * inertia), inertia], [1, 3, 6])
    return size


@kept_jit
def _best_bodies(triangle: Array, transform: Transform, guess: Array, bounds: tuple[Array, Array]) -> Minimum:
    linear = replace(transform, log=np.zeros(guess.size, bool), affine=True)
    residual = lambda theta: triangle[:, :-1] @ theta + triangle[:, -1]
    return levenberg_marquardt(residual, guess, linear, *bounds)
