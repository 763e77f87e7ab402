"""Linear screen: score every change of a model of several logs on whitened held-out rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxid.comparison.model import Change, Model, effect_changes, parameter_changes
from jaxid.comparison.rows import ComparedLog, Whitened
from jaxid.discovery import candidates as cand
from jaxid.discovery import evidence as ev
from jaxid.discovery.columns import NOTHING_NEW
from jaxid.discovery.noise import fit_whitener
from jaxid.discovery.screen import all_columns, has_influence
from jaxid.model.unknowns import Free

# Number of surrogates from which the threshold is estimated.
_SURROGATES = 200
# Ridge of a solution that only asks which columns are new, relative to their squares.
_RIDGE = 1e-12


@dataclass(frozen=True)
class Scored:
    """A change at its best start.

    Args:
        change: The change.
        evidence: Held-out gain in log-likelihood [nats].
        starts: Values of an effect from which its refit starts, the best first; empty for a parameter.
    """

    change: Change
    evidence: float
    starts: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True)
class Screen:
    """Changes scored against a model.

    Args:
        whitened: Map from residuals to rows of unit noise.
        before: Held-out sum of squares of the model.
        scores: All changes at their best starts, best first.
        largest: Largest evidence of any change, for each surrogate, (kinds, runs): the residual with other
            signs, and noise that was drawn, where it can be.
        apart: Evidence of a set of parameters for each log, in place of one for all.
        apart_by_chance: The same for each surrogate.
    """

    whitened: Whitened
    before: float
    scores: tuple[Scored, ...]
    largest: Float[np.ndarray, "kinds runs"]
    apart: float
    apart_by_chance: Float[np.ndarray, "kinds runs"]

    @property
    def threshold(self) -> float:
        """Evidence that noise alone exceeds once in a thousand comparisons; infinite if none was scored."""
        return largest_threshold(self.largest) if np.all(np.isfinite(self.largest)) else np.inf

    @property
    def apart_threshold(self) -> float:
        """Threshold of the evidence of a set of parameters for each log."""
        return largest_threshold(self.apart_by_chance)

    def false_alarm(self, evidence: float) -> float:
        """Return the probability that noise alone reaches an evidence with any change."""
        return max(ev.false_alarm(evidence, some) for some in self.largest)

    @property
    def changes(self) -> int:
        """Number of changes that were scored."""
        return len(self.scores)

    def gained(self, after: float) -> float:
        """Return the evidence of a model with a held-out sum of squares."""
        return float(ev.log_evidence(self.whitened.rows, np.array(self.before), np.array(after)))


def largest_threshold(by_chance: Float[np.ndarray, "kinds runs"]) -> float:
    """Return the largest of the thresholds that kinds of surrogates give."""
    return max(ev.threshold(some) for some in by_chance)


class _Sums(NamedTuple):
    """Sums of products of some columns, by block.

    Args:
        base: Products with the columns of the model, (block, u, k).
        gram: Products with each other, (block, k, k).
        mixed: Products with the residual and its surrogates, (block, k, r).
    """

    base: np.ndarray
    gram: np.ndarray
    mixed: np.ndarray

    def __add__(self, other: _Sums) -> _Sums:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _Sums(self.base + other.base, self.gram + other.gram, self.mixed + other.mixed)


@dataclass(frozen=True)
class _Whole:
    """Sums of products of the columns of a model, of all logs."""

    gram: Float[np.ndarray, "block u u"]
    mixed: Float[np.ndarray, "block u r"]
    squares: Float[np.ndarray, "block r"]

    def held_out(self, more: _Sums, shifted: bool) -> Float[np.ndarray, " r"]:
        """Return the held-out sums of squares with further columns.

        Args:
            more: Sums of the columns.
            shifted: Whether the last of them is a change of the residual, which is not fitted.
        """
        gram = np.concatenate(
            [
                np.concatenate([self.gram, more.base], axis=2),
                np.concatenate([np.swapaxes(more.base, 1, 2), more.gram], axis=2),
            ],
            axis=1,
        )
        mixed, squares = np.concatenate([self.mixed, more.mixed], axis=1), self.squares
        if shifted:
            squares = squares + 2 * mixed[:, -1] + gram[:, -1, -1:]
            mixed = (mixed + gram[:, :, -1:])[:, :-1]
            gram = gram[:, :-1, :-1]
        return ev.held_out(gram, mixed, squares)

    def new(self, more: _Sums) -> np.ndarray:
        """Return which columns are no combination of those of the model."""
        total, beside = self.gram.sum(axis=0), more.base.sum(axis=0)
        size = np.einsum("bkk->k", more.gram)
        ridge = _RIDGE * np.diag(np.maximum(np.diag(total), 1e-300))
        rest = size - np.sum(beside * np.linalg.solve(total + ridge, beside), axis=0)
        return rest > NOTHING_NEW**2 * np.maximum(size, 1e-300)

    def amount(self, more: _Sums) -> float:
        """Return the coefficient of one column in a fit of the residual beside those of the model."""
        total, beside = self.gram.sum(axis=0), more.base.sum(axis=0)[:, 0]
        ridge = _RIDGE * np.diag(np.maximum(np.diag(total), 1e-300))
        both = np.linalg.solve(total + ridge, np.stack([beside, self.mixed[:, :, 0].sum(axis=0)], axis=1))
        size = more.gram.sum() - beside @ both[:, 0]
        return -float((more.mixed[:, 0, 0].sum() - beside @ both[:, 1]) / max(size, 1e-300))


def screen_changes(
    superset: cand.CandidateModel,
    logs: Sequence[ComparedLog],
    model: Model,
    comparable: Sequence[int],
    *,
    effects: bool = True,
) -> Screen:
    """Score every change of a model, and calibrate the threshold.

    Args:
        superset: Machine with all candidates.
        logs: The logs.
        model: The model.
        comparable: Indices of the parameters that may differ between logs.
        effects: False to score the parameters only.
    """
    changes = effect_changes(superset.candidates, model, len(logs)) if effects else []
    rest = [c for c in superset.candidates if any(x.effect is c for x in changes)]
    whiteners, residuals, bases, points, drawn = [], [], [], [], []
    rng = np.random.default_rng(20240501)
    for k, log in enumerate(logs):
        fitted = model.fitted_in(k)
        fixed = [u.index for u in model.fixed if k in u.logs]
        e, jacobian = log.evaluate(model.theta[k], [*fitted, *fixed])
        own, extra, noisy = [], np.zeros((*e.shape, 0)), None
        if effects:
            own = log.points(rest, model.theta[k], e)
            scale = np.array([c.innovation for c in log.colour])
            own = [p for p in own if has_influence(p, log.counts, scale)]
            extra, noisy = all_columns(superset, e, jacobian[..., fitted], own, log.counts, scale)
        whitener, noise = fit_whitener(e, jacobian[..., fitted], extra, log.counts, log.colour, noisy)
        flipped = ev.flipped(noise, ev.stretch(len(noise)), _SURROGATES, rng)
        draws = log.drawn_noise(model.theta[k], model.effects_in(k), _SURROGATES)
        drawn.append(draws is not None)
        draws = flipped if draws is None else whitener(np.moveaxis(draws, 0, -1))
        whiteners.append(whitener)
        residuals.append(np.concatenate([whitener(e[..., None]), flipped, draws], axis=1))
        bases.append(jacobian)
        points.append(own)

    whitened = Whitened(whiteners)
    base = whitened.columns([*model.unknowns, *model.fixed], bases)
    if not any(drawn):
        residuals = [e[:, : 1 + _SURROGATES] for e in residuals]
    return _scored(superset, whitened, model, changes, comparable, base, residuals, points)


def _scored(
    superset: cand.CandidateModel,
    whitened: Whitened,
    model: Model,
    effects: Sequence[Change],
    comparable: Sequence[int],
    base: Sequence[np.ndarray],
    e: Sequence[np.ndarray],
    points: Sequence[Sequence[cand.Point]],
) -> Screen:
    """Score all changes from their whitened rows; columns of the base that are not fitted come last."""
    blocks, fitted = whitened.blocks, len(model.unknowns)
    grams = [ev.grams(x, b) for x, b in zip(base, blocks, strict=True)]
    pairs = [ev.products(x, y, b) for x, y, b in zip(base, e, blocks, strict=True)]
    mixed, squares = [p[0] for p in pairs], [p[1] for p in pairs]
    total = sum(grams, np.zeros(()))[:, :fitted, :fitted]
    whole = _Whole(total, sum(mixed, np.zeros(()))[:, :fitted], sum(squares, np.zeros(())))
    before = ev.held_out(whole.gram, whole.mixed, whole.squares)
    rows = whitened.rows

    def evidence(after: np.ndarray) -> np.ndarray:
        return ev.log_evidence(rows, before, after)

    largest = np.full(e[0].shape[1] - 1, -np.inf)
    scores: list[Scored] = []
    names = superset.machine.parameters.names
    for change in parameter_changes(model, names, comparable, len(base)):
        sums = _parameter_sums(change, model, grams, mixed)
        if whole.new(sums).any():
            gained = evidence(whole.held_out(sums, False))
            largest = np.maximum(largest, gained[1:])
            scores.append(Scored(change, float(gained[0])))

    sums_of = [
        _points(p, w, x[:, :fitted], y)
        for p, w, x, y in zip(points, whitened.whiteners, base, e, strict=True)
    ]
    for change in effects:
        found: list[tuple[float, np.ndarray]] = []
        for trial in _trials(change, sums_of, whole, superset.machine.parameters.free):
            gained = evidence(whole.held_out(trial.sums, trial.shifted))
            largest = np.maximum(largest, gained[1:])
            if trial.guess is not None:
                found.append((float(gained[0]), trial.guess))
        if found:
            found.sort(key=lambda pair: -pair[0])
            guesses = tuple(guess for _, guess in found[: _guesses_kept(change)])
            scores.append(Scored(change, found[0][0], guesses))

    apart = evidence(np.sum(_fitted_apart(model, grams, mixed, squares), axis=0))
    scores.sort(key=lambda s: -s.evidence)
    kinds = lambda gained: gained.reshape(-1, _SURROGATES)
    return Screen(
        whitened, float(before[0]), tuple(scores), kinds(largest), float(apart[0]), kinds(apart[1:])
    )


def _fitted_apart(
    model: Model, grams: Sequence[np.ndarray], mixed: Sequence[np.ndarray], squares: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return the held-out sums of squares of each log, fitted alone."""
    fitted, both = len(model.unknowns), [*model.unknowns, *model.fixed]
    out = []
    for k, (gram, right, total) in enumerate(zip(grams, mixed, squares, strict=True)):
        # What is held in the first log is fitted in the others.
        some = [j for j in range(len(both)) if j < fitted or k > 0]
        out.append(ev.held_out(_without_other_logs(gram[:, some][:, :, some]), right[:, some], total))
    return out


