"""Check that a log makes physical sense, before a fit.

`read_log` refuses logs that cannot be read. The checks here find faults in readable numbers: a machine at
rest, a command at its limit, a wrong unit.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.clock import clock_findings
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.units_check import (
    ByJoint,
    magnitude_findings,
    period_findings,
    plausible_inertia,
    ratio_findings,
)
from jaxid.logs.wrap import wrap_findings

__all__ = ["Finding", "check_log", "plausible_inertia", "raise_on_error"]

# Chosen: with fewer levels than this over the whole stroke, an acceleration consists of steps.
_COARSE_LEVELS = 500
# A position with fewer values does not count as motion.
FEWEST_LEVELS = 5
# Parts of all rows; a command that is at its limit more often than not does not determine the force.
_SATURATED = 0.5
_OFTEN_SATURATED = 0.05
# Number of stretches of a log under a constant force, and the part of its speed that changes in a transient.
_PIECES, _CHANGES = 10, 0.2


def check_log(
    log: Log,
    *,
    command_limit: ByJoint | None = None,
    motion: str | Sequence[str] = "linear",
    units: dict[str, str] | None = None,
    path: str | Path | None = None,
    driven: Sequence[int] | np.ndarray | None = None,
    fewest_levels: int = FEWEST_LEVELS,
    resolution_stated: bool = False,
    free: bool = False,
) -> list[Finding]:
    """Find the faults of a readable log.

    Args:
        log: The log to check.
        command_limit: Known saturation of the logged command, in units of the command; a list by channel.
        motion: "linear" (m) or "rotary" (rad), one for all joints or a list by joint.
        units: Labels of the case if the quantities are not mechanical; with another unit of position, checks
            that need metres or radians are omitted.
        path: Name of the log in messages; None: its source.
        driven: Indices of the joints with a drive, in the order of the drives; None: the first ones.
        fewest_levels: Least number of distinct positions that count as motion.
        resolution_stated: Whether the case states the resolution of the position.
        free: Whether a log without any force is accepted, because the machine is known to tell that it is.

    Returns:
        The faults; empty for a sound log.
    """
    where = str(path or log.source)
    findings = [
        *([] if log.integrated else wrap_findings(log.position, where)),
        *_movement(log, where, fewest_levels, resolution_stated),
        *_force(log, command_limit, where, free),
    ]
    still = any(finding.severity == "error" for finding in findings)
    if not still:
        ratios = ratio_findings(log, motion, where, driven)
        # Two columns that disagree by the unit of time say more than the period.
        timed = any(finding.severity == "error" for finding in ratios)
        findings += ratios if timed else [*ratios, *period_findings(log, where), *clock_findings(log, where)]
        label = (units or {}).get("position", "m")
        if label in ("m", "rad"):
            findings += magnitude_findings(log, motion, where)
    return findings


def raise_on_error(findings: Iterable[Finding]) -> None:
    """Refuse a log with an error among its findings.

    Args:
        findings: Findings of `check_log`.

    Raises:
        InputError: For the first error; its hint gives the further ones.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        first, *others = errors
        hint = first.hint
        if others:
            listed = "; ".join(f"{f.where.rpartition(', ')[2]}: {f.what}; {f.hint}" for f in others)
            hint += f" (and {len(others)} more error{'s' * (len(others) > 1)}: {listed})"
        raise InputError(first.what, where=first.where, hint=hint)


def _movement(log: Log, path: str, fewest: int, stated: bool) -> list[Finding]:
    """Find joints that do not move, and positions with coarse steps."""
    what = "velocity" if log.integrated else "position"
    measured = [(j, q) for j, q in enumerate(log.readings.T, start=1) if log.measured[j - 1]]
    reasons = [_stillness(q, fewest, what) for _, q in measured]
    if all(reasons):
        hint = f"check that {what} names the right column and that the machine moved"
        return [Finding("error", f"nothing moves: {reasons[0]}", f"{path}, {what}", hint)]
    findings = []
    for (joint, q), reason in zip(measured, reasons, strict=True):
        where = f"{path}, {what} of joint {joint}"
        levels, step = position_levels(q)
        if reason:
            hint = "its parameters are not identifiable from this log; check the column"
            findings.append(Finding("warning", f"the joint does not move: {reason}", where, hint))
        elif step and levels < _COARSE_LEVELS:
            coarse = f"the {what} is quantised in steps of {step:.3g}: {levels} levels in all"
            hint = "log a longer stroke or more digits"
            hint += "" if stated or log.integrated else ", and give sensor.position_resolution"
            findings.append(Finding("warning", coarse, where, hint))
    return findings


