"""Effects that leave nothing but the noise of the sensors, sought anew where a search got stuck."""

from __future__ import annotations

from collections.abc import Iterator

from jaxid.discovery.screen import screen_candidates
from jaxid.discovery.search import CERTAIN, MOST_OF_IT, NEARLY_ALL, Model, Search, Step
from jaxid.discovery.selection import shortlist
from jaxid.discovery.together import TAKES_OVER, taken_over


def add_by_sensors(search: Search, steps: list[Step], most: int) -> list[Step]:
    """Begin a search that got stuck anew from an effect that is large beside the noise of the sensors.

    A search estimates the colour of the noise from what a model leaves. A drive at its limit for much of a
    log, or a friction with memory, leaves so much that this colour is that of the effect itself, and no start
    near the truth gains. Here all that the case leaves is taken for noise of the sensors. An effect takes the
    place of what was found if it alone closes 99 % of the gap, or if it closes half of it and 90 % with
    those that the usual search adds to it. Each must have much evidence by the noise that all leave.

    Args:
        search: A search that has ended; its model changes if other effects are better.
        steps: Its steps.
        most: Largest number of effects in the model.

    Returns:
        Steps of the search, with those that follow.
    """
    old = search.model
    if most < 1 or search.acceptance.at_floor(old.theta):
        return steps
    search.progress("searching for effects that leave nothing but noise")
    for model in _begun(search, most):
        if _is_certain(search, model) and _is_better(search, model, old):
            names = " and ".join(c.label for c in model.added)
            why = f"{names} explain{'s' if len(model.added) == 1 else ''} what it stood for"
            return taken_over(search, steps, old, model, most, why)
    return steps


def _begun(search: Search, most: int) -> Iterator[Model]:
    """Yield models of one effect that explain a log, and those that grow from one that explains much."""
    base = Model((), search.baseline)
    screened = screen_candidates(search, base, by_sensors=True)
    for score in shortlist([s for s in screened.scores if s.evidence > screened.threshold]):
        found = search.refit(base, score, screened)
        if found.reason:
            continue
        model = Model((found.candidate,), found.refitted)
        if (closed := _closed(search, model)) > NEARLY_ALL:
            yield model
        elif closed > MOST_OF_IT:
            grown, _ = search.grow(model, most)
            if _closed(search, grown) > TAKES_OVER:
                yield grown


def _closed(search: Search, model: Model) -> float:
    """Return the part of the declared model's gap that a model closes."""
    return search.acceptance.closed(*(search.acceptance.residual(t) for t in (search.baseline, model.theta)))


def _is_certain(search: Search, model: Model) -> bool:
    """Check that a model needs each of its effects, with much evidence."""
    return all(search.loss(model, search.without(model, c))[0] > CERTAIN for c in model.added)


def _is_better(search: Search, model: Model, old: Model) -> bool:
    return search.acceptance.squares(model.theta) < search.acceptance.squares(old.theta)
