"""Unidentifiable directions of the unknowns, as combinations by name."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float

# Entries of a combination below this are omitted from its description.
_NEGLIGIBLE = 0.1


def held(directions: Float[np.ndarray, "p k"]) -> Bool[np.ndarray, " p"]:
    """Return the mask of unknowns that occur in unidentifiable orthonormal directions, (p,)."""
    return np.linalg.norm(directions, axis=1) > _NEGLIGIBLE


def named_directions(names: Sequence[str], directions: Float[np.ndarray, "p k"]) -> list[dict[str, float]]:
    """Return unidentifiable orthonormal directions as combinations of the unknowns by name."""
    vectors = _sparse(directions)
    weight = np.abs(vectors)
    # An unknown may occur only with many small weights; it is still named at least once.
    named = weight > _NEGLIGIBLE
    named |= held(directions)[:, None] & (weight >= weight.max(axis=1, keepdims=True, initial=0.0))
    return [
        {n: float(w) for n, w, there in zip(names, _signed(v), k, strict=True) if there}
        for v, k in zip(vectors.T, named.T, strict=True)
    ]


def _sparse(vectors: Float[np.ndarray, "p k"]) -> Float[np.ndarray, "p k"]:
    """Return a basis of the same space in which each vector contains an unknown that no other contains.

    Eigenvectors of one eigenvalue are arbitrary mixtures: for an arm each of two dozen would name every link.
    """
    if vectors.shape[1] < 2:
        return vectors
    factors = scipy.linalg.qr(vectors.T, mode="r", pivoting=True)
    order = np.asarray(factors[-1])
    chosen = np.sort(order[: vectors.shape[1]])
    basis = np.linalg.solve(vectors[chosen].T, vectors.T).T
    return basis / np.linalg.norm(basis, axis=0)


def _signed(v: np.ndarray) -> np.ndarray:
    """Return the direction with its first named entry positive; the sign of an eigenvector is arbitrary."""
    first = v[np.argmax(np.abs(v) > _NEGLIGIBLE)]
    return v if first > 0 else -v
