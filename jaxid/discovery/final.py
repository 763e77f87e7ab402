"""The machine at the end of a search, with the effects that were added."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.result import NamedEffect
from jaxid.discovery.score import Score
from jaxid.discovery.search import Search, Step
from jaxid.machine import Machine
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import free_effect


def machine_with(
    machine: Machine, superset: cand.CandidateModel, added: Sequence[cand.Candidate], theta: np.ndarray
) -> tuple[Machine, list[tuple[str, ...]]]:
    """Return the case's machine with only some effects, at values of the superset's unknowns.

    The names of each effect's unknowns are returned too.
    """
    plant, parameters = machine.plant, machine.parameters
    values, names = [*theta[superset.base]], []
    for c in added:
        own = _within_half_a_turn(superset, c, theta[c.index])
        plant, free = free_effect(plant, cand.effect_at(superset, c, own), machine.units)
        parameters = parameters.extended(free)
        values.extend(own)
        names.append(tuple(f.name for f in free))
    return machine.with_plant(plant, parameters).with_estimate(np.asarray(values)), names


def _within_half_a_turn(
    superset: cand.CandidateModel, candidate: cand.Candidate, values: np.ndarray
) -> np.ndarray:
    """Return values of an effect with its angles between -pi and pi: a phase is the same after a turn."""
    infos, out = parameters_of(type(cand.effect_of(superset, candidate))), values.copy()
    for k, i in enumerate(candidate.index):
        free = superset.machine.parameters.free[i]
        moved = values[k] - 2 * np.pi * np.round(values[k] / (2 * np.pi))
        if infos[str(free.path[-1])].dimension == "angle" and free.lower <= moved <= free.upper:
            out[k] = moved
    return out


def final_machine(
    machine: Machine, search: Search, alternatives: dict[int, tuple[Score, ...]], steps: list[Step]
) -> tuple[Machine, tuple[NamedEffect, ...]]:
    """Return the case's machine with only the effects that were added, at their refitted values."""
    final, named = machine_with(machine, search.superset, search.added, search.theta)
    effects = []
    for k, (c, names) in enumerate(zip(search.added, named, strict=True)):
        score = next(s.added for s in reversed(steps) if s.added and s.added.candidate is c)
        place = final.plant.place(c.port)
        effects.append(NamedEffect(c.kind, c.label, place, names, score, alternatives.get(k, ())))
    return final, tuple(effects)
