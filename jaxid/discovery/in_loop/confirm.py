"""Confirmation in the simulated loop: an effect that fits the forces must also bring the motion nearer."""

from __future__ import annotations

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.search import Search
from jaxid.gap import simulation_of_log
from jaxid.machine import Machine
from jaxid.session import OpenedLog, Session

# An effect is taken out if the simulated loop without it is nearer to the logs by this much: mean logarithm
# of the relative gaps in position and command over all logs.
_NEARER = 0.1
WHY = "the simulated loop comes nearer to the log without it"


def hindering(search: Search, session: Session, final: Machine) -> cand.Candidate | None:
    """Find the effect that most keeps the simulated loop from the logs; None if each of them helps.

    The force domain covers the band of the filter only. An effect that fits there by growth beyond the band,
    such as a fast ripple or a limit that is never reached, shows in the motion. In open loop any error grows
    with time, and the distance is not informative: the test is omitted then.

    Args:
        search: The search at its end.
        session: Case and logs.
        final: Machine with the effects that the search added, at their values.
    """
    runs = [r for r in session.runs if r.log.reference is not None]
    if not search.added or session.machine.controller is None or not runs:
        return None
    whole = _distance(final, runs)
    nearer = {}
    for k, c in enumerate(search.added):
        theta = search.without(search.model, c).theta[search.active]
        nearer[k] = whole - _distance(final.with_estimate(theta), runs)
    worst = max(nearer, key=nearer.__getitem__)
    return search.added[worst] if nearer[worst] > _NEARER else None


def _distance(machine: Machine, runs: list[OpenedLog]) -> float:
    """Return the mean logarithm of the relative gaps in the loop, over columns of a log and then over logs.

    A log on which the simulation diverges counts with a relative gap of 1000.
    """
    means = []
    for r in runs:
        gap = simulation_of_log(r.machine(machine), r.log)
        if gap is None:
            columns = np.array([1e3])
        else:
            assert gap.command_relative is not None, "a loop has a command"
            columns = np.concatenate([gap.relative, gap.command_relative])
        # A signal that is zero throughout has no relative gap.
        defined = columns[np.isfinite(columns) & (columns > 0)]
        means.append(float(np.mean(np.log(defined))) if len(defined) else 0.0)
    return float(np.mean(means))
