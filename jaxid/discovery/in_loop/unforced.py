"""Search for missing effects in logs of a loop without a force, by the positions of the simulated loop.

It is the search of `jaxid.discovery.search` with other evidence: in place of forces, the position of the
simulated loop, in which every candidate is linearised at the fitted parameters and refitted if it is
promising. Effects that act on the command and on the error of the controller take part.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from jaxid.controllers.linear import PD
from jaxid.discovery.candidates import Candidate, CandidateModel, View
from jaxid.discovery.final import final_machine, machine_with
from jaxid.discovery.in_loop.afar import MANY, Afar, Effort
from jaxid.discovery.in_loop.positions import JoinedLoops, Loops, LoopSamples, LoopSearch, PositionDomain
from jaxid.discovery.result import Discovery, Round
from jaxid.discovery.search import Model, Step
from jaxid.discovery.superset import build_candidate_model
from jaxid.discovery.where import Where
from jaxid.errors import InputError
from jaxid.estimators import steps_of
from jaxid.estimators.coarse_starts import coarse_starts, points_about
from jaxid.estimators.effort import with_effort
from jaxid.estimators.estimate import Estimate, rms_left
from jaxid.estimators.mean_readings import fitted_with_noise
from jaxid.estimators.output_error import output_error_steps
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.estimators.unforced import (
    at_its_loop_steps,
    common_scale_group,
    leaves_loop_open,
    unforced_steps,
    with_free_scale,
    without,
)
from jaxid.gap import Gap, gaps
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import Effect
from jaxid.model.plant import Plant
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import run_alone
from jaxid.results.verdict.completeness import position_residuals
from jaxid.session import OpenedLog, Session
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Numerics, Replay, make_replay
from jaxid.simulation.sensor_noise import position_noise

UNSEEN = "a log without a force is compared in the simulated loop, which follows no jump at break-away"
# Refit of a machine with what was found: session, machine, and the index of the unknown that gave the scale.
Refit: TypeAlias = "Callable[[Session, Machine, int | None], Estimate]"
# RMS that a fit at another loop leaves, over that at the first one, up to which it counts as good.
_AS_GOOD = 1.02
# Samples of the window in which the residual is loudest, as a part of the log.
_WINDOW = 0.02
# `benchmarks.unforced`, 2026-11-29: 22 of 24 hidden effects named alone, nothing in 80 complete cases.
_UNPROVEN = (
    "without a force the effect that is named may stand for another one: hold what was found against another "
    "log (docs/without_a_force.md)"
)


def explore_unforced(session: Session, *, max_effects: int, progress: Callable[[str], None]) -> Discovery:
    """Run `discover` for logs without a force.

    Args:
        session: Case and logs.
        max_effects: Largest number of effects to add.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If the loop cannot be simulated.
    """
    progress("fitting the declared model")
    before = run_alone(steps_of("output_error", session))
    if not leaves_loop_open(session):
        return explored_from(session, before, max_effects=max_effects, progress=progress)

    # An incomplete model shows neither the law nor the rate of its loop: with what was found they may change,
    # and with them what is missing.
    refit = _refit_at_any_loop()
    found = explored_from(session, before, max_effects=max_effects, progress=progress, refit=refit)
    if not found.effects or loop_of(found.after.machine) == loop_of(before.machine):
        return found
    progress("searching again at the loop that shows with what was found")
    at = session.with_machine(at_loop(session.machine, found.after.machine))
    before = _with_choices(run_alone(at_its_loop_steps(at)), found.after)
    before = replace(before, notes=(*before.notes, *_choices(found.after, "a fit with the effects found")))
    complete = not open_joints(at, found.after.machine, found.gaps_after)
    return explored_from(
        at,
        before,
        max_effects=max_effects,
        progress=progress,
        refit=refit,
        among=_found_or_rivals(found) if complete else None,
    )


def _found_or_rivals(found: Discovery) -> frozenset[str]:
    """Return the kinds of the effects that a search found, and of those that explain the log as well."""
    named = {effect.kind for effect in found.effects}
    rivals = {rival.candidate.kind for effect in found.effects for rival in effect.alternatives}
    return frozenset(named | rivals)


def _refit_at_any_loop() -> Refit:
    """Return a refit at each loop that the case allows, which fits no machine twice."""
    done: dict[frozenset[str], Estimate] = {}

    def refit(session: Session, final: Machine, base: int | None) -> Estimate:
        names = frozenset(final.parameters.names)
        if names not in done:
            done[names] = at_any_loop(session, refitted(session, final, base))
        return done[names]

    return refit


def at_any_loop(session: Session, near: Estimate) -> Estimate:
    """Return the best fit at the loops that the case allows, from the values of a fit at one of them.

    It is the given fit if none converges and leaves as little.
    """
    stated, demands = session.case.output_error, session.case.identification
    options = {"minimiser": stated.minimiser, "hessian": demands.hessian}
    best = run_alone(unforced_steps(session.with_machine(near.machine), near=True, **options))
    return best if best.converged and rms_left(best) <= _AS_GOOD * rms_left(near) else near


def loop_of(machine: Machine) -> dict[str, Any]:
    """Return the settings of a machine's loop that a fit may choose."""
    law = machine.controller
    assert law is not None, "asked of a loop"
    chosen = {"derivative": law.derivative} if isinstance(law, PD) else {}
    return {"period": law.period, **chosen, "reference_hold": machine.reference_hold}