def _parameter_sums(
    change: Change, model: Model, grams: Sequence[np.ndarray], mixed: Sequence[np.ndarray]
) -> _Sums:
    """Return the sums of the columns of a parameter in the logs of a change."""
    both = [*model.unknowns, *model.fixed]
    column = {u.logs: j for j, u in enumerate(both) if u.index == change.index}
    fitted = len(model.unknowns)
    parts = []
    for k in change.logs:
        j = [next(j for logs, j in column.items() if k in logs)]
        parts.append(_Sums(grams[k][:, :fitted, j], grams[k][:, j][:, :, j], mixed[k][:, j]))
    return _beside(parts) if change.apart else sum(parts[1:], start=parts[0])


@dataclass(frozen=True)
class _Trial:
    """An effect at one start.

    Args:
        sums: Sums of its new columns.
        shifted: Whether the last of them is a change of the residual.
        guess: Values from which a fit would begin; None: the effect would act against its sign.
    """

    sums: _Sums
    shifted: bool
    guess: np.ndarray | None


def _trials(
    change: Change, sums_of: Sequence[dict[tuple[int, int], _Sums]], whole: _Whole, free: Sequence[Free]
) -> Iterator[_Trial]:
    """Yield an effect at each of its starts, if it has columns in all logs of a change that are new."""
    c = change.effect
    assert c is not None, "an effect"
    for k, start in enumerate(c.starts):
        by_log = [sums_of[log][id(c), k] for log in change.logs if (id(c), k) in sums_of[log]]
        if len(by_log) < len(change.logs):
            continue
        sums, shifted = sum(by_log[1:], start=by_log[0]), not c.amplitude.any()
        # A change of the residual comes last, and is no column that could be old.
        kept = whole.new(sums)
        kept[-1] |= shifted
        if kept.sum() <= shifted:
            continue
        guess = start
        if not shifted:
            amount = whole.amount(_combined(sums, np.where(c.amplitude, start, 0.0)))
            bound = any(free[i].sign != "free" for i, a in zip(c.index, c.amplitude, strict=True) if a)
            guess = None if bound and amount <= 0 else np.where(c.amplitude, amount, 1.0) * start
        yield _Trial(_chosen(sums, kept), shifted, guess)


