"""Which of several scored effects to refit, to add, or to name beside another."""

from __future__ import annotations

from collections.abc import Callable

from jaxid.discovery.score import Score

# So many of the best candidates are refitted; a linear screen at a start is not the last word.
REFITTED = 5
# Two candidates whose evidence differs by less explain the log equally well: a factor of 20 in
# likelihood, or one percent of a large evidence, which is what filtering and sampling leave
# uncertain.
TIE_NATS = 3.0
TIE_PART = 0.01
# While much is missing, the effect with fewer parameters goes first where it gains this part of
# the best: a flexible one gains by imitating what is not there yet. What is still missing then
# shows in the next round, and what has become superfluous is dropped.
MODEST = 0.7


def shortlist(promising: list[Score]) -> list[Score]:
    """The best candidates, and the best of those with a single parameter."""
    best = promising[:REFITTED]
    single = [s for s in promising[REFITTED:] if len(s.candidate.index) == 1]
    return [*best, *single[:1]]


def margin(score: Score) -> float:
    """By how much evidence may differ between effects that explain a log equally well [nats]."""
    return max(TIE_NATS, TIE_PART * abs(score.total))


def next_effect(good: list[Score]) -> Score | None:
    """The effect to add next: of those that gain most of what the best gains, the simplest."""
    if not good:
        return None
    enough = [s for s in good if s.total > min(MODEST * good[0].total, good[0].total - TIE_NATS)]
    return min(enough, key=lambda s: (len(s.candidate.index), -s.total))


def simplest_equivalent(
    good: list[Score], undecided: Callable[[Score, Score], float]
) -> tuple[Score, tuple[Score, ...]]:
    """Of those that explain the log equally well, the simplest; and the others.

    Args:
        good: Refitted, best first.
        undecided: Difference in evidence of two of them that chance alone may make [nats].
    """
    first = good[0]
    equal = [
        s
        for s in good
        if s.total >= first.total - max(margin(first), undecided(first, s) if s is not first else 0.0)
    ]
    best = min(equal, key=lambda s: (len(s.candidate.index), -s.total))
    return best, tuple(s for s in equal if s is not best)