def at_loop(machine: Machine, other: Machine) -> Machine:
    """Return a machine with the loop of another one."""
    assert machine.controller is not None, "asked of a loop"
    loop = loop_of(other)
    hold = loop.pop("reference_hold")
    return replace(machine, controller=replace(machine.controller, **loop), reference_hold=hold)


def explored_from(
    session: Session,
    before: Estimate,
    *,
    max_effects: int,
    progress: Callable[[str], None],
    effort: Effort = MANY,
    judged: bool = True,
    refit: Refit | None = None,
    among: frozenset[str] | None = None,
    to_spring: bool = False,
) -> Discovery:
    """Search logs without a force from a fit of the declared model.

    Args:
        session: Case and logs.
        before: The fit.
        max_effects, progress: See `explore_unforced`.
        effort: Number of starts far from the fits of incomplete models.
        judged: Whether what a search without effects leaves is compared with noise; if not, its verdict says
            that nothing is missing.
        refit: Refit of a machine with what was found; None: `refitted`.
        among: Kinds of the effects that are tried; None: those of the case.
        to_spring: Whether the search ends with the first effect that adds a spring, without rivals.

    Raises:
        InputError: If the loop cannot be simulated.
    """
    fitted, base = at_scale(before)
    search = _search(session, fitted, effort, progress, among)
    search.to_spring = to_spring
    steps = search.run(max_effects)
    alternatives = {} if search.ended_early else search.alternatives(steps)
    final, effects = final_machine(fitted, search, alternatives, steps)
    progress("refitting in simulation")
    if search.ended_early:
        refit = functools.partial(refitted, noise=False)
    after = (refit or refitted)(session, final, base) if effects else before
    if effects:
        kept = [] if refit is not None else _choices(before, "the fit of the declared model")
        after = replace(_with_choices(after, before), notes=(*after.notes, *kept, _UNPROVEN))

    progress("simulating")
    old = gaps(before.machine, session.runs)
    new = gaps(after.machine, session.runs) if effects else old
    verdict = "found"
    if not effects:
        verdict = verdict_without_effects(judged and bool(open_joints(session, before.machine, old)))
    if verdict == "unexplained":
        after = replace(after, notes=(*after.notes, *_not_asked(session)))
    return Discovery(
        session=session,
        verdict=verdict,
        where=None if verdict == "nothing_missing" else where_in_time(session.fits, old),
        effects=effects,
        rounds=_rounds(search, steps, old, new),
        before=before,
        after=with_effort(after, session, new, searched=True),
        gaps_before=old,
        gaps_after=new,
        noise_floor=np.full(session.machine.plant.joints, np.nan),
        unseen=UNSEEN,
    )


def with_chosen_loop(found: Discovery, chosen: Estimate) -> Discovery:
    """Return a discovery with the loop that a fit chose among its settings and notes."""
    before, after = (_with_choices(e, chosen) for e in (found.before, found.after))
    # A fit that chose the loop itself says so.
    said = () if found.after.details.get("settings") else _choices(chosen, "a fit of the whole arm")
    return replace(found, before=before, after=replace(after, notes=(*after.notes, *said)))


