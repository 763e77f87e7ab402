"""A case and its logs, opened, checked and prepared: the start of every command."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.build import build_machine, drives_of_case, make_plant, motions_of
from jaxid.case.case import Case, CaseLike, FitEntry, load_case
from jaxid.consistency.absent import check_absent
from jaxid.consistency.balance_fit import BalanceFit, balance_fits
from jaxid.consistency.hold import better_hold, hold_finding, hold_setting
from jaxid.consistency.law import law_findings, loop_velocity_findings, replayed_law
from jaxid.consistency.noise import estimated_force_noise, noise_findings
from jaxid.consistency.reference_hold import (
    compare_reference_holds,
    reference_hold_finding,
    reference_hold_setting,
)
from jaxid.consistency.sign import sign_findings
from jaxid.consistency.weight import weight_findings
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike, as_log
from jaxid.logs.log import Log, with_load
from jaxid.logs.prepare import Prepared, Recipe, choose_recipe, prepare
from jaxid.logs.soundness import FEWEST_LEVELS, Finding, check_log, plausible_inertia, raise_on_error
from jaxid.logs.units import Frame
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.own_values import OwnValues, expanded, own_values
from jaxid.references import make_reference
from jaxid.settings import Actuator, Disturbance, LogTable
from jaxid.simulation.finite_effects import need_finite_effects
from jaxid.simulation.step_size import needed_steps

# One log to fit, or several; None: those of the case.
Logs = LogLike | Sequence[LogLike] | None
# Chosen: a further log that would have a cut-off or rest velocity within this factor of those of the first
# takes the recipe of the first, so that code compiled for one serves both.
_ALIKE = 1.5


@dataclass(frozen=True)
class OpenedLog:
    """One log, prepared, with the disturbance of its controller.

    Args:
        name: Name of the log in results.
        log: The log; its force has passed the recipe's running median, if there is one.
        data: The prepared log.
        disturbance: Signal that was added to the controller's command.
        reference_hold: Course of the reference between samples that is stated for this log only; None: that
            of the machine.
        own: Values that hold in this log only; None: there are none.
    """

    name: str
    log: Log
    data: Prepared
    disturbance: Disturbance | str | None
    reference_hold: str | None = None
    own: OwnValues | None = None

    def machine(self, machine: Machine) -> Machine:
        """Return a machine with the values, the disturbance and the course of the reference of this log."""
        hold = self.reference_hold or machine.reference_hold
        own = machine if self.own is None else self.own.machine(machine)
        return replace(own, disturbance=self.disturbance, reference_hold=hold)


@dataclass(frozen=True)
class Session:
    """A case, its machine at the guesses, the logs to fit and the logs to validate on.

    Args:
        case: The case.
        machine: Its machine; an unknown with a value in each log is one for each of them.
        fit: The log to fit, or the first of several.
        validations: Further logs with their names, prepared by the same recipe.
        recipe: Filtering of all logs.
        findings: Warnings on the logs.
        given: The case as it was given, where `case` is that of the joints (see `at_joints`).
        settings: Choices made from the log, by name: `value` and `reason`.
        more: Further logs that are fitted with the first one.
    """

    case: Case
    machine: Machine
    fit: OpenedLog
    validations: tuple[OpenedLog, ...]
    recipe: Recipe
    findings: tuple[Finding, ...]
    given: Case | None = None
    settings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    more: tuple[OpenedLog, ...] = ()

    @property
    def declared(self) -> Case:
        """The case as it was given, gears of the motors included."""
        return self.case if self.given is None else self.given

    @property
    def runs(self) -> tuple[OpenedLog, ...]:
        """All logs, the fitted ones first."""
        return (self.fit, *self.more, *self.validations)

    @property
    def fits(self) -> tuple[OpenedLog, ...]:
        """The fitted logs."""
        return (self.fit, *self.more)

    def need_one_log(self, what: str) -> None:
        """Refuse several fitted logs.

        Raises:
            InputError: If there are several; the message names `what`.
        """
        if self.more:
            hint = "name one log, and the others by validate"
            raise InputError(f"{what} takes one log, not {len(self.fits)}", where=self.case.where, hint=hint)

    def with_machine(self, machine: Machine) -> Session:
        """Return the session with another machine."""
        return replace(self, machine=machine)


def open_session(
    case: CaseLike,
    log: Logs = None,
    validate: Sequence[LogLike] = (),
    *,
    align_hold: bool | None = None,
    method: str | None = None,
    piecewise: bool = False,
) -> Session:
    """Open a case and its logs, check them and prepare them.

    Args:
        case: The case, its file, or a dict with its tables.
        log: The log to fit, its file, or a table with the columns that [log] names; or a list of several.
            They are fitted with the logs of [[fit]]; None: those alone.
        validate: More logs to validate on, beside those of the case.
        align_hold: See `jaxid.logs.prepare.Recipe`; None: as the case's recipe implies.
        method: Method that will fit the log, or "discover": a fit within a prior can do with a short log.
            None: within the prior, if the case has one.
        piecewise: Whether all stretches of a log with gaps are fitted, as logs of their own; if not, its
            longest one is.

    Raises:
        InputError: If anything in case or logs is unsound.
    """
    if isinstance(validate, str) or not isinstance(validate, Sequence):
        raise InputError("validate is not a list of logs", hint="put it into a list: validate=[log]")
    as_logged = load_case(case)
    if as_logged.log is not None and as_logged.log.kind == "steady":
        from jaxid.steady import open_steady

        return open_steady(as_logged, _one_table(as_logged, log), validate, _read)
    case = at_joints(as_logged)
    first, *further = _sources(as_logged, log)
    fit = _read(as_logged, first.log, columns=first.columns)
    if piecewise:
        first, *between = _between_gaps(first, fit)
        further = [*between, *further]
    # The machine of the first log serves them all: only the controller's period depends on the log.
    machine = build_machine(case, period=fit.period)
    several = bool(further or case.fits)
    if several:
        machine = _with_unknowns_by_log(case, machine, (first, *further))
        first = _with_values(case, machine, first, fit)

    def read(log: LogLike, columns: LogTable | None = None, *, whole: bool = False) -> Log:
        return _followed(case, _read(as_logged, log, columns=columns, whole=whole), machine.plant)

    fit = _followed(case, fit, machine.plant)
    short = case.fits_within_prior(method)
    at_fit = machine if first.own is None else first.own.machine(machine)
    findings = [*_left_out(case), *_check(case, fit, at_fit, short, alone=not several)]
    recipe = choose_recipe(fit, case.preprocess)
    if align_hold is not None:
        recipe = replace(recipe, align_hold=align_hold)
    needed = 0 if short else enough(at_fit)

    opened = [_run(first.name, fit, at_fit, recipe, needed, first.disturbance)]
    opened[0] = replace(opened[0], reference_hold=first.reference_hold, own=first.own)
    more: list[OpenedLog] = []
    waiting = list(further)
    while waiting:
        source = waiting.pop(0)
        try:
            measured = read(source.log, source.columns)
            if piecewise and not source.found:
                source, *between = _between_gaps(source, measured)
                waiting = [*between, *waiting]
            source = _with_values(case, machine, source, measured)
            run, doubts = _opened(case, machine, source, measured, recipe, short)
        except InputError as error:
            if not source.found:
                raise
            what, hint = f"{source.name} is left out: {error}", "name other stretches in [log] rows"
            findings.append(Finding("warning", what, case.where, hint))
            continue
        more.append(run)
        findings += doubts
    names = {run.name for run in (*opened, *more)}
    for entry in case.validations:
        other = fit if entry.log is None else entry.log
        source = other.source if isinstance(other, Log) else other
        for name, columns in _pieces(entry.name, entry.columns):
            measured = read(source, columns)
            findings += _check(case, measured, machine, short)
            own = None
            if entry.known or several:
                where = f"{case.where}, [[validation]] {entry.name}"
                own = own_values(case, machine, entry.name, entry.known, measured.period, where)
            at = machine if own is None else own.machine(machine)
            beside = _enough_beside(measured, at, short)
            run = _run(name, measured, at, recipe, beside, entry.disturbance)
            opened.append(replace(run, reference_hold=entry.columns.reference_hold, own=own))
            names.add(name)
    for extra in validate:
        measured = read(extra, whole=True)
        findings += _check(case, measured, machine, short)
        name = _unlike(Path(measured.source).stem, names)
        names.add(name)
        own = OwnValues(name) if several else None
        at = machine if own is None else own.machine(machine)
        run = _run(name, measured, at, recipe, _enough_beside(measured, at, short), machine.disturbance)
        opened.append(replace(run, own=own))
    if first.own is not None and not more:
        machine = first.own.machine(machine)
    machine = _scaled(machine, opened[0].data)
    for run in (opened[0], *more):
        need_finite_effects(run.machine(machine).plant, run.data, run.log.source)
    settings = {}
    if not short:
        free_hold = not isinstance(first.log, Log) and "hold" not in case.tables.get("log", {})
        held = _held_against(
            as_logged, opened[0].machine(machine) if several else machine, opened[0], free_hold
        )
        findings += held.findings
        settings = held.settings
        machine = replace(machine, reference_hold=held.reference_hold)
        if held.hold is not None:
            machine = replace(machine, hold=held.hold)
            own = [v["name"] for v in case.tables.get("validation", []) if "hold" in v]
            opened = [run if run.name in own else _under(held.hold, run, machine) for run in opened]
            more = [_under(held.hold, run, machine) for run in more]
        # The other logs are of the same sensors.
        opened = [replace(run, data=replace(run.data, force_noise=held.force_noise)) for run in opened]
        for k, run in enumerate(more):
            # A further log to fit counts by its own noise.
            also = _held_against(as_logged, run.machine(machine), run, False)
            findings += also.findings
            data = replace(run.data, force_noise=also.force_noise)
            more[k] = replace(run, data=data, reference_hold=run.reference_hold or also.reference_hold)
    return Session(
        case, machine, opened[0], tuple(opened[1:]), recipe, tuple(findings), as_logged, settings, tuple(more)
    )


def _one_table(case: Case, log: Logs) -> LogLike:
    """Return the only log of a command, for a case whose log is a table of steady speeds.

    Raises:
        InputError: If there are several, none, or the case has [[fit]].
    """
    logs: list[Any] = list(log) if isinstance(log, list | tuple) else [] if log is None else [log]
    if len(logs) != 1 or case.fits:
        hint = "put all speeds into one table"
        raise InputError('kind = "steady" takes one table', where=f"{case.where}, [log]", hint=hint)
    return logs[0]


@dataclass(frozen=True)
class _Source:
    """A log to fit, before it is read.

    Args:
        name: Name of the log in results.
        log: The log, its file, or a table.
        columns: Its columns, of one stretch; None: those of [log].
        disturbance: Signal that was added to the controller's command.
        entry: The entry of the case that it takes its values from; None: none.
        reference_hold: Course of the reference that is stated for this log only.
        whole: Name of the log of which this is a piece.
        own: Values that hold in this log only; None: there are none.
        found: Whether it is a stretch between gaps, which nobody named.
    """

    name: str
    log: LogLike
    columns: LogTable | None
    disturbance: Disturbance | str | None
    entry: FitEntry | None = None
    reference_hold: str | None = None
    whole: str = ""
    own: OwnValues | None = None
    found: bool = False


def _sources(case: Case, log: Logs) -> list[_Source]:
    """Return the logs to fit: those of a command, with the entries of [[fit]] that name them, and the others.

    Raises:
        InputError: If there is none, or an entry lacks its log.
    """
    logs: list[Any] = [] if log is None else list(log) if isinstance(log, list | tuple) else [log]
    if not logs and not case.fits:
        hint = "name a log, or add [[fit]] with log to the case"
        raise InputError("there is no log to fit", where=case.where, hint=hint)
    _check_once([log for log in logs if isinstance(log, str | Path)])
    found: list[_Source] = []
    disturbance = None if case.controller is None else case.controller.disturbance
    alone = len(logs) == 1 and not case.fits
    taken: set[str] = set()
    for k, given in enumerate(logs):
        entries = [e for e in case.fits if _names(e, given) or (k == 0 and e.log is None)]
        taken |= {e.name for e in entries}
        if entries:
            found += [_of_entry(e, given) for e in entries]
        else:
            name = "fit" if alone else _name_of(given, k)
            found.append(_Source(name, given, None, disturbance))
    for entry in case.fits:
        if entry.name in taken:
            continue
        if entry.log is None:
            what, hint = "has no log, and none was named", "add log, or name a log for the command"
            raise InputError(what, where=f"{case.where}, [[fit]] {entry.name}", hint=hint)
        found.append(_of_entry(entry, entry.log))
    named: set[str] = set()
    out = []
    for source in found:
        name = _unlike(source.name, named, source.log)
        named.add(name)
        columns = source.columns
        if columns is None and not isinstance(source.log, Log):
            columns = case.columns
        pieces = [(name, None)] if columns is None else _pieces(name, columns)
        whole = len(pieces) == 1 and source.columns is None
        out += [
            replace(source, name=piece, whole=name, columns=None if whole else own) for piece, own in pieces
        ]
    return out


def _check_once(files: Sequence[str | Path]) -> None:
    """Refuse a log that is named twice: its information would count twice."""
    known = [Path(file).resolve() for file in files]
    for k, file in enumerate(known):
        if file in known[:k]:
            hint = "name each log once; stretches of one are rows = [[first, end], ...] in [log]"
            raise InputError("is named twice", where=str(files[k]), hint=hint)


def _names(entry: FitEntry, log: Any) -> bool:
    """Check that a log of a command is the file of an entry."""
    return entry.log is not None and isinstance(log, str | Path) and Path(log).name == entry.log.name


def _of_entry(entry: FitEntry, log: LogLike) -> _Source:
    hold = entry.columns.reference_hold
    return _Source(entry.name, log, entry.columns, entry.disturbance, entry, hold)


def _name_of(log: Any, number: int) -> str:
    """Return the name of a log in results: that of its file, or its number."""
    if isinstance(log, Log):
        log = log.source
    return Path(log).stem if isinstance(log, str | Path) else f"log {number + 1}"


def _unlike(name: str, names: Collection[str], log: Any = None) -> str:
    """Return a name that no other log has: with that of its folder, or with a mark."""
    if name in names and isinstance(log, str | Path):
        name = f"{Path(log).resolve().parent.name}/{name}"
    while name in names:
        name += "'"
    return name


def _pieces(name: str, columns: LogTable) -> list[tuple[str, LogTable]]:
    """Return name and table of each stretch of rows of a log."""
    if columns.rows is None or isinstance(columns.rows[0], int):
        return [(name, columns)]
    stretches: Any = columns.rows
    return [
        (f"{name}, rows {first} to {end}", replace(columns, rows=(first, end))) for first, end in stretches
    ]


def _between_gaps(source: _Source, log: Log) -> list[_Source]:
    """Return the stretches of a log that gaps separate, the longest first; the log itself if it has none."""
    if not log.others or log.table is None or isinstance(source.log, Log):
        return [source]
    return [
        replace(
            source,
            name=f"{source.name}, rows {first} to {end}",
            columns=replace(log.table, rows=(first, end)),
            found=k > 0,
        )
        for k, (first, end) in enumerate([log.rows, *log.others])
    ]


def _with_unknowns_by_log(case: Case, machine: Machine, sources: Sequence[_Source]) -> Machine:
    """Return the machine with the unknowns of all logs; see `jaxid.own_values.expanded`."""
    known = {}
    for source in sources:
        # A set of places does not depend on the sampling of the log.
        known[source.whole] = set(_own(case, machine, source, 1.0).plant)
    return expanded(case, machine, case.identification.per_log, known)


def _own(case: Case, machine: Machine, source: _Source, period: float) -> OwnValues:
    stated = {} if source.entry is None else source.entry.known
    where = f"{case.where}, [[fit]] {source.whole}"
    return own_values(case, machine, source.whole, stated, period, where)


def _with_values(case: Case, machine: Machine, source: _Source, log: Log) -> _Source:
    """Return a source with the values that hold in its log."""
    return replace(source, own=_own(case, machine, source, log.period))


def _opened(
    case: Case, machine: Machine, source: _Source, log: Log, recipe: Recipe, short: bool
) -> tuple[OpenedLog, list[Finding]]:
    """Open one further log to fit, and return the findings on it."""
    at = machine if source.own is None else source.own.machine(machine)
    findings = _check(case, log, at, short, alone=False)
    run = _run(
        source.name,
        log,
        at,
        _recipe_of(log, case, recipe),
        _enough_beside(log, at, short),
        source.disturbance,
    )
    return replace(run, reference_hold=source.reference_hold, own=source.own), findings


def _recipe_of(log: Log, case: Case, recipe: Recipe) -> Recipe:
    """Return the recipe of a further log: that of the first, unless its rate or noise asks for another."""
    own = replace(choose_recipe(log, case.preprocess), align_hold=recipe.align_hold)
    pairs = [(own.cutoff_hz, recipe.cutoff_hz), *zip(own.rest_velocity, recipe.rest_velocity, strict=True)]
    alike = own.decimation == recipe.decimation and own.median == recipe.median
    alike &= all(max(a, b) <= _ALIKE * min(a, b) for a, b in pairs)
    return recipe if alike else own


def open_another(session: Session, log: LogLike) -> OpenedLog:
    """Open one more log for a session, prepared by the recipe of its others.

    Args:
        session: The session.
        log: The log, its file, or a table; all its rows are taken.

    Raises:
        InputError: If the log is unsound.
    """
    case, machine = session.declared, session.machine
    measured = _followed(at_joints(case), _read(case, log, whole=True), machine.plant)
    held = case.within_prior is not None
    _check(at_joints(case), measured, machine, held)
    needed = 0 if held else enough(machine)
    name = Path(measured.source).stem
    own = OwnValues(name) if session.more else None
    at = machine if own is None else own.machine(machine)
    run = replace(_run(name, measured, at, session.recipe, needed, machine.disturbance), own=own)
    run = replace(run, data=replace(run.data, force_noise=session.fit.data.force_noise))
    return run if run.log.hold == machine.hold else _under(machine.hold, run, machine)


def session_around(case: Case, machine: Machine, log: Log, recipe: Recipe | None = None) -> Session:
    """Open a session on a simulated log; no file checks are needed.

    Args:
        case: The case.
        machine: Machine at the start of a fit.
        log: The simulated log.
        recipe: Filtering of the log; None: chosen from the log.

    Raises:
        InputError: If the log is too short, or moves too little.
    """
    recipe = recipe or choose_recipe(log, case.preprocess)
    needed = 0 if case.fits_within_prior(None) else enough(machine)
    run = _run("fit", log, machine, recipe, needed, machine.disturbance)
    return Session(case, _scaled(machine, run.data), run, (), recipe, ())


def session_around_several(
    case: Case,
    machine: Machine,
    logs: Sequence[tuple[str, OwnValues | None, Log]],
    recipe: Recipe | None = None,
) -> Session:
    """Open a session on simulated logs that are fitted together; no file checks are needed.

    Args:
        case: The case.
        machine: Machine at the start of a fit, with the unknowns of all logs.
        logs: Name of each log, the values that hold in it, and the log.
        recipe: Filtering of the logs; None: chosen from the first.

    Raises:
        InputError: If a log is too short, or moves too little.
    """
    recipe = recipe or choose_recipe(logs[0][2], case.preprocess)
    disturbances = {entry.name: entry.disturbance for entry in case.fits}
    runs = []
    for name, own, log in logs:
        at = machine if own is None else own.machine(machine)
        needed = 0 if case.fits_within_prior(None) else enough(at)
        disturbance = disturbances.get(name, machine.disturbance)
        runs.append(replace(_run(name, log, at, recipe, needed, disturbance), own=own))
    own = logs[0][1]
    if len(runs) == 1 and own is not None:
        machine = own.machine(machine)
    return Session(case, _scaled(machine, runs[0].data), runs[0], (), recipe, (), more=tuple(runs[1:]))


def _read(case: Case, log: LogLike, *, columns: LogTable | None = None, whole: bool = False) -> Log:
    """Return a log, or read it from a file; its forces and positions are those of the joints.

    Args:
        case: The case, as it was logged.
        log: The log, its file, or a table of columns.
        columns: Columns of the file or table; None: those of [log].
        whole: Whether to read all rows of the file.
    """
    joints, drives, load = case.plant.joints, case.plant.drives, case.plant.cls.load
    if not isinstance(log, Log):
        columns = case.columns if columns is None else columns
        columns = replace(columns, rows=None) if whole else columns
        frame = _frame(case)
        log = as_log(log, columns, joints=joints if load is None else None, drives=drives, frame=frame)
        return with_load(_without_gears(case, log), load, joints)
    log = with_load(log, load, joints)
    for name, width in (("position", joints), ("force", drives), ("reference", drives)):
        values = getattr(log, name)
        if values is not None and values.shape[1] != width:
            what = "joint" if name == "position" else "drive"
            raise InputError(
                f"{name} has {values.shape[1]} column(s) where {width} belong",
                where=log.source,
                hint=f"give one column a {what}, in the order of the {what}s",
            )
    return _without_gears(case, log)


def _frame(case: Case) -> Frame:
    """Return the machine behind the columns of a log, for the conversion of their units."""
    units = case.plant.units
    labels = {"position": units.position, "force": units.force}
    plant = make_plant(case)
    return Frame(
        motions=motions_of(case, plant),
        driven=plant.driven(plant.joints),
        actuator=case.actuator,
        labels={name: label for name, label in labels.items() if label is not None},
    )


def at_joints(case: Case) -> Case:
    """Return the case for logs of the joints, if its logs are of motors that move several."""
    return case if case.actuator.transmission is None else replace(case, actuator=Actuator())


def _without_gears(case: Case, log: Log) -> Log:
    """Return a log of motors as one of the joints: positions R^-1 p, forces R' times gain times command."""
    if case.actuator.transmission is None:
        return log
    rows = np.asarray(case.actuator.transmission)
    moved = {
        name: np.linalg.solve(rows, getattr(log, name).T).T
        for name in ("position", "velocity", "acceleration", "reference")
        if getattr(log, name) is not None
    }
    return replace(log, force=log.force * np.asarray(case.actuator.gain) @ rows, **moved)


