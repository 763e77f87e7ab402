"""Course of the logged reference between samples, held against the motion of a log slower than its loop."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.signal
from jaxtyping import Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.consistency.hold import clearly_better, shifts_force, with_friction
from jaxid.consistency.law import law_at_ticks
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.names import HOLDS
from jaxid.simulation.force_balance import ForceData, measured_force

# Factor on the gap of the logged force up to which the law's command explains the motion.
_EXPLAINS = 1.5
# The law is right if its command leaves at most this part of the gap of the logged one, and of the force.
_HALF, _LEFT = 0.5, 0.05
# Reason of a hold that the forces do not decide; that of the comparison follows.
UNDECIDED = "the default; the forces do not decide it"
# Forces under two holds that differ by less than this part of the measured one have the same effect.
_SAME = 1e-3


@dataclass(frozen=True)
class ReferenceHold:
    """A comparison of the courses that a reference may have between samples.

    Args:
        gaps: RMS force gap under each of `jaxid.names.HOLDS` [N or N m], of the drive in which they differ
            most.
        best: The hold that is clearly better than all others; None if there is none.
        reason: Clause that says why there is none; empty if there is one.
        matters: Whether the holds cause noticeably different forces.
        confirmed: Holds under which the motion confirms the declared law.
    """

    gaps: dict[str, float]
    best: str | None
    reason: str = ""
    matters: bool = True
    confirmed: tuple[str, ...] = ()


def compare_reference_holds(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit
) -> ReferenceHold | None:
    """Compare the force gaps under the courses that the reference may have between samples.

    The declared law gives the command at every tick, from positions between the samples and from the
    reference under one of the holds. The balance of forces then has this command in place of the logged one,
    which is that of every tenth tick, for example. A reference that is held makes the command jump at each
    sample and decay until the next. All unknowns, forces of position, and a viscous and a Coulomb friction of
    every joint are fitted under each hold.

    Args:
        machine: The machine with its controller.
        log: The log.
        data: The prepared log.
        fit: Balance of the prepared log.

    Returns:
        The comparison; None if there is nothing to choose: no controller or one with unknowns, no reference
        in the log, or a row of the log for every tick.
    """
    controller = machine.controller
    if controller is None or log.reference is None or round(log.period / controller.period) <= 1:
        return None
    if machine.unknown_controller:
        return None
    if shifts_force(machine):
        return ReferenceHold({}, None, "an effect of the drive changes the force in time")
    laws = {hold: law_at_ticks(replace(machine, reference_hold=hold), log) for hold in HOLDS}
    commands = {hold: law for hold, law in laws.items() if law is not None}
    if len(commands) < len(laws):
        return ReferenceHold({}, None, "the declared law cannot be computed from the log alone")

    wider = with_friction(fit)
    acting, residuals = {}, {}
    for hold, made in commands.items():
        force = _between_samples(made.command, made.every)[: log.samples] * np.asarray(machine.gain)
        acting[hold] = np.asarray(
            measured_force(machine.plant, ForceData.of(replace(data, force=force, hold=0.0)))
        )
        residuals[hold] = wider.under_force(acting[hold]).fit(bounded=False)[1]
    return _compared(machine, wider, acting, residuals)


def _between_samples(command: Float[np.ndarray, "ticks m"], every: int) -> Float[np.ndarray, "time m"]:
    """Return the low frequencies of a held command at the samples of its log, (time, m)."""
    # A held command has on the mean, at a tick, half of the value before and half of that after it.
    before = np.concatenate([command[:1], command[:-1]])
    return scipy.signal.resample_poly(0.5 * (before + command), 1, every, axis=0, padtype="line")


def _compared(
    machine: Machine, fit: BalanceFit, acting: dict[str, np.ndarray], residuals: dict[str, np.ndarray]
) -> ReferenceHold:
    """Return the comparison from forces and residuals under each hold, (kept, n)."""
    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    rms = {hold: fit.rms(e) for hold, e in residuals.items()}
    spread = np.ptp([x[driven] / fit.scale[driven] for x in rms.values()], axis=0)
    joint = driven[int(np.argmax(spread))]
    gaps = {hold: float(x[joint]) for hold, x in rms.items()}

    def total(hold: str) -> float:
        return float(np.sum((rms[hold] / fit.scale) ** 2))

    ranked = sorted(residuals, key=total)
    changes = [fit.rms(acting[a] - acting[b]) for a, b in ((ranked[0], ranked[1]), (ranked[0], ranked[2]))]
    with_logged, force = fit.rms(fit.fit(bounded=False)[1]), fit.rms(fit.force)
    matters = bool(np.max(np.array(changes) / np.maximum(force, 1e-300)) > _SAME)
    small = np.minimum(_HALF * with_logged, _LEFT * force)[driven]
    confirmed = tuple(hold for hold in ranked if np.all(rms[hold][driven] <= small))
    if not rms[ranked[0]][joint] <= _EXPLAINS * with_logged[joint]:
        return ReferenceHold(gaps, None, "the declared law does not explain the motion", matters)
    unclear = [h for h in ranked[1:] if not clearly_better(residuals[ranked[0]], residuals[h], fit)]
    if unclear:
        names = " and ".join(f"'{h}'" for h in [ranked[0], *unclear])
        return ReferenceHold(gaps, None, f"{names} explain the motion about equally well", matters, confirmed)
    return ReferenceHold(gaps, ranked[0], confirmed=confirmed)


def reference_hold_finding(
    log: Log, compared: ReferenceHold, hold: str, unit: str, *, stated: bool
) -> list[Finding]:
    """Return the note that another hold than the present one is used, fits better, or is not identifiable.

    Args:
        log: The log.
        compared: The comparison.
        hold: The stated hold, or the default.
        unit: Unit of the gaps.
        stated: Whether the case states it.
    """
    where, best = f"{log.source}, reference", compared.best
    if best is None:
        if stated or not compared.matters:
            return []
        what = (
            f"reference_hold is not stated, and cannot be decided: {compared.reason}; '{hold}' is used, but "
            "output_error of one log fits each and takes the one that explains it"
        )
        hint = "state reference_hold in [log]: 'zero_order' if a target is kept until the next row"
        return [Finding("warning", what, where, hint)]
    if best == hold:
        return []
    sizes = (
        f"with it the declared law leaves a force gap of {compared.gaps[best]:.3g} {unit}, with '{hold}' "
        f"{compared.gaps[hold]:.3g} {unit}"
    )
    if stated:
        what = f"reference_hold = '{hold}' is stated, but '{best}' fits better: {sizes}"
        hint = f"set reference_hold = '{best}' in [log], or check the law in [controller]"
    else:
        what = f"reference_hold is not stated, and '{best}' is used: {sizes}"
        hint = f"state reference_hold = '{best}' in [log] to confirm it, or another"
    return [Finding("warning", what, where, hint)]


def reference_hold_setting(compared: ReferenceHold, hold: str, unit: str, *, stated: bool) -> dict[str, str]:
    """Return the entry of `settings` in result.json: the hold in use, and the reason.

    Args:
        compared: The comparison.
        hold: The hold in use.
        unit: Unit of the gaps.
        stated: Whether the case states it.
    """
    if stated:
        return {"value": hold, "reason": "the case states it"}
    if compared.best is None:
        return {"value": hold, "reason": f"{UNDECIDED}: {compared.reason}"}
    others = ", ".join(f"'{h}' {gap:.3g} {unit}" for h, gap in compared.gaps.items() if h != hold)
    reason = f"the declared law then leaves a force gap of {compared.gaps[hold]:.3g} {unit}"
    return {"value": hold, "reason": f"{reason}; with {others}"}