def _with_choices(after: Estimate, before: Estimate) -> Estimate:
    """Return a fit with what another one chose and it did not, and with the law that the other questions."""
    settings = {**before.details.get("settings", {}), **after.details.get("settings", {})}
    law = {key: before.details[key] for key in ("other_law",) if key in before.details}
    return replace(after, details={**after.details, **law, "settings": settings})


def _choices(estimate: Estimate, by: str) -> list[str]:
    """Return notes on the settings of the loop that a fit chose."""
    chosen = estimate.details.get("settings", {})
    return [
        f"{key} = {chosen[key]['value']} was chosen by {by}: {chosen[key]['reason']}"
        for key in ("derivative", "period")
        if key in chosen
    ]


def _not_asked(session: Session) -> list[str]:
    """Return a note on effects that were not tried because nobody asked for them."""
    from jaxid.effects import EFFECTS

    asked = {*session.case.kinds, *(cls.kind for cls in session.case.candidates)}
    left = sorted(k for k, cls in EFFECTS.items() if cls.without_force_on_request and k not in asked)
    if not left:
        return []
    return [f"not tried: {' and '.join(left)}; name them in candidates of [discover] to search for them"]


def searched(session: Session, machine: Machine) -> list[type[Effect]]:
    """Return the effects that a search without a force tries, those that add a spring last.

    They are those that the case limits it to, or else the ones that say so and those that it asks for. A
    joint of an arm gets a spring on request only.
    """
    from jaxid.effects import EFFECTS

    case = session.case
    asked = {cls.kind for cls in case.candidates}
    kinds = [
        cls
        for kind, cls in EFFECTS.items()
        if (kind in case.kinds if case.kinds else cls.without_force or kind in asked)
    ]
    if machine.load is not None:
        # With links behind a spring a search of an arm takes many times as long.
        kinds = [cls for cls in kinds if not cls.adds_spring or cls.kind in asked or case.kinds]
    rigid = not machine.plant.springs(machine.plant.joints)
    kinds = [cls.of_joint if rigid and cls.of_joint is not None else cls for cls in kinds]
    if any(e.adds_spring for e in machine.plant.effects):
        kinds = [cls for cls in kinds if not cls.adds_spring]
    followed = [c for c in (*kinds, *case.own_effects) if c.break_away_level is None and not c.opens_spring]
    law = machine.controller
    apart = [c for c in followed if c.duplicates_field is None or getattr(law, c.duplicates_field) is None]
    return sorted(apart, key=lambda cls: cls.adds_spring)


def at_scale(estimate: Estimate) -> tuple[Machine, int | None]:
    """Return a fitted machine with the unknown held that gives the scale, and its index; None without."""
    machine, base = loop_machine(estimate)
    return (machine, None) if base is None else (without(machine, base), base)


def loop_machine(estimate: Estimate) -> tuple[Machine, int | None]:
    """Return a fitted machine, and the index of the unknown that gives the scale; None if something does."""
    relative = estimate.details.get("relative")
    if relative is None:
        return estimate.machine, None
    return estimate.machine, estimate.machine.parameters.names.index(relative["to"])


