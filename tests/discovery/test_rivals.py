"""Effects that explain a log as well as one that was named."""

from functools import partial
from types import SimpleNamespace

import numpy as np

from jaxid.discovery.score import Score
from jaxid.discovery.search import Model, Search

CHANCE = 2.5  # [nats], by which two of the fits below differ by chance


def effect(label: str, unknowns: int) -> SimpleNamespace:
    return SimpleNamespace(label=label, index=np.arange(unknowns))


def rivals(named: SimpleNamespace, *others: tuple[SimpleNamespace, float]) -> list[str]:
    """Labels of the rivals of an effect that gains 125 nats, and is kept, by what others gain [nats]."""
    scores = [
        Score(c, 0, np.zeros(1), gain, theta=np.zeros(1))
        for c, gain in sorted([(named, 125.0), *others], key=lambda pair: -pair[1])
    ]
    search = SimpleNamespace(
        model=Model((named,), np.zeros(1)),
        progress=lambda text: None,
        without=lambda model, c: model,
        best=lambda model, near, replaced: ((), tuple(scores), 17.0),
        _chance_difference=lambda one, two: CHANCE,
        _takes_over=lambda model, best, current: False,
    )
    search._equal = partial(Search._equal, search)
    return [s.candidate.label for s in Search.alternatives(search, [])[0]]


def test_an_exact_tie_is_a_rival_beside_an_effect_that_gains_more_with_more_unknowns():
    """A spring at the drive imitated all; a gain of the drive, alike to 0.01 nats, was not listed."""
    mass, gain, spring = effect("mass", 1), effect("gain", 1), effect("spring", 3)
    assert rivals(mass, (gain, 124.99), (spring, 138.0)) == ["spring", "gain"]


def test_an_effect_that_gains_less_than_chance_explains_is_no_rival():
    mass, other, spring = effect("mass", 1), effect("other", 1), effect("spring", 3)
    assert rivals(mass, (other, 120.0), (spring, 138.0)) == ["spring"]
    assert rivals(mass, (other, 120.0)) == []
    assert rivals(mass, (other, 123.0)) == ["other"]
