"""Delay between a logged force and the motion, by the balance of forces."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.consistency.hold import clearly_better, with_friction
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

# Delays that are tried first, in samples of the log.
_TRIED = np.arange(-8.0, 8.01, 0.5)
# Fewest kept samples.
_FEWEST = 100
# Kept samples that are added at each end, which the transform joins to a circle, and those beside a sample at
# rest, or at an end, that do not count.
_PAD, _BESIDE = 256, 3
# Beginning of the finding.
SEEMS = "the force seems to be logged"


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
    table = log.table
    stated = table is not None and any("force" in (times or {}) for times in (table.delay, table.lag))
    shifts = any(e.delays_command() or not e.adds_force for e in machine.plant.effects)
    if stated or shifts or not fit.finite or not all(log.measured) or len(fit.force) < _FEWEST:
        return []
    shifted = _Shifted.of(fit, data)
    if not shifted.fit.counts.any():
        return []
    delay = shifted.best()
    as_logged, moved = shifted.residual(0.0), shifted.residual(delay)
    if not clearly_better(moved, as_logged, shifted.fit):
        return []

    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    gaps = np.array([shifted.fit.rms(e) for e in (as_logged, moved)])[:, driven]
    worst = int(np.argmax(gaps[0] / shifted.fit.scale[driven]))
    side, samples, unit = "late" if delay > 0 else "early", abs(delay) / data.period, machine.unit("force")
    what = (
        f"{SEEMS} {1e3 * abs(delay):.3g} ms {side} ({samples:.2g} samples): taken back, it leaves a gap of "
    )
    what += f"{gaps[1, worst]:.3g} {unit} in place of {gaps[0, worst]:.3g} {unit} beside the best friction"
    hint = "declare the effect input_delay or actuator_lag if the drive acts so late"
    if delay > 0:
        hint = f"state delay = {{ force = {delay:.3g} }} in [log] if it was recorded so"
    return [Finding("warning", what, f"{log.source}, force", hint)]


class _Shifted:
    """A balance whose model is compared with a force that was read late.

    Args:
        fit: The balance with friction, and the samples that count.
        model: Transform of the model's force and of its columns, (f, n, 1 + p).
        turn: Angular frequency of the transform, times the imaginary unit [1/s], (f,).
        period: Sampling time of the log [s].
    """

    def __init__(self, fit: BalanceFit, model: np.ndarray, turn: np.ndarray, period: float) -> None:
        self.fit, self.model, self.turn, self.period = fit, model, turn, period

    @classmethod
    def of(cls, fit: BalanceFit, data: Prepared) -> _Shifted:
        """Transform the model of a balance."""
        plain = with_friction(replace(fit, potential=fit.potential[..., :0]))
        columns = np.concatenate([plain.columns, plain.potential], axis=2)
        model = np.concatenate([(plain.known + plain.force)[..., None], columns], axis=2)
        padded = np.pad(model, [(_PAD, _PAD), (0, 0), (0, 0)], mode="edge")
        frequency = np.fft.rfftfreq(len(padded), data.period * data.recipe.decimation)

        counts = plain.counts.copy()
        for k in range(1, _BESIDE + 1):
            counts[k:] &= plain.counts[:-k]
            counts[:-k] &= plain.counts[k:]
        counts[:_BESIDE], counts[-_BESIDE:] = False, False
        turn = 2j * np.pi * frequency
        return cls(replace(plain, counts=counts), np.fft.rfft(padded, axis=0), turn, data.period)

    def residual(self, delay: float) -> Float[np.ndarray, "kept n"]:
        """Return the force residual of the best fit, if the force was read with a delay [s]."""
        rows = len(self.fit.force) + 2 * _PAD
        passes = np.exp(-self.turn * delay)[:, None, None]
        late = np.fft.irfft(self.model * passes, rows, axis=0)[_PAD:-_PAD]
        known, columns, counts = late[..., 0] - self.fit.force, late[..., 1:], self.fit.counts
        scaled = (columns / self.fit.scale[:, None])[counts]
        size = np.linalg.norm(scaled, axis=0)
        size = np.where(size > 0, size, 1.0)
        values = np.linalg.lstsq(scaled / size, -(known / self.fit.scale)[counts], rcond=1e-10)[0] / size
        return known + columns @ values

    def best(self) -> float:
        """Return the delay that leaves least [s]."""

        def cost(delay: float) -> float:
            return float(np.linalg.norm(self.fit.rms(self.residual(delay)) / self.fit.scale))

        tried = _TRIED * self.period
        k = int(np.argmin([cost(delay) for delay in tried]))
        bounds = (tried[max(k - 1, 0)], tried[min(k + 1, tried.size - 1)])
        found: Any = scipy.optimize.minimize_scalar(cost, bounds=bounds, method="bounded")
        return float(found.x)
