"""The search for missing friction in a table of steady speeds.

A table has few rows and no time, so that each effect is refitted, and its evidence is that of every row
predicted from the others.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.consistency.absent import acts_by_position
from jaxid.discovery.candidates import Candidate
from jaxid.discovery.result import Discovery, NamedEffect, Round
from jaxid.discovery.score import Score
from jaxid.discovery.search import Step
from jaxid.discovery.selection import simplest_equivalent
from jaxid.discovery.where import Where
from jaxid.estimators.common.shapes import without_unseen_shapes
from jaxid.estimators.estimate import Estimate
from jaxid.gap import force_gap, gaps, row_noise
from jaxid.machine import Machine
from jaxid.model.effect import Effect, Scales, Signals, scaled
from jaxid.model.parameter import parameters_of
from jaxid.model.unknowns import free_effect, label
from jaxid.numerics.lanes import run_alone
from jaxid.session import Session
from jaxid.steady import balance_rows, steady_fit

# Probability that noise alone exceeds the threshold with any of the candidates.
_FALSE_POSITIVE = 1e-3
# Difference in evidence of two effects that chance may cause [nats].
_CHANCE = 3.0
# Rows in one point of the curve of the residual over the velocity.
_ROWS_A_POINT = 2


@dataclass(frozen=True)
class _Trial:
    """A fit of the table with one more effect.

    Args:
        effect: The effect at its start; None for the baseline.
        session: The session with the machine that was fitted.
        estimate: Its estimate.
        squares: Sum of squares of every row predicted from the others, weighted.
    """

    effect: Effect | None
    session: Session
    estimate: Estimate
    squares: float


def explore_steady(
    session: Session, *, max_effects: int = 5, progress: Callable[[str], None] = lambda text: None
) -> Discovery:
    """Search a table of steady speeds for the friction that its case lacks.

    Args:
        session: The session, of `jaxid.steady.open_steady`.
        max_effects: Largest number of effects to add.
        progress: Function called with a line of text at every stage.

    Source:
        Allen (1974), Technometrics 16, for the prediction of each row from the others (PRESS).
    """
    progress("fitting the declared model")
    baseline = now = _trial(session, None)
    steps, named = [_step(session, None, (), 0.0)], []
    rounds = [_round(baseline, steps[0])]
    while len(named) < max_effects:
        trials = []
        for effect in _candidates(now.session):
            progress(f"fitting {effect.kind}")
            trials.append(_trial(_with(now.session, effect), effect))
        trials = [t for t in trials if t.estimate.converged and _determined(t)]
        scores = [_score(session, now, t) for t in trials]
        limit = _threshold(session, trials)
        order = sorted(range(len(scores)), key=lambda k: -scores[k].evidence)
        good = [scores[k] for k in order if scores[k].evidence > limit]
        if not good:
            steps.append(_step(session, None, tuple(scores[k] for k in order), limit))
            rounds.append(_round(now, steps[-1]))
            break
        best, others = simplest_equivalent(good, lambda one, two: _CHANCE)
        now = trials[next(k for k, s in enumerate(scores) if s is best)]
        steps.append(_step(session, best, tuple(scores[k] for k in order), limit))
        rounds.append(_round(now, steps[-1]))
        free = now.estimate.machine.parameters.free[-len(best.candidate.index) :]
        place = session.machine.plant.place(0)
        names = tuple(f.name for f in free)
        named.append(NamedEffect(best.candidate.kind, best.candidate.label, place, names, best, others))

    before, after = baseline.estimate, now.estimate
    old = gaps(before.machine, session.runs)
    new = gaps(after.machine, session.runs) if named else old
    left = _beyond_scatter(now)
    verdict = "found" if named else "unexplained" if left else "nothing_missing"
    where = None if verdict == "nothing_missing" else _where(session, baseline)
    floor = row_noise(session.machine, session.fit.log)
    return Discovery(
        session=session,
        verdict=verdict,
        where=where,
        effects=tuple(named),
        rounds=tuple(rounds),
        before=before,
        after=without_unseen_shapes(after),
        gaps_before=old,
        gaps_after=new,
        noise_floor=floor,
    )


def _trial(session: Session, effect: Effect | None) -> _Trial:
    estimate = run_alone(steady_fit(session))
    fitted = replace(session, machine=estimate.machine)
    e, jacobian = balance_rows(fitted)
    scale = np.linalg.norm(jacobian, axis=0)
    used = jacobian[:, scale > 0] / scale[scale > 0]
    left, values, _ = np.linalg.svd(used, full_matrices=False)
    left = left[:, values > 1e-9 * np.max(values, initial=1e-300)]
    leverage = np.sum(left**2, axis=1)
    squares = float(np.sum((e / np.maximum(1 - leverage, 1e-6)) ** 2))
    return _Trial(effect, fitted, estimate, squares)


def _determined(trial: _Trial) -> bool:
    """Check that the table determines every parameter of the new effect."""
    assert trial.effect is not None, "asked only with an effect"
    count = len([n for n in parameters_of(type(trial.effect)) if getattr(trial.effect, n) is not None])
    return bool(np.all(trial.estimate.identifiable[-count:]))


def _with(session: Session, effect: Effect) -> Session:
    """Return the session with one more effect, whose parameters are unknown."""
    machine = session.machine
    plant, free = free_effect(machine.plant, effect, machine.units)
    theta = np.append(machine.parameters.guess, [f.guess for f in free])
    wider = machine.with_plant(plant, machine.parameters.extended(free)).with_estimate(theta)
    return replace(session, machine=wider)


def _candidates(session: Session) -> list[Effect]:
    """Return the effects whose force depends on the velocity alone and that the plant does not have yet."""
    machine, speed = session.machine, np.abs(session.fit.log.readings_of_speed)
    force = np.abs(session.fit.data.force)
    scales = Scales(
        position=1.0,
        velocity=float(np.sqrt(np.mean(speed**2))),
        acceleration=1.0,
        force=float(np.sqrt(np.mean(force**2))),
        peak_velocity=float(speed.max()),
        peak_force=float(force.max()),
        period=1.0,
        duration=1.0,
    )
    present = {effect.kind for effect in machine.plant.effects}
    out = []
    for cls in session.case.searched:
        own = cls.kind in present or cls.with_springs or cls.of_stages or not cls.adds_force
        if own or cls.initial_state is not Effect.initial_state or cls.delays_command():
            continue
        starts = cls.starts(scales)
        start = starts[len(starts) // 2]
        # Weak at first, so that the refit begins near the model without it.
        values: dict[str, Any] = {name: jnp.asarray(v) for name, v in scaled(cls, start, 0.1).items()}
        effect = cls(**values)
        if not acts_by_position(effect) and _acts_at_speed(effect):
            out.append(effect)
    return out


def _acts_at_speed(effect: Effect) -> bool:
    """Check that an effect has a force at a steady speed, and none that depends on the acceleration."""

    def force(acceleration: float) -> float:
        named = {name: jnp.asarray(0.0) for name in Signals.__dataclass_fields__}
        named |= {"yd": jnp.asarray(0.2), "ydd": jnp.asarray(acceleration), "width": jnp.asarray(1e-3)}
        action = effect.act(Signals(**{**named, "dry_scale": jnp.asarray(1.0)}), None)
        return float(jnp.asarray(action.force)) + float(jnp.asarray(action.dry))

    return force(0.0) != 0.0 and force(0.0) == force(1.0)


def _score(session: Session, now: _Trial, trial: _Trial) -> Score:
    """Return the evidence of an effect: the gain in the likelihood of rows predicted from the others."""
    effect = trial.effect
    assert effect is not None, "asked only with an effect"
    rows = int(session.fit.data.moving.sum())
    if _scatter_known(session):
        gain = 0.5 * (now.squares - trial.squares)
    else:
        gain = 0.5 * rows * np.log(max(now.squares, 1e-300) / max(trial.squares, 1e-300))
    names = [n for n in parameters_of(type(effect)) if getattr(effect, n) is not None]
    theta = np.asarray(trial.estimate.theta)
    index = np.arange(len(theta) - len(names), len(theta))
    neutral, start = np.zeros(len(names)), theta[index]
    amplitude = np.ones(len(names), bool)
    named = label(session.machine.plant, effect.kind, effect.port)
    candidate = Candidate(effect.kind, named, effect.port, index, neutral, start[None], amplitude)
    validation = _on_validation(session, now.estimate.machine, trial.estimate.machine)
    reason = "" if validation is None or validation > 0 else "the validation tables contradict it"
    evidence = float(gain) if not reason else min(float(gain), 0.0)
    return Score(candidate, 0, start, evidence, validation=validation, theta=theta, reason=reason)


def _on_validation(session: Session, before: Machine, after: Machine) -> float | None:
    """Return the gain in log-likelihood on the validation tables [nats]; None without any."""
    if not session.validations:
        return None
    gain = 0.0
    for run in session.validations:
        old, new = (np.nansum(force_gap(m, run.data).residual ** 2) for m in (before, after))
        gain += 0.5 * run.data.moving.sum() * np.log(max(old, 1e-300) / max(new, 1e-300))
    return float(gain)


def _threshold(session: Session, trials: list[_Trial]) -> float:
    """Return the evidence that noise alone exceeds once in a thousand tables, with any of the candidates.

    It is that of the fit itself, of which the prediction of rows left out gains less.
    """
    rows, many = int(session.fit.data.moving.sum()), max(len(trials), 1)
    most = max((t.estimate.theta.size - session.machine.parameters.guess.size for t in trials), default=1)
    chance = _FALSE_POSITIVE / many
    if _scatter_known(session):
        return 0.5 * float(scipy.stats.chi2.isf(chance, most))
    spare = max(rows - max((t.estimate.theta.size for t in trials), default=0), 1)
    return 0.5 * rows * float(np.log1p(most * scipy.stats.f.isf(chance, most, spare) / spare))


def _scatter_known(session: Session) -> bool:
    steady = session.fit.log.steady
    return steady is not None and steady.std is not None


def _beyond_scatter(trial: _Trial) -> bool:
    """Check that a residual exceeds the stated scatter of the rows."""
    if not _scatter_known(trial.session):
        return False
    e, jacobian = balance_rows(trial.session)
    return bool(scipy.stats.chi2.sf(np.sum(e**2), max(len(e) - jacobian.shape[1], 1)) < _FALSE_POSITIVE)


def _step(session: Session, added: Score | None, scores: tuple[Score, ...], limit: float) -> Step:
    theta = session.machine.parameters.guess if added is None else added.refitted
    return Step(added, None, scores, limit, np.asarray(theta), np.arange(len(theta)))


def _round(trial: _Trial, step: Step) -> Round:
    """Return a step with the residuals of its machine."""
    machine, session = trial.estimate.machine, trial.session
    fit, *others = (force_gap(machine, run.data).rms for run in session.runs)
    return Round(step, fit, np.max(others, axis=0) if others else None)


def _where(session: Session, baseline: _Trial) -> Where:
    """Return the velocities at which the baseline's residual is largest."""
    gap = force_gap(baseline.estimate.machine, session.fit.data)
    speed: Float[np.ndarray, " rows"] = session.fit.log.readings_of_speed[:, 0]
    rows = np.isfinite(gap.residual[:, 0])
    order = np.argsort(speed[rows])
    v, e = speed[rows][order], gap.residual[rows, 0][order]
    pieces = np.array_split(np.arange(len(v)), max(len(v) // _ROWS_A_POINT, 1))
    x, mean = (np.array([values[p].mean() for p in pieces]) for values in (v, e))
    half = 1.96 * float(np.std(e)) / np.sqrt(_ROWS_A_POINT)
    k = int(np.argmax(np.abs(mean)))
    region = (float(v[pieces[k]].min()), float(v[pieces[k]].max()))
    unit = session.machine.unit("position/time")
    text = f"the residual is largest between {region[0]:.3g} and {region[1]:.3g} {unit}"
    return Where(
        joint=1,
        variable="velocity",
        region=region,
        intervals=(),
        text=text,
        explained=0.0,
        evidence=0.0,
        threshold=0.0,
        clear=True,
        x=x,
        mean=mean,
        low=mean - half,
        high=mean + half,
    )
