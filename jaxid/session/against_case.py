"""A prepared log held against its case: sign, hold and noise of the force, and the control law."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

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
from jaxid.logs.log import Log
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
    clipped: Bool[np.ndarray, "samples m"] | None = None
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
    nothing = AgainstCase(
        [], None, machine.reference_hold, ForceNoise(np.zeros(opened.log.force.shape[1])), {}
    )
    if opened.log.passive:
        # Sign, hold and noise of a force, and a law, need a force.
        return nothing
    comparison = _Comparison(case, machine, opened)
    if not comparison.declared.finite:
        return nothing

    comparison.take_sign()
    comparison.take_clipped_rows()
    comparison.take_hold(free_hold)
    comparison.take_tick(free_hold)
    comparison.take_law()
    return comparison.with_noise()


class _Comparison:
    """State of the comparison of a log with its case.

    Each step adds findings. Later steps use what earlier ones chose.
    """

    def __init__(self, case: Case, machine: Machine, opened: OpenedLog) -> None:
        self.case = case
        self.opened, self.data = opened, opened.data
        self.findings: list[Finding] = []
        self.settings: dict[str, dict[str, str]] = {}
        self.hold: str | None = None
        self.tick: Tick | None = None
        self.clipped: Bool[np.ndarray, "samples m"] | None = None
        # Whether the loop is faster than the log; None: it is known not to be.
        self.faster: bool | None = False
        # Whether another hold than the stated one is clearly better.
        self.contradicted = False
        # Command of the declared law; None: it does not reproduce the logged one.
        self.command: Float[np.ndarray, "time m"] | None = None
        self._balance(machine)

    @property
    def log(self) -> Log:
        """The log under the hold that was chosen."""
        return self.opened.log

    def _balance(self, machine: Machine) -> None:
        """Fit the balance of forces along the log as it is prepared now."""
        self.machine = with_rough_gains(machine, self.data)
        self.declared = balance_fits(self.machine, self.data)[0]

    def _take_opened(self, opened: OpenedLog) -> None:
        self.opened, self.data = opened, opened.data

    def take_sign(self) -> None:
        """Refuse a force that does not push."""
        gain, actuator = None, self.case.actuator
        if actuator.transmission is None and actuator.torque_constant is None:
            gain = drives_of_case(self.case, self.machine.plant).gain.tolist()
        self.findings += sign_findings(self.machine, self.log, self.data, self.declared, gain)
        raise_on_error(self.findings)

    def take_clipped_rows(self) -> None:
        """Leave out the rows in which the recording of a force is clipped."""
        found = clipped_force(self.machine, self.log, self.data, self.declared)
        if found is None:
            return
        self.clipped, finding = found
        self.findings.append(finding)
        rows = f"{int(self.clipped.any(axis=1).sum())} rows"
        self.settings["clipped_force"] = {"value": rows, "reason": finding.what}
        self._take_opened(without_clipped(self.opened, self.clipped, self.machine))
        self.declared = replace(self.declared, counts=self.data.fitted)

    def take_hold(self, free: bool) -> None:
        """Compare the courses of the force between samples; take the better one if none is stated."""
        unit = self.machine.unit("force")
        better = better_hold(self.machine, self.log, self.data, self.declared)
        self.contradicted = better is not None and not free
        if better is None:
            return
        self.findings.append(hold_finding(self.log, *better, unit, used=free))
        if free:
            self.settings["hold"] = hold_setting(self.log.hold, *better, unit)
            self._take_other_hold(better[0])
            self._balance(self.machine)

    def _take_other_hold(self, hold: str) -> None:
        self.hold = hold
        self._take_opened(under_hold(hold, self.opened, self.machine))

    def take_tick(self, free: bool) -> None:
        """Take the time for which each force acts in the log of a faster loop, if no hold is stated."""
        if not free:
            return
        fast = loop_is_faster(self.machine, self.log, likely=self.hold == "linear")
        tick = faster_tick(self.machine, self.log, self.data, self.declared, fast=fast)
        if tick is None:
            return
        if tick.period == self.log.period:
            self.faster = None
            return

        self.tick, self.faster = tick, True
        self.findings.append(tick.finding(self.log))
        self.settings["tick"] = tick.setting()
        # Of the two courses that a simulation has, lines are nearer to a force that acts for half a row.
        if self.log.hold != "linear":
            self._take_other_hold("linear")
        self.data = replace(self.data, hold=tick.period)
        self._balance(self.machine)

    def take_law(self) -> None:
        """Compare times of force and position, the course of the reference, and the declared control law."""
        if not self.contradicted:  # a wrong hold is half a sample late
            self.findings += timing_findings(self.machine, self.log, self.data, self.declared)
        confirmed = False
        if self.case.log is not None and self.case.log.reference is not None:
            found = _with_reference_hold(self.case, self.machine, self.opened, self.declared)
            self.machine, doubts, setting, confirmed = found
            self.findings += doubts
            self.settings |= setting
        replayed = replayed_law(self.machine, self.log)
        self.findings += law_findings(self.machine, self.log, replayed, confirmed=confirmed)
        self.findings += loop_velocity_findings(self.machine, self.log)
        raise_on_error(self.findings)
        self.command = replayed.command if replayed is not None and replayed.exact else None

    def with_noise(self) -> AgainstCase:
        """Estimate the noise of the force, and return the whole comparison."""
        parts = (self.machine, self.log, self.data, self.declared)
        self.findings += weight_findings(self.machine, self.log, self.declared)
        noise = estimated_force_noise(*parts, self.command, fast=self.faster)
        self.findings += noise_findings(*parts, noise.std)
        return AgainstCase(
            findings=self.findings,
            hold=self.hold,
            reference_hold=self.machine.reference_hold,
            force_noise=noise,
            settings=self.settings,
            clipped=self.clipped,
            tick=self.tick,
        )


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
