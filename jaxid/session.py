"""A case and its logs, opened, checked and prepared: where every command starts."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxid.build import build_machine
from jaxid.case.case import Case, load_case
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike, as_log
from jaxid.logs.log import Log, with_load
from jaxid.logs.prepare import Prepared, Recipe, choose_recipe, prepare
from jaxid.logs.soundness import FEWEST_LEVELS, Finding, check_log, plausible_inertia, raise_on_error
from jaxid.machine import Machine
from jaxid.references import make_reference
from jaxid.simulation.step_size import needed_steps


@dataclass(frozen=True)
class OpenedLog:
    """One log with what was different when it was taken.

    Args:
        name: In results.
        log: The log, its force behind the recipe's running median where it has one.
        data: The same, prepared.
        disturbance: The controller's.
    """

    name: str
    log: Log
    data: Prepared
    disturbance: dict | str | None

    def machine(self, machine: Machine) -> Machine:
        """A machine as it stood when this log was taken."""
        return replace(machine, disturbance=self.disturbance)


@dataclass(frozen=True)
class Session:
    """A case, its machine at the guesses, the log to fit and the logs to validate on.

    Args:
        case: The case.
        machine: Its machine.
        fit: The log to fit.
        validations: Others, by name; prepared by the same recipe.
        recipe: How the logs are filtered.
        findings: Warnings on the logs.
        given: The case as it was given, where `case` is that of the joints (see `at_joints`).
    """

    case: Case
    machine: Machine
    fit: OpenedLog
    validations: tuple[OpenedLog, ...]
    recipe: Recipe
    findings: tuple[Finding, ...]
    given: Case | None = None

    @property
    def declared(self) -> Case:
        """The case as it was given, gears of the motors included."""
        return self.case if self.given is None else self.given

    @property
    def runs(self) -> tuple[OpenedLog, ...]:
        """All logs, the fitted one first."""
        return (self.fit, *self.validations)

    def with_machine(self, machine: Machine) -> Session:
        """The same session around another machine."""
        return replace(self, machine=machine)


def open_session(
    case: Case | str | Path,
    log: LogLike,
    validate: Sequence[LogLike] = (),
    *,
    align_hold: bool | None = None,
    method: str = "output_error",
) -> Session:
    """Open a case and its logs, check them and prepare them.

    Args:
        case: The case, or its file.
        log: The log to fit, its file, or a table with the columns that [log] names.
        validate: More logs to validate on, beside the case's own.
        align_hold: See `jaxid.logs.prepare.Recipe`; absent: what the case's recipe implies.
        method: That is to fit the log: only `output_error` can do with a short one, within a prior, and
            "discover" by it.

    Raises:
        InputError: If anything in case or logs is unsound.
    """
    if isinstance(validate, str) or not isinstance(validate, Sequence):
        raise InputError("validate is not a list of logs", hint="put it into a list: validate=[log]")
    given = case if isinstance(case, Case) else load_case(case)
    read = functools.partial(_read, given)
    case = at_joints(given)
    fit = read(log)
    machine = build_machine(case, period=fit.period)
    held = method in ("output_error", "discover") and "prior" in case.output_error
    findings = _check(case, fit, machine, held)
    recipe = choose_recipe(fit, case.preprocess)
    if align_hold is not None:
        recipe = replace(recipe, align_hold=align_hold)
    disturbance = machine.disturbance
    needed = 0 if held else enough(machine)
    opened = [_run("fit", fit, machine, recipe, needed, disturbance)]
    names = {"fit"}
    for entry in case.validations:
        other = fit if entry.log is None else entry.log
        source = other.source if isinstance(other, Log) else other
        measured = read(source, columns=entry.columns)
        findings += _check(case, measured, machine, held)
        opened.append(_run(entry.name, measured, machine, recipe, needed, entry.disturbance))
        names.add(entry.name)
    for extra in validate:
        measured = read(extra, whole=True)
        findings += _check(case, measured, machine, held)
        name = Path(measured.source).stem
        while name in names:
            name += "'"
        names.add(name)
        opened.append(_run(name, measured, machine, recipe, needed, disturbance))
    machine = _scaled(machine, opened[0].data)
    return Session(case, machine, opened[0], tuple(opened[1:]), recipe, tuple(findings), given)


def open_another(session: Session, log: LogLike) -> OpenedLog:
    """Open one more log for a session, prepared by the recipe of its others.

    Args:
        session: The session.
        log: The log, its file, or a table; all its rows are taken.

    Raises:
        InputError: If the log is unsound.
    """
    case, machine = session.declared, session.machine
    measured = _read(case, log, whole=True)
    held = "prior" in case.output_error
    _check(at_joints(case), measured, machine, held)
    needed = 0 if held else enough(machine)
    name = Path(measured.source).stem
    return _run(name, measured, machine, session.recipe, needed, machine.disturbance)


def session_around(case: Case, machine: Machine, log: Log, recipe: Recipe | None = None) -> Session:
    """A session around a simulated log, which no file was read for and nothing can be wrong with.

    Args:
        case: The case.
        machine: At the start of a fit.
        log: The log.
        recipe: How to filter it; absent: chosen from it.

    Raises:
        InputError: If the log is too short, or moves too little.
    """
    recipe = recipe or choose_recipe(log, case.preprocess)
    needed = 0 if "prior" in case.output_error else enough(machine)
    run = _run("fit", log, machine, recipe, needed, machine.disturbance)
    return Session(case, _scaled(machine, run.data), run, (), recipe, ())


def _read(case: Case, log: LogLike, *, columns: dict | None = None, whole: bool = False) -> Log:
    """A log, or that of a file by the case's columns or others; `whole`: all its rows."""
    joints, drives, load = case.plant.joints, case.plant.drives, case.plant.cls.load
    if not isinstance(log, Log):
        columns = case.columns if columns is None else columns
        kept = {k: v for k, v in columns.items() if not (whole and k == "rows")}
        own = joints if load is None else None
        log = as_log(log, kept, joints=own, drives=drives)
        return _followed(case, with_load(_without_gears(case, log), load, joints))
    log = _followed(case, with_load(log, load, joints))
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


