"""Noise of the force that a likelihood needs, beside what the log shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.estimate import Estimate
from jaxid.machine import Machine
from jaxid.results.report.numbers import plain
from jaxid.session import OpenedLog, Session
from jaxid.simulation.sensor_noise import force_noise, high_band_force_noise

# Factor between the noise that a fit needs and that of the log beyond which the model lacks something.
_MORE = 3.0
# Part of the force below which a fit's noise may be the error of its integration.
_LEAST = 3e-3


def needed_noise(session: Session, estimate: Estimate) -> str:
    """Return a clause on a fit that needs more noise of the force than the log has; empty if none does.

    `prediction_error` fits the noise of the force with the unknowns. What the model lacks can pass for such
    noise, even where the residual in the filter's band is too short to show a colour.
    """
    if estimate.method != "prediction_error":
        return ""
    by_log: dict[str, dict[str, Any]] = estimate.details.get("fits", {session.fit.name: estimate.details})
    for run in session.fits:
        noise = by_log.get(run.name, {}).get("noise", {}).get("force")
        if noise is not None and not run.log.passive:
            on = f" on the log {run.name}" if session.more else ""
            if clause := _beyond(run.machine(session.machine), run, np.asarray(noise), on):
                return clause
    return ""


def _beyond(machine: Machine, run: OpenedLog, needed: np.ndarray, on: str) -> str:
    """Return the clause for the noise that a fit needs on one log, (m,); empty if the log allows it."""
    allowed = _allowed(machine, run)
    over = needed > np.maximum(_MORE * allowed, _LEAST * np.std(run.log.force, axis=0))
    if not over.any():
        return ""

    worst = int(np.argmax(np.where(over, needed / np.maximum(allowed, 1e-300), 0.0)))
    stated = machine.sensor.force_noise is not None
    shown = "the case states" if stated else "the log shows at most"
    which = f" {worst + 1}" if needed.size > 1 else ""
    return (
        f"the fit needs noise of force{which} with a standard deviation of {plain(needed[worst])}{on}, and "
        f"{shown} {plain(allowed[worst])} in the units of its column"
    )


def _allowed(machine: Machine, run: OpenedLog) -> Float[np.ndarray, " m"]:
    """Return the noise of each force that is stated, or the most that the log shows, (m,).

    The estimate of the noise subtracts that of the positions, and may fall to zero beside it.
    """
    known = force_noise(machine, run.data)
    if machine.sensor.force_noise is not None:
        return known
    return np.maximum(known, high_band_force_noise(run.log, run.data))
