"""Held-out evidence of columns, from Gram matrices by block of time, and its null distribution.

A fit on some blocks and its error on another need sums of products of columns only, so that a thousand
candidates on hundreds of surrogates cost no more than small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.fft
import scipy.sparse
from jaxtyping import Bool, Float, Int

from jaxid.numerics.coloured_noise import NoiseModel

BLOCKS = 10
# Number of rows over which whitening may leave a correlation, and least number of stretches of a surrogate.
_CORRELATED = 10
_STRETCHES = 20
# Ridge added to a normal matrix, relative to its diagonal.
_RIDGE = 1e-9
# Sum of squares below which a column is zero.
_NOTHING = 1e-200
# Probability that noise alone exceeds the threshold with any of the candidates.
FALSE_POSITIVE = 1e-3


@dataclass(frozen=True)
class Whitener:
    """Linear map from residuals and columns of a log to rows with uncorrelated noise of unit variance.

    Args:
        noise: Noise model of each joint.
        rows: Mask of the samples that count, by joint.
    """

    noise: tuple[NoiseModel, ...]
    rows: Bool[np.ndarray, "kept n"]
    _matrices: list[scipy.sparse.csr_array] = field(init=False, repr=False, compare=False)
    _order: np.ndarray = field(init=False, repr=False, compare=False)

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
        """Build the whitener of noise such as `e`; with an expected colour, only the deviation is fitted."""
        if colour:
            first = cls(colour, counts)
            return first.then(cls.of(first.placed(first(e[..., None])[:, 0]), counts))
        return cls(tuple(NoiseModel.fit(x, c, 20) for x, c in zip(e.T, counts.T, strict=True)), counts)

    def then(self, after: Whitener) -> Whitener:
        """Compose this whitener with another that follows it."""
        noise = tuple(
            NoiseModel(
                -np.convolve([1.0, *-a.coefficients], [1.0, *-b.coefficients])[1:],
                a.innovation * b.innovation,
            )
            for a, b in zip(self.noise, after.noise, strict=True)
        )
        return Whitener(noise, self.rows)

    def __call__(self, x: Float[np.ndarray, "kept n k"]) -> Float[np.ndarray, "row k"]:
        """Return whitened rows, ordered by block of time."""
        return np.concatenate([m @ x[:, i] for i, m in enumerate(self._matrices)])[self._order]

    def placed(self, rows: Float[np.ndarray, " row"]) -> Float[np.ndarray, "kept n"]:
        """Put rows back at their samples; samples that do not count are zero."""
        out = np.zeros(self.rows.shape)
        ordered = np.empty_like(rows)
        ordered[self._order] = rows
        out.T[self.rows.T] = ordered
        return out

    def blocks(self) -> np.ndarray:
        """Return the block of time of every row, in ascending order."""
        return np.sort(self._blocks())

    def stretches(self, count: int) -> np.ndarray:
        """Return the stretch of time of every row, of so many of equal length."""
        return self._blocks(count)[self._order]

    def _blocks(self, count: int = BLOCKS) -> np.ndarray:
        parts = []
        for i in range(len(self.noise)):
            n = int(self.rows[:, i].sum())
            parts.append(np.minimum(np.arange(n) * count // max(n, 1), count - 1))
        return np.concatenate(parts)


def _predictor(model: NoiseModel, counts: Bool[np.ndarray, " kept"]) -> scipy.sparse.csr_array:
    """Build the matrix from a signal to its scaled innovations at the samples that count.

    After a gap fewer past samples are available, and the predictor of that lower order is used: otherwise a
    log with many reversals would lose most of its rows.
    """
    order = len(model.coefficients)
    size = scipy.fft.next_fast_len(max(4096, 64 * order), real=True)
    covariance = np.fft.irfft(model.density(size), size)[: order + 1]  # pyright: ignore[reportArgumentType] (its stub)

    # Number of past samples in sequence at each row, at most the order.
    index = np.flatnonzero(counts)
    since = np.arange(len(counts)) - np.maximum.accumulate(np.where(counts, -1, np.arange(len(counts))))
    past = np.minimum(since[index] - 1, order)
    rows, columns, values = [], [], []

    # Levinson-Durbin recursion: predictors of all orders, each used at the rows with that many past samples.
    a, variance = np.zeros(0), covariance[0]
    for k in range(order + 1):
        if k > 0:
            reflection = (covariance[k] - a @ covariance[k - 1 : 0 : -1]) / variance
            a = np.append(a - reflection * a[::-1], reflection)
            variance = variance * (1 - reflection**2)
        here = np.flatnonzero(past == k)
        rows.append(np.repeat(here, k + 1))
        columns.append((index[here][:, None] - np.arange(k + 1)).ravel())
        values.append(np.tile(np.array([1.0, *-a]) / np.sqrt(variance), len(here)))

    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return scipy.sparse.csr_array(entries, shape=(len(index), len(counts)))


def grams(columns: Float[np.ndarray, "row k"], blocks: np.ndarray) -> Float[np.ndarray, "block k k"]:
    """Compute the products of columns, block by block."""
    return np.stack([columns[b].T @ columns[b] for b in _slices(blocks)])


def products(
    columns: Float[np.ndarray, "row k"], e: Float[np.ndarray, "row r"], blocks: np.ndarray
) -> tuple[Float[np.ndarray, "block k r"], Float[np.ndarray, "block r"]]:
    """Compute products of columns with residuals, and squares of residuals, block by block."""
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
    """Compute each residual's sum of squares on every block after a least-squares fit to the others."""
    return _held_out_squares(_others(gram), gram, mixed.sum(axis=0) - mixed, mixed, squares)


