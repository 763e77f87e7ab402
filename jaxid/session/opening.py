"""Sessions, opened from a case and its logs: each read, checked, prepared, and held against the case."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from jaxid.build import build_machine
from jaxid.case.case import Case, CaseLike, load_case
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.logs.prepare import Recipe, choose_recipe
from jaxid.logs.soundness import Finding
from jaxid.machine import Machine
from jaxid.own_values import OwnValues, expanded, own_values
from jaxid.session.against_case import hold_against_case
from jaxid.session.checks import log_findings, parts_left_out
from jaxid.session.holds import session_under_hold
from jaxid.session.opened import Logs, OpenedLog, Session
from jaxid.session.preparing import (
    enough,
    enough_beside,
    open_log,
    recipe_of,
    under_hold,
    with_force_noise,
    with_velocity_scale,
    without_clipped,
)
from jaxid.session.reading import at_joints, read_at_joints, with_reference
from jaxid.session.sources import Source, between_gaps, one_table, pieces_of, sources_of, unlike
from jaxid.settings import LogTable
from jaxid.simulation.finite_effects import need_finite_effects


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

        return open_steady(as_logged, one_table(as_logged, log), validate, read_at_joints)
    case = at_joints(as_logged)

    source, measured, further = _first_log(as_logged, log, piecewise=piecewise)
    # The machine of the first log serves them all: only the controller's period depends on the log.
    machine = build_machine(case, period=measured.period)
    several = bool(further or case.fits)
    if several:
        machine = _with_unknowns_by_log(case, machine, (source, *further))
        source = _with_values(case, machine, source, measured)
    measured = with_reference(case, measured, machine.plant)

    short = case.fits_within_prior(method)
    on_log = source.machine(machine)
    findings = [*parts_left_out(case), *log_findings(case, measured, on_log, short, alone=not several)]
    recipe = choose_recipe(measured, case.preprocess)
    if align_hold is not None:
        recipe = replace(recipe, align_hold=align_hold)
    needed = 0 if short else enough(on_log)
    fit = _open_source(source, measured, machine, recipe, needed)

    opening = _Opening(
        as_logged=as_logged,
        case=case,
        machine=machine,
        recipe=recipe,
        short=short,
        several=several,
        findings=findings,
    )
    more = opening.further_logs(further, piecewise=piecewise)
    validations = opening.validations_of_case(measured)
    names = {run.name for run in (fit, *more, *validations)}
    validations += opening.more_validations(validate, names)

    if source.own is not None and not more:
        machine = source.own.machine(machine)
    machine = with_velocity_scale(machine, fit.data)
    for run in (fit, *more):
        need_finite_effects(run.machine(machine).plant, run.data, run.log.source)
    session = Session(
        case, machine, fit, tuple(validations), recipe, tuple(findings), as_logged, more=tuple(more)
    )
    if short:
        return session
    chooses_hold = not isinstance(source.log, Log) and "hold" not in case.tables.get("log", {})
    return _held_against_case(replace(session, chooses_hold=chooses_hold), several=several)


def _first_log(case: Case, log: Logs, *, piecewise: bool) -> tuple[Source, Log, list[Source]]:
    """Read the first log to fit; return its source, the log at the joints, and the sources of the others."""
    source, *further = sources_of(case, log)
    measured = read_at_joints(case, source.log, columns=source.columns)
    if piecewise:
        source, *between = between_gaps(source, measured)
        further = [*between, *further]
    return source, measured, further


@dataclass(frozen=True)
class _Opening:
    """Choices made from the first log, by which the other logs of a session are opened.

    Args:
        as_logged: The case as it was given.
        case: The case for logs of the joints.
        machine: Machine at the guesses, with the unknowns of all logs.
        recipe: Filtering of the first log.
        short: Whether a fit within a prior can do with a short log.
        several: Whether several logs are fitted.
        findings: Warnings on the logs; those on each further log are added.
    """

    as_logged: Case
    case: Case
    machine: Machine
    recipe: Recipe
    short: bool
    several: bool
    findings: list[Finding]

    def further_logs(self, sources: Sequence[Source], *, piecewise: bool) -> list[OpenedLog]:
        """Open the further logs to fit; a stretch between gaps that is unsound is left out with a warning.

        Raises:
            InputError: If a log that was named is unsound.
        """
        opened: list[OpenedLog] = []
        waiting = list(sources)
        while waiting:
            source = waiting.pop(0)
            try:
                measured = self._read(source.log, source.columns)
                if piecewise and not source.found:
                    source, *between = between_gaps(source, measured)
                    waiting = [*between, *waiting]
                opened.append(self._further_log(source, measured))
            except InputError as error:
                if not source.found:
                    raise
                what, hint = f"{source.name} is left out: {error}", "name other stretches in [log] rows"
                self.findings.append(Finding("warning", what, self.case.where, hint))
        return opened

    def validations_of_case(self, first: Log) -> list[OpenedLog]:
        """Open the logs of [[validation]], those without a file from the file of the first log.

        Raises:
            InputError: If one is unsound.
        """
        opened = []
        for entry in self.case.validations:
            other = first if entry.log is None else entry.log
            file = other.source if isinstance(other, Log) else other
            for name, columns in pieces_of(entry.name, entry.columns):
                log = self._read(file, columns)
                self.findings.extend(log_findings(self.case, log, self.machine, self.short))
                values = None
                if entry.known or self.several:
                    where = f"{self.case.where}, [[validation]] {entry.name}"
                    values = own_values(self.case, self.machine, entry.name, entry.known, log.period, where)
                opened.append(
                    open_log(
                        name,
                        log,
                        self.machine,
                        self.recipe,
                        enough_beside(log, self.machine, self.short),
                        entry.disturbance,
                        values=values,
                        reference_hold=entry.columns.reference_hold,
                    )
                )
        return opened

    def more_validations(self, logs: Sequence[LogLike], names: set[str]) -> list[OpenedLog]:
        """Open the logs to validate on that the case does not name, under names unlike those of the others.

        Raises:
            InputError: If one is unsound.
        """
        opened, names = [], set(names)
        for given in logs:
            log = self._read(given, whole=True)
            self.findings.extend(log_findings(self.case, log, self.machine, self.short))
            name = unlike(Path(log.source).stem, names)
            names.add(name)
            values = OwnValues(name) if self.several else None
            machine, disturbance = self.machine, self.machine.disturbance
            needed = enough_beside(log, machine, self.short)
            opened.append(open_log(name, log, machine, self.recipe, needed, disturbance, values=values))
        return opened

    def _read(self, log: LogLike, columns: LogTable | None = None, *, whole: bool = False) -> Log:
        log = read_at_joints(self.as_logged, log, columns=columns, whole=whole)
        return with_reference(self.case, log, self.machine.plant)

    def _further_log(self, source: Source, log: Log) -> OpenedLog:
        source = _with_values(self.case, self.machine, source, log)
        on_log = source.machine(self.machine)
        findings = log_findings(self.case, log, on_log, self.short, alone=False)
        recipe = recipe_of(log, self.case, self.recipe)
        opened = _open_source(source, log, self.machine, recipe, enough_beside(log, on_log, self.short))
        self.findings.extend(findings)
        return opened


def _open_source(source: Source, log: Log, machine: Machine, recipe: Recipe, needed: int) -> OpenedLog:
    """Open a log to fit that has been read; see `jaxid.session.preparing.open_log`."""
    return open_log(
        source.name,
        log,
        machine,
        recipe,
        needed,
        source.disturbance,
        values=source.own,
        reference_hold=source.reference_hold,
    )


def _held_against_case(session: Session, *, several: bool) -> Session:
    """Return a session after its fitted logs have been held against the case.

    Args:
        session: The session.
        several: Whether values may differ between its logs.

    Returns:
        The session with the holds of reference and force, the noise of the force, and warnings.

    Raises:
        InputError: If a log contradicts the case.
    """
    case, machine, fit = session.declared, session.machine, session.fit
    found = hold_against_case(case, fit.machine(machine) if several else machine, fit, session.chooses_hold)
    session = session.with_machine(replace(machine, reference_hold=found.reference_hold))
    if found.clipped is not None:
        session = _without_clipped(session, found.clipped)
    if found.hold is not None:
        session = session_under_hold(session, found.hold)
    machine, opened, more = session.machine, [session.fit, *session.validations], list(session.more)

    # The logs to validate on are of the same sensors and the same loop.
    opened = [with_force_noise(run, found.force_noise, found.tick) for run in opened]
    if found.tick is not None:
        session = replace(session, chooses_hold=False)
    findings = [*session.findings, *found.findings]
    for k, run in enumerate(more):
        # A further log to fit counts by its own noise.
        also = hold_against_case(case, run.machine(machine), run, False)
        findings += also.findings
        if also.clipped is not None:
            run = without_clipped(run, also.clipped, machine)
        same_rate = run.log.period == fit.log.period
        run = with_force_noise(run, also.force_noise, found.tick if same_rate else None)
        other = None if also.reference_hold == machine.reference_hold else also.reference_hold
        more[k] = replace(run, reference_hold=run.reference_hold or other)
    return replace(
        session,
        machine=machine,
        fit=opened[0],
        validations=tuple(opened[1:]),
        # What holds of the case is found with every log.
        findings=tuple(dict.fromkeys(findings)),
        settings=found.settings,
        more=tuple(more),
    )


def _without_clipped(session: Session, rows: Bool[np.ndarray, "samples m"]) -> Session:
    """Return a session without the clipped rows of its first log, and with none at that level in validations.

    The logs to validate on are of the same sensors.
    """
    machine, log = session.machine, session.fit.log
    levels = np.where(rows, np.abs(log.force), np.inf).min(axis=0)

    def clean(run: OpenedLog) -> OpenedLog:
        beyond = np.abs(run.log.force) >= levels
        return without_clipped(run, beyond, machine) if beyond.any() else run

    validations = tuple(clean(run) for run in session.validations)
    return replace(session, fit=without_clipped(session.fit, rows, machine), validations=validations)


def _with_unknowns_by_log(case: Case, machine: Machine, sources: Sequence[Source]) -> Machine:
    """Return the machine with the unknowns of all logs; see `jaxid.own_values.expanded`."""
    known = {}
    for source in sources:
        # A set of places does not depend on the sampling of the log.
        known[source.whole] = set(_values_of(case, machine, source, 1.0).plant)
    return expanded(case, machine, case.identification.per_log, known)


def _values_of(case: Case, machine: Machine, source: Source, period: float) -> OwnValues:
    stated = {} if source.entry is None else source.entry.known
    where = f"{case.where}, [[fit]] {source.whole}"
    return own_values(case, machine, source.whole, stated, period, where)


def _with_values(case: Case, machine: Machine, source: Source, log: Log) -> Source:
    """Return a source with the values that hold in its log."""
    return replace(source, own=_values_of(case, machine, source, log.period))


def open_another(session: Session, log: LogLike) -> OpenedLog:
    """Open one more log for a session, prepared by the recipe of its others.

    Args:
        session: The session.
        log: The log, its file, or a table; all its rows are taken.

    Raises:
        InputError: If the log is unsound.
    """
    case, machine = session.declared, session.machine
    measured = read_at_joints(case, log, whole=True)
    measured = with_reference(at_joints(case), measured, machine.plant)
    short = case.within_prior is not None
    log_findings(at_joints(case), measured, machine, short)

    name, needed = Path(measured.source).stem, 0 if short else enough(machine)
    values = OwnValues(name) if session.more else None
    opened = open_log(name, measured, machine, session.recipe, needed, machine.disturbance, values=values)
    known = session.fit.data
    data = replace(
        opened.data,
        force_noise=known.force_noise,
        faster_loop=known.faster_loop,
        answer=known.answer,
    )
    opened = replace(opened, data=data)
    if opened.log.hold != machine.hold:
        opened = under_hold(machine.hold, opened, machine)
    if "tick" in session.settings:
        data = replace(opened.data, hold=known.hold, hold_std=known.hold_std)
        opened = replace(opened, data=data)
    return opened


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
    return session_around_several(case, machine, [("fit", None, log)], recipe)


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
    opened = []
    for name, values, log in logs:
        on_log = machine if values is None else values.machine(machine)
        needed = 0 if case.fits_within_prior(None) else enough(on_log)
        disturbance = disturbances.get(name, machine.disturbance)
        opened.append(open_log(name, log, machine, recipe, needed, disturbance, values=values))
    values = logs[0][1]
    if len(opened) == 1 and values is not None:
        machine = values.machine(machine)
    fit, *more = opened
    return Session(case, with_velocity_scale(machine, fit.data), fit, (), recipe, (), more=tuple(more))
