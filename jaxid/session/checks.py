"""Checks of a log before it is prepared."""

from __future__ import annotations

import numpy as np

from jaxid.case.case import Case
from jaxid.consistency.absent import check_absent
from jaxid.logs.log import SLOW_LOOP, Log
from jaxid.logs.soundness import FEWEST_LEVELS, Finding, check_log, plausible_inertia, raise_on_error
from jaxid.machine import Machine


def log_findings(case: Case, log: Log, machine: Machine, short: bool, *, alone: bool = True) -> list[Finding]:
    """Check a log, and return the findings.

    Args:
        case: The case.
        log: The log.
        machine: The machine on this log.
        short: Whether a fit within a prior needs two positions only.
        alone: Whether no other log is fitted with it.

    Raises:
        InputError: If the log is unsound.
    """
    limit = None if case.controller is None else case.controller.limit
    units, plant = machine.units, machine.plant
    motions = [plant.motion(j) or units.motion for j in range(plant.joints)]
    driven = np.asarray(plant.at_drives(np.arange(plant.joints)))
    sensor = machine.sensor
    # A log without a force is compared by its positions, whose noise may be stated with the counts in it.
    stated = sensor.position_resolution is not None
    stated = stated or (sensor.position_noise is not None and machine.unforced(log))
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
    if machine.unforced(log) and case.controller is not None and log.period > SLOW_LOOP:
        findings += [] if case.controller.period else [_assumed_period(case, log)]

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


def _assumed_period(case: Case, log: Log) -> Finding:
    """Return the warning that a slow log's period may be taken for that of the servo's loop."""
    return Finding(
        "warning",
        f"the period of the servo's loop is not stated: that of the log, {1e3 * log.period:.3g} ms, is "
        "taken, unless identify finds another one",
        f"{case.where}, [controller]",
        "state period: most servos run their loop at 200 Hz to some kHz, and gains depend on it",
    )


def parts_left_out(case: Case) -> list[Finding]:
    """Return the parts of a robot's file that the machine does not hold."""
    hint = "state an effect if the log shows it"
    return [Finding("warning", note, f"{case.where}, [plant]", hint) for note in case.plant.notes]
