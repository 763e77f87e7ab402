"""Algebra of small polynomial matrices in the derivative operator s.

A polynomial is an array of coefficients, lowest order first, (orders,); a matrix of polynomials is
(orders, rows, columns). All loops are unrolled and differentiable, because the matrices have few rows.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array

Polynomial = Float[Array, " orders"]
Matrix = Float[Array, "orders rows columns"]


def product(a: Matrix, b: Matrix) -> Matrix:
    """Return the product of two matrices."""
    out = [jnp.zeros((a.shape[1], b.shape[2]))] * (len(a) + len(b) - 1)
    for i, first in enumerate(a):
        for j, second in enumerate(b):
            out[i + j] = out[i + j] + first @ second
    return jnp.stack(out)


def scaled(p: Polynomial, a: Matrix) -> Matrix:
    """Return a matrix with each entry multiplied by one polynomial."""
    out = [jnp.zeros(a.shape[1:])] * (len(p) + len(a) - 1)
    for i in range(len(p)):
        for j in range(len(a)):
            out[i + j] = out[i + j] + p[i] * a[j]
    return jnp.stack(out)


def total(a: Matrix, b: Matrix) -> Matrix:
    """Return the sum of two matrices of any orders."""
    orders = max(len(a), len(b))
    padded = (jnp.pad(x, ((0, orders - len(x)), (0, 0), (0, 0))) for x in (a, b))
    return sum(padded, jnp.zeros(()))


def determinant(a: Matrix, sign: float = -1.0) -> Polynomial:
    """Return the determinant of a square matrix, expanded by its first row; that of an empty matrix is one.

    With `sign` = 1 it is the permanent. For a matrix of magnitudes that is the size of the terms that the
    determinant sums.
    """
    n = a.shape[1]
    if n == 0:
        return jnp.ones(1)
    parts = [sign**j * jnp.convolve(a[:, 0, j], determinant(_minor(a, 0, j), sign)) for j in range(n)]
    return sum(parts[1:], parts[0])


def adjugate(a: Matrix, sign: float = -1.0) -> Matrix:
    """Return the adjugate, whose product with `a` is its determinant; `sign` is that of `determinant`."""
    n = a.shape[1]
    if n == 0:
        return jnp.zeros((1, 0, 0))
    rows = [
        jnp.stack([sign ** (i + j) * determinant(_minor(a, i, j), sign) for i in range(n)], axis=1)
        for j in range(n)
    ]
    return jnp.stack(rows, axis=1)


def _minor(a: Matrix, row: int, column: int) -> Matrix:
    """Return the matrix without one row and one column."""
    rows = jnp.asarray([i for i in range(a.shape[1]) if i != row], dtype=int)
    columns = jnp.asarray([j for j in range(a.shape[2]) if j != column], dtype=int)
    return a[:, rows][:, :, columns]
