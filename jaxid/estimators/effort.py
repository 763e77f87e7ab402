"""The scale of a loop's forces from a current or load of known gain, and how far such a column agrees.

A log without a force determines all forces but for one factor. A column that follows the force, with a gain
that is known, determines that factor. Without its gain the fitted force still explains a part of the column.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.consistency.effort import ENOUGH, Witness, is_unsigned, witness
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.several.parts import Part
from jaxid.gap import Gap, simulation_of_log
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.settings import LogTable

if TYPE_CHECKING:
    from jaxid.session import OpenedLog, Session

# Key of an estimate's details that says whence the scale of its forces is.
SCALE = "scale"


@dataclass(frozen=True)
class Scale:
    """The factor between the forces of a fit and those of the machine.

    Args:
        factor: Force of the machine over that of the fit.
        std: Standard deviation of the factor at the values of the fit.
        slopes: Derivative of the factor by the unknowns of the fit, (p,); zero for those not identifiable.
    """

    factor: float
    std: float
    slopes: Float[np.ndarray, " p"]


def scale_by_effort(session: Session, parts: Sequence[Part], estimate: Estimate) -> Scale | None:
    """Return the factor that efforts of known gain give, the weighted mean over logs and drives.

    Args:
        session: Case and logs of the fit.
        parts: The fitted logs.
        estimate: The fit, in which the scale is that of one value that was held.

    Returns:
        The factor; None if no effort of known gain follows the simulated force.
    """
    found: list[Scale] = []
    for part in parts:
        log, table = part.log, table_of(session, part.log)
        if log.effort is None or table.effort_gain is None or session.declared.actuator.transmission:
            continue
        force = simulated_force(part.at(estimate.theta), log)
        if force is None:
            continue
        nudged = _nudged(part, estimate)
        for drive in range(force.shape[1]):
            own = _of_drive(log, table, force, drive)
            gain = _gain(table, drive)
            if own is None or gain is None or not _follows(own) or not own.gain / gain > 0.0:
                continue
            factor, std = own.gain / gain, own.std[0] / abs(gain)
            slopes = np.zeros(estimate.theta.size)
            for k, (step, moved) in nudged.items():
                other = own.gain_of(log.effort[:, drive], moved[:, drive], log.period) / gain
                slopes[k] = (other - factor) / step
            found.append(Scale(factor, std, slopes))
    if not found:
        return None
    weights = np.array([1.0 / scale.std**2 for scale in found])
    share = weights / weights.sum()
    return Scale(
        float(share @ [scale.factor for scale in found]),
        float(1.0 / np.sqrt(weights.sum())),
        share @ np.array([scale.slopes for scale in found]),
    )


def table_of(session: Session, log: Log) -> LogTable:
    """Return the `[log]` table that a log was read by, or that of the case."""
    return log.table or session.case.log or LogTable()


def simulated_force(machine: Machine, log: Log) -> np.ndarray | None:
    """Return the force of each drive in the simulated loop, (time, m); None if the simulation diverges."""
    gap = simulation_of_log(machine, log)
    return None if gap is None or gap.command is None else gap.command * machine.gain


def with_effort(
    estimate: Estimate, session: Session, gaps: Sequence[Gap], *, searched: bool = False
) -> Estimate:
    """Return an estimate with what each effort says beside it, as notes and under `effort` of its details.

    Args:
        estimate: The estimate.
        session: Case and logs of the fit.
        gaps: Gaps of the estimate, those of the fitted logs first.
        searched: Whether the estimate is that of a search, which takes no scale from an effort.
    """
    said: list[dict[str, Any]] = []
    for run, gap in zip(session.fits, gaps, strict=False):
        said += _said_of(estimate, session, run, gap, searched)
    if not said:
        return estimate
    named = len(session.fits) > 1
    notes = [_words(entry, estimate.machine, named) for entry in said]
    return replace(estimate, notes=(*estimate.notes, *notes), details={**estimate.details, "effort": said})


def _said_of(
    estimate: Estimate, session: Session, run: OpenedLog, gap: Gap, searched: bool
) -> list[dict[str, Any]]:
    """Return an entry for each drive of a log with an effort."""
    log = run.log
    if log.effort is None:
        return []
    table, machine = table_of(session, log), run.machine(estimate.machine)
    out = []
    for drive in range(log.effort.shape[1]):
        force, missing = _force(session, machine, log, gap)
        own = None if force is None else _of_drive(log, table, force, drive)
        use, why = _use(estimate, own, _gain(table, drive), missing, searched)
        unit = f"1/({machine.unit('force', machine.plant.driven(machine.plant.joints)[drive])})"
        free = "relative" in estimate.details
        out.append(
            {"log": run.name, "drive": drive + 1, "use": use, "reason": why} | _numbers(own, unit, free)
        )
    return out


def _force(session: Session, machine: Machine, log: Log, gap: Gap) -> tuple[np.ndarray | None, str]:
    """Return the force of each drive, logged or simulated, or the reason why there is none."""
    if session.declared.actuator.transmission is not None:
        return None, "the log is of motors that move several joints"
    if not log.passive:
        return log.force * machine.gain, ""
    if machine.controller is None:
        return None, "there is neither a force nor a loop whose force could be simulated"
    if gap.simulation is None or gap.simulation.command is None:
        return None, "the simulation diverges"
    return gap.simulation.command * machine.gain, ""


def _of_drive(log: Log, table: LogTable, force: np.ndarray, drive: int) -> Witness | None:
    """Compare the effort of one drive with its force; None if one of them is constant."""
    assert log.effort is not None, "only logs with an effort are asked"
    effort = log.effort[:, drive]
    unsigned = is_unsigned(effort) if table.effort_unsigned is None else table.effort_unsigned
    return witness(effort, force[:, drive], log.period, unsigned)


def _gain(table: LogTable, drive: int) -> float | None:
    """Return the stated gain of one drive."""
    given = table.effort_gain
    return given[drive] if isinstance(given, tuple) else given


def _follows(own: Witness) -> bool:
    """Check that most of an effort is the force's, beyond chance, and that it has a gain with a precision."""
    return own.agrees and own.agreement >= ENOUGH and not own.bent and bool(own.std[0] > 0.0)