def _followed(case: Case, log: Log, plant: Plant) -> Log:
    """Return the log with the reference of the case, if the log has none."""
    if log.reference is not None or case.controller is None or case.reference is None:
        return log
    if case.unknown_reference:
        return log
    rate, where = 1 / log.period, f"{case.where}, [reference]"
    reference = make_reference(
        case.reference, rate, log.samples / rate, case.folder, where=where, plant=plant
    )
    return replace(log, reference=np.broadcast_to(reference, (log.samples, case.plant.drives)))


def _check(case: Case, log: Log, machine: Machine, short: bool, *, alone: bool = True) -> list[Finding]:
    """Check a log, and return the findings.

    Args:
        case: The case.
        log: The log.
        machine: The machine on this log.
        short: Whether a fit within a prior needs two positions only.
        alone: Whether no other log is fitted with it.
    """
    limit = None if case.controller is None else case.controller.limit
    units, plant = machine.units, machine.plant
    motions = [plant.motion(j) or units.motion for j in range(plant.joints)]
    driven = np.asarray(plant.at_drives(np.arange(plant.joints)))
    stated = machine.sensor.position_resolution is not None
    findings = check_log(
        log,
        command_limit=limit,
        motion=motions,
        units={"position": units.position} if units.position else None,
        driven=driven,
        fewest_levels=2 if short else FEWEST_LEVELS,
        resolution_stated=stated,
        free=True,
    )
    check_absent(case, machine, log, alone=alone)
    impossible = plant.impossible(log.position) if all(log.measured) else None
    if impossible is not None:
        row, what = impossible
        hint = "check the lengths, the zeros of the angles and their unit (rad)"
        findings.append(Finding("error", f"row {log.rows[0] + row}: {what}", f"{log.source}, position", hint))
    inertia = plant.own_inertia()
    if inertia is not None:
        slip = plausible_inertia(log, np.asarray(inertia), machine.gain, motion=motions, driven=driven)
        findings += [slip] if slip is not None else []
    raise_on_error(findings)
    return findings


