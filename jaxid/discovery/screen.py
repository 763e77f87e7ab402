"""The first look: all candidates at all their starts, linearised, on whitened held-out rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.columns import independent, left_over, orthonormal, span, stacked, unit
from jaxid.discovery.noise import fit_whitener
from jaxid.discovery.pairs import Pairs, score_pairs
from jaxid.discovery.score import Score

if TYPE_CHECKING:
    from jaxid.discovery.search import Search

_SURROGATES = 200
# An effect in the drive that, changed by its own size, moves the residual by less than this part of
# the noise (in sum of squares) is not felt.
_HIDDEN = 0.01
# Points whose products are taken at once: few enough for memory, enough for matrix products to pay.
_TOGETHER = 64


@dataclass
class Screen:
    """Candidates scored against a model.

    Args:
        whitener: From residual to rows of unit noise.
        blocks: Block of time of every row.
        before: Held-out sum of squares of the model, (1,).
        scores: Best start of every candidate, best first.
        threshold: Evidence that noise alone exceeds once in a thousand searches.
        pairs: Evidence of every two candidates.
    """

    whitener: ev.Whitener
    blocks: np.ndarray
    before: np.ndarray
    scores: list[Score]
    threshold: float
    pairs: Pairs | None = None

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


def screen_candidates(search: Search, *, ahead: bool = False) -> Screen:
    """Evaluate every candidate at every start, whiten, score, calibrate.

    Args:
        search: Where the search stands.
        ahead: Score every two candidates together too.
    """
    e, jacobian = cand.evaluate(search.union, search.samples, search.theta, search.active)
    rest = search.rest()
    points = cand.points(search.union, rest, search.samples, search.theta, e)
    base = jacobian[..., search.active]
    for c in rest:
        if c.has_grid:
            points.extend(search.many(c))
    counts = search.samples.moving
    scale = np.array([c.innovation for c in search.colour])
    points = [p for p in points if _felt(p, counts, scale)]
    extra = _all_columns(e, base, points, counts, scale)
    whitener, noise = fit_whitener(e, base, extra, counts, search.colour)
    out = Screen.of(whitener, e, base)
    white, columns = whitener(e[..., None]), whitener(base)
    length = ev.stretch(out.rows)
    surrogates = ev.flipped(noise, length, _SURROGATES, np.random.default_rng(20240501))
    _score(out, search, white, columns, surrogates, points)
    if ahead:
        out.pairs = score_pairs(columns, white, _few_points(out, points, columns), out.blocks)
    return out


def _felt(p: cand.Point, counts: np.ndarray, scale: np.ndarray) -> bool:
    """Whether an effect in the drive does anything at its start that noise would not hide.

    Residuals are in units of the declared force, so that whatever changes the drive also scales them
    a little. Where it does nothing else, as a limit that no sample reaches, its column is the residual
    itself: brought to length one it would explain everything.
    """
    c = p.candidate
    if c.amplitude.any():
        return True
    start = c.starts[p.start]
    change = stacked(p.columns * np.where(start != 0, np.abs(start), 1.0), counts, scale)
    return float(np.sum(change**2)) > _HIDDEN * len(change)


def _few_points(out: Screen, points: list[cand.Point], base: np.ndarray) -> list[tuple]:
    """Points to be paired, whitened: of an effect with many starts only the best one."""
    best = {(s.candidate.kind, s.candidate.port): s.start for s in out.scores}
    found, q = [], orthonormal(base)
    for p in points:
        if p.candidate.has_grid and best.get((p.candidate.kind, p.candidate.port)) != p.start:
            continue
        columns = independent(q, out.whitener(p.columns))
        if columns.shape[1]:
            found.append((p, columns, out.whitener(p.offset[..., None]) if p.offset.any() else None))
    return found


def guess_pair(
    pair: tuple[cand.Point, cand.Point], out: Screen, base: np.ndarray, e: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray] | None:
    """Start of a refit of two candidates: their shapes, with the strengths of a common fit."""
    strengths = [p.strength for p in pair]
    offset = sum(p.offset for p, s in zip(pair, strengths, strict=True) if s is None)
    white = out.whitener((e + offset)[..., None])[:, 0]
    columns = [out.whitener(s[..., None]) for s in strengths if s is not None]
    if not columns:
        return tuple(p.candidate.starts[p.start] for p in pair)
    both = unit(np.concatenate([out.whitener(base), *columns], axis=1))
    norms = [np.linalg.norm(c) for c in columns]
    amounts = iter(-np.linalg.lstsq(both, white, rcond=None)[0][-len(columns) :] / norms)
    found = []
    for p, strength in zip(pair, strengths, strict=True):
        c, amount = p.candidate, 1.0 if strength is None else next(amounts)
        if not _allowed(c, amount, search):
            return None
        found.append(np.where(c.amplitude, amount, 1.0) * c.starts[p.start])
    return tuple(found)


def _allowed(c: cand.Candidate, amount: float, search: Search) -> bool:
    """Whether an effect may have a strength of this sign."""
    signs = [search.union.machine.parameters.free[i].sign for i in c.index]
    bound = any(s != "free" for s, a in zip(signs, c.amplitude, strict=True) if a)
    return amount > 0 or not bound


def _score(
    out: Screen,
    search: Search,
    white: np.ndarray,
    base: np.ndarray,
    surrogates: np.ndarray,
    points: list[cand.Point],
) -> None:
    beside = ev.Beside(base, np.concatenate([white, surrogates], axis=1), out.blocks)
    null_before = out.held(base, surrogates)
    largest = np.full(surrogates.shape[1], -np.inf)
    best: dict[tuple[str, int], Score] = {}
    alone: dict[tuple[str, int], tuple[float, np.ndarray]] = {}
    q = orthonormal(base)
    for p, extra, crossed in _crossed(beside, q, out.whitener, points):
        offset = out.whitener(p.offset[..., None]) if p.offset.any() else None
        after = beside.held_out(extra, crossed, offset)
        largest = np.maximum(largest, ev.log_evidence(out.rows, null_before, after[1:]))
        guess = _guess(p, q, out.whitener, white if offset is None else white + offset, search)
        if guess is None:
            continue
        gain = float(ev.log_evidence(out.rows, out.before, after[:1])[0])
        key = (p.candidate.kind, p.candidate.port)
        if key not in best or gain > best[key].evidence:
            best[key] = Score(p.candidate, p.start, guess, gain)
        if offset is not None:
            left = float(out.held(base, white + offset)[0])
            alone[key] = min(alone.get(key, (np.inf, guess)), (left, guess), key=lambda a: a[0])
    scores = [replace(s, second=alone[k][1]) if k in alone else s for k, s in best.items()]
    out.scores = sorted(scores, key=lambda s: -s.evidence)
    out.threshold = ev.threshold(largest)


def _crossed(
    beside: ev.Beside, q: np.ndarray, whitener: ev.Whitener, points: list[cand.Point]
) -> Iterator[tuple[cand.Point, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
    """Points with their whitened columns beside the base, as far as these are new, and their products."""
    for first in range(0, len(points), _TOGETHER):
        some = points[first : first + _TOGETHER]
        extras = [independent(q, whitener(p.columns)) for p in some]
        ends = np.cumsum([0, *[x.shape[1] for x in extras]])
        with_base, with_residuals = beside.crossed(np.concatenate(extras, axis=1))
        for p, extra, a, b in zip(some, extras, ends[:-1], ends[1:], strict=True):
            if a < b:
                yield p, extra, (with_base[:, :, a:b], with_residuals[:, a:b])


def _guess(
    p: cand.Point, q: np.ndarray, whitener: ev.Whitener, white: np.ndarray, search: Search
) -> np.ndarray | None:
    """Start of a candidate's refit: its shape, with the strength that least squares gives it.

    None where that strength has a sign that the effect cannot have.
    """
    c = p.candidate
    strength = p.strength
    if strength is None:
        return c.starts[p.start]
    new = left_over(q, whitener(strength[..., None])[:, 0])
    amount = -float(new @ white[:, 0]) / max(float(new @ new), 1e-300)
    if not _allowed(c, amount, search):
        return None
    return np.where(c.amplitude, amount, 1.0) * c.starts[p.start]


def _all_columns(
    e: np.ndarray, base: np.ndarray, points: list[cand.Point], counts: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Columns of every candidate with few starts, and of a clear one with many."""
    columns = np.concatenate([p.columns for p in points if not p.candidate.has_grid], axis=2)
    many = [p for p in points if p.candidate.has_grid]
    if not many:
        return columns
    own = span(*(stacked(x, counts, scale) for x in (base, columns)))
    rest = left_over(own, stacked(e[..., None], counts, scale)[:, 0])
    gained = np.zeros(len(many))
    for first in range(0, len(many), _TOGETHER):
        some = [unit(stacked(p.columns, counts, scale)) for p in many[first : first + _TOGETHER]]
        ends = np.cumsum([x.shape[1] for x in some])[:-1]
        fresh = np.split(left_over(own, np.concatenate(some, axis=1)), ends, axis=1)
        for k, new in enumerate(fresh, start=first):
            part = np.sum((np.linalg.qr(new)[0].T @ rest) ** 2) / max(np.sum(rest**2), 1e-300)
            gained[k] = -0.5 * counts.sum() * np.log1p(-min(part, 1 - 1e-12))
    best = int(np.argmax(gained))
    # What the best of so many starts gains by chance, once in a thousand.
    chance = np.log(1000 * len(many)) + many[best].columns.shape[2]
    found = [many[best].columns] if gained[best] > chance else []
    return np.concatenate([columns, *found], axis=2)
