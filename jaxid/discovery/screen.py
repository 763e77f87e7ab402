"""Linear screen: score all candidates at all their starts on whitened held-out rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    from jaxid.discovery.search import Model, Search

# Number of surrogates from which the threshold is estimated.
SURROGATES = 200
# A drive effect has no influence if a change by its size moves the residual by less than this part of the
# noise (in sum of squares).
_HIDDEN = 0.01
# Number of points whose products are computed at once: few for memory, enough for matrix products to pay.
_TOGETHER = 64


@dataclass
class Screen:
    """Candidates scored against a model.

    Args:
        whitener: Map from a residual to rows of unit noise.
        blocks: Block of time of every row.
        before: Held-out sum of squares of the model, (1,).
        scores: Scores of all candidates at their best starts, best first.
        threshold: Evidence that noise alone exceeds once in a thousand searches.
        pairs: Evidence of every two candidates, if it was computed.
    """

    whitener: ev.Whitener
    blocks: np.ndarray
    before: np.ndarray
    scores: list[Score]
    threshold: float
    pairs: Pairs | None = None

    @classmethod
    def of(cls, whitener: ev.Whitener, e: np.ndarray, jacobian: np.ndarray) -> Screen:
        """Screen a model without any candidates."""
        out = cls(whitener, whitener.blocks(), np.zeros(1), [], 0.0)
        out.before = out.held_out(e, jacobian)
        return out

    @property
    def rows(self) -> int:
        """Number of whitened rows."""
        return len(self.blocks)

    def held_out(self, e: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
        """Return the held-out sum of squares of a model, linearised at its unknowns."""
        return self.held_out_rows(self.whitener(jacobian), self.whitener(e[..., None]))

    def held_out_rows(self, columns: np.ndarray, e: np.ndarray) -> np.ndarray:
        """Return the held-out sums of squares of several residuals, from whitened rows."""
        mixed, squares = ev.products(columns, e, self.blocks)
        return ev.held_out(ev.grams(columns, self.blocks), mixed, squares)


def screen_candidates(
    search: Search, model: Model, *, ahead: bool = False, by_sensors: bool = False
) -> Screen:
    """Evaluate every candidate at every start, whiten, score, and calibrate the threshold.

    Args:
        search: The search, with superset, samples and noise.
        model: The model to extend.
        ahead: True to score every two candidates together too.
        by_sensors: True to take what the model leaves for noise of the sensors, whatever its colour.
    """
    active = search.fitted_by(model.added)
    e, jacobian = search.domain.evaluate(search.samples, model.theta, active)
    base = jacobian[..., active]
    counts = search.samples.moving
    scale = np.array([c.innovation for c in search.colour])

    rest = search.rest(model)
    points = search.domain.points(rest, search.samples, model.theta, e)
    points = [p for p in points if has_influence(p, counts, scale)]

    if by_sensors:
        whitener = ev.Whitener(search.colour, counts)
        noise = whitener(e[..., None])[:, 0]
    else:
        extra, noisy = all_columns(search.superset, e, base, points, counts, scale)
        whitener, noise = fit_whitener(e, base, extra, counts, search.colour, noisy)
    out = Screen.of(whitener, e, base)
    white, columns = whitener(e[..., None]), whitener(base)

    length = ev.stretch(out.rows)
    surrogates = [ev.flipped(noise, length, SURROGATES, np.random.default_rng(20240501))]
    drawn = search.drawn_noise(model, SURROGATES)
    if drawn is not None:
        surrogates.append(whitener(np.moveaxis(drawn, 0, -1)))
    _score(out, search, white, columns, surrogates, points)
    if ahead:
        out.pairs = score_pairs(columns, white, _points_to_pair(out, points, columns), out.blocks)
    return out


def has_influence(p: cand.Point, counts: np.ndarray, scale: np.ndarray) -> bool:
    """Check that a drive effect has an influence at its start that noise would not hide.

    Residuals are in units of the declared force, so that every effect on the drive also scales them a little.
    If it does nothing else, for instance a limit that no sample reaches, its column is the residual itself:
    scaled to length one it would explain everything. So the change of scale does not count.
    """
    c = p.candidate
    if c.amplitude.any():
        return True
    start = c.starts[p.start]
    change = stacked(p.explaining * np.where(start != 0, np.abs(start), 1.0), counts, scale)
    return float(np.sum(change**2)) > _HIDDEN * len(change)


def _points_to_pair(out: Screen, points: list[cand.Point], base: np.ndarray) -> list[tuple]:
    """Select the points to be paired and whiten them; of a candidate with many starts only the best one."""
    best = {(s.candidate.kind, s.candidate.port): s.start for s in out.scores}
    to_pair = []
    q = orthonormal(base)
    for p in points:
        if p.candidate.has_grid and best.get((p.candidate.kind, p.candidate.port)) != p.start:
            continue
        columns = independent(q, out.whitener(p.columns))
        if columns.shape[1]:
            to_pair.append((p, columns, out.whitener(p.offset[..., None]) if p.offset.any() else None))
    return to_pair


def guess_pair(
    pair: Sequence[cand.Point], out: Screen, base: np.ndarray, e: np.ndarray, search: Search
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the start of a refit of two candidates: their shapes, with the strengths of a joint linear fit.

    None if a strength has a sign that its effect cannot have.
    """
    strengths = [p.strength for p in pair]
    # Drive effects have no strength to fit: they change the residual by their offset.
    offset = sum(p.offset for p, s in zip(pair, strengths, strict=True) if s is None)
    white = out.whitener((e + offset)[..., None])[:, 0]
    columns = [out.whitener(s[..., None]) for s in strengths if s is not None]
    first, second = pair
    if not columns:
        return first.candidate.starts[first.start], second.candidate.starts[second.start]

    both = unit(np.concatenate([out.whitener(base), *columns], axis=1))
    norms = [np.linalg.norm(c) for c in columns]
    amounts = iter(-np.linalg.lstsq(both, white, rcond=None)[0][-len(columns) :] / norms)
    guesses = []
    for p, strength in zip(pair, strengths, strict=True):
        c = p.candidate
        amount = 1.0 if strength is None else next(amounts)
        if not _allowed(c, amount, search):
            return None
        guesses.append(np.where(c.amplitude, amount, 1.0) * c.starts[p.start])
    return guesses[0], guesses[1]