def _nudged(part: Part, estimate: Estimate) -> dict[int, tuple[float, np.ndarray]]:
    """Return the forces of a log with each identifiable unknown a standard deviation up, with that step."""
    out = {}
    for k in np.flatnonzero(estimate.identifiable):
        step = float(estimate.std[k])
        moved = estimate.theta + step * (np.arange(estimate.theta.size) == k)
        force = simulated_force(part.at(moved), part.log) if k in part.index and step > 0.0 else None
        if force is not None:
            out[int(k)] = (step, force)
    return out


def _use(
    estimate: Estimate, own: Witness | None, gain: float | None, missing: str, searched: bool
) -> tuple[str, str]:
    """Return what an effort is used for (scale, check or nothing), and why."""
    if own is None:
        return "nothing", missing or "it is constant, or the force is"
    if not own.agrees:
        return "nothing", "it agrees with the force no better than chance"
    if own.agreement < ENOUGH:
        return "nothing", "most of it is something else than the force, so that its gain may be off"
    if own.bent:
        return "nothing", "it grows faster than in proportion to the force, so that it has no one gain"
    if "relative" in estimate.details:
        if gain is None:
            why = "its gain is not known, so that it gives no scale: state [log] effort_gain if it is"
            return "nothing", why
        if searched:
            return "nothing", "a search leaves the scale open; identify takes it from effort_gain"
        return "nothing", "its sign is opposite to that of effort_gain, or its gain has no precision"
    if estimate.details.get(SCALE, {}).get("from") == "effort" and gain is not None:
        return "scale", "its gain is stated, and nothing else gives the scale"
    if gain is None:
        return "check", "the scale is known without it, and gives its gain"
    off = (own.gain - gain) / own.std[0]
    return "check", f"the scale is known without it; its gain is {off:+.1f} σ from effort_gain = {gain:.4g}"


def _numbers(own: Witness | None, unit: str, free: bool) -> dict[str, Any]:
    """Return the figures of a comparison as JSON has them; without a scale there is no gain."""
    if own is None:
        return {}
    std = [float(s) if np.isfinite(s) else None for s in own.std]
    gain = None if free else {"value": own.gain, "std": std[0], "unit": unit}
    return {
        "unsigned": own.shape.unsigned,
        "agreement": own.agreement,
        "chance": own.chance,
        "gain": gain,
        "offset": {"value": own.offset, "std": std[1]},
        "delay": {"value": own.shape.delay, "std": std[2], "unit": "s"},
        "lag": {"value": own.shape.lag, "std": std[3], "unit": "s"},
    }


def _words(entry: dict[str, Any], machine: Machine, named: bool) -> str:
    """Return an entry in one line."""
    of = f" of drive {entry['drive']}" if machine.gain.size > 1 else ""
    head = f"effort{of}" + (f" in {entry['log']}" if named else "")
    used = {"scale": "gives the scale", "check": "is a check only", "nothing": "is left out"}[entry["use"]]
    line = f"{head} {used}: {entry['reason']}"
    if "agreement" not in entry:
        return line
    what = "magnitude of the force" if entry["unsigned"] else "force"
    figures = [
        f"the {what} explains {100 * entry['agreement']:.0f} % of its variance "
        f"(chance: up to {100 * entry['chance']:.0f} %)"
    ]
    for name in ("gain", "delay", "lag") if entry["agreement"] > entry["chance"] else ():
        if entry[name] is not None:
            spread = "" if entry[name]["std"] is None else f" ± {entry[name]['std']:.2g}"
            figures.append(f"{name} {entry[name]['value']:.4g}{spread} {entry[name]['unit']}")
    return f"{line}; {', '.join(figures)}"
