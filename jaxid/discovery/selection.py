"""Rules that select scored effects: shortlist for a refit, next effect, and simplest equivalent."""

from __future__ import annotations

from collections.abc import Callable

from jaxid.discovery.score import Score

# Number of best candidates that are refitted; the order of a linear screen is not final.
REFITTED = 5
# Two candidates whose evidence differs by less explain the log equally well: a factor of 20 in likelihood,
# or one percent of a large evidence, which is the uncertainty from filtering and sampling.
TIE_NATS = 3.0
TIE_PART = 0.01
# While much is missing, the effect with fewer parameters is added first if it gains this part of the best
# gain: a flexible effect gains by imitating effects that are not in the model yet. An effect that is then
# still missing shows in the next round, and a superfluous one is dropped.
MODEST = 0.7


def shortlist(promising: list[Score]) -> list[Score]:
    """Return the best candidates, and the best of the others with a single parameter."""
    best = promising[:REFITTED]
    single = [s for s in promising[REFITTED:] if len(s.candidate.index) == 1]
    return [*best, *single[:1]]


def margin(score: Score) -> float:
    """Return the difference of evidence up to which two effects explain a log equally well [nats]."""
    return max(TIE_NATS, TIE_PART * abs(score.total))


def next_effect(good: list[Score]) -> Score | None:
    """Return the effect to add next: the simplest of those whose gain is close to the best."""
    if not good:
        return None
    enough = [s for s in good if s.total > min(MODEST * good[0].total, good[0].total - TIE_NATS)]
    return min(enough, key=lambda s: (len(s.candidate.index), -s.total))


def simplest_equivalent(
    good: list[Score], chance_difference: Callable[[Score, Score], float]
) -> tuple[Score, tuple[Score, ...]]:
    """Return the simplest of the effects that explain the log equally well, and the others of them.

    Args:
        good: Refitted candidates, best first.
        chance_difference: Difference in evidence of two of them that chance alone may cause [nats].
    """
    first = good[0]
    equal = [
        s
        for s in good
        if s.total >= first.total - max(margin(first), chance_difference(first, s) if s is not first else 0.0)
    ]
    best = min(equal, key=lambda s: (len(s.candidate.index), -s.total))
    return best, tuple(s for s in equal if s is not best)
