"""The machine at the end of a search, with the effects that were added."""

from __future__ import annotations

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.result import NamedEffect
from jaxid.discovery.score import Score
from jaxid.discovery.search import Search, Step
from jaxid.machine import Machine
from jaxid.model.unknowns import free_effect


def final_machine(
    machine: Machine, search: Search, alternatives: dict[int, tuple[Score, ...]], steps: list[Step]
) -> tuple[Machine, tuple[NamedEffect, ...]]:
    """Return the case's machine with only the effects that were added, at their refitted values."""
    plant, parameters = machine.plant, machine.parameters
    theta = [*search.theta[search.superset.base]]
    effects = []
    for k, c in enumerate(search.added):
        effect = cand.effect_at(search.superset, c, search.theta[c.index])
        plant, free = free_effect(plant, effect, machine.units)
        parameters = parameters.extended(free)
        theta.extend(search.theta[c.index])
        score = next(s.added for s in reversed(steps) if s.added and s.added.candidate is c)
        names = tuple(f.name for f in free)
        place = plant.place(c.port)
        effects.append(NamedEffect(c.kind, c.label, place, names, score, alternatives.get(k, ())))
    final = machine.with_plant(plant, parameters).with_estimate(np.asarray(theta))
    return final, tuple(effects)
