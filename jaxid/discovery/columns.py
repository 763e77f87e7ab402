"""Columns of linear models: scaled to one length, what is new in them, and what they leave."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# A column that stands out of others by less than this part of itself is theirs: with smoothing
# and filtering, what is collinear in physics is so to four digits in numbers.
NOTHING_NEW = 1e-3


def unit(columns: Float[np.ndarray, "row k"]) -> Float[np.ndarray, "row j"]:
    """Columns of length one; those that are zero are left out."""
    norm = np.linalg.norm(columns, axis=0)
    return columns[:, norm > 0] / norm[norm > 0]


def independent(
    base: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]
) -> Float[np.ndarray, "row i"]:
    """What is new in the columns of `extra` beside the base, those left out that bring nothing."""
    extra = unit(extra)
    q = np.linalg.qr(unit(base))[0] if base.shape[1] else base
    rest = extra - q @ (q.T @ extra)
    return rest[:, np.linalg.norm(rest, axis=0) > NOTHING_NEW]


def span(
    base: Float[np.ndarray, "row k"], extra: Float[np.ndarray, "row j"]
) -> Float[np.ndarray, "row i"]:
    """Orthonormal columns that span the base and what is new in the rest."""
    q = np.linalg.qr(unit(base))[0] if base.shape[1] else base
    rest = unit(independent(base, extra))
    if rest.shape[1] == 0:
        return q
    u, s, _ = np.linalg.svd(rest, full_matrices=False)
    return np.concatenate([q, u[:, s > NOTHING_NEW * s[0]]], axis=1)


def left_over(
    span: Float[np.ndarray, "row i"], e: Float[np.ndarray, " row"]
) -> Float[np.ndarray, " row"]:
    """What orthonormal columns do not explain."""
    return e - span @ (span.T @ e)