def _left_out(case: Case) -> list[Finding]:
    """Return the parts of a robot's file that the machine does not hold."""
    hint = "state an effect if the log shows it"
    return [Finding("warning", note, f"{case.where}, [plant]", hint) for note in case.plant.notes]


@dataclass(frozen=True)
class _Held:
    """Result of `_held_against`.

    Args:
        findings: Warnings.
        hold: Hold of the force to take in place of the log's; None: the log's.
        reference_hold: Course of the reference between samples.
        force_noise: Estimated noise of the force, in units of the command, (m,).
        settings: Choices made from the log; see `Session`.
    """

    findings: list[Finding]
    hold: str | None
    reference_hold: str
    force_noise: np.ndarray
    settings: dict[str, dict[str, str]]


def _held_against(case: Case, machine: Machine, opened: OpenedLog, free_hold: bool) -> _Held:
    """Hold a prepared log against its case.

    Args:
        case: The case, as it was logged.
        machine: Its machine.
        opened: The log.
        free_hold: Whether the hold of the force is to be chosen, because the case does not state it.

    Raises:
        InputError: If the log contradicts the case.
    """
    log, data = opened.log, opened.data
    if log.passive:
        # Sign, hold and noise of a force, and a law, need a force.
        return _Held([], None, machine.reference_hold, np.zeros(log.force.shape[1]), {})
    declared = balance_fits(machine, data)[0]
    if not declared.finite:
        return _Held([], None, machine.reference_hold, np.zeros(log.force.shape[1]), {})
    gain = None
    if case.actuator.transmission is None and case.actuator.torque_constant is None:
        gain = drives_of_case(case, machine.plant).gain.tolist()
    findings = sign_findings(machine, log, data, declared, gain)
    raise_on_error(findings)

    hold, better, settings = None, better_hold(machine, log, data, declared), {}
    if better is not None:
        findings.append(hold_finding(log, *better, machine.unit("force"), used=free_hold))
        if free_hold:
            hold = better[0]
            settings["hold"] = hold_setting(log.hold, *better, machine.unit("force"))
            opened = _under(hold, opened, machine)
            log, data = opened.log, opened.data
            declared = balance_fits(machine, data)[0]

    confirmed = False
    if case.log is not None and case.log.reference is not None:
        machine, doubts, setting, confirmed = _with_reference_hold(case, machine, opened, declared)
        findings, settings = [*findings, *doubts], settings | setting
    replayed = replayed_law(machine, log)
    findings += law_findings(machine, log, replayed, confirmed=confirmed)
    findings += loop_velocity_findings(machine, log)
    raise_on_error(findings)

    findings += weight_findings(machine, log, declared)
    made = replayed.command if replayed is not None and replayed.exact else None
    noise = estimated_force_noise(machine, log, data, declared, made)
    findings += noise_findings(machine, log, data, declared, noise)
    return _Held(findings, hold, machine.reference_hold, noise, settings)


