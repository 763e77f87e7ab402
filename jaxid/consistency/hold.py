"""Course of the logged force between samples, held against the motion: zero_order or linear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.simulation.force_balance import ForceData, measured_force

# Part of the gap with a shift in time that the other hold leaves at most, to stand in place of the shift.
_LESS = 0.98
# Part of the gap under one hold that the other leaves at most, to be the better one.
_CLEARLY = 0.9
# Stretches of a log whose gaps are compared. Their mean difference must exceed so many standard errors: one
# reversal alone, which a model may meet by chance, is no evidence.
_STRETCHES = 20
_SURE = 2.0
# Beginning of the note that a hold was chosen.
_CHOSEN = "hold is not stated"
# Smallest gain in log-likelihood, over the samples with independent residuals; also that of one course of the
# force over another one.
EVIDENCE = 12.0


def better_hold(
    machine: Machine,
    log: Log,
    data: Prepared,
    fit: BalanceFit,
    *,
    rival: Float[np.ndarray, " n"] | None = None,
) -> tuple[str, Float[np.ndarray, " 2"]] | None:
    """Compare the force gaps under both holds.

    A held force acts half a sample later than its samples, one that is joined by lines does not. All
    unknowns, gains of drives among them, forces of position, and a viscous and a Coulomb friction of every
    joint are fitted under both: a friction that is missing acts as a shift in time does.

    Args:
        machine: The machine.
        log: The log.
        data: The log, prepared under its hold.
        fit: Balance of the prepared log.
        rival: Force gap of each joint under the log's hold with effects that shift the force in time [N or
            N m]. The other hold is also the better one if it leaves less without them.

    Returns:
        The other hold and the gaps under the log's and under the other [N or N m], of the drive whose gap
        falls most; None if the other hold is not clearly better, or the two cannot be compared.
    """
    holds = {"zero_order": "linear", "linear": "zero_order"}
    if log.hold not in holds or shifts_in_time(machine, data) or not all(log.measured):
        return None
    other = holds[log.hold]
    held = data.recipe.hold(replace(log, hold=other), machine.hold_period)
    wider = with_friction(fit)
    residuals = [residual_held(machine, data, wider, time) for time in (data.hold, held)]

    gaps = np.array([fit.rms(e) for e in residuals])
    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    least = driven[int(np.argmin(gaps[1, driven] / np.maximum(gaps[0, driven], 1e-300)))]
    simpler = rival is not None and bool(np.all(gaps[1, driven] < _LESS * rival[driven]))
    better = simpler or clearly_better(residuals[1], residuals[0], fit)
    return (other, gaps[:, least]) if better else None


def shifts_force(machine: Machine) -> bool:
    """Check whether the machine has an effect that shifts the force in time by itself."""
    return any(e.shifts_time for e in machine.plant.effects)


def shifts_in_time(machine: Machine, data: Prepared) -> bool:
    """Check whether a drive shifts its force in time, or the filter ignores for how long a force acts."""
    return shifts_force(machine) or not data.recipe.align_hold


def residual_held(
    machine: Machine, data: Prepared, fit: BalanceFit, held: float
) -> Float[np.ndarray, "kept n"]:
    """Return the residual of a balance, fitted anew, if each force acts for another time.

    Unknown gains of drives are fitted, too.

    Args:
        machine: The machine.
        data: The prepared log.
        fit: Its balance.
        held: Time for which each force acts [s]; zero: lines join them.
    """
    force = np.asarray(measured_force(machine.plant, ForceData.of(replace(data, hold=held))))
    return fit.under_force(force).with_gains().fit(bounded=False)[1]


def clearly_better(
    residual: Float[np.ndarray, "kept n"], other: Float[np.ndarray, "kept n"], fit: BalanceFit
) -> bool:
    """Check that a force residual is smaller than another one: by a tenth, throughout the log, and surely.

    Args:
        residual: The residual that may be smaller.
        other: The residual that it is compared with.
        fit: Balance of the log, for its counts and scales.
    """
    return clearly_smaller(residual / fit.scale, other / fit.scale, fit.counts)


def clearly_smaller(
    residual: Float[np.ndarray, "row n"], other: Float[np.ndarray, "row n"], counts: Bool[np.ndarray, "row n"]
) -> bool:
    """Check that a scaled residual is smaller than another one: by a tenth, throughout the log, and surely.

    Args:
        residual: The residual that may be smaller.
        other: The residual that it is compared with.
        counts: Mask of the samples that count.
    """
    less, more = (np.where(counts, e, 0.0) ** 2 for e in (residual, other))
    gain = [piece.sum() for piece in np.array_split(more - less, _STRETCHES)]
    error = np.std(gain, ddof=1) / np.sqrt(len(gain))
    total = np.sqrt(less.sum() / max(more.sum(), 1e-300))
    evidence = -independent(residual, counts) * np.log(max(total, 1e-300))
    return bool(np.mean(gain) > _SURE * error and total < _CLEARLY and evidence > EVIDENCE)


def independent(residual: np.ndarray, counts: np.ndarray) -> float:
    """Return the number of samples with independent residuals, by the correlation of neighbours."""
    total = 0.0
    for e, counted in zip(residual.T, counts.T, strict=True):
        x, both = np.where(counted, e, 0.0), counted[1:] & counted[:-1]
        alike = float(x[1:] @ x[:-1]) / max(float(np.sum(x[:-1][both] ** 2)), 1e-300)
        alike = float(np.clip(alike, 0.0, 0.99))
        total += counted.sum() * (1 - alike) / (1 + alike)
    return total


def with_friction(fit: BalanceFit) -> BalanceFit:
    """Return the balance with a viscous and a Coulomb friction of every joint among the undeclared forces."""
    joints = fit.velocity.shape[1]
    more = np.zeros((*fit.velocity.shape, 2 * joints))
    for j in range(joints):
        more[:, j, 2 * j] = fit.velocity[:, j]
        more[:, j, 2 * j + 1] = np.sign(fit.velocity[:, j])
    return fit.beside(more)


def hold_finding(log: Log, other: str, gaps: np.ndarray, unit: str, *, used: bool) -> Finding:
    """Return the note that another hold fits better.

    Args:
        log: The log under its hold.
        other: The better hold.
        gaps: Force gaps under the log's hold and under the other one.
        unit: Unit of the gaps.
        used: Whether the other one is used, because the case states none.
    """
    sizes = f"leaves a force gap of {gaps[1]:.3g} {unit}, '{log.hold}' {gaps[0]:.3g} {unit}"
    if used:
        what = f"{_CHOSEN}, and '{other}' is used: it {sizes}"
        hint = f"state hold = '{other}' in [log] to confirm it, or hold = '{log.hold}'"
    else:
        what = f"hold = '{log.hold}' is stated, but '{other}' {sizes}"
        hint = f"set hold = '{other}' in [log] if the force is not held between its samples"
        if other == "zero_order":
            hint = f"set hold = '{other}' in [log] if each force is held until the next sample"
    return Finding("warning", what, f"{log.source}, force", hint)


def under_smooth_force(
    findings: Sequence[Finding], reason: str, gain: float
) -> tuple[tuple[Finding, ...], str]:
    """Return the findings and the reason of a chosen hold when a smooth force replaces lines.

    Args:
        findings: Findings of the session, the choice of the hold among them.
        reason: Reason for which lines were chosen; see `hold_setting`.
        gain: Log-likelihood under the smooth force minus that under lines [nats].
    """
    smooth = f"a smooth curve in place of lines raises the log-likelihood by {gain:.3g}"
    what = f"{_CHOSEN}, and 'band_limited' is used: the force is not held, and {smooth}"
    hint = "state hold = 'band_limited' in [log] to confirm it, or hold = 'linear'"
    changed = (replace(f, what=what, hint=hint) if f.what.startswith(_CHOSEN) else f for f in findings)
    return tuple(changed), f"lines: {reason}; {smooth}"


def without_lines(findings: Sequence[Finding], gain: float) -> tuple[tuple[Finding, ...], str]:
    """Return the findings and the reason of a held force when the log had chosen lines.

    Args:
        findings: Findings of the session, the choice of lines among them.
        gain: Log-likelihood of a held force that was logged late minus that of lines [nats].
    """
    reason = f"held, and logged late, it raises the log-likelihood by {gain:.3g} over lines"
    return tuple(f for f in findings if not f.what.startswith(_CHOSEN)), reason


def hold_setting(before: str, other: str, gaps: np.ndarray, unit: str) -> dict[str, str]:
    """Return the entry of `settings` in result.json for a hold that was chosen from the log.

    Args:
        before: The default hold.
        other: The chosen hold.
        gaps: Force gaps under the default and under the chosen hold.
        unit: Unit of the gaps.
    """
    return {
        "value": other,
        "reason": f"it leaves a force gap of {gaps[1]:.3g} {unit}, '{before}' {gaps[0]:.3g} {unit}",
    }