def _search(
    session: Session,
    machine: Machine,
    effort: Effort,
    progress: Callable[[str], None],
    among: frozenset[str] | None = None,
) -> LoopSearch:
    """Return the search for the effects that a fitted machine lacks; `among`: kinds, or those of the case."""
    first = session.fit.machine(machine)
    log = session.fit.log
    superset, data = loop_superset(session, machine, among)
    numerics = choose_numerics(first, log)
    period = log.period if machine.controller is None else machine.controller.period
    floor = position_noise(first, log)

    def samples(run: OpenedLog) -> LoopSamples:
        at_fit = run.machine(machine)
        view = None
        if run.own is not None:
            own = position_noise(at_fit, run.log)
            scale = np.where((own > 0) & (floor > 0), floor / np.where(own > 0, own, 1.0), 1.0)
            view = View.of(superset.machine, run.own, scale if run in session.fits else np.ones_like(scale))
        return LoopSamples.of(run, machine, superset, choose_numerics(at_fit, run.log), view)

    declared = {f.name: f.guess for f in session.machine.parameters.free}

    def coarse(model: Model) -> list[np.ndarray]:
        theta = model.theta.copy()
        theta[superset.base] = [declared[name] for name in machine.parameters.names]
        alone = machine_with(machine, superset, model.added, theta)[0]
        parts = parts_of(session.with_machine(alone))
        return coarse_starts(alone, parts, [choose_numerics(part.machine, part.log) for part in parts])

    def far(added: Sequence[Candidate], theta: np.ndarray, count: int) -> np.ndarray:
        at = theta.copy()
        at[superset.base] = [declared[name] for name in machine.parameters.names]
        points = points_about(machine_with(machine, superset, added, at)[0], count)
        if points is None:
            return at[None]
        out = np.tile(at, (len(points), 1))
        out[:, np.concatenate([superset.base, *[c.index for c in added]]).astype(int)] = points
        return out

    def by_mean_readings(model: Model) -> np.ndarray | None:
        whole = machine_with(machine, superset, model.added, model.theta)[0]
        logs = parts_of(session.with_machine(whole))
        found = run_alone(fitted_with_noise(whole, logs, whole.parameters.guess))
        if found is None or not np.all(np.isfinite(found.theta)):
            return None
        out = model.theta.copy()
        out[np.concatenate([superset.base, *[c.index for c in model.added]]).astype(int)] = found.theta
        return out

    @functools.cache
    def scaled() -> dict[tuple[str, int], np.ndarray]:
        # The declared model may have run far away: the best of the points about its guesses has not.
        values = coarse(Model((), superset.neutral))
        best = min(values[1:] or values, key=lambda v: search.acceptance.squares(_with(superset, v)))
        near = loop_superset(session, machine.with_estimate(best), among)[0]
        return {(c.kind, c.port): c.starts for c in near.candidates}

    fits = [samples(run) for run in session.fits]
    search = LoopSearch(
        superset,
        data,
        floor,
        tuple(NoiseModel(np.zeros(0), float(s) if s > 0 else 1.0) for s in floor),
        tuple(run.data for run in session.validations),
        progress,
        positions=PositionDomain.of(superset, period, numerics),
        logs=(
            JoinedLoops.of(fits) if len(fits) > 1 else fits[0],
            *[samples(run) for run in session.validations],
        ),
        coarse=coarse,
        afar=Afar(far, scaled, effort),
        by_mean_readings=by_mean_readings,
        guess=tuple(declared[name] for name in machine.parameters.names),
    )
    return search


def _with(superset: CandidateModel, values: np.ndarray) -> np.ndarray:
    """Return all unknowns of the superset, with values of those of the case."""
    theta = superset.neutral.copy()
    theta[superset.base] = values
    return theta


def loop_superset(
    session: Session, machine: Machine, among: frozenset[str] | None = None
) -> tuple[CandidateModel, Prepared]:
    """Return a fitted machine with all effects that a search tries, and the first log with its command.

    Args:
        session: Case and logs.
        machine: The machine.
        among: Kinds of the effects that are tried; None: those of the case.

    Raises:
        InputError: If the loop cannot be simulated.
    """
    data, first, log = _with_command(session, machine), session.fit.machine(machine), session.fit.log
    between = _largest_force(first, log, choose_numerics(first, log))
    tried = [cls for cls in searched(session, machine) if among is None or cls.kind in among]
    return build_candidate_model(machine, data, tried, between), data


def _with_command(session: Session, machine: Machine) -> Prepared:
    """Return the prepared log with the simulated force of the drives, which gives the scale of effects."""
    data = session.fit.data
    (gap,) = gaps(machine, (session.fit,))
    if gap.simulation is None or gap.simulation.command is None:
        raise InputError(
            "the simulated loop diverges at the values that fit best",
            where=session.case.where,
            hint="check guesses, gains and the sign of the reference",
        )
    return replace(data, force=gap.simulation.command * machine.gain, moving=np.ones_like(data.moving))


def _largest_force(machine: Machine, log: Log, numerics: Numerics) -> Float[np.ndarray, " m"]:
    """Return the largest absolute force of each drive at all ticks of the simulated loop, (m,)."""
    replay = make_replay(machine, log, numerics)
    run = _run(replace(replay, every=1), machine.plant)
    return np.max(np.abs(np.asarray(run.command) * machine.gain), axis=0)


