"""Least squares with physically consistent bodies and an affine residual, by an interior-point method."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.pseudo_inertia import log_cholesky, pseudo_inertia
from jaxid.arrays import Array

# Number of weights of the barrier, each with two Newton steps, and ratio of the last to the first.
_WEIGHTS, _LAST = 112, 1e-14
# Largest decrement of the last Newton step, in units of the weight, for a point near the central path.
_ON_PATH = 0.25
# A point counts as feasible if one farther from the start by this part is a body too: rounding is smaller.
_MARGIN = 1e-12


def inner_start(
    columns: Float[Array, "rows p"],
    rest: Float[Array, " rows"],
    theta: Float[Array, " p"],
    bodies: tuple[tuple[int, ...], ...],
    solve: Callable[[Array, Array], Array],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Minimise the sum of squares of columns @ theta + rest over bodies with positive pseudo-inertia P.

    A barrier, minus the logarithms of the determinants of P, times a decreasing weight, keeps the bodies
    feasible. Damped Newton steps leave the feasible set by rounding only; such a step is refused. With the
    trace the barrier is the divergence tr(P0^-1 P) - log det(P0^-1 P) from the start P0, which is smallest at
    the start: unidentifiable directions end at the bodies nearest to it. Without the trace, unidentifiable
    masses would diverge, and the steps would leave the central path.

    Args:
        columns, rest: Matrix (rows, p) and constant (rows,) of the affine residual.
        theta: Start, (p,), with positive definite pseudo-inertias.
        bodies: Places of the ten parameters of each body.
        solve: Solver of a symmetric positive definite system with arguments (p, p) and (p, k).

    Returns:
        The minimum, and a lower bound of half the sum of squares; minus infinity if the bound is not certain.

    Source:
        Boyd & Vandenberghe (2004), Convex Optimization, chapters 9.6 and 11, for path and damping; Lee,
        Wensing & Park (2020), IEEE Trans. Robotics 36(1), for the divergence.
    """
    start = theta
    normal, slope = columns.T @ columns, columns.T @ rest
    places = np.array(bodies)
    unit = pseudo_inertia(jnp.eye(10))
    inverses = [solve(pseudo_inertia(theta[at]), jnp.eye(4)) for at in places]
    home = [jnp.einsum("ij,aji->a", inverse, unit) for inverse in inverses]
    # Unknowns that belong to no body have no barrier; a small diagonal term keeps the matrix definite.
    loose = 1e-13 * jnp.diag(normal)

    def advance(k: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        theta, _ = now
        weight = first * _LAST ** (k // 2 / _WEIGHTS)
        gradient, hessian = normal @ theta + slope, normal + jnp.diag(loose)
        for at, pull in zip(places, home, strict=True):
            inverse = solve(pseudo_inertia(theta[at]), jnp.eye(4))
            turned = jnp.einsum("ij,ajk->aik", inverse, unit)
            gradient = jnp.asarray(gradient).at[at].add(weight * (pull - jnp.einsum("aii->a", turned)))
            hessian = (
                jnp.asarray(hessian)
                .at[np.ix_(at, at)]
                .add(weight * jnp.einsum("aij,bji->ab", turned, turned))
            )
        # An unknown that has no effect and belongs to no body keeps its value.
        size = jnp.diag(hessian)
        without = size <= 0
        scale = jnp.where(without, 0.0, 1.0 / jnp.sqrt(jnp.where(without, 1.0, size)))
        scaled = hessian * jnp.outer(scale, scale) + jnp.diag(without.astype(float))
        step = -scale * solve(scaled, (scale * gradient)[:, None])[:, 0]
        fall = -gradient @ step
        ahead = theta + step / (1.0 + jnp.sqrt(jnp.maximum(fall, 0.0) / weight))
        # With a small weight, rounding may spoil a step, or lead it out of the set; the current point is then
        # accurate enough.
        farther = ahead + _MARGIN * (ahead - start)
        within = jnp.all(jnp.isfinite(jax.vmap(log_cholesky)(farther[places])))
        sound = jnp.all(jnp.isfinite(ahead)) & (fall > 0) & within
        return jnp.where(sound, ahead, theta), fall / weight

    def cost(theta: Array) -> Array:
        e = columns @ theta + rest
        return 0.5 * e @ e

    first = cost(theta) + 1e-300
    theta, decrement = jax.lax.fori_loop(0, 2 * _WEIGHTS, advance, (theta, jnp.asarray(jnp.inf)))
    # The gap to the minimum is the order of the barrier times the weight on the path, and less than twice
    # that near it.
    order, weight = 4 * len(bodies), first * _LAST ** ((_WEIGHTS - 1) / _WEIGHTS)
    floor = cost(theta) - 2 * order * weight
    return theta, jnp.where(jnp.abs(decrement) < _ON_PATH, floor, -jnp.inf)
