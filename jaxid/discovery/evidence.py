"""Held-out evidence for columns, from Gram matrices by block of time, and its null distribution.

A fit on some blocks and its error on another need only sums of products of columns, so that a
thousand candidates on hundreds of surrogates cost no more than small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from jaxid.precision import NoiseModel

BLOCKS = 10
# Probability with which noise alone may exceed the threshold for all candidates together.
_FALSE_POSITIVE = 1e-3


@dataclass(frozen=True)
class Whitener:
    """Turns residuals and columns of a log into rows of unit, uncorrelated noise.

    Args:
        noise: Model by joint.
        rows: Which samples count, by joint, their past included.
    """

    noise: tuple[NoiseModel, ...]
    rows: Bool[np.ndarray, "kept n"]

    @classmethod
    def of(cls, e: Float[np.ndarray, "kept n"], counts: Bool[np.ndarray, "kept n"]) -> Whitener:
        """Whitener for noise such as `e`."""
        noise = tuple(NoiseModel.fit(e[:, i], counts[:, i], 20) for i in range(e.shape[1]))
        return cls(noise, np.stack([m.whitened_counts(c) for m, c in zip(noise, counts.T, strict=True)], 1))

    def on(self, counts: Bool[np.ndarray, "kept n"]) -> Whitener:
        """The same noise on another log."""
        rows = [m.whitened_counts(c) for m, c in zip(self.noise, counts.T, strict=True)]
        return Whitener(self.noise, np.stack(rows, 1))

    def __call__(self, x: Float[np.ndarray, "kept n k"]) -> Float[np.ndarray, "row k"]:
        """Whitened rows, joint after joint."""
        parts = []
        for i, model in enumerate(self.noise):
            parts.append(model.whiten(x[:, i])[self.rows[:, i]])
        return np.concatenate(parts)

    def blocks(self) -> np.ndarray:
        """Block of time of every row."""
        parts = []
        for i in range(len(self.noise)):
            n = int(self.rows[:, i].sum())
            parts.append(np.minimum(np.arange(n) * BLOCKS // max(n, 1), BLOCKS - 1))
        return np.concatenate(parts)


def grams(
    columns: Float[np.ndarray, "row k"], blocks: np.ndarray
) -> Float[np.ndarray, "block k k"]:
    """Products of columns, block by block."""
    return np.stack([columns[blocks == b].T @ columns[blocks == b] for b in range(BLOCKS)])


def products(
    columns: Float[np.ndarray, "row k"], e: Float[np.ndarray, "row r"], blocks: np.ndarray
) -> tuple[Float[np.ndarray, "block k r"], Float[np.ndarray, "block r"]]:
    """Products of columns with residuals, and squares of residuals, block by block."""
    mixed = [columns[blocks == b].T @ e[blocks == b] for b in range(BLOCKS)]
    squares = [np.sum(e[blocks == b] ** 2, axis=0) for b in range(BLOCKS)]
    return np.stack(mixed), np.stack(squares)


def held_out(
    gram: Float[np.ndarray, "block k k"],
    mixed: Float[np.ndarray, "block k r"],
    squares: Float[np.ndarray, "block r"],
) -> Float[np.ndarray, " r"]:
    """Sum of squares on each block after a least-squares fit to the others, for every residual."""
    total_gram, total_mixed = gram.sum(axis=0), mixed.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(total_gram), 1e-300))
    ridge = 1e-9 * np.eye(len(scale))
    out = np.zeros(squares.shape[1])
    for b in range(len(gram)):
        matrix = (total_gram - gram[b]) / np.outer(scale, scale) + ridge
        x = -np.linalg.solve(matrix, (total_mixed - mixed[b]) / scale[:, None]) / scale[:, None]
        out += squares[b] + 2 * np.sum(x * mixed[b], axis=0)
        out += np.einsum("ir,ij,jr->r", x, gram[b], x)
    return out


def log_evidence(rows: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Gain in held-out log-likelihood (nats) where a sum of squares falls from before to after."""
    return 0.5 * rows * np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))


def flipped(
    e: Float[np.ndarray, " row"], length: int, runs: int, rng: np.random.Generator
) -> Float[np.ndarray, "row runs"]:
    """Surrogates of a whitened residual: the sign of every stretch of it drawn anew.

    It keeps where the noise is large and what correlation whitening left, and destroys any
    relation to the columns.
    """
    stretches = -(-len(e) // length)
    signs = rng.choice([-1.0, 1.0], size=(stretches, runs))
    return e[:, None] * np.repeat(signs, length, axis=0)[: len(e)]


def threshold(largest: Float[np.ndarray, " runs"]) -> float:
    """Evidence that noise alone exceeds with the stated probability.

    Args:
        largest: Of each surrogate, the largest evidence over all candidates.

    Source:
        Gumbel's distribution of maxima, fitted by moments.
    """
    scale = np.std(largest) * np.sqrt(6) / np.pi
    location = np.mean(largest) - 0.5772 * scale
    return float(location - scale * np.log(-np.log(1 - _FALSE_POSITIVE)))