def _with_reference_hold(
    case: Case, machine: Machine, opened: OpenedLog, declared: BalanceFit
) -> tuple[Machine, list[Finding], dict[str, dict[str, str]], bool]:
    """Return the machine with its reference's course, warnings, settings, and if the law is confirmed."""
    compared = compare_reference_holds(machine, opened.log, opened.data, declared)
    if compared is None:
        return machine, [], {}, False
    stated, unit = case.columns.reference_hold is not None, machine.unit("force")
    findings = reference_hold_finding(opened.log, compared, machine.reference_hold, unit, stated=stated)
    if compared.best is not None and not stated:
        machine = replace(machine, reference_hold=compared.best)
    setting = reference_hold_setting(compared, machine.reference_hold, unit, stated=stated)
    confirmed = machine.reference_hold in compared.confirmed
    return machine, findings, {"reference_hold": setting}, confirmed


def _under(hold: str, opened: OpenedLog, machine: Machine) -> OpenedLog:
    """Return a log under another hold of its force."""
    log = replace(opened.log, hold=hold)
    held = opened.data.recipe.hold(log, machine.hold_period)
    return replace(opened, log=log, data=replace(opened.data, hold=held))


def enough(machine: Machine) -> int:
    """Return the samples of motion that a log must have for a fit without a prior."""
    return 5 * max(len(machine.parameters.free), 4)


