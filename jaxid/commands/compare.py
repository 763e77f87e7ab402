"""The command `compare`: are these logs of one machine, and if not, what differs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxid.case.case import CaseLike
from jaxid.case.user_faults import named_faults
from jaxid.comparison.loops import LoopLog
from jaxid.comparison.model import Change, Model
from jaxid.comparison.result import Comparison, Difference, LogGap, Rival, Value
from jaxid.comparison.rows import ComparedLog
from jaxid.comparison.search import Named, Search
from jaxid.consistency.absent import acts_by_position
from jaxid.discovery.in_loop.unforced import loop_machine, loop_superset
from jaxid.discovery.superset import build_candidate_model, scales_of
from jaxid.errors import InputError
from jaxid.estimators import steps_of
from jaxid.estimators.needs import need_alike, need_known_controller, need_known_reference
from jaxid.estimators.several.force import inverse_dynamics_steps
from jaxid.estimators.several.parts import parts_of
from jaxid.logs.in_memory import LogLike
from jaxid.machine import Machine
from jaxid.model.unknowns import Free
from jaxid.numerics.lanes import run_alone
from jaxid.own_values import OwnValues
from jaxid.session import OpenedLog, Session, open_session


@named_faults()
def compare(
    case: CaseLike,
    logs: Sequence[LogLike] | None = None,
    *,
    max_changes: int = 5,
    progress: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Compare logs, each of one machine or of one state of it, and find what differs between them.

    Args:
        case: The case of the machine, its file, or a dict with its tables.
        logs: The logs, the base first: files, or tables of the columns that [log] names. The logs of [[fit]]
            are compared with them; None: those alone.
        max_changes: Largest number of changes of the model, those that all logs share included.
        progress: Function called with a line of text at every stage.

    Raises:
        InputError: If case or logs are unsound, there are fewer than two logs, or only some have a force.
    """
    if max_changes < 1:
        raise InputError(f"max_changes is {max_changes}", hint="give one or more")
    if isinstance(logs, str) or not (logs is None or isinstance(logs, list | tuple)):
        raise InputError("logs is not a list of logs", hint="put them into a list: logs=[one, two]")
    session = open_session(case, list(logs) if logs else None, align_hold=True, method="compare")
    return compare_session(session, max_changes=max_changes, progress=progress)


def compare_session(
    session: Session, *, max_changes: int = 5, progress: Callable[[str], None] = lambda text: None
) -> Comparison:
    """Run `compare` on a session that is open already.

    Args:
        session: Case and logs, prepared with the hold aligned.
        max_changes, progress: Settings of `compare`.

    Raises:
        InputError: If there are fewer than two logs, only some have a force, or the loop of logs with a force
            has unknowns.
    """
    if session.fit.log.steady is not None:
        hint = "fit each table by identify, and compare the values"
        raise InputError("compare takes no table of steady speeds", where=session.fit.log.source, hint=hint)
    groups = _by_log(session)
    if len(groups) < 2:
        hint = "name two logs or more: jaxid compare CASE.toml LOG LOG"
        raise InputError("compare takes two logs or more, not one", where=session.case.where, hint=hint)
    need_known_reference(session, "an error of it would be taken for a difference")
    need_alike(session)

    progress("fitting one machine to all logs")
    unforced = session.machine.unforced(session.fit.log)
    search = _search_in_loops(session, groups) if unforced else _search_in_forces(session, groups)
    search.progress = progress

    start = search.start(search.superset.neutral)
    model, named = search.run(start, max_changes)
    why = "" if named else search.differ_unexplained(model)
    verdict = "differs" if named else "unexplained" if why else "same"
    return _result(session, search, start, model, named, verdict, why)


def _search_in_forces(session: Session, groups: Sequence[Sequence[OpenedLog]]) -> Search:
    """Return the search for differences between the forces of logs."""
    need_known_controller(session, "a comparison in forces does not simulate the loop")
    machine = fitted_machine(session)
    superset = build_candidate_model(machine, session.fit.data, _searched(session))
    logs = tuple(ComparedLog.of(runs, machine, superset) for runs in groups)
    return Search(superset, logs, _comparable(session, superset.base))


def _search_in_loops(session: Session, groups: Sequence[Sequence[OpenedLog]]) -> Search:
    """Return the search for differences between the positions of loops without a force.

    Raises:
        InputError: If a loop cannot be simulated.
    """
    machine, base = loop_machine(run_alone(steps_of("output_error", session)))
    superset, _ = loop_superset(session, machine)
    logs = tuple(LoopLog.of(runs, machine, superset) for runs in groups)
    held = () if base is None else (base,)
    return Search(superset, logs, _comparable(session, superset.base), held=held)


