"""Held-out evidence for columns, from Gram matrices by block of time, and its null distribution.

A fit on some blocks and its error on another need only sums of products of columns, so that a
thousand candidates on hundreds of surrogates cost no more than small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
import scipy.sparse
from jaxtyping import Bool, Float, Int

from jaxid.numerics.precision import NoiseModel

BLOCKS = 10
# Rows that whitening may leave correlated; fewest stretches of a surrogate.
_CORRELATED = 10
_STRETCHES = 20
# Of a normal matrix, relative to its diagonal.
_RIDGE = 1e-9
# Probability with which noise alone may exceed the threshold for all candidates together.
_FALSE_POSITIVE = 1e-3


@dataclass(frozen=True)
class Whitener:
    """Turns residuals and columns of a log into rows of unit, uncorrelated noise.

    Args:
        noise: Model by joint.
        rows: Which samples count, by joint.
    """

    noise: tuple[NoiseModel, ...]
    rows: Bool[np.ndarray, "kept n"]

    def __post_init__(self) -> None:
        pairs = zip(self.noise, self.rows.T, strict=True)
        object.__setattr__(self, "_matrices", [_predictor(m, c) for m, c in pairs])
        object.__setattr__(self, "_order", np.argsort(self._blocks(), kind="stable"))

    @classmethod
    def of(
        cls,
        e: Float[np.ndarray, "kept n"],
        counts: Bool[np.ndarray, "kept n"],
        colour: tuple[NoiseModel, ...] = (),
    ) -> Whitener:
        """Whitener for noise such as `e`; from an expected colour, what of it is not so is fitted."""
        if colour:
            first = cls(colour, counts)
            return first.then(cls.of(first.placed(first(e[..., None])[:, 0]), counts))
        return cls(tuple(NoiseModel.fit(x, c, 20) for x, c in zip(e.T, counts.T, strict=True)), counts)

    def then(self, after: Whitener) -> Whitener:
        """This whitener and then another as one."""
        noise = tuple(
            NoiseModel(
                -np.convolve([1.0, *-a.coefficients], [1.0, *-b.coefficients])[1:],
                a.innovation * b.innovation,
            )
            for a, b in zip(self.noise, after.noise, strict=True)
        )
        return Whitener(noise, self.rows)

    def __call__(self, x: Float[np.ndarray, "kept n k"]) -> Float[np.ndarray, "row k"]:
        """Whitened rows, block after block of time."""
        return np.concatenate([m @ x[:, i] for i, m in enumerate(self._matrices)])[self._order]

    def placed(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, "kept n"]:
        """Rows back at their samples; zero where none counts."""
        out, own = np.zeros(self.rows.shape), np.empty_like(rows)
        own[self._order] = rows
        out.T[self.rows.T] = own
        return out

    def blocks(self) -> np.ndarray:
        """Block of time of every row, in rising order."""
        return np.sort(self._blocks())

    def _blocks(self) -> np.ndarray:
        parts = []
        for i in range(len(self.noise)):
            n = int(self.rows[:, i].sum())
            parts.append(np.minimum(np.arange(n) * BLOCKS // max(n, 1), BLOCKS - 1))
        return np.concatenate(parts)


def _predictor(model: NoiseModel, counts: Bool[np.ndarray, " kept"]) -> scipy.sparse.csr_array:
    """Matrix from a signal to its innovations at the samples that count, over their deviation.

    After a gap fewer past samples are there, and the predictor of that order takes over: a log
    with many reversals would lose most of its rows otherwise.
    """
    order = len(model.coefficients)
    size = scipy.fft.next_fast_len(max(4096, 64 * order), real=True)
    covariance = np.fft.irfft(model.density(size), size)[: order + 1]
    index = np.flatnonzero(counts)
    since = np.arange(len(counts)) - np.maximum.accumulate(np.where(counts, -1, np.arange(len(counts))))
    past = np.minimum(since[index] - 1, order)
    rows, columns, values = [], [], []
    a, variance = np.zeros(0), covariance[0]
    for k in range(order + 1):
        if k > 0:
            turn = (covariance[k] - a @ covariance[k - 1 : 0 : -1]) / variance
            a, variance = np.append(a - turn * a[::-1], turn), variance * (1 - turn**2)
        here = np.flatnonzero(past == k)
        rows.append(np.repeat(here, k + 1))
        columns.append((index[here][:, None] - np.arange(k + 1)).ravel())
        values.append(np.tile(np.array([1.0, *-a]) / np.sqrt(variance), len(here)))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.csr_array(entries, shape=(len(index), len(counts)))


def grams(columns: Float[np.ndarray, "row k"], blocks: np.ndarray) -> Float[np.ndarray, "block k k"]:
    """Products of columns, block by block."""
    return np.stack([columns[b].T @ columns[b] for b in _slices(blocks)])


def products(
    columns: Float[np.ndarray, "row k"], e: Float[np.ndarray, "row r"], blocks: np.ndarray
) -> tuple[Float[np.ndarray, "block k r"], Float[np.ndarray, "block r"]]:
    """Products of columns with residuals, and squares of residuals, block by block."""
    slices = _slices(blocks)
    squares = [np.einsum("ir,ir->r", e[b], e[b]) for b in slices]
    return np.stack([columns[b].T @ e[b] for b in slices]), np.stack(squares)


def _slices(blocks: np.ndarray) -> list[slice]:
    edges = np.searchsorted(blocks, np.arange(BLOCKS + 1))
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def held_out(
    gram: Float[np.ndarray, "block k k"],
    mixed: Float[np.ndarray, "block k r"],
    squares: Float[np.ndarray, "block r"],
) -> Float[np.ndarray, " r"]:
    """Sum of squares on each block after a least-squares fit to the others, for every residual."""
    return _left(_others(gram), gram, mixed.sum(axis=0) - mixed, mixed, squares)


def _left(
    trained: Float[np.ndarray, "block k k"],
    held: Float[np.ndarray, "block k k"],
    trained_e: Float[np.ndarray, "block k r"],
    held_e: Float[np.ndarray, "block k r"],
    squares: Float[np.ndarray, "block r"],
) -> Float[np.ndarray, " r"]:
    """What is left on the blocks: products over the others, with residuals too, and on each itself."""
    x = -np.linalg.solve(trained, trained_e)
    return np.sum(squares + np.sum(x * (2 * held_e + held @ x), axis=1), axis=0)


def _others(gram: Float[np.ndarray, "block k k"]) -> Float[np.ndarray, "block k k"]:
    """Products over all blocks but each, with a trace of a ridge: columns may depend on one another."""
    total = gram.sum(axis=0)
    return total - gram + _RIDGE * np.diag(np.maximum(np.diag(total), 1e-300))


def swept(
    gram: Float[np.ndarray, "block n n"], base: int
) -> tuple[Float[np.ndarray, "block m m"], Float[np.ndarray, "block m m"]]:
    """Products of columns from which a base is taken out that was fitted to the other blocks.

    A base of sixty columns beside ten thousand pairs need not be solved for each again.

    Args:
        gram: Products of all columns.
        base: How many of them, the first ones, are the base.

    Returns:
        Of the others: over the blocks fitted to, and on the block itself.
    """
    rest = _others(gram)
    taken = np.linalg.solve(rest[:, :base, :base], rest[:, :base, base:])
    trained = rest[:, base:, base:] - np.swapaxes(rest[:, :base, base:], 1, 2) @ taken
    back = np.swapaxes(taken, 1, 2)
    cross = back @ gram[:, :base, base:]
    held = gram[:, base:, base:] - cross - np.swapaxes(cross, 1, 2) + back @ gram[:, :base, :base] @ taken
    return trained, held


def left_beside(
    trained: Float[np.ndarray, "block m m"],
    held: Float[np.ndarray, "block m m"],
    columns: Int[np.ndarray, " j"],
    target: Int[np.ndarray, " t"],
) -> float:
    """What is left of a sum of columns once some others, and the base, are fitted; by `swept`."""
    own, mixed = (columns[:, None], columns), (columns[:, None], target)
    squares = held[:, target[:, None], target].sum(axis=(1, 2))[:, None]
    with_target = [x[:, *mixed].sum(axis=2)[..., None] for x in (trained, held)]
    return float(_left(trained[:, *own], held[:, *own], *with_target, squares)[0])


class Beside:
    """Held-out sums of squares of a base with further columns beside it, for many residuals.

    What the base and the residuals have in common is summed and solved once; a candidate adds its own.

    Args:
        base: Whitened columns of the base.
        e: Whitened residuals.
        blocks: Block of time of every row.
    """

    def __init__(
        self, base: Float[np.ndarray, "row k"], e: Float[np.ndarray, "row r"], blocks: np.ndarray
    ) -> None:
        self.base, self.e, self.blocks = base, e, blocks
        self.gram = grams(base, blocks)
        self.mixed, squares = products(base, e, blocks)
        self.inverse = np.linalg.inv(_others(self.gram))
        # What the base says of the residuals where it is fitted to the other blocks, and its products.
        self.said = self.inverse @ (self.mixed.sum(axis=0) - self.mixed)
        self.seen = self.gram @ self.said
        self.squares = squares + np.sum(self.said * (self.seen - 2 * self.mixed), axis=1)

    def crossed(
        self, extra: Float[np.ndarray, "row j"]
    ) -> tuple[Float[np.ndarray, "block k j"], Float[np.ndarray, "block j r"]]:
        """Products of further columns with the base and with the residuals.

        The residuals are many, and going through them takes most of the time: what is to be scored
        is best brought together.
        """
        slices = _slices(self.blocks)
        with_base = np.stack([self.base[b].T @ extra[b] for b in slices])
        return with_base, np.stack([extra[b].T @ self.e[b] for b in slices])

    def held_out(
        self,
        extra: Float[np.ndarray, "row j"],
        crossed: tuple[Float[np.ndarray, "block k j"], Float[np.ndarray, "block j r"]],
        offset: Float[np.ndarray, "row 1"] | None = None,
    ) -> Float[np.ndarray, " r"]:
        """With further columns and their products, and with an offset that all residuals share."""
        if offset is not None:
            more = self.crossed(offset)
            extra = np.concatenate([extra, offset], axis=1)
            crossed = [np.concatenate([crossed[k], more[k]], axis=2 - k) for k in range(2)]
        with_base, with_e = crossed
        own = grams(extra, self.blocks)
        others = with_base.sum(axis=0) - with_base
        taken = self.inverse @ others
        back = np.swapaxes(taken, 1, 2)
        trained = _others(own) - np.swapaxes(others, 1, 2) @ taken
        trained_e = with_e.sum(axis=0) - with_e - np.swapaxes(others, 1, 2) @ self.said
        cross = back @ with_base
        held = own - cross - np.swapaxes(cross, 1, 2) + back @ self.gram @ taken
        held_e = with_e - back @ self.mixed - np.swapaxes(with_base, 1, 2) @ self.said + back @ self.seen
        if offset is None:
            return _left(trained, held, trained_e, held_e, self.squares)
        squares = self.squares + 2 * held_e[:, -1] + held[:, -1, -1:]
        trained_e = trained_e[:, :-1] + trained[:, :-1, -1:]
        held_e = held_e[:, :-1] + held[:, :-1, -1:]
        return _left(trained[:, :-1, :-1], held[:, :-1, :-1], trained_e, held_e, squares)


def log_evidence(rows: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Gain in held-out log-likelihood (nats) where a sum of squares falls from before to after."""
    # Below 1e-12 of what was there, a sum of squares is rounding.
    return -0.5 * rows * np.log(np.maximum(after / np.maximum(before, 1e-300), 1e-12))


def stretch(rows: int) -> int:
    """How many rows keep their sign together in a surrogate.

    As many as whitening may leave correlated, or a hundredth of a long log; of a short log fewer,
    since of five stretches there are no two hundred surrogates.
    """
    return max(min(_CORRELATED, rows // _STRETCHES), rows // 100, 1)


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
