"""Choice of the reference's course and of the loop's velocity for a log that is slower than its loop.

Forces between the rows of such a log are not known well enough for either. Each loop is fitted in simulation;
the position and the command that it leaves show which one made the log.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.consistency.hold import clearly_smaller
from jaxid.consistency.law import mass_of_late_velocity
from jaxid.consistency.reference_hold import UNDECIDED
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.output_error import output_error_steps
from jaxid.gap import simulation_of_log
from jaxid.machine import Machine
from jaxid.names import HOLDS
from jaxid.numerics.lanes import Steps

if TYPE_CHECKING:
    from jaxid.session import Session

# Settings that are chosen, and the values that the velocity has.
_HOLD, _VELOCITY = "reference_hold", "loop_velocity"
_DIFFERENCED, _MEASURED = "differenced", "measured"


@dataclass(frozen=True)
class _Loop:
    """A fitted loop, and what it leaves of a log.

    Args:
        estimate: The fit.
        left: Measured minus simulated position, and logged minus simulated command, (time, k).
    """

    estimate: Estimate
    left: Float[np.ndarray, "time k"]


def with_loop_of_log(session: Session, estimate: Estimate, **options: Any) -> Steps[Estimate]:
    """Fit the loops that the case leaves open, and return the fit that explains position and command.

    Args:
        session: Case and log of the fit.
        estimate: Fit of the loop as it was taken.
        options: Further arguments of `output_error_steps`.

    Returns:
        The fit that is clearly the best. If some are about equally good, the best of them, its standard
        deviations widened so that their 95 % intervals hold the values of the others. Unchanged if nothing
        is open, or no loop follows the log.
    """
    machines, log = _open_loops(session), session.fit.log
    if len(machines) == 1:
        return estimate
    start = estimate.theta if np.all(np.isfinite(estimate.theta)) else None
    loops = {}
    for k, (settings, machine) in enumerate(machines.items()):
        fit = estimate if k == 0 else (yield from output_error_steps(machine, log, start=start, **options))
        gap = simulation_of_log(fit.machine, log) if fit.converged else None
        if gap is not None and gap.command is not None:
            left = np.concatenate([log.position - gap.position, log.force - gap.command], axis=1)
            loops[settings] = _Loop(fit, left)
    if not loops:
        return estimate

    scale = np.min([np.sqrt(np.mean(loop.left**2, axis=0)) for loop in loops.values()], axis=0)
    scaled = {settings: loop.left / np.maximum(scale, 1e-300) for settings, loop in loops.items()}
    best = min(scaled, key=lambda settings: float(np.sum(scaled[settings] ** 2)))
    counts = np.ones(scaled[best].shape, bool)
    equal = [s for s in scaled if s != best and not clearly_smaller(scaled[best], scaled[s], counts)]
    chosen = loops[best].estimate.holding(*(loops[s].estimate.theta for s in equal))
    reason = _reason(loops, best, equal, log.force.shape[1])
    return _said(chosen, estimate, dict(best), reason)


def _open_loops(session: Session) -> dict[tuple[tuple[str, str], ...], Machine]:
    """Return the machines that a case leaves open by their settings, that of the session first."""
    machine, log = session.machine, session.fit.log
    if machine.controller is None or not all(log.measured) or log.reference is None:
        return {(): machine}
    loops: dict[tuple[tuple[str, str], ...], Machine] = {(): machine}
    undecided = session.settings.get(_HOLD, {}).get("reason", "").startswith(UNDECIDED)
    if undecided and np.ptp(log.reference, axis=0).any():
        holds = sorted(HOLDS, key=lambda hold: hold != machine.reference_hold)
        loops = {((_HOLD, hold),): replace(machine, reference_hold=hold) for hold in holds}
    stated = "velocity_average" in session.case.tables.get("controller", {})
    if stated or mass_of_late_velocity(machine, log) is None:
        return loops
    measuring = replace(machine.controller, own_velocity=True)
    out = {}
    for settings, made in loops.items():
        out[*settings, (_VELOCITY, _DIFFERENCED)] = made
        out[*settings, (_VELOCITY, _MEASURED)] = replace(made, controller=measuring)
    return out


def _reason(
    loops: Mapping[tuple[tuple[str, str], ...], _Loop],
    best: tuple[tuple[str, str], ...],
    equal: list[tuple[tuple[str, str], ...]],
    drives: int,
) -> str:
    """Return in words why the best loop was taken.

    Args:
        loops: All loops that follow the log.
        best: Settings of the best one.
        equal: Settings of those that are about as good.
        drives: Number of drives.
    """
    words = lambda settings: " and ".join(value for _, value in settings)
    if equal:
        named = ", ".join(words(s) for s in (best, *equal))
        return f"{named} explain the log about equally well, and the 95 % intervals hold the values of all"
    sizes = []
    for settings, loop in loops.items():
        parts = (loop.left[:, :-drives], loop.left[:, -drives:])
        position, command = (float(np.sqrt(np.mean(part**2))) for part in parts)
        sizes.append(f"{words(settings)} {position:.3g} and {command:.3g}")
    return f"RMS of position and command that each fitted loop leaves of the log: {'; '.join(sizes)}"


def _said(estimate: Estimate, before: Estimate, chosen: Mapping[str, str], reason: str) -> Estimate:
    """Return an estimate with the choices among its settings, and among the notes of the fit before."""
    settings = {name: {"value": value, "reason": reason} for name, value in chosen.items()}
    taken = " and ".join(f"{name} = '{value}'" for name, value in chosen.items())
    return replace(
        estimate,
        notes=(*before.notes, f"{taken} taken, which the case does not state: {reason}"),
        details={
            **estimate.details,
            "settings": {**estimate.details.get("settings", {}), **settings},
        },
    )