def fitted_machine(session: Session) -> Machine:
    """Return the machine with the values that fit all logs, one set for all of them."""
    machine = session.machine
    if not machine.parameters.free:
        return machine
    theta = run_alone(inverse_dynamics_steps(machine, parts_of(session))).theta
    return machine.with_estimate(np.where(np.isfinite(theta), theta, machine.parameters.guess))


def _by_log(session: Session) -> list[list[OpenedLog]]:
    """Return the fitted logs, pieces of one log together."""
    groups: dict[str, list[OpenedLog]] = {}
    for run in session.fits:
        name = run.own.log if run.own is not None else run.name
        # A single log has no values of its own.
        own = run if run.own is not None else replace(run, own=OwnValues(name))
        groups.setdefault(name, []).append(own)
    return list(groups.values())


def _searched(session: Session) -> tuple[Any, ...]:
    """Return the effects that may act in some of the logs."""
    searched = session.case.searched
    if not any(run.log.integrated for run in session.fits):
        return searched
    # It was not measured at which position the machine is.
    scales = scales_of(session.machine.plant, session.fit.data)[0]
    return tuple(
        cls
        for cls in searched
        if not acts_by_position(cls(**dict(cls.starts(scales)[0])))  # pyright: ignore[reportArgumentType]  # values by name
    )


def _comparable(session: Session, base: np.ndarray) -> tuple[int, ...]:
    """Return the unknowns that may differ: neither stated to differ, nor known in one of the logs."""
    known = {place for run in session.fits if run.own is not None for place in run.own.plant}
    free = session.machine.parameters.free
    return tuple(int(i) for i in base if free[i].log is None and (free[i].path, free[i].index) not in known)


def _result(
    session: Session,
    search: Search,
    start: Model,
    model: Model,
    named: Sequence[Named],
    verdict: str,
    why: str,
) -> Comparison:
    final, values, std = search.estimate(model, search.round(start).screen.whitened)
    estimates = dict(zip(final.unknowns, zip(values, std, strict=True), strict=True))
    free, names = search.superset.machine.parameters.free, [log.name for log in search.logs]

    def value(index: int, log: int) -> Value:
        unknown = next((u for u in estimates if u.index == index and log in u.logs), None)
        if unknown is None:
            return Value(float(final.theta[log, index]), np.nan, free[index].unit)
        return Value(float(estimates[unknown][0]), float(estimates[unknown][1]), free[index].unit)

    differences = []
    for found in named:
        c = found.change
        by_log: dict[str, Any] = {}
        for k, name in enumerate(names):
            if c.effect is None:
                by_log[name] = value(int(c.index or 0), k)
            elif k in c.logs:
                by_log[name] = {str(free[i].path[-1]): value(int(i), k) for i in c.effect.index}
            else:
                by_log[name] = None
        others = tuple(
            Rival(*_named(search, r.change), _acting(r.change, names), r.evidence) for r in found.alternatives
        )
        differences.append(
            Difference(*_named(search, c), by_log, found.evidence, found.threshold, found.false_alarm, others)
        )
    shared = {
        free[u.index].name: Value(float(v), float(s), free[u.index].unit)
        for u, (v, s) in estimates.items()
        if len(u.logs) == len(names)
    }
    screen = search.round(start).screen
    return Comparison(
        session=session,
        verdict=verdict,
        differences=tuple(differences),
        alike=tuple(c.label for c in model.changes if c.alike),
        gaps=_gaps(search, start, final),
        why=why,
        tried=screen.changes,
        threshold=screen.threshold,
        parameters=shared,
        quantity="position" if session.machine.unforced(session.fit.log) else "force",
        scale=free[search.held[0]].name if search.held else "",
    )


def _acting(change: Change, names: Sequence[str]) -> tuple[str, ...]:
    return () if change.effect is None else tuple(names[k] for k in change.logs)


def _named(search: Search, change: Change) -> tuple[str, str, str, tuple[str, int] | None]:
    """Return label, parameter, kind and place of a change."""
    plant = search.superset.machine.plant
    if change.effect is not None:
        return change.label, "", change.effect.kind, plant.place(change.effect.port)
    f: Free = search.superset.machine.parameters.free[int(change.index or 0)]
    return change.label, f.name, "", _place(plant, f)


def _place(plant: Any, f: Free) -> tuple[str, int] | None:
    """Return the place of a parameter: that of its effect, or of its entry in a list of the plant."""
    if f.effect is not None:
        return plant.place(plant.effects[f.effect].port)
    return ("joint", 1) if plant.joints == 1 else None


def _gaps(search: Search, start: Model, model: Model) -> tuple[LogGap, ...]:
    """Return the unexplained force of each log, with one model for all and with the differences."""
    out = []
    for log, before, after in zip(search.logs, search.residuals(start), search.residuals(model), strict=True):
        hidden = [np.where(log.counts, e, np.nan) for e in (before, after)]
        out.append(LogGap(log.name, log.rms(before), log.rms(after), log.floor, log.times, *hidden))
    return tuple(out)
