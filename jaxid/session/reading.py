"""Logs of a case, read and converted to forces and positions of the joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.build import make_plant, motions_of
from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.logs.in_memory import LogLike, as_log
from jaxid.logs.log import Log, with_load
from jaxid.logs.units import Frame
from jaxid.model.plant import Plant
from jaxid.references import make_reference
from jaxid.settings import Actuator, LogTable


def read_at_joints(case: Case, log: LogLike, *, columns: LogTable | None = None, whole: bool = False) -> Log:
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


def with_reference(case: Case, log: Log, plant: Plant) -> Log:
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
