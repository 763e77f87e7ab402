"""Whether an effect that fits the forces brings the simulated loop nearer: it is run with and without."""

from __future__ import annotations

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.search import Search
from jaxid.gap import simulated
from jaxid.machine import Machine
from jaxid.session import OpenedLog, Session

# An effect hinders where the simulated loop without it is nearer by so much: mean logarithm of the
# relative gaps in position and command over all logs.
_NEARER = 0.1
WHY = "the simulated loop comes nearer to the log without it"


def hindering(search: Search, session: Session, final: Machine) -> cand.Candidate | None:
    """The effect that most keeps the simulated loop from the logs; None where each helps.

    The force domain sees the band of the filter only. What fits there by growing beyond it, such as
    a ripple that is fast or a limit that nothing reaches, shows in the motion. In open loop any error
    grows with time, and the distance says little: nothing is asked then.

    Args:
        search: As it ended.
        session: Case and logs.
        final: Machine with the effects that the search added, at their values.
    """
    runs = [r for r in session.runs if r.log.reference is not None]
    if not search.added or session.machine.controller is None or not runs:
        return None
    whole = _distance(final, runs)
    nearer = {}
    for k, c in enumerate(search.added):
        theta = search.without(c)[search.active]
        nearer[k] = whole - _distance(final.with_estimate(theta), runs)
    worst = max(nearer, key=nearer.__getitem__)
    return search.added[worst] if nearer[worst] > _NEARER else None


def _distance(machine: Machine, runs: list[OpenedLog]) -> float:
    """Mean logarithm of the relative gaps in the loop, over the columns of a log and then the logs.

    A log from which the simulation runs away counts as far as one may be and still be a simulation.
    """
    means = []
    for r in runs:
        gap = simulated(r.machine(machine), r.log)
        columns = np.array([1e3]) if gap is None else np.concatenate([gap.relative, gap.command_relative])
        # A signal that is zero throughout has no relative gap.
        told = columns[np.isfinite(columns) & (columns > 0)]
        means.append(float(np.mean(np.log(told))) if len(told) else 0.0)
    return float(np.mean(means))
