"""What a model within a prior lacks, judged in its simulated loop: its log may tell no forces.

Each effect that the machine might lack is added to the simulated loop next to no strength, and its column is
laid through what the fit leaves, the unknowns free to give way within their priors. What noise alone would
gain by the best of them, rounding in the loop included, is drawn; what gains more is fitted for good, from
where its looks lead when they are simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.discovery.candidates import Candidate, effect_at
from jaxid.discovery.in_loop.candidates import LinearTrial, Loop, LoopFit, StartPoint
from jaxid.discovery.result import Discovery, NamedEffect, Round
from jaxid.discovery.score import Score
from jaxid.discovery.search import Step
from jaxid.estimators import steps_of
from jaxid.estimators.within_prior.fit import directions_steps
from jaxid.gap import gaps, noise_floor
from jaxid.machine import Machine
from jaxid.model.unknowns import Free, free_effect
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session

# So many candidates are fitted for good, the most promising first: those that a linear look gives this part
# of the threshold; the second where something is seen, for the look knows an effect at few shapes only.
_FEW, _PROMISING = 4, (0.5, 0.1)
# What is that near to the best [nats] cannot be told from it.
_AS_GOOD = 2.0
UNSEEN = "a fit within a prior looks at the loop alone"


def explore_within(session: Session, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """`discover` for a case with `[within_prior]`.

    Args:
        session: Case and log.
        max_effects: Most effects to add.
        progress: Called with a line at every stage.

    Raises:
        InputError: If the loop cannot be simulated, or a guess is zero.
    """
    progress("fitting what is there")
    first = run_alone(steps_of(session.case.prior_method, session))
    before = after = LoopFit.of(session, session.machine, {}, first)
    effects: list[NamedEffect] = []
    rounds = []
    added: Score | None = None
    while True:
        loop = Loop.of(session, after)
        progress(f"screening {len(loop.union.candidates)} effects in the loop")
        looks = loop.looks()
        threshold, noisy = loop.threshold(looks)
        screened = loop.scored(looks)
        step = Step(added, None, tuple(screened), threshold, loop.theta, loop.union.base)
        rounds.append(Round(step, loop.rms, None))
        if len(effects) >= max_effects:
            break
        refitted = []
        least = _PROMISING[0 if noisy else 1] * threshold
        for score in [s for s in screened if s.evidence > least][:_FEW]:
            progress(f"refitting with {score.candidate.label}")
            refitted.append(_refitted(loop, after, score, looks))
        good = sorted((r for r in refitted if r[0].evidence > threshold), key=lambda r: -r[0].evidence)
        if not good:
            break
        added, after, found = good[0]
        # Those that were only compared had nothing drawn about them.
        drawn = session.case.need_prior().drawn
        after = _fit(session, after.machine, after.widths, after.estimate.theta, drawn=drawn)
        near = [s for s, *_ in good[1:] if s.evidence > added.evidence - _AS_GOOD]
        effects.append(replace(found, alternatives=tuple(near)))
    verdict = "found" if effects else "nothing_missing" if noisy else "unexplained"
    progress("simulating")
    last = after.estimate
    old = gaps(first.machine, session.runs)
    new = gaps(last.machine, session.runs) if effects else old
    floor = noise_floor(first.machine, session.fit.log, session.fit.data)
    where = None if verdict == "nothing_missing" else Loop.of(session, before).where()
    return Discovery(
        session, verdict, where, tuple(effects), tuple(rounds), first, last, old, new, floor, (), UNSEEN
    )


def _refitted(
    loop: Loop, base: LoopFit, score: Score, looks: list[LinearTrial]
) -> tuple[Score, LoopFit, NamedEffect]:
    """The best fit within the prior with an effect beside the rest, and what it gains."""
    fits = [_fitted(loop, base, score.candidate, begin) for begin in loop.begins(score.candidate, looks)]
    gained, begin, fit = max(fits, key=lambda f: f[0])
    refitted = replace(score, start=begin.start, guess=begin.values, evidence=gained)
    c, own = score.candidate, fit.machine.parameters.names[len(loop.union.base) :]
    return refitted, fit, NamedEffect(c.kind, c.label, fit.machine.plant.place(c.port), own, refitted, ())


def _fitted(loop: Loop, base: LoopFit, c: Candidate, begin: StartPoint) -> tuple[float, StartPoint, LoopFit]:
    machine = base.machine
    plant, free = free_effect(machine.plant, effect_at(loop.union, c, begin.values), machine.units)
    machine = machine.with_plant(plant, machine.parameters.extended(free))
    widths = base.widths | {f.name: _width(f, c.starts[:, k]) for k, f in enumerate(free)}
    known = np.asarray(loop.problem.prior.outward(begin.point))[: len(loop.union.base)]
    fit = _fit(loop.session, machine, widths, np.concatenate([known, begin.values]), drawn=False)
    return loop.gained(fit, base) if fit.estimate.converged else 0.0, begin, fit


def _fit(
    session: Session,
    machine: Machine,
    widths: dict[str, float],
    begin: Float[np.ndarray, " p"],
    *,
    drawn: bool,
) -> LoopFit:
    """A fit within the prior from some values of the unknowns; `drawn`: as of `directions_steps`."""
    settings = session.case.need_prior()
    found = run_alone(
        directions_steps(
            machine,
            session.fit.log,
            prior=settings.prior,
            on=settings.on,
            widths=widths,
            begin=begin,
            drawn=drawn,
        )
    )
    return LoopFit.of(session, machine, widths, replace(found, method=session.case.prior_method))


def _width(free: Free, starts: Float[np.ndarray, " starts"]) -> float:
    """Standard deviation of what an effect begins at: it may be as far off as where else it might begin."""
    if free.sign == "positive":
        return max(1.0, float(np.log(starts.max() / starts.min())))
    return float(max(np.abs(starts).max(), abs(free.guess))) or 1.0
