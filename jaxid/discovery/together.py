"""Laws of several joints added at once, where one missing law hides another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.score import Score
from jaxid.discovery.search import SUPERFLUOUS, Model, Search, Step

# Effects take the place of what was found one by one if they close this part of the gap that is left.
TAKES_OVER = 0.9
# Laws that are added before any single effect: fewer are found one by one, beside effects that resemble them.
LEAST_AT_ONCE = 6


def add_together(search: Search, steps: list[Step], most: int, least: int = 1) -> list[Step]:
    """Add laws of all joints at once if single effects got stuck, and continue the search from there.

    A search adds one effect at a time, the one that gains most. Where several joints lack something, none
    may count: the largest residual is that of one joint, the largest evidence that of another. The laws of
    all joints are linear in their strengths, so that one fit holds all of them, and those that it does
    not need are dropped. They count only if they close nearly all that single effects left.

    A robot's file often states no friction and no rotor at all. Before its first step a search tries that: at
    least `LEAST_AT_ONCE` laws that close nearly all of the gap.

    Args:
        search: A search that has ended, or has not begun; its model changes if the laws are better.
        steps: Its steps.
        most: Largest number of effects in the model.
        least: Least number of laws that count.

    Returns:
        Steps of the search, with those that follow.
    """
    old = search.model
    if most < 1 or search.data.q.shape[1] < 2 or search.acceptance.at_floor(old.theta):
        return steps
    rest = search.rest(Model((), old.theta))
    laws = [c for c in rest if cand.effect_of(search.superset, c).in_robot_file]
    if len(laws) < 2:
        return steps
    search.progress("fitting friction, springs and rotors of all joints at once")
    theta = _fitted(search, laws).theta
    if not _closes(search, old, theta):
        return steps

    laws = _needed(search, theta, laws)
    if len(laws) < least:
        return steps
    model = _fitted(search, laws)
    model, _ = search.drop_superfluous(model, search.limit, model.added)
    new = len(model.added)
    if not least <= new <= most or not _closes(search, old, model.theta) or _objection(search, old, model):
        return steps
    why = "laws of several joints together explain what it stood for"
    return taken_over(search, steps, old, model, most, why)


def _closes(search: Search, old: Model, theta: np.ndarray) -> bool:
    residuals = (search.acceptance.residual(t) for t in (old.theta, theta))
    return search.acceptance.closed(*residuals) > TAKES_OVER


def _fitted(search: Search, laws: Sequence[cand.Candidate]) -> Model:
    """Fit the baseline with some laws."""
    theta = search.baseline.copy()
    for c in laws:
        theta[c.index] = c.starts[0]
    return Model(tuple(laws), search.fit(theta, search.fitted_by(laws)))


def _needed(search: Search, theta: np.ndarray, laws: list[cand.Candidate]) -> list[cand.Candidate]:
    """Return the laws without which the fit is worse by a relevant part, the least needed first.

    The residual is linear in the strengths, so that the sum of squares without a law follows from the fit
    with it: it grows by the square of the strength over its entry in the inverse of the normal matrix.
    """
    active = search.fitted_by(laws)
    e, jacobian = search.domain.evaluate(search.samples, theta, active)
    counts = search.samples.moving
    columns = np.where(counts[..., None], jacobian[..., active], 0.0).reshape(-1, len(active))
    squares = float(np.sum(np.where(counts, e, 0.0) ** 2))
    size = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    gram, strengths = (columns / size).T @ (columns / size), theta[active] * size
    first = len(search.superset.base)
    here, cost = list(range(len(active))), np.zeros(len(active))
    while len(here) > first:
        inverse = np.linalg.pinv(gram[np.ix_(here, here)], hermitian=True)
        cost = strengths[here] ** 2 / np.maximum(np.diag(inverse), 1e-300)
        k = first + int(np.argmin(cost[first:]))
        if cost[k] > SUPERFLUOUS * (squares + cost[k]):
            break
        # Without it the others take up what they can of it.
        strengths[here] -= inverse[:, k] / inverse[k, k] * strengths[here[k]]
        squares += float(cost[k])
        del here[k]
    order = np.argsort(cost[first:]) if len(here) > first else []
    return [laws[here[first + j] - first] for j in order]


def _objection(search: Search, old: Model, model: Model) -> str:
    """Explain why laws may not be named; empty if they may."""
    index = np.concatenate([c.index for c in model.added])
    new = len(search.fitted_by(model.added))
    confirmed = search.acceptance.confirmed(old.theta, model.theta, drive=False)
    return search.acceptance.objection(index, old.theta, model.theta, *confirmed, new)


def taken_over(
    search: Search, steps: list[Step], old: Model, model: Model, most: int, why: str
) -> list[Step]:
    """Put a model in the place of the search's, and continue from there.

    Args:
        search: The search.
        steps: Its steps.
        old: Its model.
        model: The model that takes the place.
        most: Largest number of effects in the model.
        why: Reason for dropping an effect of the old model.

    Returns:
        Steps of the search, with those that follow.
    """
    scores = {c.label: _score(search, model, c) for c in model.added}
    kept = [c for c in old.added if c.label in scores]
    # What stays was scored while the others were missing.
    steps = [
        replace(s, added=scores[s.added.candidate.label])
        if s.added and s.added.candidate.label in [c.label for c in kept]
        else s
        for s in steps
    ]
    for c in old.added:
        if c.label not in scores:
            steps.append(search.step(_fitted(search, kept), dropped=c, threshold=search.limit, why=why))

    added = [*kept]
    for score in sorted(scores.values(), key=lambda s: -s.total):
        if score.candidate.label not in [c.label for c in kept]:
            added.append(score.candidate)
            now = _fitted(search, added)
            score = replace(score, theta=now.theta)
            steps.append(search.step(now, added=score, scores=(score,), threshold=search.limit))
    model, more = search.grow(Model(tuple(added), model.theta), most)
    # The evidence of noise is known by now.
    search.model, dropped = search.drop_superfluous(model, search.limit, model.added)
    return [*steps, *more, *dropped]


def _score(search: Search, model: Model, c: cand.Candidate) -> Score:
    """Score an effect of a model by what is lost without it."""
    smaller = search.without(model, c)
    evidence, _ = search.loss(model, smaller)
    validation, _ = search.acceptance.confirmed(smaller.theta, model.theta, drive=False)
    return Score(c, 0, model.theta[c.index], evidence, validation=validation, theta=model.theta)