def _held_out_squares(
    trained: Float[np.ndarray, "block k k"],
    held: Float[np.ndarray, "block k k"],
    trained_e: Float[np.ndarray, "block k r"],
    held_e: Float[np.ndarray, "block k r"],
    squares: Float[np.ndarray, "block r"],
) -> Float[np.ndarray, " r"]:
    """Sum squares after a fit; `trained` are products over the other blocks, `held` those on the block."""
    x = -np.linalg.solve(trained, trained_e)
    return np.sum(squares + np.sum(x * (2 * held_e + held @ x), axis=1), axis=0)


def _others(gram: Float[np.ndarray, "block k k"]) -> Float[np.ndarray, "block k k"]:
    """Sum products over all blocks except each, with a small ridge, since columns may be dependent.

    A column of zeros, for instance of a limit that nothing reaches, gets a ridge too: an inverse without one
    overflows, and every evidence beside that column is lost.
    """
    total = gram.sum(axis=0)
    power = np.diag(total)
    return total - gram + _RIDGE * np.diag(np.where(power > _NOTHING, power, 1.0))


def partial_products(
    gram: Float[np.ndarray, "block n n"], base: int
) -> tuple[Float[np.ndarray, "block m m"], Float[np.ndarray, "block m m"]]:
    """Compute products of columns after removal of a base that was fitted to the other blocks.

    A base of sixty columns beside ten thousand pairs need not be solved for each pair again.

    Args:
        gram: Products of all columns by block.
        base: Number of columns, the first ones, that are the base.

    Returns:
        Products of the other columns, over the blocks of the fit and on the block itself.
    """
    rest = _others(gram)
    regression = np.linalg.solve(rest[:, :base, :base], rest[:, :base, base:])
    trained = rest[:, base:, base:] - np.swapaxes(rest[:, :base, base:], 1, 2) @ regression
    back = np.swapaxes(regression, 1, 2)
    cross = back @ gram[:, :base, base:]
    held = (
        gram[:, base:, base:] - cross - np.swapaxes(cross, 1, 2) + back @ gram[:, :base, :base] @ regression
    )
    return trained, held


def residual_squares(
    trained: Float[np.ndarray, "block m m"],
    held: Float[np.ndarray, "block m m"],
    columns: Int[np.ndarray, " j"],
    target: Int[np.ndarray, " t"],
) -> float:
    """Compute the held-out sum of squares of a sum of columns after a fit of others and of the base.

    Args:
        trained, held: Both results of `partial_products`.
        columns: Indices of the columns to fit.
        target: Indices of the columns whose sum is the residual.
    """
    square = (columns[:, None], columns)
    mixed = (columns[:, None], target)
    squares = held[:, target[:, None], target].sum(axis=(1, 2))[:, None]
    trained_e, held_e = (x[:, *mixed].sum(axis=2)[..., None] for x in (trained, held))
    return float(_held_out_squares(trained[:, *square], held[:, *square], trained_e, held_e, squares)[0])


