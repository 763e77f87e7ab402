"""A force that was logged late or through a low-pass, held against effects found in its place.

A force that is read after the plant has felt it, and a spring or a lag of the drive, all turn the phase of
the force against that of the motion. A log of many frequencies tells them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.optimize
from jaxtyping import Bool, Float

from jaxid.consistency.balance_fit import BalanceFit, balance_fits
from jaxid.consistency.force_reading import ForceReading
from jaxid.consistency.late_model import LateModel, least_near
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

# Part of the gap with the effects that a late force leaves at most, to explain the log as well.
_AS_MUCH = 1.02
# Part of what the effects explain (in squares) that it explains at least: where they explain little, two
# equal gaps would say nothing.
_EXPLAINS = 0.95
# Part of the gap as logged that it leaves at most.
_CLEARLY = 0.9
# A delay alone is taken unless a low-pass leaves clearly less, and that alone unless both do.
_SIMPLER = 0.98
# Times that are tried first, in samples of the log.
_TRIED = 0.25 * 2.0 ** (np.arange(15) / 2.0)
# Time constants after which a low-pass has forgotten a stop: a four-hundredth of a dry friction is left.
_DECAYED = 6.0
# Largest number of kept samples: more tell a time constant no better than is needed here.
_MOST = 8000


@dataclass(frozen=True, kw_only=True)
class LateForce(ForceReading):
    """A late force that explains a log as well as effects do.

    Args:
        gap, rival, effects, unit: See `ForceReading`.
        delay: Time by which the force is logged after it acted [s].
        lag: Time constant of the first-order low-pass that it passed on the way, zero if none [s].
    """

    delay: float
    lag: float

    key = "late_force"
    short = "late force"

    @property
    def keys(self) -> str:
        """The keys of [log] that take the force back to when it acted."""
        given = {"delay": self.delay, "lag": self.lag}
        return " and ".join(f"{k} = {{ force = {v:.2g} }}" for k, v in given.items() if v > 0.0)

    @property
    def how(self) -> str:
        """The way in which the force seems to be logged."""
        late = f"{1e3 * self.delay:.2g} ms late"
        if self.lag == 0.0:
            return late
        passed = f"through a low-pass with a time constant of {1e3 * self.lag:.2g} ms"
        return passed if self.delay == 0.0 else f"{passed}, and {late}"

    def json(self) -> dict[str, object]:
        """Return the object `late_force` of discovery.json."""
        return {"delay": self.delay, "lag": self.lag, **super().json()}

    @property
    def findings(self) -> list[str]:
        """Sentences on it and on what to do."""
        return [
            f"The force seems to be logged {self.how}: that {self.beside_effects('as well as')}.",
            f"If the drive logs its force so, set {self.keys} in [log], which takes it back, and search "
            "again.",
        ]


def late_force(
    machine: Machine,
    whole: Machine,
    data: Prepared,
    effects: Sequence[str],
    held: Prepared | None = None,
) -> LateForce | None:
    """Return the late force that explains a log as well as some effects; None if none does.

    The model's force is delayed and smoothed, not the logged one undone, which would amplify its noise.

    Args:
        machine: The machine without the effects.
        whole: The machine with them.
        data: The prepared log.
        effects: Their names in results.
        held: The same log under the default hold of its force, if another one was chosen: a late force seems
            to act earlier than a held one does. None: the log is under the default hold.
    """
    if not all(data.measured):
        return None
    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    part, part_held = _longest(data), _longest(data if held is None else held)
    now, found = (plain(balance_fits(m, part)[0]) for m in (machine, whole))
    late = _Reading.of(now if held is None else plain(balance_fits(machine, part_held)[0]), part_held)
    if not (now.finite and found.finite and late.fit.finite):
        return None
    late = late.beside_stops(sum(late.best()), found.counts)
    if not late.fit.counts.any():
        return None
    now, found = (replace(fit, counts=late.fit.counts) for fit in (now, found))

    delay, lag = late.best()
    fits = (late.residual(delay, lag), now.fit(bounded=True)[1], found.fit(bounded=True)[1])
    gap, before, rival = (found.rms(e)[driven] for e in fits)
    explains = before**2 - gap**2 >= _EXPLAINS * (before**2 - rival**2)
    if not np.all(explains & (gap <= _AS_MUCH * rival) & (gap <= _CLEARLY * before)):
        return None
    return LateForce(
        gap=gap, rival=rival, effects=tuple(effects), unit=machine.unit("force"), delay=delay, lag=lag
    )


def _longest(data: Prepared) -> Prepared:
    """Return the piece of a log with the most samples that count."""
    return max(data.parts(_MOST, 1), key=lambda piece: int(piece.fitted.sum()))


def plain(fit: BalanceFit) -> BalanceFit:
    """Return a balance of the declared forces alone."""
    return replace(fit, potential=fit.potential[..., :0])


@dataclass(frozen=True)
class _Reading:
    """A balance whose model is compared with a force that was read late.

    Args:
        late: The balance, and its model at any delay.
    """

    late: LateModel

    @property
    def fit(self) -> BalanceFit:
        """The balance."""
        return self.late.fit

    @classmethod
    def of(cls, fit: BalanceFit, data: Prepared) -> _Reading:
        """Transform the model of a balance."""
        return cls(LateModel.of(fit, data))

    def beside_stops(self, time: float, counts: Bool[np.ndarray, "kept n"]) -> _Reading:
        """Return the reading at some samples only, without those to which a stop is carried by a low-pass."""
        counts = self.fit.counts & counts
        left = counts.copy()
        reach = min(int(np.ceil(_DECAYED * time / self.late.kept)), len(left) - 1)
        for k in range(1, reach + 1):
            left[k:] &= counts[:-k]
        # Before the first sample nothing is known.
        left[:reach] = False
        return _Reading(replace(self.late, fit=replace(self.fit, counts=left)))

    def residual(self, delay: float, lag: float) -> Float[np.ndarray, "kept n"]:
        """Return the force residual of the best fit, if the force was read late."""
        return self.late.at(delay, lag).fit(bounded=True)[1]

    def best(self) -> tuple[float, float]:
        """Return the delay and the time constant that leave least; one is zero if the other does as well."""
        delay, by_delay = self._search(lambda t: (t, 0.0))
        lag, by_lag = self._search(lambda t: (0.0, t))
        close = 0.01 * self.late.period
        start, size = np.array([0.5 * delay, lag]), 0.25 * max(delay, lag, self.late.period)
        corners = np.abs(start + size * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, -1.0]]))
        both = scipy.optimize.minimize(
            lambda x: self._cost(*np.abs(x)),
            start,
            method="Nelder-Mead",
            options={
                "initial_simplex": corners,
                "xatol": close,
                "fatol": 0.0,
                "maxfev": 60,
            },
        )
        simple = (delay, 0.0) if by_delay <= by_lag / _SIMPLER else (0.0, lag)
        if both.fun < _SIMPLER * min(by_delay, by_lag):
            delay, lag = np.abs(both.x).tolist()
            return delay, lag
        return simple

    def _search(self, times: Callable[[float], tuple[float, float]]) -> tuple[float, float]:
        """Return the best time along one axis, and its cost."""
        tried = np.concatenate([[0.0], _TRIED * self.late.period])
        return least_near(lambda t: self._cost(*times(t)), tried, 0.01 * self.late.period)

    def _cost(self, delay: float, lag: float) -> float:
        """Return the gap of all joints, each in parts of its force."""
        return float(np.linalg.norm(self.fit.rms(self.residual(delay, lag)) / self.fit.scale))
