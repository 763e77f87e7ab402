"""Columns of linear models: unit length, new directions, and the part of a residual that they leave."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# A column whose remainder beside others is shorter than this part of it counts as their combination:
# smoothing and filtering keep columns that are collinear in physics collinear to about four digits only.
NOTHING_NEW = 1e-3


def unit(columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row j"]:
    """Scale columns to length one and omit those that are zero."""
    norm = np.linalg.norm(columns, axis=0)
    return columns[:, norm > 0] / norm[norm > 0]


def stacked(
    x: Float[np.ndarray, "kept n k"], counts: Bool[np.ndarray, "kept n"], scale: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "row k"]:
    """Stack the rows that count, joint below joint, each joint divided by its scale.

    Joints share unknowns. The balance of a joint without a drive, taken alone, is solved by zeros: its
    residual lies in the span of its columns, and only other joints determine the scale.
    """
    return np.concatenate([x[c, i] / s for i, (c, s) in enumerate(zip(counts.T, scale, strict=True))])


def orthonormal(columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row j"]:
    """Return orthonormal columns that span the same space."""
    return np.linalg.qr(unit(columns))[0] if columns.shape[1] else columns


def independent(
    span: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]
) -> Float[np.ndarray, "row i"]:
    """Return the parts of unit columns outside an orthonormal span, without those that are negligible."""
    extra = unit(extra)
    rest = extra - span @ (span.T @ extra)
    return rest[:, np.linalg.norm(rest, axis=0) > NOTHING_NEW]


def span(base: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]) -> Float[np.ndarray, "row i"]:
    """Return orthonormal columns that span the base and the new directions of the extra columns."""
    q = orthonormal(base)
    rest = unit(independent(q, extra))
    if rest.shape[1] == 0:
        return q
    # From products of columns: a tenth of the time of a singular value decomposition, and as accurate, since
    # six digits in squares suffice.
    squares, vectors = np.linalg.eigh(rest.T @ rest)
    kept = squares > NOTHING_NEW**2 * squares[-1]
    return np.concatenate([q, rest @ (vectors[:, kept] / np.sqrt(squares[kept]))], axis=1)


def left_over(span: Float[np.ndarray, "row i"], e: Float[np.ndarray, " row"]) -> Float[np.ndarray, " row"]:
    """Return the part of a residual that orthonormal columns do not explain."""
    return e - span @ (span.T @ e)
