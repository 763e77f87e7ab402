"""The full Hessian of a cost, and the covariance by it."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

from jaxid.arrays import Array


def hessian_covariance(
    normal: Float[np.ndarray, "p p"], meat: Float[np.ndarray, "p p"], hessian: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, "p p"] | None, Float[np.ndarray, " 2"]]:
    """Return the covariance by the full Hessian, widened by the colour of the residual.

    With V the directions in which normal matrix N and Hessian H are both diagonal, V' N V = 1 and
    V' H V = L, Gauss-Newton's covariance N^-1 M N^-1 is V (V' M V) V'. By the Hessian it is
    V L^(-1/2) (V' M V) L^(-1/2) V'. For white noise M is the variance times N, and this is the variance times
    H^-1, the inverse of the observed information.

    Args:
        normal: Gauss-Newton's matrix J'J, positive definite, (p, p).
        meat: Covariance J'RJ of the gradient, with R that of the residual, (p, p).
        hessian: Full Hessian of half the sum of squares, (p, p).

    Returns:
        The covariance, (p, p), None if the Hessian is not positive definite; and the smallest and the largest
        element of L, (2,).

    Source:
        Efron and Hinkley (1978), Biometrika 65, 457-482: the observed information, and not the expected one,
        gives the variance of an estimate that its own log supports.
    """
    ratio, directions = scipy.linalg.eigh(0.5 * (hessian + hessian.T), normal)
    curvature = np.array([ratio[0], ratio[-1]])
    if not ratio[0] > 0.0:
        return None, curvature
    curved = directions / np.sqrt(ratio)
    return curved @ (directions.T @ meat @ directions) @ curved.T, curvature


def profiled_out(
    hessian: Float[np.ndarray, "q q"], kept: Bool[np.ndarray, " q"]
) -> Float[np.ndarray, "p p"] | None:
    """Return the Hessian of a cost that is minimised over all unknowns but the kept ones, (p, p).

    It is the Schur complement of the block of the others. With that block positive definite, it is positive
    definite if and only if the whole Hessian is.

    Args:
        hessian: Hessian over all unknowns at a minimum, (q, q).
        kept: Mask of the p kept unknowns, (q,).

    Returns:
        The Hessian; None if the block of the others is not positive definite, or a number is not finite.
    """
    if not np.all(np.isfinite(hessian)):
        return None
    own, others, between = (hessian[np.ix_(a, b)] for a, b in ((kept, kept), (~kept, ~kept), (~kept, kept)))
    if not others.size:
        return own
    try:
        half = scipy.linalg.solve_triangular(np.linalg.cholesky(others), between, lower=True)
    except np.linalg.LinAlgError:
        return None
    return own - half.T @ half


def full_hessian(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]], theta: Float[Array, " p"]
) -> Float[Array, "p p"]:
    """Return the Hessian of half the sum of squares, with the curvature of the residual."""

    def gradient(theta: Array) -> Array:
        e, push = jax.linearize(residual, theta)
        return jax.vmap(lambda b: jnp.vdot(push(b), e))(jnp.eye(theta.size))

    return jax.jacfwd(gradient)(theta)