@kept_jit
def _run(replay: Replay, plant: Plant) -> Trajectory:
    return replay(plant)


def refitted(session: Session, final: Machine, base: int | None, *, noise: bool = True) -> Estimate:
    """Refit a machine with what was found, from its values; the scale stays free if nothing gives it.

    Args:
        session: Case and logs.
        final: The machine.
        base: Index of the unknown that gave the scale, which `final` holds; None if something known does.
        noise: Whether the noise of the encoder goes round the loop.
    """
    stated, demands = session.case.output_error, session.case.identification
    options: dict[str, Any] = {"minimiser": stated.minimiser, "hessian": demands.hessian}
    if not session.more:
        # A joint of an arm has the load of its links along the log.
        final = session.fit.machine(final)
    fitted = parts_of(session.with_machine(final)) if session.more else session.fit.log
    held = None
    if noise:
        held = run_alone(fitted_with_noise(final, fitted, final.parameters.guess, **options))
    if held is None:
        held = run_alone(output_error_steps(final, fitted, start=None, **options))
    if base is None:
        return held
    free = session.machine.parameters.free[base]
    parameters = final.parameters.free
    whole = replace(final.parameters, free=(*parameters[:base], free, *parameters[base:]))
    machine = final.with_plant(final.plant, whole)
    group = common_scale_group(machine, parts_of(session.with_machine(machine)))
    return with_free_scale(held, machine, group, base)


def open_joints(session: Session, machine: Machine, found: Sequence[Gap]) -> set[int]:
    """Return the joints, from 0, at which a machine leaves more than noise of the fitted logs.

    Args:
        session: Case and logs.
        machine: The fitted machine.
        found: Its gaps, those of the fitted logs first.
    """
    pairs = zip(session.fits, found, strict=False)
    left = [r for run, gap in pairs for r in position_residuals(machine, run, gap.simulation)]
    return {r.joint for r in left if r.complete is False}


def verdict_without_effects(unexplained: bool) -> str:
    """Return the verdict of a search that added nothing."""
    return "unexplained" if unexplained else "nothing_missing"


def _rounds(
    search: LoopSearch, steps: list[Step], old: tuple[Gap, ...], new: tuple[Gap, ...]
) -> tuple[Round, ...]:
    """Return the steps with the RMS of the position that each leaves, on the fitted and validation logs."""
    none = np.full(search.samples.moving.shape[1], np.nan)

    def left(samples: Loops, theta: np.ndarray) -> np.ndarray:
        parts = []
        for part in samples.parts:
            e = search.domain.evaluate(part, theta, ())[0]
            parts.append(np.where(part.moving, e if part.view is None else e / part.view.scale, np.nan))
        return np.sqrt(np.nanmean(np.concatenate(parts) ** 2, axis=0))

    out = []
    for step in steps:
        fit, *others = (left(samples, step.theta) for samples in search.logs)
        worst = np.max(others, axis=0) if others else None
        out.append(Round(step, none, None if worst is None else none, fit, worst))
    return tuple(out)


def where_in_time(runs: Sequence[OpenedLog], found: Sequence[Gap]) -> Where | None:
    """Return the log and time in which the position that the declared model leaves is largest."""
    seen = [
        (run, gap.simulation) for run, gap in zip(runs, found, strict=False) if gap.simulation is not None
    ]
    if not seen:
        return None
    run, simulation = max(seen, key=lambda one: float(np.nanmax(one[1].rms)))
    log = run.log
    e = np.nan_to_num(log.position - simulation.position)
    window = max(10, round(_WINDOW * log.samples))
    squares = np.square(e)
    joint = int(np.argmax(np.sum(squares, axis=0)))
    power = np.convolve(squares[:, joint], np.ones(window), "valid")
    k = int(np.argmax(power))
    begin, end = (float(log.time[i] - log.time[0]) for i in (k, k + window - 1))
    at = [run.name] if len(runs) > 1 else []
    at += [f"joint {joint + 1}"] if e.shape[1] > 1 else []
    text = f"the simulated position is farthest from the log between {begin:.3g} and {end:.3g} s"
    text = ": ".join([", ".join(at), text]) if at else text
    part = float(power[k] / max(np.sum(squares[:, joint]), 1e-300))
    return Where.in_time(joint + 1, (begin, end), text, part)
