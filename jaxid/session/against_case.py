"""A prepared log held against its case: sign, hold and noise of the force, and the control law."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxid.build import drives_of_case
from jaxid.case.case import Case
from jaxid.consistency.balance_fit import BalanceFit, balance_fits, with_rough_gains
from jaxid.consistency.clipped import clipped_force
from jaxid.consistency.hold import better_hold, hold_finding, hold_setting
from jaxid.consistency.law import law_findings, loop_velocity_findings, replayed_law
from jaxid.consistency.noise import ForceNoise, estimated_force_noise, loop_is_faster, noise_findings
from jaxid.consistency.reference_hold import (
    compare_reference_holds,
    reference_hold_finding,
    reference_hold_setting,
)
from jaxid.consistency.sign import sign_findings
from jaxid.consistency.tick import Tick, faster_tick
from jaxid.consistency.timing import timing_findings
from jaxid.consistency.weight import weight_findings
from jaxid.logs.soundness import Finding, raise_on_error
from jaxid.machine import Machine
from jaxid.session.opened import OpenedLog
from jaxid.session.preparing import under_hold, without_clipped


@dataclass(frozen=True)
class AgainstCase:
    """Result of `hold_against_case`.

    Args:
        findings: Warnings.
        hold: Hold of the force to take in place of the log's; None: the log's.
        reference_hold: Course of the reference between samples.
        force_noise: Estimated noise of the force.
        settings: Choices made from the log; see `Session`.
        clipped: Rows in which the recording of a force is clipped, (samples, drives); None: none.
        tick: Time for which each force acts, if it is less than a row; None: it is not.
    """

    findings: list[Finding]
    hold: str | None
    reference_hold: str
    force_noise: ForceNoise
    settings: dict[str, dict[str, str]]
    clipped: np.ndarray | None = None
    tick: Tick | None = None


def hold_against_case(case: Case, machine: Machine, opened: OpenedLog, free_hold: bool) -> AgainstCase:
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
        return AgainstCase([], None, machine.reference_hold, ForceNoise(np.zeros(log.force.shape[1])), {})
    machine = with_rough_gains(machine, data)
    declared = balance_fits(machine, data)[0]
    if not declared.finite:
        return AgainstCase([], None, machine.reference_hold, ForceNoise(np.zeros(log.force.shape[1])), {})
    gain = None
    if case.actuator.transmission is None and case.actuator.torque_constant is None:
        gain = drives_of_case(case, machine.plant).gain.tolist()
    findings = sign_findings(machine, log, data, declared, gain)
    raise_on_error(findings)

    clipped = clipped_force(machine, log, data, declared)
    if clipped is not None:
        findings.append(clipped[1])
        opened = without_clipped(opened, clipped[0], machine)
        log, data = opened.log, opened.data
        declared = replace(declared, counts=data.fitted)

    hold, better, settings = None, better_hold(machine, log, data, declared), {}
    if clipped is not None:
        rows = f"{int(clipped[0].any(axis=1).sum())} rows"
        settings["clipped_force"] = {"value": rows, "reason": clipped[1].what}
    if better is not None:
        findings.append(hold_finding(log, *better, machine.unit("force"), used=free_hold))
        if free_hold:
            hold = better[0]
            settings["hold"] = hold_setting(log.hold, *better, machine.unit("force"))
            opened = under_hold(hold, opened, machine)
            log, data = opened.log, opened.data
            machine = with_rough_gains(machine, data)
            declared = balance_fits(machine, data)[0]

    tick = None
    if free_hold:
        fast = loop_is_faster(machine, log, likely=hold == "linear")
        tick = faster_tick(machine, log, data, declared, fast=fast)
    of_row = tick is not None and tick.period == log.period
    if tick is not None and not of_row:
        findings.append(tick.finding(log))
        settings["tick"] = tick.setting()
        # Of the two courses that a simulation has, lines are nearer to a force that acts for half a row.
        if log.hold != "linear":
            hold = "linear"
            opened = under_hold(hold, opened, machine)
            log, data = opened.log, opened.data
        data = replace(data, hold=tick.period)
        machine = with_rough_gains(machine, data)
        declared = balance_fits(machine, data)[0]

    if better is None or free_hold:  # a wrong hold is half a sample late
        findings += timing_findings(machine, log, data, declared)
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
    fast = None if of_row else tick is not None
    noise = estimated_force_noise(machine, log, data, declared, made, fast=fast)
    findings += noise_findings(machine, log, data, declared, noise.std)
    left_out = None if clipped is None else clipped[0]
    faster = None if of_row else tick
    return AgainstCase(findings, hold, machine.reference_hold, noise, settings, left_out, faster)


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
