"""Solution of small linear systems inside compiled loops."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array


def small_solve(a: Float[Array, "n n"], b: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve a x = b by unrolled elimination, for the small mass matrices inside loops.

    A LAPACK call inside a scan would defeat the loop flag (see `jaxid._platform`), 60 times slower.
    No pivoting: a mass matrix is positive definite.
    """
    n = b.size
    rows = [[a[i, j] for j in range(n)] + [b[i]] for i in range(n)]
    # Reciprocals of the pivots: those of a constant mass matrix are taken out of the loop.
    scale: list[Array] = []
    for k in range(n):
        scale.append(1.0 / rows[k][k])
        for i in range(k + 1, n):
            factor = rows[i][k] * scale[k]
            rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k], strict=True)]
    x: list[Array] = [jnp.zeros(())] * n
    for k in reversed(range(n)):
        known = [rows[k][j] * x[j] for j in range(k + 1, n)]
        x[k] = sum((-y for y in known), rows[k][n]) * scale[k]
    return jnp.stack(x)
