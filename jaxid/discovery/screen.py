"""The first look: all candidates at all their starts, linearised, on whitened held-out rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev

if TYPE_CHECKING:
    from jaxid.discovery.search import Search

_SURROGATES = 200
# A stretch that keeps its sign in a surrogate: this part of the log.
_STRETCH = 1 / 100


@dataclass(frozen=True)
class Score:
    """Evidence of one candidate.

    Args:
        candidate: Which.
        start: Index of its best start.
        guess: Where its refit starts.
        evidence: Held-out gain in log-likelihood on the log [nats].
        validation: The same on the validation logs; None without any.
        theta: All unknowns of the union after its refit; None where it was only screened.
        reason: Why it was turned down; empty where it was not.
    """

    candidate: cand.Candidate
    start: int
    guess: np.ndarray
    evidence: float
    validation: float | None = None
    theta: np.ndarray | None = None
    reason: str = ""

    @property
    def total(self) -> float:
        """Evidence of log and validation together."""
        return self.evidence + (self.validation or 0.0)


@dataclass
class Screen:
    """Candidates scored against a model.

    Args:
        whitener: From residual to rows of unit noise.
        blocks: Block of time of every row.
        before: Held-out sum of squares of the model, (1,).
        scores: Best start of every candidate, best first.
        threshold: Evidence that noise alone exceeds once in a thousand searches.
    """

    whitener: ev.Whitener
    blocks: np.ndarray
    before: np.ndarray
    scores: list[Score]
    threshold: float

    @classmethod
    def of(cls, whitener: ev.Whitener, e: np.ndarray, jacobian: np.ndarray) -> Screen:
        """A model by itself, nothing scored yet."""
        out = cls(whitener, whitener.blocks(), np.zeros(1), [], 0.0)
        out.before = out.held_out(e, jacobian)
        return out

    @property
    def rows(self) -> int:
        """Number of whitened rows."""
        return len(self.blocks)

    def held_out(self, e: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Held-out sum of squares of a model, linearised where it stands."""
        return self.held(self.whitener(jacobian), self.whitener(e[..., None]))

    def held(self, columns: np.ndarray, e: np.ndarray) -> np.ndarray:
        """The same on whitened rows, for several residuals."""
        mixed, squares = ev.products(columns, e, self.blocks)
        return ev.held_out(ev.grams(columns, self.blocks), mixed, squares)


def screen_candidates(search: Search) -> Screen:
    """Evaluate every candidate at every start, whiten, score, calibrate."""
    e, jacobian = cand.evaluate(search.union, search.arrays, search.theta)
    rest = search.rest()
    points = cand.points(search.union, rest, search.arrays, search.theta, e)
    base = jacobian[..., search.active]
    for c in rest:
        if c.many:
            points.extend(search.many(c))
    whitener = _saturated_whitener(e, base, points, search.data.moving)
    out = Screen.of(whitener, e, base)
    white, columns = whitener(e[..., None]), whitener(base)
    noise = _left(np.concatenate([columns, *_plain(points, whitener)], axis=1), white[:, 0])
    length = max(2, int(out.rows * _STRETCH))
    surrogates = ev.flipped(noise, length, _SURROGATES, np.random.default_rng(20240501))
    _score(out, search, white, columns, surrogates, points)
    return out


def _score(
    out: Screen, search: Search, white: np.ndarray, base: np.ndarray, surrogates: np.ndarray,
    points: list[cand.Point],
) -> None:
    null_before = out.held(base, surrogates)
    largest = np.full(surrogates.shape[1], -np.inf)
    best: dict[tuple[str, int], Score] = {}
    for p in points:
        extra = _independent(base, out.whitener(p.columns))
        if extra.shape[1] == 0:
            continue
        offset = out.whitener(p.offset[..., None])
        both = np.concatenate([base, extra], axis=1)
        after = out.held(both, np.concatenate([white, surrogates], axis=1) + offset)
        largest = np.maximum(largest, ev.log_evidence(out.rows, null_before, after[1:]))
        guess = _guess(p, base, out.whitener, white + offset, search)
        if guess is None:
            continue
        gain = float(ev.log_evidence(out.rows, out.before, after[:1])[0])
        key = (p.candidate.kind, p.candidate.port)
        if key not in best or gain > best[key].evidence:
            best[key] = Score(p.candidate, p.start, guess, gain)
    out.scores = sorted(best.values(), key=lambda s: -s.evidence)
    out.threshold = ev.threshold(largest)


def _guess(
    p: cand.Point, base: np.ndarray, whitener: ev.Whitener, white: np.ndarray, search: Search
) -> np.ndarray | None:
    """Start of a candidate's refit: its shape, with the strength that least squares gives it.

    None where that strength has a sign that the effect cannot have.
    """
    c = p.candidate
    strength = p.strength
    if strength is None:
        return c.starts[p.start]
    both = np.concatenate([base, whitener(strength[..., None])], axis=1)
    norm = np.linalg.norm(both, axis=0)
    amount = -np.linalg.lstsq(both / norm, white[:, 0], rcond=None)[0][-1] / norm[-1]
    signs = [search.union.machine.parameters.free[i].sign for i in c.index]
    if amount <= 0 and any(s != "free" for s, a in zip(signs, c.amplitude, strict=True) if a):
        return None
    return np.where(c.amplitude, amount, 1.0) * c.starts[p.start]


def _independent(base: np.ndarray, extra: np.ndarray) -> np.ndarray:
    """Those columns of `extra` that are not rounding beside the base."""
    norm = np.linalg.norm(extra, axis=0)
    extra = extra[:, norm > 0] / norm[norm > 0]
    rest = extra - base @ np.linalg.lstsq(base, extra, rcond=None)[0]
    return rest[:, np.linalg.norm(rest, axis=0) > 1e-5]


def _plain(points: list[cand.Point], whitener: ev.Whitener) -> list[np.ndarray]:
    return [whitener(p.columns) for p in points if not p.candidate.many]


def _left(columns: np.ndarray, e: np.ndarray) -> np.ndarray:
    """What is left of e beside all columns."""
    norm = np.linalg.norm(columns, axis=0)
    columns = columns[:, norm > 0] / norm[norm > 0]
    return e - columns @ np.linalg.lstsq(columns, e, rcond=1e-7)[0]


def _saturated_whitener(
    e: np.ndarray, base: np.ndarray, points: list[cand.Point], counts: np.ndarray
) -> ev.Whitener:
    """Whitener for what is left when every candidate has had its say.

    The colour of the current residual is partly the missing effect itself; whitened with that,
    the effect would vanish.
    """
    few = [base, *[p.columns for p in points if not p.candidate.many]]
    columns = np.concatenate(few, axis=2)
    many = [p for p in points if p.candidate.many]
    left = np.zeros_like(e)
    for i, rows in enumerate(counts.T):
        now, own = e[rows, i], columns[rows, i]
        rest = _left(own, now)
        taken = [_explained(p.columns[rows, i], rest) for p in many]
        if taken:
            best = many[int(np.argmax(taken))].columns[rows, i]
            rest = _left(np.concatenate([own, best], axis=1), now)
        left[rows, i] = rest
    return ev.Whitener.of(left, counts)


def _explained(columns: np.ndarray, e: np.ndarray) -> float:
    """Sum of squares that some columns take off e."""
    return float(e @ e - np.sum(_left(columns, e) ** 2))
