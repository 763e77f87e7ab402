"""The logs of one run of a study: one, or one for each [[fit]] of its case."""

from __future__ import annotations

from dataclasses import replace

from jaxid.case.case import Case
from jaxid.case.log_entries import FitEntry
from jaxid.machine import Machine
from jaxid.own_values import OwnValues, expanded, own_values


def with_logs(case: Case, machine: Machine) -> Machine:
    """Return a machine with the unknowns of all logs of a case; see `jaxid.own_values.expanded`.

    Raises:
        InputError: If an entry names what the case does not declare.
    """
    if not case.fits:
        return machine
    known = {entry.name: set(values_in(case, machine, entry).plant) for entry in case.fits}
    return expanded(case, machine, case.identification.per_log, known)


def values_in(case: Case, machine: Machine, entry: FitEntry) -> OwnValues:
    """Return the values that hold in one log of a study, whose sampling is that of all."""
    period = 1.0 if machine.controller is None else machine.controller.period
    return own_values(case, machine, entry.name, entry.known, period, f"{case.where}, [[fit]] {entry.name}")


def machines_of(case: Case, machine: Machine) -> list[tuple[str, OwnValues | None, Machine]]:
    """Return name, values and machine of each log of a run; of a case without [[fit]] the machine itself."""
    if not case.fits:
        return [("fit", None, machine)]
    out = []
    for entry in case.fits:
        own = values_in(case, machine, entry)
        out.append((entry.name, own, replace(own.machine(machine), disturbance=entry.disturbance)))
    return out
