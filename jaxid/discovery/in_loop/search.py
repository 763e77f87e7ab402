"""Search for effects that a model within a prior lacks, in its simulated loop.

This search serves logs that may not determine forces. Each candidate effect is added to the simulated loop
with next to no strength, and its column is regressed on the residual of the fit, while the unknowns respond
within their priors. The largest gain by noise alone is drawn, rounding in the loop included. Candidates that
gain more are fitted fully, from the points to which their linear trials lead in simulation.
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
from jaxid.estimators.effort import with_effort
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.within_prior.fit import within_prior_steps
from jaxid.gap import gaps, noise_floor
from jaxid.machine import Machine
from jaxid.model.unknowns import Free, free_effect
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session

# Number of most promising candidates that are fitted fully. They must reach this part of the threshold in
# their linear trial: the second value if the residual is not noise, since a trial covers few shapes.
_FEW, _PROMISING = 4, (0.5, 0.1)
# Effects whose evidence is that near to the best [nats] are equivalent to it.
_AS_GOOD = 2.0
UNSEEN = "a fit within a prior examines the simulated loop only"


def explore_within(session: Session, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """Run `discover` for a case with `[within_prior]`.

    Args:
        session: Case and log.
        max_effects: Largest number of effects to add.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If the loop cannot be simulated, or a guess is zero.
    """
    progress("fitting the baseline")
    first = run_alone(steps_of(session.case.prior_method, session))
    before = after = LoopFit.of(session, session.machine, {}, first)
    effects: list[NamedEffect] = []
    rounds = []
    added: Score | None = None
    while True:
        loop = Loop.of(session, after)
        progress(f"screening {len(loop.superset.candidates)} effects in the loop")
        trials = loop.trials()
        threshold, noisy = loop.threshold(trials)
        screened = loop.scored(trials)
        step = Step(
            added=added,
            dropped=None,
            scores=tuple(screened),
            threshold=threshold,
            theta=loop.theta,
            active=loop.superset.base,
        )
        rounds.append(Round(step, loop.rms, None))
        if len(effects) >= max_effects:
            break

        least = _PROMISING[0 if noisy else 1] * threshold
        promising = [s for s in screened if s.evidence > least][:_FEW]
        addition = _best_addition(loop, after, promising, threshold, trials, progress)
        if addition is None:
            break
        # Fits for the comparison were made without draws about them.
        fit, effect = addition
        drawn = session.case.need_prior().drawn
        after = _fit(session, fit.machine, fit.widths, fit.estimate.theta, drawn=drawn)
        effects.append(effect)
        added = effect.score
    verdict = "found" if effects else "nothing_missing" if noisy else "unexplained"
    progress("simulating")
    last = after.estimate
    old = gaps(first.machine, session.runs)
    new = gaps(last.machine, session.runs) if effects else old
    floor = noise_floor(first.machine, session.fit.log, session.fit.data)
    return Discovery(
        session=session,
        verdict=verdict,
        where=None if verdict == "nothing_missing" else Loop.of(session, before).where(),
        effects=tuple(effects),
        rounds=tuple(rounds),
        before=first,
        after=with_effort(last, session, new, searched=True),
        gaps_before=old,
        gaps_after=new,
        noise_floor=floor,
        unseen=UNSEEN,
    )


def _best_addition(
    loop: Loop,
    base: LoopFit,
    promising: list[Score],
    threshold: float,
    trials: list[LinearTrial],
    progress: Callable[[str], None],
) -> tuple[LoopFit, NamedEffect] | None:
    """Refit promising candidates; return the best fit and its effect, or None if none is accepted."""
    refitted = []
    for score in promising:
        progress(f"refitting with {score.candidate.label}")
        refitted.append(_refitted(loop, base, score, trials))
    good = sorted((r for r in refitted if r[0].evidence > threshold), key=lambda r: -r[0].evidence)
    if not good:
        return None
    best, fit, effect = good[0]
    near = [s for s, *_ in good[1:] if s.evidence > best.evidence - _AS_GOOD]
    return fit, replace(effect, alternatives=tuple(near))


def _refitted(
    loop: Loop, base: LoopFit, score: Score, trials: list[LinearTrial]
) -> tuple[Score, LoopFit, NamedEffect]:
    """Fit the best model within the prior with one more effect, and score its gain."""
    fits = [_fitted(loop, base, score.candidate, p) for p in loop.start_points(score.candidate, trials)]
    gained, start, fit = max(fits, key=lambda f: f[0])
    refitted = replace(score, start=start.start, guess=start.values, evidence=gained)
    c = score.candidate
    effect = NamedEffect(
        kind=c.kind,
        label=c.label,
        place=fit.machine.plant.place(c.port),
        names=tuple(fit.machine.parameters.names[len(loop.superset.base) :]),
        score=refitted,
        alternatives=(),
    )
    return refitted, fit, effect


def _fitted(loop: Loop, base: LoopFit, c: Candidate, start: StartPoint) -> tuple[float, StartPoint, LoopFit]:
    """Fit a model with one more effect from a start point; return the gain [nats], the start and the fit."""
    machine = base.machine
    plant, free = free_effect(machine.plant, effect_at(loop.superset, c, start.values), machine.units)
    machine = machine.with_plant(plant, machine.parameters.extended(free))
    widths = base.widths | {f.name: _width(f, c.starts[:, k]) for k, f in enumerate(free)}
    known = np.asarray(loop.problem.prior.outward(start.point))[: len(loop.superset.base)]
    fit = _fit(loop.session, machine, widths, np.concatenate([known, start.values]), drawn=False)
    return loop.gained(fit, base) if fit.estimate.converged else 0.0, start, fit


def _fit(
    session: Session,
    machine: Machine,
    widths: dict[str, float],
    begin: Float[np.ndarray, " p"],
    *,
    drawn: bool,
) -> LoopFit:
    """Fit within the prior from some values of the unknowns; for `drawn` see `within_prior_steps`."""
    settings, log = session.case.need_prior(), session.fit.log
    numerics = choose_numerics(machine, log, solver=settings.solver)
    result = run_alone(
        within_prior_steps(
            machine,
            log,
            prior=settings.prior,
            on=settings.on,
            widths=widths,
            begin=begin,
            drawn=drawn,
            numerics=numerics,
            minimiser=settings.minimiser,
        )
    )
    return LoopFit.of(session, machine, widths, replace(result, method=session.case.prior_method))


def _width(free: Free, starts: Float[np.ndarray, " starts"]) -> float:
    """Return the standard deviation of an effect's start: the range of its possible starts."""
    if free.sign == "positive":
        return max(1.0, float(np.log(starts.max() / starts.min())))
    return float(max(np.abs(starts).max(), abs(free.guess))) or 1.0
