"""Faults of the reading of a force, held against the effects that a search found."""

from __future__ import annotations

from collections.abc import Sequence

from jaxid.consistency.force_reading import ForceReading
from jaxid.consistency.late_force import LateForce, late_force
from jaxid.consistency.slow_force import SlowForce, slow_force
from jaxid.discovery import candidates as cand
from jaxid.discovery.final import machine_with
from jaxid.discovery.search import Model, Search, Step
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.names import HOLDS
from jaxid.session import Session
from jaxid.session.preparing import under_hold


def force_reading(
    session: Session, search: Search, machine: Machine, steps: Sequence[Step] = ()
) -> ForceReading | None:
    """Return a late or drifting reading of the force that explains one log as well as effects; None if none.

    Where nothing was found, a late force is held against the best spring that was turned down: a late force
    looks like one with a heavy load.

    Args:
        session: Case and logs.
        search: The search, at its end.
        machine: The machine of the case.
        steps: Steps of the search.
    """
    if session.more:
        return None
    if search.model.added:
        return _late_force(session, search, machine, search.model) or _slow_force(session, search, machine)
    scores = [s for step in steps for s in step.scores if s.reason and s.theta is not None]
    springs = [s for s in scores if cand.effect_of(search.superset, s.candidate).adds_spring]
    if not springs:
        return None
    best = max(springs, key=lambda s: s.evidence)
    return _late_force(session, search, machine, Model((best.candidate,), best.refitted))


def _late_force(session: Session, search: Search, machine: Machine, model: Model) -> LateForce | None:
    """Return the late force that explains the log as well as the effects of a model; None if none does.

    Those that shift the force in time are held against it first, then all.
    """
    whole, _ = machine_with(machine, search.superset, model.added, model.theta)
    data, held = session.fit.data, None
    if "hold" in session.settings:
        held = under_hold(HOLDS[0], session.fit, session.machine).data
    kept = [c for c in model.added if keeps_time(cand.effect_of(search.superset, c))]
    for beside in (kept, []) if kept else ([],):
        if len(beside) == len(model.added):
            continue
        without, _ = machine_with(machine, search.superset, beside, model.theta)
        named = [c.label for c in model.added if all(c is not b for b in beside)]
        late = late_force(without, whole, data, named, held)
        if late is not None:
            return late
    return None


def _slow_force(session: Session, search: Search, machine: Machine) -> SlowForce | None:
    """Return the slow course of the force that explains the log better than effects that were found.

    All effects are held against it first, then all but one; None if it explains the log better than none.
    """
    model = search.model
    whole, _ = machine_with(machine, search.superset, model.added, model.theta)
    added = list(model.added)
    for beside in ([], *([c] for c in added if len(added) > 1)):
        without, _ = machine_with(machine, search.superset, beside, model.theta)
        named = [c for c in added if all(c is not b for b in beside)]
        unknowns = sum(len(c.index) for c in named)
        slow = slow_force(without, whole, session.fit.data, [c.label for c in named], unknowns)
        if slow is not None:
            return slow
    return None


def keeps_time(effect: Effect) -> bool:
    """Check that an effect does not shift the force in time."""
    return effect.adds_force and not effect.adds_spring and not effect.delays_command()
