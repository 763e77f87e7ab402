"""Tick of a loop that is faster than its log, by the time for which each force seems to be held."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.consistency.hold import independent, residual_held, shifts_in_time, with_friction
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

# Ticks in a row of the log that are tried.
_TICKS = tuple(range(2, 11))
# Gain in log-likelihood over a force that is held for a row, and over lines, from which a tick is taken.
_EVIDENCE = 8.0
# Part of a row below which a tick, and part of a tick below which its deviation, is not given as a number.
_SHORT = 0.01


class Tick(NamedTuple):
    """Time for which each force acts in the log of a faster loop.

    Args:
        period: The time [s].
        std: Standard deviation of the time, by the likelihood of those that were tried [s].
        evidence: Gain in log-likelihood over lines and over a force that is held for a row [nats]; None: the
            log shows that the loop is faster, and its noise leaves the time uncertain.
    """

    period: float
    std: float
    evidence: float | None

    def finding(self, log: Log) -> Finding:
        """Return the note on it."""
        acts = f"each force seems to act for {1e3 * self.period:.2g} ms"
        if self.period < _SHORT * log.period:
            acts = "each force seems to act for a small part of a row"
        what = f"the loop is faster than the log: {acts}, and the log lacks the forces between its rows"
        return Finding("warning", what, f"{log.source}, force", "log every tick of the loop if you can")

    def setting(self) -> dict[str, str]:
        """Return the entry of `settings` in result.json."""
        if self.evidence is None:
            reason = "the force answers to the noise of its own row's reading only, as that of a faster loop"
        else:
            reason = f"it raises the log-likelihood by {self.evidence:.3g} over held forces and over lines"
        if self.std > _SHORT * self.period:
            reason = f"{reason}; standard deviation {self.std:.2g} s"
        return {"value": f"{self.period:.3g} s", "reason": reason}


def faster_tick(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit, *, fast: bool = False
) -> Tick | None:
    """Return the time for which each force acts if it is less than a row of the log; None if it is not.

    A loop that counts as faster by its noise may be one of the log's rate: if a row is clearly the better
    time, that is the result.

    A force that is held for h acts h/2 later than lines between its values do. Of a loop of the log's rate h
    is a row; of a faster one the log has every second or third force only, each of which acts for a part of
    the row. The times are compared as in `better_hold`. What a model lacks leaves so much that no time is
    clearly better than another.

    Args:
        machine: The machine.
        log: The log.
        data: The prepared log.
        fit: Its balance.
        fast: Whether the loop is known to be faster. The time is then the mean over those that are possible,
            weighted by their likelihood.
    """
    if machine.controller is not None or log.hold == "band_limited" or shifts_in_time(machine, data):
        return None
    if not all(log.measured) or not fit.finite:
        return None
    wider = with_friction(fit)

    def residual(held: float) -> Float[np.ndarray, "kept n"]:
        return residual_held(machine, data, wider, held)

    def cost(held: float) -> float:
        return max(float(np.linalg.norm(fit.rms(residual(held)) / fit.scale)), 1e-300)

    # Plain numbers: a hold is static in compiled code.
    times = [log.period / rows for rows in _TICKS]
    costs = np.array([cost(held) for held in times])
    best = int(np.argmin(costs))
    count = independent(residual(times[best]) / fit.scale, fit.counts)
    lines, row = cost(0.0), cost(log.period)
    evidence = count * float(np.log(min(lines, row) / costs[best]))

    possible, all_costs = np.array([*times, 0.0]), np.append(costs, lines)
    weights = (all_costs / all_costs.min()) ** -count
    weights /= weights.sum()
    mean = float(possible @ weights)
    spread = lambda about: float(np.sqrt((possible - about) ** 2 @ weights))
    if fast and evidence < -_EVIDENCE and row < lines:
        # A loop of the log's rate with a filtered derivative answers to its row's noise nearly alone, too.
        return Tick(log.period, 0.0, evidence)
    if fast and evidence < _EVIDENCE:
        return Tick(mean, spread(mean), None)
    if evidence < _EVIDENCE:
        return None
    return Tick(times[best], spread(times[best]), evidence)
