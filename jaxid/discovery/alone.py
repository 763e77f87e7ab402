"""A single effect that leaves nothing but the noise of the sensors, tried where a search got stuck."""

from __future__ import annotations

from jaxid.discovery.screen import screen_candidates
from jaxid.discovery.search import CERTAIN, NEARLY_ALL, Model, Search, Step
from jaxid.discovery.selection import shortlist
from jaxid.discovery.together import taken_over


def add_alone(search: Search, steps: list[Step], most: int) -> list[Step]:
    """Add the one effect that explains a log if a search got stuck, and continue the search from there.

    A search estimates the colour of the noise from what a model leaves. A drive at its limit for much of a
    log leaves so much that this colour is that of the effect itself, and no start near the truth gains. Here
    all that the case leaves is taken for noise of the sensors. An effect counts only if it closes nearly all
    of the gap, with much evidence by the noise that it leaves itself.

    Args:
        search: A search that has ended; its model changes if an effect is better.
        steps: Its steps.
        most: Largest number of effects in the model.

    Returns:
        Steps of the search, with those that follow.
    """
    old, base = search.model, Model((), search.baseline)
    if most < 1 or search.acceptance.at_floor(old.theta):
        return steps
    search.progress("searching for one effect that leaves nothing but noise")
    screened = screen_candidates(search, base, by_sensors=True)
    for score in shortlist([s for s in screened.scores if s.evidence > screened.threshold]):
        found = search.refit(base, score, screened)
        model = Model((found.candidate,), found.refitted)
        if found.reason or not _explains(search, base, model) or not _is_better(search, model, old):
            continue
        return taken_over(
            search, steps, old, model, most, f"{found.candidate.label} explains what it stood for"
        )
    return steps


def _explains(search: Search, base: Model, model: Model) -> bool:
    """Check that a model closes nearly all of the gap, with much evidence."""
    residuals = (search.acceptance.residual(m.theta) for m in (base, model))
    return search.acceptance.closed(*residuals) > NEARLY_ALL and search.loss(model, base)[0] > CERTAIN


def _is_better(search: Search, model: Model, old: Model) -> bool:
    return search.acceptance.squares(model.theta) < search.acceptance.squares(old.theta)
