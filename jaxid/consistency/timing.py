"""Delay between a logged force and the motion, by the balance of forces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.consistency.hold import clearly_better, shifts_force, with_friction
from jaxid.consistency.late_force import plain
from jaxid.consistency.late_model import LateModel, least_near
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.settings import LogTable

# Delays that are tried first, in samples of the log.
_TRIED = np.arange(-8.0, 8.01, 0.5)
# Fewest kept samples, and most of all joints: more tell a delay no better than is needed here.
_FEWEST, _MOST = 100, 8000
# Kept samples beside one at rest, or beside an end, that do not count.
_BESIDE = 3
# Beginning of the finding.
SEEMS = "the force seems to be logged"


def states_delay(table: LogTable | None) -> bool:
    """Check whether a table [log] says by how much the force was logged late."""
    return table is not None and any("force" in (times or {}) for times in (table.delay, table.lag))


def timing_findings(machine: Machine, log: Log, data: Prepared, fit: BalanceFit) -> list[Finding]:
    """Return a warning if the force fits the motion clearly better some samples earlier or later.

    A viscous and a Coulomb friction of every joint are fitted beside the declared model: where one is
    missing, a delay would stand in for it.

    Args:
        machine: The machine.
        log: The log.
        data: The prepared log.
        fit: Its balance.
    """
    if shifts_force(machine) or states_delay(log.table) or not fit.finite or not all(log.measured):
        return []
    if len(fit.force) < _FEWEST:
        return []
    part = _busiest_part(fit)
    late = LateModel.of(replace(part, counts=_beside_stops(part.counts)), data)
    if not late.fit.counts.any():
        return []

    def residual(delay: float) -> Float[np.ndarray, "kept n"]:
        return late.at(delay).fit(bounded=False)[1]

    def cost(delay: float) -> float:
        return float(np.linalg.norm(late.fit.rms(residual(delay)) / late.fit.scale))

    delay, _ = least_near(cost, _TRIED * data.period, 0.01 * data.period)
    as_logged, moved = residual(0.0), residual(delay)
    if not clearly_better(moved, as_logged, late.fit):
        return []

    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    gaps = np.array([late.fit.rms(e) for e in (as_logged, moved)])[:, driven]
    worst = int(np.argmax(gaps[0] / late.fit.scale[driven]))
    side, samples, unit = "late" if delay > 0 else "early", abs(delay) / data.period, machine.unit("force")
    sizes = f"{gaps[1, worst]:.3g} {unit} in place of {gaps[0, worst]:.3g} {unit}"
    what = f"{SEEMS} {1e3 * abs(delay):.3g} ms {side} ({samples:.2g} samples): taken back, it leaves a force "
    what += f"gap of {sizes}, beside the best friction of every joint"
    hint = "declare the effect input_delay or actuator_lag if the drive acts so late"
    if delay > 0:
        hint = f"state delay = {{ force = {delay:.3g} }} in [log] if it was recorded so"
    return [Finding("warning", what, f"{log.source}, force", hint)]


def _busiest_part(fit: BalanceFit) -> BalanceFit:
    """Return a balance with friction of every joint, along the part of a long log with most samples."""
    rows = min(len(fit.force), max(_MOST // fit.force.shape[1], _FEWEST))
    counted = np.convolve(fit.counts.sum(axis=1), np.ones(rows), "valid")
    first = int(np.argmax(counted))
    along = slice(first, first + rows)
    names = ("columns", "known", "potential", "force", "velocity", "counts")
    return with_friction(plain(replace(fit, **{name: getattr(fit, name)[along] for name in names})))


def _beside_stops(counts: Bool[np.ndarray, "kept n"]) -> Bool[np.ndarray, "kept n"]:
    """Return the mask of the samples that count without those beside one that does not, or an end."""
    left = counts.copy()
    for k in range(1, _BESIDE + 1):
        left[k:] &= counts[:-k]
        left[:-k] &= counts[k:]
    left[:_BESIDE], left[-_BESIDE:] = False, False
    return left
