"""Noise of the force that a likelihood needs, beside what the log shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxid.estimators.estimate import Estimate
from jaxid.results.report.numbers import plain
from jaxid.session import OpenedLog, Session
from jaxid.simulation.sensor_noise import force_noise

# Factor between the noise that a fit needs and that of the log beyond which the model lacks something.
_MORE = 3.0
# Part of the force below which a fit's noise may be the error of its integration.
_LEAST = 3e-3


def needed_noise(session: Session, estimate: Estimate) -> str:
    """Return a clause on a fit that needs more noise of the force than the log has; empty if none does.

    `prediction_error` fits the noise of the force with the unknowns. What the model lacks can pass for such
    noise, even where the residual in the filter's band is too short to show a colour.
    """
    by_log: dict[str, dict[str, Any]] = estimate.details.get("fits", {session.fit.name: estimate.details})
    for run in session.fits:
        noise = by_log.get(run.name, {}).get("noise", {}).get("force")
        if noise is not None and (clause := _beyond(session, run, np.asarray(noise))):
            return clause
    return ""


def _beyond(session: Session, run: OpenedLog, needed: np.ndarray) -> str:
    """Return the clause for the noise that a fit needs on one log, (m,); empty if the log allows it."""
    machine, log = run.machine(session.machine), run.log
    if log.passive:
        return ""
    allowed = force_noise(machine, run.data)
    over = needed > np.maximum(_MORE * allowed, _LEAST * np.std(log.force, axis=0))
    if not over.any():
        return ""

    worst = int(np.argmax(np.where(over, needed / np.maximum(allowed, 1e-300), 0.0)))
    stated = machine.sensor.force_noise is not None
    shown = "the case states" if stated else "the log shows at most"
    which = f" {worst + 1}" if needed.size > 1 else ""
    on = f" on the log {run.name}" if session.more else ""
    return (
        f"the fit needs noise of force{which} with a standard deviation of {plain(needed[worst])}{on}, and "
        f"{shown} {plain(allowed[worst])} in the units of its column"
    )
