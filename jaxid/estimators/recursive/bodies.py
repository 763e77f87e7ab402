"""Real bodies nearest to the last estimate of a recursion, which goes sample by sample without them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.interior import inner_start
from jaxid.estimators.common.levenberg_marquardt import eliminated
from jaxid.machine import Machine
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps


def nearest_bodies(
    machine: Machine, root: Float[np.ndarray, "p p"], theta: Float[np.ndarray, " p"]
) -> Steps[Float[np.ndarray, " p"]]:
    """Find the values nearest to an estimate whose links are real bodies.

    The distance is that of least squares: what the sum of squares over the log grows by.

    Args:
        machine: The machine; the guesses of its links are real bodies.
        root: S, with S S' the covariance of the estimate for rows of unit noise, (p, p).
        theta: The estimate, (p,).

    Returns:
        The values, (p,).
    """
    # Unknowns that the log does not determine begin at the guess, and stay near it.
    columns = np.linalg.solve(root, np.eye(len(theta)))
    places = tuple(body.places for body in machine.parameters.bodies)
    arguments = (columns, -columns @ theta, machine.parameters.guess, places)
    return np.asarray((yield SolveRequest(_nearest, arguments)))


@kept_jit
def _nearest(
    columns: Array, rest: Array, start: Array, places: tuple[tuple[int, ...], ...]
) -> Float[Array, " p"]:
    return inner_start(columns, rest, start, places, eliminated)[0]
