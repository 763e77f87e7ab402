"""Least squares over real bodies: of an affine residual, and of the distance from a fit without bodies."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.interior import inner_start
from jaxid.estimators.common.levenberg_marquardt import eliminated
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
# Part of the way back to the guess: the best bodies often have no extent some way, and rounding would leave
# none of them real.
_INWARD = 1e-8


def best_bodies(
    parameters: Parameters,
    columns: Float[np.ndarray, "rows p"],
    e: Float[np.ndarray, " rows"],
    theta: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Minimise a sum of squares over real bodies and the other unknowns.

    Unidentifiable directions of bodies stay near the guess. Another unknown that would pass a bound stays
    there.

    Args:
        parameters: The unknowns; the guesses of the links are real bodies.
        columns: Jacobian of the residual, (rows, p).
        e: Residual at theta, (rows,).
        theta: Values of the unknowns, (p,).

    Returns:
        The unknowns at the minimum, (p,), and whether they are finite. At the last weights of the interior
        point rounding may hide how near the minimum is, so that its bound is no test.
    """
    # The triangular factor gives the same sum of squares with about as many rows as unknowns.
    triangle = np.asarray(np.linalg.qr(np.column_stack([columns, e - columns @ theta]), mode="r"))
    root, rest = triangle[:, :-1], triangle[:, -1]
    places = tuple(body.places for body in parameters.bodies)
    within, (lower, upper) = parameters.in_bodies, parameters.bounds

    start, held = parameters.guess, np.zeros(len(theta), bool)
    while True:
        # An unknown without a column keeps its start.
        fixed = rest + root[:, held] @ start[held]
        best, _ = _interior(np.where(held, 0.0, root), fixed, start, places)
        found = np.asarray(best)
        out = ~within & ~held & ((found < lower) | (found > upper))
        if not out.any():
            break
        start, held = np.where(out, np.clip(found, lower, upper), start), held | out

    inward = np.where(within, found + _INWARD * (parameters.guess - found), found)
    return inward, bool(np.all(np.isfinite(inward)))


def nearest_bodies(
    parameters: Parameters, columns: Float[np.ndarray, "rows p"], theta: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " p"], bool]:
    """Find the values nearest to an estimate whose links are real bodies.

    The distance is that of least squares: what the sum of squares grows by. Directions that are not
    identified stay near the guess.

    Args:
        parameters: The unknowns; the guesses of the links are real bodies.
        columns: R, with R'R the information of the fit, (rows, p).
        theta: Estimate without the demand, (p,).

    Returns:
        The values, (p,), and whether they are finite.
    """
    size, effect = _sizes(parameters), np.any(columns != 0, axis=0)
    _, values, directions = np.linalg.svd(np.linalg.qr(columns * size, mode="r"), full_matrices=False)
    seen = values > _BLIND * values[0]
    # Rounding would multiply the huge value of an unknown without effect.
    root = np.where(effect, values[seen, None] * directions[seen] / size, 0.0)
    return best_bodies(parameters, root, np.zeros(len(root)), np.where(effect, theta, parameters.guess))


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
def _interior(
    columns: Array, rest: Array, start: Array, places: tuple[tuple[int, ...], ...]
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    return inner_start(columns, rest, start, places, eliminated)
