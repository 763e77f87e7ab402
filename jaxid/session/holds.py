"""A session under another hold of its force: the course of the force between its samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.consistency.balance_fit import balance_fits
from jaxid.consistency.hold import better_hold, hold_finding, hold_setting
from jaxid.consistency.noise import estimated_force_noise, loop_is_faster
from jaxid.consistency.tick import faster_tick
from jaxid.machine import Machine
from jaxid.session.opened import Session
from jaxid.session.preparing import under_hold, with_force_noise


def session_under_hold(session: Session, hold: str) -> Session:
    """Return a session under another hold; logs to validate on keep the one that they state."""
    machine = replace(session.machine, hold=hold)
    stated = [v["name"] for v in session.case.tables.get("validation", []) if "hold" in v]
    kept = (run if run.name in stated else under_hold(hold, run, machine) for run in session.validations)
    return replace(
        session,
        machine=machine,
        fit=under_hold(hold, session.fit, machine),
        more=tuple(under_hold(hold, run, machine) for run in session.more),
        validations=tuple(kept),
    )


def session_under_better_hold(
    session: Session, machine: Machine, rival: Float[np.ndarray, " n"] | None = None
) -> Session | None:
    """Return a session under the other hold if that explains the log clearly better.

    A missing effect may hide which hold is right: the session chose it with the effects of the case alone.

    Args:
        session: The session.
        machine: The machine with the effects that a search found, without those that shift the force in time.
        rival: Force gap of each joint with these, if there are any; see `better_hold`.

    Returns:
        The session with the other hold and the reason for it; None if the hold is stated, or if it is not
        clearly worse.
    """
    run = session.fit
    if not session.chooses_hold or run.log.passive:
        return None
    at_fit = run.machine(machine)
    fit = balance_fits(at_fit, run.data)[0]
    better = better_hold(at_fit, run.log, run.data, fit, rival=rival) if fit.finite else None
    if better is None:
        return None
    unit = machine.unit("force")
    return replace(
        session_under_hold(session, better[0]),
        findings=(*session.findings, hold_finding(run.log, *better, unit, used=True)),
        settings={**session.settings, "hold": hold_setting(run.log.hold, *better, unit)},
        chooses_hold=False,
    )


def session_of_faster_loop(session: Session, machine: Machine) -> Session | None:
    """Return a session in which each force acts for the tick of a loop that is faster than its log.

    A missing effect leaves so much that no tick is clearly better than another: the session may have seen
    none with the effects of the case alone.

    Args:
        session: The session.
        machine: The machine with the effects that a search found, without those that shift the force in time.

    Returns:
        The session with the tick and the reason for it; None if the hold is stated or the tick is known, or
        if the log shows no faster loop.
    """
    run, chosen = session.fit, session.chooses_hold or "hold" in session.settings
    if not chosen or run.log.passive or session.more or "tick" in session.settings:
        return None
    lines = under_hold("linear", run, replace(machine, hold="linear"))
    at_fit = lines.machine(machine)
    fast = loop_is_faster(at_fit, run.log, likely=run.log.hold == "linear")
    tick = faster_tick(at_fit, lines.log, lines.data, balance_fits(at_fit, lines.data)[0], fast=fast)
    if tick is None or tick.period >= run.log.period:
        return None
    held = session_under_hold(session, "linear")
    at_fit, data = held.fit.machine(machine), held.fit.data
    noise = estimated_force_noise(at_fit, held.fit.log, data, balance_fits(at_fit, data)[0], fast=True)
    return replace(
        held,
        fit=with_force_noise(held.fit, noise, tick),
        validations=tuple(with_force_noise(other, noise, tick) for other in held.validations),
        findings=(*session.findings, tick.finding(run.log)),
        settings={**session.settings, "tick": tick.setting()},
        chooses_hold=False,
    )
