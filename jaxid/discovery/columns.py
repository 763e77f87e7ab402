"""Columns of linear models: scaled to one length, what is new in them, and what they leave."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# A column that stands out of others by less than this part of itself is theirs: with smoothing
# and filtering, what is collinear in physics is so to four digits in numbers.
NOTHING_NEW = 1e-3


def unit(columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row j"]:
    """Columns of length one; those that are zero are left out."""
    norm = np.linalg.norm(columns, axis=0)
    return columns[:, norm > 0] / norm[norm > 0]


def stacked(
    x: Float[np.ndarray, "kept n k"], counts: Bool[np.ndarray, "kept n"], scale: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "row k"]:
    """Rows that count, joint below joint, over the scale of each.

    Joints share unknowns. Taken by itself, the balance of a joint that nothing drives is met by
    zeros: its residual lies in its own columns, and only the others tell the scale.
    """
    return np.concatenate([x[c, i] / s for i, (c, s) in enumerate(zip(counts.T, scale, strict=True))])


def orthonormal(columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row j"]:
    """Orthonormal columns that span the same."""
    return np.linalg.qr(unit(columns))[0] if columns.shape[1] else columns


def independent(
    span: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]
) -> Float[np.ndarray, "row i"]:
    """What is new in the columns of `extra` beside orthonormal ones, without those that bring nothing."""
    extra = unit(extra)
    rest = extra - span @ (span.T @ extra)
    return rest[:, np.linalg.norm(rest, axis=0) > NOTHING_NEW]


def span(base: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]) -> Float[np.ndarray, "row i"]:
    """Orthonormal columns that span the base and what is new in the rest."""
    q = orthonormal(base)
    rest = unit(independent(q, extra))
    if rest.shape[1] == 0:
        return q
    # By their products: a tenth of the time of a singular value decomposition, and as good where
    # all that counts is six digits in squares.
    squares, vectors = np.linalg.eigh(rest.T @ rest)
    kept = squares > NOTHING_NEW**2 * squares[-1]
    return np.concatenate([q, rest @ (vectors[:, kept] / np.sqrt(squares[kept]))], axis=1)


def left_over(span: Float[np.ndarray, "row i"], e: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """What orthonormal columns do not explain."""
    return e - span @ (span.T @ e)
