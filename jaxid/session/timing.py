"""A session whose forces are taken back to when they acted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxid.logs.finding import Finding
from jaxid.logs.late import earlier
from jaxid.machine import Machine
from jaxid.session.opened import OpenedLog, Session
from jaxid.session.preparing import prepared


def states_timing(session: Session) -> bool:
    """Check whether the case says by how much the force was logged late, or has an effect that shifts it."""
    table = session.case.log
    stated = table is not None and any("force" in (times or {}) for times in (table.delay, table.lag))
    return stated or any(e.delays_command() or not e.adds_force for e in session.machine.plant.effects)


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
    log = opened.log
    columns = [earlier(log.time, x, delay, log.hold) for x in log.force.T]
    log = replace(log, force=np.stack(columns, axis=1))
    return replace(opened, log=log, data=prepared(log, opened.machine(machine), opened.data.recipe))