def _run(
    name: str, log: Log, machine: Machine, recipe: Recipe, needed: int, disturbance: Disturbance | str | None
) -> OpenedLog:
    log = recipe.cleaned(log)
    return OpenedLog(name, log, _prepare(log, machine, recipe, needed), disturbance)


def _enough_beside(log: Log, machine: Machine, short: bool) -> int:
    """Return the least number of moving samples of a log beside the first.

    The position of a loop whose force was not logged tells, or confirms, that a joint stands still.
    """
    return 0 if short or machine.unforced(log) else enough(machine)


def _prepare(log: Log, machine: Machine, recipe: Recipe, needed: int) -> Prepared:
    remaining = log.samples // recipe.decimation - 2 * recipe.trim
    if remaining * log.position.shape[1] < needed:
        raise InputError(
            f"too short: {log.samples} samples leave {max(remaining, 0)} after decimation by "
            f"{recipe.decimation} and trimming {recipe.trim} at each end, as [preprocess] states or "
            "the log's noise asks",
            where=log.source,
            hint="take a longer log, or lower decimation and trim in [preprocess]",
        )
    data = prepare(log, machine.gain, recipe, machine.hold_period)
    if not all(log.measured):
        data = replace(data, steps=needed_steps(machine, log))
    if data.moving.sum() < needed:
        raise InputError(
            f"only {int(data.moving.sum())} samples move faster than the rest velocity "
            f"{min(recipe.rest_velocity):.3g}",
            where=log.source,
            hint="take a log with more motion, or lower rest_velocity",
        )
    return data


def _scaled(machine: Machine, data: Prepared) -> Machine:
    """Return the machine with the velocity scale of its log, which the smoothed sign multiplies."""
    speed = typical_velocity(machine.plant, data.qd, lambda v: float(np.sqrt(np.mean(v**2))))
    plant = machine.plant.smoothed(velocity_scale=speed)
    return machine.with_plant(plant, machine.parameters)