def _stillness(q: np.ndarray, fewest: int, what: str = "position") -> str:
    """Explain why a position, or a velocity, shows no motion; empty if it does."""
    if np.ptp(q) == 0:
        return f"the {what} is {q[0]:.6g} throughout"
    levels, step = position_levels(q)
    if levels < fewest:
        return f"the {what} takes only {levels} values, {step:.3g} apart"
    centred = q - q.mean()
    lags = range(1, min(20, q.size // 4) + 1)
    similar = [abs(centred[lag:] @ centred[:-lag]) / (centred @ centred) for lag in lags]
    # A motion that the sampling resolves is correlated with itself a sample later; noise is not.
    if max(similar) < max(0.1, 4.0 / np.sqrt(q.size)):
        return f"the {what} is noise of {q.std():.3g} (standard deviation)"
    return ""


def position_levels(q: np.ndarray) -> tuple[int, float]:
    """Return the number of distinct positions and their spacing; spacing 0 if they are on no grid."""
    levels = np.unique(q)
    gaps = np.diff(levels)
    # Equal levels may differ in their last bits after a conversion of units.
    gaps = gaps[gaps > 1e-9 * np.ptp(q)] if gaps.size else gaps
    if not gaps.size:
        return 1, 0.0
    multiples = gaps / gaps.min()
    on_grid = np.mean(np.abs(multiples - np.round(multiples)) < 0.05) > 0.99
    return gaps.size + 1, float(gaps.min()) if on_grid else 0.0


def _force(log: Log, limit: ByJoint | None, path: str, free: bool) -> list[Finding]:
    """Find commands that are constant, or at their limit."""
    channels = log.force.T
    if log.passive:
        if free:
            return []
        hint = "check that force names the right column; a constant force identifies nothing"
        return [Finding("error", "the force is zero throughout", f"{path}, force", hint)]
    constant = np.ptp(log.force, axis=0) == 0
    if constant.all():
        if _transient(log):
            return []
        hint = "check that force names the right column; a constant force identifies nothing"
        hint += " of a motion without a transient"
        what = f"the force is constant ({channels[0][0]:.6g}) throughout"
        return [Finding("error", what, f"{path}, force", hint)]
    limits = [None] * len(channels) if limit is None else np.broadcast_to(limit, len(channels))
    findings = []
    for k, (u, bound) in enumerate(zip(channels, limits, strict=True), start=1):
        where = f"{path}, force {k}"
        if constant[k - 1]:
            hint = "check the column; this joint is driven by the others alone"
            findings.append(Finding("warning", f"constant at {u[0]:.6g}", where, hint))
        else:
            found = _saturation(u, bound, where)
            step = _step(u) if bound is None else None
            if found and step is not None:
                first = log.rows[0] + step
                what = f"the force is one step, from {u[0]:.6g} to {u[-1]:.6g}"
                hint = f"select the rows behind it: rows = [{first}, {log.rows[0] + u.size}] in [log]"
                found = [Finding(found[0].severity, what, where, hint)]
            findings += found
    return findings


def _transient(log: Log) -> bool:
    """Check that a machine under a constant force gets faster or slower without turning, as after a step."""
    position = log.filled
    part = max(len(position) // _PIECES, 2)
    speeds = np.stack([position[k + part - 1] - position[k] for k in range(0, len(position) - part, part)])
    fastest = np.max(np.abs(speeds), axis=0)
    one_way = np.abs(np.sum(np.sign(speeds) * (np.abs(speeds) > 0.05 * fastest), axis=0))
    turns = one_way < np.sum(np.abs(speeds) > 0.05 * fastest, axis=0)
    return bool(np.any((np.ptp(speeds, axis=0) > _CHANGES * fastest) & ~turns))


def _step(u: np.ndarray) -> int | None:
    """Return the row at which a force of two levels and one step changes; None of others."""
    steps = np.flatnonzero(np.diff(u))
    return int(steps[0]) + 1 if steps.size == 1 else None


def _saturation(u: np.ndarray, bound: float | None, where: str) -> list[Finding]:
    """Find a command that is often at its limit."""
    extreme = np.abs(u).max() if bound is None else bound
    at_limit = np.abs(u) >= (1.0 - 1e-6) * extreme
    share = float(at_limit.mean())
    if share <= (_OFTEN_SATURATED if bound is not None else _SATURATED):
        return []
    what = f"the command is saturated: |u| = {extreme:.6g} in {100 * share:.0f} % of the rows"
    hint = "log a gentler motion, or select other rows"
    # A random binary excitation has two levels of both signs and is a sound experiment.
    binary = bound is None and share > 0.98 and np.ptp(np.sign(u[at_limit])) == 2
    severity = "error" if share > _SATURATED and not binary else "warning"
    return [Finding(severity, what, where, hint)]
