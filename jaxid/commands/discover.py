"""The command `discover`: the search for missing effects, the refit with them, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from jaxid.case.case import Case, CaseLike
from jaxid.case.user_faults import named_faults
from jaxid.commands.robot_case import implied_case
from jaxid.consistency.absent import acts_by_position
from jaxid.discovery import candidates as cand
from jaxid.discovery.at_rest.naming import Found, named_at_rest
from jaxid.discovery.by_sensors import add_by_sensors
from jaxid.discovery.final import final_machine, machine_with
from jaxid.discovery.force_readings import force_reading, keeps_time
from jaxid.discovery.in_loop.by_joint import explore_by_joint
from jaxid.discovery.in_loop.confirm import WHY, hindering
from jaxid.discovery.in_loop.search import explore_within
from jaxid.discovery.in_loop.unforced import explore_unforced
from jaxid.discovery.noise import sensor_colour
from jaxid.discovery.refit import Refitted, in_simulation
from jaxid.discovery.result import Discovery, NamedEffect, Round
from jaxid.discovery.search import Search, Step
from jaxid.discovery.separating.propose import Proposal, proposals
from jaxid.discovery.superset import build_candidate_model, scales_of
from jaxid.discovery.together import LEAST_AT_ONCE, add_together
from jaxid.discovery.where import Where, locate
from jaxid.errors import InputError, suggest
from jaxid.estimators import METHODS
from jaxid.estimators.apart.joint import stands_apart
from jaxid.estimators.common.consistency import need_bodies, with_links
from jaxid.estimators.common.minimisers import Minimiser, minimiser_of
from jaxid.estimators.common.shapes import without_unseen_shapes
from jaxid.estimators.effort import with_effort
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.needs import need_force, need_known_controller, need_known_reference
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.uncertain_hold import with_uncertain_hold
from jaxid.gap import Gap, filter_floor, force_gap, gaps, noise_floor
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.lanes import begin, run_alone
from jaxid.session import Logs, OpenedLog, Session, open_session
from jaxid.session.holds import session_of_faster_loop, session_under_better_hold
from jaxid.simulation.force_balance import ForceData
from jaxid.simulation.solvers import SOLVERS

# A residual counts as a disagreement only if it exceeds the noise floor by this factor.
_ABOVE_FLOOR = 1.3
# Beyond this factor something is missing, even if the residual stands out over no variable.
_FAR_ABOVE = 3.0
# Largest number of effects to add unless it is stated, and that by joint of an arm.
_EFFECTS, _BY_JOINT = 5, 3
# Number of effects that hinder the simulation and are replaced; further ones are only removed.
_BARRED = 3
# Reason why no break-away friction is searched.
_UNEXPLAINED = "there is a gap that no known effect explains"


# Matrices of a search are tall and narrow: threads of linear algebra wait for each other, and a decomposition
# of 3600 rows takes 0.1 s of both cores in place of 1 ms of one.
@threadpool_limits.wrap(limits=1, user_api="blas")
@named_faults()
def discover(
    case: CaseLike,
    log: Logs = None,
    *,
    validate: Sequence[LogLike] = (),
    max_effects: int | None = None,
    refit: bool = True,
    experiments: bool | None = None,
    solver: str | None = None,
    minimiser: str | Minimiser | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Discovery:
    """Find the effects that a case's model lacks, from a log.

    Args:
        case: The case, its file, or a dict with its tables; or a robot's file in MJCF or URDF, with which the
            log implies a case.
        log: The log, its file, or a table of the columns that [log] names (DataFrame, Dataset, dict).
        validate: Logs that must confirm each effect, beside those of the case.
        max_effects: Largest number of effects to add, without a force at each joint of an arm. None: five, or
            three a joint of an arm if that is more.
        refit: Whether the parameters are refitted in simulation; if not, they are those of inverse dynamics.
        experiments: Whether experiments are designed that separate rival effects. None: unless joints are
            coupled, as in an arm, whose simulation takes minutes to compile for it.
        solver, minimiser: Numerics of the fits in simulation, as for `identify`; None: those of the case.
        progress: Function called with a line of text at every stage.

    Raises:
        InputError: If case, log, solver or minimiser are unsound.
    """
    if solver is not None and solver not in SOLVERS:
        raise InputError(f"solver {solver!r} is not known", hint=suggest(solver, SOLVERS))
    minimiser_of(minimiser)
    case = implied_case(case, log, search=True)
    session = open_session(case, log, validate, align_hold=True, method="discover")
    session = replace(session, case=_with_numerics(session.case, solver, minimiser))
    return explore(session, max_effects=max_effects, refit=refit, experiments=experiments, progress=progress)


def _with_numerics(case: Case, solver: str | None, minimiser: str | Minimiser | None) -> Case:
    """Return the case with a solver and a minimiser in place of those that it states."""
    given = {"solver": solver, "minimiser": minimiser}
    given = {name: value for name, value in given.items() if value is not None}
    within = None if case.within_prior is None else replace(case.within_prior, **given)
    return replace(case, output_error=replace(case.output_error, **given), within_prior=within)


def explore(
    session: Session,
    *,
    max_effects: int | None = None,
    refit: bool = True,
    experiments: bool | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> Discovery:
    """Run `discover` on a session that is open already.

    Args:
        session: Case and logs, prepared with the hold aligned.
        max_effects, refit, experiments, progress: Settings of `discover`.

    Raises:
        InputError: If the reference has unknowns.
    """
    need_known_reference(session, "an error of it would be taken for an effect")
    most = _EFFECTS if max_effects is None else max_effects
    if session.machine.unforced(session.fit.log):
        if stands_apart(session.machine, parts_of(session)):
            return explore_by_joint(session, max_effects=most, progress=progress)
        _need_one_servo(session)
        return explore_unforced(session, max_effects=most, progress=progress)

    need_force(session, "a search of a log with a force")
    _need_effects_of_force(session)
    need_known_controller(session, "a search in forces does not simulate the loop")
    if session.fit.log.steady is not None:
        from jaxid.discovery.steady import explore_steady

        return explore_steady(session, max_effects=most, progress=progress)
    if session.case.fits_within_prior("discover"):
        session.need_one_log("discover within a prior")
        return explore_within(session, max_effects=most, progress=progress)

    if max_effects is None:
        most = max(most, _BY_JOINT * session.fit.data.q.shape[1])
    return _explore_forces(session, most, refit=refit, experiments=experiments, progress=progress)


def _explore_forces(
    session: Session,
    most: int,
    *,
    refit: bool,
    experiments: bool | None,
    progress: Callable[[str], None],
) -> Discovery:
    """Search in the force domain, refit in simulation, and search at rest what that leaves.

    Args:
        session: Case and logs, with forces.
        most: Largest number of effects to add.
        refit, experiments, progress: Settings of `discover`.
    """
    progress("fitting the declared model")
    baseline, search = start_search(session, progress)
    # Compiling the refits takes as long as the search, and neither needs the other.
    declared = begin(_as_bodies_in_simulation, session, baseline, refit)
    steps = _searched(search, most)
    if (other := _under_better_hold(session, search, baseline.machine)) is not None:
        declared.cancel()
        progress("searching under another course of the force")
        return _explore_forces(other, most, refit=refit, experiments=experiments, progress=progress)

    likely, ahead = search.model, None
    if likely.added:
        machine, _ = final_machine(baseline.machine, search, {}, steps)
        ahead = begin(_with_effects, session, machine, refit)
    where = where_of(search, steps[0], session)
    final, effects = _simulable(session, search, baseline.machine, steps, most, progress)
    verdict = "found" if effects else _verdict_on_none(where, steps, search, session, baseline.machine)
    reading = force_reading(session, search, baseline.machine, steps)

    progress("refitting in simulation" if refit else "simulating")
    before = after = declared.result()
    if ahead is not None and search.model is not likely:
        ahead.cancel()
        ahead = None
    if effects:
        after = ahead.result() if ahead else _with_effects(session, final, refit)
    separating = _experiments(session, search, effects, experiments, progress)

    # Friction at rest is sought beside the fit in the force domain, which no sample at rest has entered: a
    # refit that counts them bends the other values around the missing friction.
    moving = Found(after.in_force, effects, where, _UNEXPLAINED if verdict == "unexplained" else "")
    found = named_at_rest(moving, session, search, steps, most, progress)
    estimate, new = after.estimate, after.gaps
    if found.estimate is not moving.estimate:
        progress("simulating")
        verdict, estimate = "found", found.estimate
        new = gaps(estimate.machine, session.runs)
    return Discovery(
        session=session,
        verdict=verdict,
        where=None if verdict == "nothing_missing" else found.where,
        effects=found.effects,
        rounds=_as_refitted([_round(search, s) for s in steps], before.gaps, new, len(session.fits)),
        before=before.estimate,
        after=with_effort(without_unseen_shapes(estimate), session, new, searched=True),
        gaps_before=before.gaps,
        gaps_after=new,
        noise_floor=search.floor,
        proposals=separating,
        unseen=found.unseen,
        force_reading=reading,
    )


def _searched(search: Search, most: int) -> list[Step]:
    """Run a search, with the laws of all joints at once where many are missing, and return its steps."""
    steps = search.run(most, lambda search, first: add_together(search, first, most, least=LEAST_AT_ONCE))
    return add_by_sensors(search, add_together(search, steps, most), most)


def _under_better_hold(session: Session, search: Search, machine: Machine) -> Session | None:
    """Return the session under another course of its force, if what was found explains the log better so.

    Effects that shift the force in time may stand for a wrong hold: they are left out.
    """
    model = search.model
    if not model.added:
        return None
    added = [c for c in model.added if keeps_time(cand.effect_of(search.superset, c))]
    found, _ = machine_with(machine, search.superset, added, model.theta)
    if (faster := session_of_faster_loop(session, found)) is not None:
        return faster
    if len(added) == len(model.added):
        return session_under_better_hold(session, found)
    whole, _ = machine_with(machine, search.superset, model.added, model.theta)
    rival = force_gap(session.fit.machine(whole), session.fit.data).rms
    return session_under_better_hold(session, found, rival)


def _simulable(
    session: Session,
    search: Search,
    machine: Machine,
    steps: list[Step],
    most: int,
    progress: Callable[[str], None],
) -> tuple[Machine, tuple[NamedEffect, ...]]:
    """Replace or remove the effects that hinder the simulation; the steps of this are added to `steps`.

    Returns:
        The machine with the effects, and these.
    """
    alternatives = search.alternatives(steps)
    final, effects = final_machine(machine, search, alternatives, steps)
    progress("simulating the effects")
    while (c := hindering(search, session, final)) is not None:
        # After some removals nothing is added in exchange, because a search must end.
        steps.extend(search.bar(c, WHY, most if len(search.barred) < _BARRED else 0))
        alternatives = search.alternatives(steps)
        final, effects = final_machine(machine, search, alternatives, steps)
    return final, effects


def _experiments(
    session: Session,
    search: Search,
    effects: tuple[NamedEffect, ...],
    asked: bool | None,
    progress: Callable[[str], None],
) -> tuple[Proposal, ...]:
    """Design experiments that separate rival effects, where these are asked for, or the plant suits them."""
    if session.more and asked:
        session.need_one_log("the design of experiments")
    designs = session.machine.plant.designs_experiments if asked is None else asked
    return proposals(session, search, effects, progress) if designs and not session.more else ()


def _need_one_servo(session: Session) -> None:
    """Refuse a search of several servos at once without a force, whose loop would be simulated for hours.

    Raises:
        InputError: If the machine is an arm of several joints, which cannot be searched one by one.
    """
    joints = session.machine.plant.joints
    if session.machine.plant.coupled and joints > 2:
        hint = (
            "each joint needs a servo (pd or cascade_pd), a command and an encoder, and each unknown must be "
            'of one servo or joint: take "base" or "all" out of unknown'
        )
        what = f"a search without a force goes joint by joint, which these {joints} joints do not allow"
        raise InputError(what, where=session.case.where, hint=hint)


def _need_effects_of_force(session: Session) -> None:
    """Refuse a search for an effect that is tried in logs without a force only.

    Raises:
        InputError: If the case asks for one.
    """
    for cls in session.case.searched:
        if cls.controller_field is not None:
            raise InputError(
                f"{cls.kind} acts in front of the controller, and the log has a force, which comes after it",
                where=f"{session.case.where}, [discover]",
                hint="leave it out, or leave force out of [log] to search in the simulated loop",
            )
    plant = session.machine.plant
    for cls in session.case.candidates:
        if cls.of_joint is not None and not plant.springs(plant.joints):
            raise InputError(
                f"{cls.kind} of a joint without a spring is searched for only in a log without a force",
                where=f"{session.case.where}, [discover]",
                hint="leave it out, or declare joint_flexibility with a gap to fit it",
            )


def start_search(
    session: Session, progress: Callable[[str], None] = lambda text: None
) -> tuple[Estimate, Search]:
    """Return the baseline of a session in the force domain, and the search for the effects that it lacks.

    Several logs are searched together: residuals of each further log are scaled so that the noise of its
    sensors is that of the first, and evidence is the sum over all.
    """
    log, data = session.fit.log, session.fit.data
    baseline = _of_force(session)
    at_fit = session.fit.machine(baseline.machine) if session.more else baseline.machine
    floor = noise_floor(at_fit, log, data)
    sure = noise_floor(at_fit, log, data, np.zeros(at_fit.gain.shape))
    colour = sensor_colour(at_fit, log, data)
    searched = session.case.searched
    if log.integrated:
        # Where the machine is was not measured.
        scales = scales_of(baseline.machine.plant, data)[0]
        starts: dict[type, dict[str, Any]] = {cls: dict(cls.starts(scales)[0]) for cls in searched}
        searched = tuple(cls for cls in searched if not acts_by_position(cls(**starts[cls])))
    union = build_candidate_model(baseline.machine, data, searched)
    others = tuple(v.data for v in session.validations)
    guess = tuple(session.machine.parameters.guess)
    if not session.more:
        return baseline, Search(union, data, floor, colour, others, progress, guess=guess, sure=sure)

    def view(run: OpenedLog) -> cand.View:
        assert run.own is not None, "every log of several has values of its own, or none"
        own = noise_floor(run.machine(baseline.machine), run.log, run.data)
        scale = np.where((own > 0) & (floor > 0), floor / np.where(own > 0, own, 1.0), 1.0)
        return cand.View.of(union.machine, run.own, scale)

    search = Search(
        union,
        data,
        floor,
        colour,
        others,
        progress,
        view=view(session.fit),
        more=tuple((run.data, view(run)) for run in session.more),
        validation_views=tuple(view(run).unscaled() for run in session.validations),
        guess=guess,
        sure=sure,
    )
    return baseline, search


def _with_effects(session: Session, final: Machine, refit: bool) -> Refitted:
    """Fit the machine with the effects that were added."""
    return _as_bodies_in_simulation(session, _of_force(session.with_machine(final)), refit)


def _as_bodies_in_simulation(session: Session, start: Estimate, refit: bool) -> Refitted:
    """Run `in_simulation`, links being those of real bodies if the case asks for that.

    The search goes without: what an effect explains hardly depends on it.
    """
    if session.case.identification.physically_consistent:
        # The bodies start at the guesses of the case, the effects at what was found.
        known = session.machine.parameters.guess
        at = start.machine.with_estimate([*known, *start.theta[len(known) :]])
        bodies = need_bodies(session.with_machine(at))
        start = run_alone(with_links(with_uncertain_hold(METHODS["inverse_dynamics"], bodies), bodies))
    return in_simulation(session, start, refit)


def _of_force(session: Session) -> Estimate:
    """Return the estimate by inverse dynamics of one log or of several."""
    return run_alone(with_uncertain_hold(METHODS["inverse_dynamics"], session))


def where_of(search: Search, baseline: Step, session: Session) -> Where:
    """Return the region of a whole log in which the baseline's residual is significant.

    Of several logs it is the one with the most evidence.
    """
    first = _where_on(search, baseline, session.fit.log, search.data, search.view, search.colour)
    if not session.more:
        return first
    found = [(first, session.fit.name)]
    for run, (data, view) in zip(session.more, search.more, strict=True):
        colour = sensor_colour(run.machine(session.machine), run.log, data)
        found.append((_where_on(search, baseline, run.log, data, view.unscaled(), colour), run.name))
    where, name = max(found, key=lambda w: (w[0].significant, w[0].evidence))
    return replace(where, text=f"{where.text} (log {name})")


def _where_on(
    search: Search,
    baseline: Step,
    log: Log,
    data: Prepared,
    view: cand.View | None,
    colour: tuple[NoiseModel, ...],
) -> Where:
    """Return the region of one log in which the baseline's residual is significant."""
    whole = [cand.Viewed(ForceData.of(data), view)]
    e, jacobian = cand.evaluate_on(search.superset, whole, baseline.theta, baseline.active)
    wanted = None
    if log.reference is not None:
        # A mass that is not driven has no wanted motion other than the measured one.
        wanted = data.at_kept(data.qd).copy()
        driven = search.superset.machine.plant.at_drives(np.arange(wanted.shape[1]))
        wanted[:, driven] = data.at_kept(np.gradient(log.reference, log.period, axis=0))
    # A parameter that joints share cannot change for one of them alone.
    alone = np.sum(search.superset.enters[:, baseline.active], axis=0) == 1
    unshared = jacobian[..., baseline.active[alone]]
    machine = search.superset.machine
    units = [machine.unit("position", joint) for joint in range(data.q.shape[1])]
    return locate(-e, unshared, data, colour, units, wanted, machine.plant)


