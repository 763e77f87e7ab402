"""Least squares among bodies, where the residual is affine: a convex problem, solved from inside."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arms.pseudo_inertia import pseudo_inertia
from jaxid.arrays import Array

# Weights of the barrier, each with two Newton steps; the last over the first.
_WEIGHTS, _LAST = 112, 1e-14
# Of Newton's step at the end, in the barrier's own measure: beyond, it has left the path.
_ON_PATH = 0.25


def inner_start(
    columns: Float[Array, "rows p"],
    rest: Float[Array, " rows"],
    theta: Float[Array, " p"],
    bodies: tuple[tuple[int, ...], ...],
    solve: Callable[[Array, Array], Array],
) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Minimise the squares of columns @ theta + rest among bodies, from any body.

    Minus the logarithms of the determinants of the pseudo-inertias, over those at the start, times a weight
    that falls, keep what is sought inside. Newton's steps, damped by their own length, never leave it. The
    divergence whose part that is, tr(P0^-1 P) - log det(P0^-1 P), is least at the start: of what the columns
    do not tell the bodies nearest to it are taken. Without the trace, masses that no column tells would run
    away, and the steps would follow them and leave the path.

    Args:
        columns, rest: The residual.
        theta: Values that are bodies where they must be.
        bodies: Places of the ten parameters of each.
        solve: Of a symmetric positive definite system, (p, p) and (p, k).

    Returns:
        The values, and half a sum of squares below which no bodies fall; minus infinity where none is sure.

    Source:
        Boyd & Vandenberghe (2004), Convex Optimization, chapters 9.6 and 11, for path and damping; Lee,
        Wensing & Park (2020), IEEE Trans. Robotics 36(1), for the divergence.
    """
    normal, slope = columns.T @ columns, columns.T @ rest
    places = np.array(bodies)
    unit = pseudo_inertia(jnp.eye(10))
    inverses = [solve(pseudo_inertia(theta[at]), jnp.eye(4)) for at in places]
    home = [jnp.einsum("ij,aji->a", inverse, unit) for inverse in inverses]
    # What is in no body may stand anywhere, and has no barrier: a trace keeps the matrix definite.
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
        # What is without effect, and in no body, stays where it is.
        size = jnp.diag(hessian)
        without = size <= 0
        scale = jnp.where(without, 0.0, 1.0 / jnp.sqrt(jnp.where(without, 1.0, size)))
        scaled = hessian * jnp.outer(scale, scale) + jnp.diag(without.astype(float))
        step = -scale * solve(scaled, (scale * gradient)[:, None])[:, 0]
        fall = -gradient @ step
        ahead = theta + step / (1.0 + jnp.sqrt(jnp.maximum(fall, 0.0) / weight))
        # Rounding may spoil a step where the weight is small: what is there is good enough then.
        return jnp.where(jnp.all(jnp.isfinite(ahead)) & (fall > 0), ahead, theta), fall / weight

    def cost(theta: Array) -> Array:
        e = columns @ theta + rest
        return 0.5 * e @ e

    first = cost(theta) + 1e-300
    theta, decrement = jax.lax.fori_loop(0, 2 * _WEIGHTS, advance, (theta, jnp.asarray(jnp.inf)))
    # On the path it is the order of the barrier times the weight; near it, less than twice that.
    order, weight = 4 * len(bodies), first * _LAST ** ((_WEIGHTS - 1) / _WEIGHTS)
    floor = cost(theta) - 2 * order * weight
    return theta, jnp.where(jnp.abs(decrement) < _ON_PATH, floor, -jnp.inf)
