"""Effects that act at rest, named by the moments at which a joint starts from rest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxid.discovery import candidates as cand
from jaxid.discovery.at_rest.break_away import BreakAway, break_away
from jaxid.discovery.at_rest.fading import Fading, fading_friction
from jaxid.discovery.at_rest.holding_force import was_held
from jaxid.discovery.result import NamedEffect
from jaxid.discovery.score import Score
from jaxid.discovery.search import Search, Step
from jaxid.discovery.where import Where
from jaxid.estimators.estimate import Estimate
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import free_effect
from jaxid.session import Session


@dataclass(frozen=True)
class Found:
    """Effects that were named so far.

    Args:
        estimate: Fit of the machine with them.
        effects: The effects.
        where: Region in which the baseline's residual is significant.
        unseen: Reason why no break-away friction was named, or "".
    """

    estimate: Estimate
    effects: tuple[NamedEffect, ...]
    where: Where
    unseen: str


def named_at_rest(
    found: Found,
    session: Session,
    search: Search,
    steps: list[Step],
    most: int,
    progress: Callable[[str], None],
) -> Found:
    """Name the friction at rest that the starts from rest show.

    Args:
        found: What was named by the samples that move.
        session: Case and logs.
        search: The search.
        steps: Its steps, to which those of this are added.
        most: Largest number of effects.
        progress: Called with a line of text at every stage.
    """
    # The trials of a start from rest run one machine.
    differ = session.more and any(run.own and run.own.plant for run in session.fits)
    differ = differ or any(f.log is not None for f in session.machine.parameters.free)
    missing = [] if found.unseen or differ else _break_aways(search)
    while missing:
        progress("evaluating the starts from rest")
        leaving = break_away(found.estimate, session.runs, [c.port for c in missing])
        unseen = next((b for b in leaving if isinstance(b, str)), "")
        found = replace(found, unseen=unseen)
        machine, data = found.estimate.machine, session.fit.data
        held = [
            b
            for c, b in zip(missing, leaving, strict=True)
            if isinstance(b, BreakAway) and b.holds and was_held(machine, data, b, c.port)
        ]
        if not held or len(found.effects) >= most:
            break
        # The clearest first: a joint that sticks makes its neighbours start late.
        b = max(held, key=lambda b: b.evidence)
        c = missing.pop(leaving.index(b))
        where = found.where if found.effects else _at_starts(found.where, c, b)
        progress("comparing with friction that fades above rest")
        fading = fading_friction(session, found.estimate, search.superset, c.port, b)
        if fading is None:
            estimate, effect, step = _with_break_away(found.estimate, search, c, b)
            estimate = replace(estimate, notes=(*estimate.notes, _rival_at_rest(session, effect, c.port)))
        else:
            estimate, effect, step = _with_fading(search, fading, b)
        steps.append(step)
        found = Found(estimate, (*found.effects, effect), where, unseen)
    return found


def _break_aways(search: Search) -> list[cand.Candidate]:
    """Return candidates that act at rest only and have one parameter, their level; one for each port."""
    out: dict[int, cand.Candidate] = {}
    for c in search.rest():
        cls = type(cand.effect_of(search.superset, c))
        if [*parameters_of(cls)] == [cls.break_away_level]:
            out.setdefault(c.port, c)
    return list(out.values())


def _with_break_away(
    estimate: Estimate, search: Search, c: cand.Candidate, b: BreakAway
) -> tuple[Estimate, NamedEffect, Step]:
    """Return an estimate with break-away friction added at the level that the starts from rest show."""
    machine = estimate.machine
    cls = type(cand.effect_of(search.superset, c))
    effect = cls(**{str(cls.break_away_level): b.level}, port=c.port)
    plant, free = free_effect(machine.plant, effect, machine.units)
    theta = np.append(estimate.theta, b.level)
    machine = machine.with_plant(plant, machine.parameters.extended(free)).with_estimate(theta)
    beside = estimate.std_misspecified
    new = replace(
        estimate,
        machine=machine,
        theta=theta,
        precision=estimate.precision.beside(b.std),
        std_misspecified=None if beside is None else np.append(beside, np.nan),
    )
    score = Score(c, 0, np.array([b.level]), b.evidence)
    found = NamedEffect(c.kind, c.label, plant.place(c.port), (free[0].name,), score, ())
    return new, found, Step(score, None, (score,), b.threshold, search.theta, search.active)


def _with_fading(search: Search, fading: Fading, b: BreakAway) -> tuple[Estimate, NamedEffect, Step]:
    """Return the fit with a friction that fades just above rest, in place of a break-away friction."""
    c, place = fading.candidate, fading.estimate.machine.plant.place(fading.candidate.port)
    score = Score(c, 0, fading.values, fading.evidence)
    found = NamedEffect(c.kind, c.label, place, fading.names, score, ())
    return fading.estimate, found, Step(score, None, (score,), b.threshold, search.theta, search.active)


def _rival_at_rest(session: Session, effect: NamedEffect, port: int) -> str:
    """Return the note that a friction which fades just above rest looks as a break-away friction does."""
    slow = session.fit.data.recipe.rest_velocity[port]
    unit = session.machine.unit("position/time", port)
    return (
        f"{effect.label} was found at the starts from rest: a stribeck_friction that fades below "
        f"{slow:.2g} {unit}, the slowest motion that counts, would look alike there"
    )


def _at_starts(where: Where, c: cand.Candidate, b: BreakAway) -> Where:
    """Return the region in which break-away friction shows: the starts from rest, without a curve."""
    text = f"joint {c.port + 1}: {b.count} starts from rest come later than sliding friction explains"
    spans = tuple((float(t), float(t)) for t in b.times)
    region = (float(b.times.min()), float(b.times.max())) if len(b.times) else where.region
    none = np.zeros(0)
    return replace(
        where,
        joint=c.port + 1,
        variable="time",
        region=region,
        intervals=spans,
        text=text,
        evidence=b.evidence,
        threshold=b.threshold,
        x=none,
        mean=none,
        low=none,
        high=none,
        frequency_hz=None,
    )