def _allowed(c: cand.Candidate, amount: float, search: Search) -> bool:
    """Check that an effect may have a strength of this sign."""
    signs = [search.superset.machine.parameters.free[i].sign for i in c.index]
    bound = any(s != "free" for s, a in zip(signs, c.amplitude, strict=True) if a)
    return amount > 0 or not bound


def _score(
    out: Screen,
    search: Search,
    white: np.ndarray,
    base: np.ndarray,
    kinds: list[np.ndarray],
    points: list[cand.Point],
) -> None:
    """Score every candidate at its best start, and set the threshold: the largest by a kind of surrogates."""
    surrogates = np.concatenate(kinds, axis=1)
    beside = ev.Beside(base, np.concatenate([white, surrogates], axis=1), out.blocks)
    null_before = out.held_out_rows(base, surrogates)
    largest = np.full(surrogates.shape[1], -np.inf)
    best: dict[tuple[str, int], Score] = {}
    alone: dict[tuple[str, int], tuple[float, np.ndarray]] = {}
    q = orthonormal(base)
    for p, extra, crossed in _with_products(beside, q, out.whitener, points):
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
            remaining = float(out.held_out_rows(base, white + offset)[0])
            alone[key] = min(alone.get(key, (np.inf, guess)), (remaining, guess), key=lambda a: a[0])

    scores = [replace(s, second=alone[k][1]) if k in alone else s for k, s in best.items()]
    out.scores = sorted(scores, key=lambda s: -s.evidence)
    if np.all(np.isneginf(largest)):
        # Nothing was tried, so that noise gains nothing by it.
        largest = np.zeros_like(largest)
    ends = np.cumsum([k.shape[1] for k in kinds])[:-1]
    out.threshold = max(ev.threshold(some) for some in np.split(largest, ends))