def at_joints(case: Case) -> Case:
    """The case of what is logged at the joints, where its own logs are of motors that move several."""
    return case if case.transmission is None else replace(case, transmission=None, gain=1.0)


def _without_gears(case: Case, log: Log) -> Log:
    """A log of the motors as one of the joints: positions R^-1 p, forces R' times gain times command."""
    if case.transmission is None:
        return log
    rows = np.asarray(case.transmission)
    moved = {
        name: np.linalg.solve(rows, getattr(log, name).T).T
        for name in ("position", "velocity", "acceleration", "reference")
        if getattr(log, name) is not None
    }
    return replace(log, force=log.force * np.asarray(case.gain) @ rows, **moved)


def _followed(case: Case, log: Log) -> Log:
    """The log with the reference that the case knows, where the log has none."""
    if log.reference is not None or case.controller is None or case.reference is None:
        return log
    if case.unknown_reference:
        return log
    rate, plant = 1 / log.period, build_machine(at_joints(case), period=log.period).plant
    where = f"{case.path}, [reference]"
    reference = make_reference(
        case.reference, rate, log.samples / rate, case.folder, where=where, plant=plant
    )
    return replace(log, reference=np.broadcast_to(reference, (log.samples, case.plant.drives)))


def _check(case: Case, log: Log, machine: Machine, held: bool) -> list[Finding]:
    """Findings on a log; held: by a prior, for which two positions are a movement."""
    limit = (case.controller or {}).get("limit")
    units, plant = machine.units, machine.plant
    driven = plant.at_drives(np.arange(plant.joints))
    stated = machine.sensor.position_resolution is not None
    findings = check_log(
        log,
        command_limit=limit,
        motion=units.motion,
        units={"position": units.position} if units.position else None,
        driven=driven,
        fewest_levels=2 if held else FEWEST_LEVELS,
        resolution_stated=stated,
    )
    impossible = plant.impossible(log.position) if all(log.measured) else None
    if impossible is not None:
        row, what = impossible
        hint = "check the lengths, the zeros of the angles and their unit (rad)"
        findings.append(Finding("error", f"row {log.rows[0] + row}: {what}", f"{log.source}, position", hint))
    inertia = plant.own_inertia()
    if inertia is not None:
        slip = plausible_inertia(log, np.asarray(inertia), machine.gain, motion=units.motion, driven=driven)
        findings += [slip] if slip is not None else []
    raise_on_error(findings)
    return findings


def enough(machine: Machine) -> int:
    """Samples of motion that a log must have, where no prior holds what it does not tell."""
    return 5 * max(len(machine.parameters.free), 4)


def _run(
    name: str, log: Log, machine: Machine, recipe: Recipe, needed: int, disturbance: dict | str | None
) -> OpenedLog:
    log = recipe.cleaned(log)
    return OpenedLog(name, log, _prepare(log, machine, recipe, needed), disturbance)


def _prepare(log: Log, machine: Machine, recipe: Recipe, needed: int) -> Prepared:
    left = log.samples // recipe.decimation - 2 * recipe.trim
    if left * log.position.shape[1] < needed:
        raise InputError(
            f"too short: {log.samples} samples leave {max(left, 0)} after decimation by "
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
    """The machine with the velocity scale of its log, which the smoothed sign multiplies."""
    speed = float(np.sqrt(np.mean(data.qd**2)))
    plant = replace(machine.plant, velocity_scale=np.asarray(speed))
    return machine.with_plant(plant, machine.parameters)