def _verdict_on_none(
    where: Where, steps: list[Step], search: Search, session: Session, declared: Machine
) -> str:
    """Return the verdict on a search that added nothing, by the residual of the declared model."""
    if not search.acceptance.above_numerics(steps[0].theta):
        return "nothing_missing"
    rms = _rms(search, search.samples, steps[0].theta)
    most = _ABOVE_FLOOR if where.significant else _FAR_ABOVE
    if not np.any(rms > most * search.floor):
        return "nothing_missing"
    floor = np.hypot(search.floor, filter_floor(declared, session.fit))
    return "unexplained" if np.any(rms > most * floor) else "nothing_missing"


def _round(search: Search, step: Step) -> Round:
    fit, *others = (
        _rms(search, samples, step.theta) for samples in [search.samples, *search.acceptance.others]
    )
    return Round(step, fit, np.max(others, axis=0) if others else None)


def _as_refitted(
    rounds: list[Round], before: tuple[Gap, ...], after: tuple[Gap, ...], fits: int
) -> tuple[Round, ...]:
    """Return the steps with the gaps of the refits at the baseline and from the last change on.

    The search fits by inverse dynamics, so that its gaps differ a little from those of the result. The first
    `fits` of the gaps are those of the fitted logs.
    """
    changes = [k for k, r in enumerate(rounds) if r.step.added or r.step.dropped]
    last = max(changes, default=0)
    out = []
    for k, r in enumerate(rounds):
        if 0 < k < last:
            out.append(r)
            continue
        rms = [gap.force.rms for gap in (before if k == 0 and last > 0 else after)]
        fit, others = np.max(rms[:fits], axis=0), rms[fits:]
        out.append(replace(r, fit=fit, validation=np.max(others, axis=0) if others else None))
    return tuple(out)


def _rms(search: Search, samples: cand.CandidateSamples, theta: np.ndarray) -> np.ndarray:
    e, _ = cand.evaluate(search.superset, samples, theta, ())
    return np.sqrt(np.nanmean(np.where(samples.moving, e, np.nan) ** 2, axis=0))