def _with_products(
    beside: ev.Beside, q: np.ndarray, whitener: ev.Whitener, points: list[cand.Point]
) -> Iterator[tuple[cand.Point, np.ndarray, tuple[np.ndarray, np.ndarray]]]:
    """Yield points with the new part of their whitened columns beside the base, and their products."""
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
    """Return the start of a candidate's refit: its shape, with the strength from linear least squares.

    None if that strength has a sign that the effect cannot have.
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


def all_columns(
    superset: cand.CandidateModel,
    e: np.ndarray,
    base: np.ndarray,
    points: list[cand.Point],
    counts: np.ndarray,
    scale: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return columns of every candidate that might explain a residual, and which are those of added springs.

    The force of a spring between a joint and its load follows from the derivatives of the readings.

    A candidate in the drive contributes those of its best start. Its columns hold the noise of the logged
    force: lags and delays of several lengths together are a filter that reproduces the noise of the residual.
    A candidate with many starts contributes only if its best start clearly explains.
    """
    in_drive = [p for p in points if not p.candidate.has_grid and not p.candidate.amplitude.any()]
    chosen = [p for p in points if not p.candidate.has_grid and p.candidate.amplitude.any()]
    none = np.zeros((*e.shape, 0))
    columns = np.concatenate([none, *(p.explaining for p in chosen)], axis=2)

    by_candidate: dict[int, list[cand.Point]] = {}
    for p in in_drive:
        by_candidate.setdefault(id(p.candidate), []).append(p)
    for starts in by_candidate.values():
        gained = _gains(e, base, columns, starts, counts, scale) if len(starts) > 1 else np.zeros(1)
        chosen.append(starts[int(np.argmax(gained))])
    columns = np.concatenate([none, *(p.explaining for p in chosen)], axis=2)

    many = [p for p in points if p.candidate.has_grid]
    if many:
        gained = _gains(e, base, columns, many, counts, scale)
        best = int(np.argmax(gained))
        # The gain that the best of so many starts reaches by chance once in a thousand.
        chance = np.log(1000 * len(many)) + many[best].columns.shape[2]
        if gained[best] > chance:
            chosen.append(many[best])
            columns = np.concatenate([columns, many[best].columns], axis=2)

    springs = [cand.effect_of(superset, p.candidate).adds_spring for p in chosen]
    return columns, np.repeat(np.array(springs, bool), [p.columns.shape[2] for p in chosen])


def _gains(
    e: np.ndarray,
    base: np.ndarray,
    columns: np.ndarray,
    points: list[cand.Point],
    counts: np.ndarray,
    scale: np.ndarray,
) -> np.ndarray:
    """Return the gain in log-likelihood by the columns of each point alone, beside other columns."""
    explained = span(*(stacked(x, counts, scale) for x in (base, columns)))
    rest = left_over(explained, stacked(e[..., None], counts, scale)[:, 0])
    gained = np.zeros(len(points))
    for first in range(0, len(points), _TOGETHER):
        some = points[first : first + _TOGETHER]
        unit_columns = [unit(stacked(p.explaining, counts, scale)) for p in some]
        ends = np.cumsum([x.shape[1] for x in unit_columns])[:-1]
        fresh = np.split(left_over(explained, np.concatenate(unit_columns, axis=1)), ends, axis=1)
        for k, new in enumerate(fresh, start=first):
            part = np.sum((np.linalg.qr(new)[0].T @ rest) ** 2) / max(np.sum(rest**2), 1e-300)
            gained[k] = -0.5 * counts.sum() * np.log1p(-min(part, 1 - 1e-12))
    return gained