def _guesses_kept(change: Change) -> int:
    """Return how many starts of an effect are tried.

    A linear screen exaggerates a start of an effect that is not linear: the next best is tried too.
    """
    c = change.effect
    assert c is not None, "an effect"
    return 1 if c.amplitude.all() or c.has_grid else 2


def _without_other_logs(gram: np.ndarray) -> np.ndarray:
    """Return products of the columns of one log, of which those of other logs are zero."""
    size = np.einsum("bkk->k", gram)
    return gram + np.diag(np.where(size > 0, 0.0, 1.0))


def _points(
    points: Sequence[cand.Point], whitener: ev.Whitener, base: np.ndarray, e: np.ndarray
) -> dict[tuple[int, int], _Sums]:
    """Return the sums of the columns of all points of one log, by candidate and start.

    For an effect in the drive, which changes the residual by more than its columns, the change is the last.
    """
    blocks = whitener.blocks()
    edges = np.searchsorted(blocks, np.arange(ev.BLOCKS + 1))
    slices = [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    out = {}
    together = 64
    for first in range(0, len(points), together):
        some = points[first : first + together]
        shifts = [not p.candidate.amplitude.any() for p in some]
        columns = [
            np.concatenate([p.columns, p.offset[..., None]], axis=2) if s else p.columns
            for p, s in zip(some, shifts, strict=True)
        ]
        rows = whitener(np.concatenate(columns, axis=2))
        with_base = np.stack([base[b].T @ rows[b] for b in slices])
        with_e = np.stack([rows[b].T @ e[b] for b in slices])
        ends = np.cumsum([0, *[c.shape[2] for c in columns]])
        for p, a, z in zip(some, ends[:-1], ends[1:], strict=True):
            gram = np.stack([rows[b, a:z].T @ rows[b, a:z] for b in slices])
            out[id(p.candidate), p.start] = _Sums(with_base[:, :, a:z], gram, with_e[:, a:z])
    return out


def _beside(parts: Sequence[_Sums]) -> _Sums:
    """Return the sums of columns of which each belongs to another log."""
    gram = np.zeros((len(parts[0].gram), len(parts), len(parts)))
    for j, part in enumerate(parts):
        gram[:, j, j] = part.gram[:, 0, 0]
    base = np.concatenate([p.base for p in parts], axis=2)
    return _Sums(base, gram, np.concatenate([p.mixed for p in parts], axis=1))


def _chosen(sums: _Sums, kept: np.ndarray) -> _Sums:
    """Return the sums of some of the columns."""
    return _Sums(sums.base[:, :, kept], sums.gram[:, kept][:, :, kept], sums.mixed[:, kept])


def _combined(sums: _Sums, weights: np.ndarray) -> _Sums:
    """Return the sums of one combination of the columns; a change of the residual takes no part."""
    w = np.zeros((sums.gram.shape[1], 1))
    w[: len(weights), 0] = weights
    return _Sums(sums.base @ w, w.T @ sums.gram @ w, w.T @ sums.mixed)
