"""A session whose forces are taken back to when they acted."""

from __future__ import annotations

from dataclasses import replace

from jaxid.consistency.hold import shifts_force
from jaxid.consistency.timing import states_delay
from jaxid.logs.finding import Finding
from jaxid.logs.late import earlier
from jaxid.machine import Machine
from jaxid.session.opened import OpenedLog, Session
from jaxid.session.preparing import prepared
from jaxid.simulation.sensor_noise import high_band_force_noise


def states_timing(session: Session) -> bool:
    """Check whether the case says by how much the force was logged late, or has an effect that shifts it."""
    return states_delay(session.case.log) or shifts_force(session.machine)


def session_with_force_at(session: Session, delay: float, finding: Finding) -> Session:
    """Return a session whose forces act as much earlier than they were logged; all logs have one logger.

    Args:
        session: The session.
        delay: Time by which the forces were logged late, below zero if early [s].
        finding: What it was estimated from.
    """
    machine = session.machine
    return replace(
        session,
        fit=_moved(session.fit, delay, machine),
        more=tuple(_moved(run, delay, machine) for run in session.more),
        validations=tuple(_moved(run, delay, machine) for run in session.validations),
        findings=(*session.findings, finding),
        settings={**session.settings, "force_delay": {"value": f"{delay:.3g} s", "reason": finding.what}},
    )


def _moved(opened: OpenedLog, delay: float, machine: Machine) -> OpenedLog:
    """Return a log with its force taken back."""
    log, before = opened.log, opened.data
    # A force between the samples is smoother than its noise, and steps are no longer steps.
    noise = {"force_noise": before.force_noise, "high_band": high_band_force_noise(log, before)}
    log = replace(log, force=earlier(log.time, log.force, delay, log.hold))
    data = prepared(log, opened.machine(machine), before.recipe)
    return replace(opened, log=log, data=replace(data, **noise))
