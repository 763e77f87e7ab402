"""A force that changes slowly along a log, held against effects found in its place.

The zero of a sensor drifts as it gets warm. Over few motions a slow course of time looks like springs and
frictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.consistency.balance_fit import BalanceFit, balance_fits
from jaxid.consistency.force_reading import ForceReading
from jaxid.consistency.late_force import plain
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

# Degrees of the polynomials of time that are tried.
_DEGREES = (1, 2, 3, 4, 6, 8)
# Evidence by which a slow force is above the effects, unknowns counted (Schwarz) [nats].
_CLEARLY = 5.0
# Part of the gap without either that it leaves at most.
_LESS = 0.9


@dataclass(frozen=True, kw_only=True)
class SlowForce(ForceReading):
    """A slow course of the force, a polynomial of time, that explains a log better than effects do.

    Args:
        gap, rival, effects, unit: See `ForceReading`.
        degree: Degree of the polynomial.
        evidence: Log-likelihood beyond that of the effects, half the logarithm of the number of samples
            subtracted for each unknown [nats].
    """

    degree: int
    evidence: float

    key = "slow_force"
    short = "drift of the force"

    def json(self) -> dict[str, object]:
        """Return the object `slow_force` of discovery.json."""
        return {"degree": self.degree, "evidence": self.evidence, **super().json()}

    @property
    def findings(self) -> list[str]:
        """Sentences on it and on what to do."""
        return [
            "The force seems to drift: a slow course of time (a polynomial of degree "
            f"{self.degree}) {self.beside_effects('better than')}.",
            "Log the force at rest before and after the motion, subtract the zero of the sensor, and search "
            "again; a longer log with more motions tells both apart.",
        ]


def slow_force(
    machine: Machine, whole: Machine, data: Prepared, effects: Sequence[str], unknowns: int
) -> SlowForce | None:
    """Return the slow course of the force that explains a log better than some effects; None if none does.

    Args:
        machine: The machine without the effects.
        whole: The machine with them.
        data: The prepared log.
        effects: Their names in results.
        unknowns: Number of their unknowns.

    Source:
        Schwarz (1978), Annals of Statistics 6, 461-464.
    """
    if not all(data.measured):
        return None
    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    now, found = (plain(balance_fits(m, data)[0]) for m in (machine, whole))
    if not (now.finite and found.finite):
        return None
    counts = now.counts & found.counts
    samples = data.recipe.independent * counts[:, driven].sum()
    now, found = (replace(fit, counts=counts, scale=now.scale) for fit in (now, found))

    def evidence(fit: BalanceFit, more: int) -> tuple[float, np.ndarray]:
        gap = fit.rms(fit.fit(bounded=True)[1])[driven]
        squares = np.sum((gap / fit.scale[driven]) ** 2 * counts[:, driven].sum(axis=0)) / samples
        return -0.5 * samples * np.log(max(squares, 1e-300)) - 0.5 * more * np.log(samples), gap

    before, (by_effects, rival) = evidence(now, 0)[1], evidence(found, unknowns)
    best = None
    for degree in _DEGREES:
        number = (degree + 1) * len(driven)
        if samples < 10 * number:
            break
        drifting = replace(now, potential=_courses(data, now, driven, degree))
        by_course, gap = evidence(drifting, number)
        if best is None or by_course > best[0]:
            best = by_course, gap, degree
    if best is None or best[0] < by_effects + _CLEARLY:
        return None
    by_course, gap, degree = best
    if not np.any(gap <= _LESS * before):
        return None
    return SlowForce(
        gap=gap,
        rival=rival,
        effects=tuple(effects),
        unit=machine.unit("force"),
        degree=degree,
        evidence=float(by_course - by_effects),
    )


def _courses(
    data: Prepared, fit: BalanceFit, driven: Sequence[int], degree: int
) -> Float[np.ndarray, "kept n k"]:
    """Return Legendre's polynomials of time as forces on each driven joint."""
    # So slow courses pass the parallel filter as they are.
    along = np.linspace(-1.0, 1.0, len(data.q))[data.kept]
    shapes = np.polynomial.legendre.legvander(along, degree)
    out = np.zeros((*fit.force.shape, len(driven) * (degree + 1)))
    for k, joint in enumerate(driven):
        out[:, joint, k * (degree + 1) : (k + 1) * (degree + 1)] = shapes
    return out