class Beside:
    """Held-out sums of squares of a base with further columns beside it, for many residuals.

    The part that involves only the base and the residuals is summed and solved once for all candidates.

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
        # Coefficients of the base fitted to the other blocks, for each residual, and their products.
        self.fitted = self.inverse @ (self.mixed.sum(axis=0) - self.mixed)
        self.products_fitted = self.gram @ self.fitted
        self.squares = squares + np.sum(self.fitted * (self.products_fitted - 2 * self.mixed), axis=1)

    def crossed(
        self, extra: Float[np.ndarray, "row j"]
    ) -> tuple[Float[np.ndarray, "block k j"], Float[np.ndarray, "block j r"]]:
        """Compute the products of further columns with the base and with the residuals.

        The residuals are many, and multiplying them takes most of the time: it is best to pass the columns of
        several candidates in one call.
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
        """Return the sums of squares with further columns beside the base.

        Args:
            extra: Further columns.
            crossed: Their products, from `crossed`.
            offset: Change of all residuals, if there is one.
        """
        with_base, with_e = crossed
        if offset is not None:
            offset_base, offset_e = self.crossed(offset)
            extra = np.concatenate([extra, offset], axis=1)
            with_base = np.concatenate([with_base, offset_base], axis=2)
            with_e = np.concatenate([with_e, offset_e], axis=1)

        # Remove the base, fitted to the other blocks, from the further columns.
        gram = grams(extra, self.blocks)
        others = with_base.sum(axis=0) - with_base
        regression = self.inverse @ others
        back = np.swapaxes(regression, 1, 2)
        trained = _others(gram) - np.swapaxes(others, 1, 2) @ regression
        trained_e = with_e.sum(axis=0) - with_e - np.swapaxes(others, 1, 2) @ self.fitted
        cross = back @ with_base
        held = gram - cross - np.swapaxes(cross, 1, 2) + back @ self.gram @ regression
        held_e = (
            with_e
            - back @ self.mixed
            - np.swapaxes(with_base, 1, 2) @ self.fitted
            + back @ self.products_fitted
        )
        if offset is None:
            return _held_out_squares(trained, held, trained_e, held_e, self.squares)

        # The last column is the offset: it changes the residuals and is not fitted.
        squares = self.squares + 2 * held_e[:, -1] + held[:, -1, -1:]
        trained_e = trained_e[:, :-1] + trained[:, :-1, -1:]
        held_e = held_e[:, :-1] + held[:, :-1, -1:]
        return _held_out_squares(trained[:, :-1, :-1], held[:, :-1, :-1], trained_e, held_e, squares)


def log_evidence(rows: int, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the gain in held-out log-likelihood [nats] if a sum of squares falls from before to after."""
    # A ratio below 1e-12 is rounding.
    return -0.5 * rows * np.log(np.maximum(after / np.maximum(before, 1e-300), 1e-12))


def stretch(rows: int) -> int:
    """Return the number of rows that keep a common sign in a surrogate.

    It is the number over which whitening may leave a correlation, or a hundredth of a long log. For a short
    log it is smaller, since five stretches do not give two hundred different surrogates.
    """
    return max(min(_CORRELATED, rows // _STRETCHES), rows // 100, 1)


def flipped(
    e: Float[np.ndarray, " row"], length: int, runs: int, rng: np.random.Generator
) -> Float[np.ndarray, "row runs"]:
    """Draw surrogates of a whitened residual with a random sign for every stretch of rows.

    A surrogate keeps the places of large noise and any correlation that whitening left, and destroys the
    relation to the columns.
    """
    stretches = -(-len(e) // length)
    signs = rng.choice([-1.0, 1.0], size=(stretches, runs))
    return e[:, None] * np.repeat(signs, length, axis=0)[: len(e)]


def threshold(largest: Float[np.ndarray, " runs"]) -> float:
    """Return the evidence that noise alone exceeds with probability `FALSE_POSITIVE`.

    Args:
        largest: Largest evidence over all candidates, for each surrogate.

    Source:
        Gumbel's distribution of maxima, fitted by moments.
    """
    location, scale = _gumbel(largest)
    return float(location - scale * np.log(-np.log(1 - FALSE_POSITIVE)))


def false_alarm(evidence: float, largest: Float[np.ndarray, " runs"]) -> float:
    """Return the probability that noise alone reaches an evidence with any of the candidates.

    Args:
        evidence: The evidence [nats].
        largest: Largest evidence over all candidates, for each surrogate.
    """
    location, scale = _gumbel(largest)
    return float(-np.expm1(-np.exp(-(evidence - location) / max(scale, 1e-300))))


def _gumbel(largest: Float[np.ndarray, " runs"]) -> tuple[float, float]:
    """Return location and scale of Gumbel's distribution, fitted by moments."""
    scale = float(np.std(largest) * np.sqrt(6) / np.pi)
    return float(np.mean(largest)) - 0.5772 * scale, scale
