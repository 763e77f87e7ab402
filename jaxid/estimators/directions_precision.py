"""How well a fit within a prior tells each combination of unknowns, and each unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array

from jaxid.estimators.directions_problem import NO_PULL, Found, fit_each, residual_of
from jaxid.estimators.steps import Solve, Steps
from jaxid.machine import Machine
from jaxid.precision import Precision, assess, full_hessian

# A parameter is told where what is left of its prior is less than this.
_TOLD = 0.5
# Entries of a combination below this are left out when it is named.
_NEGLIGIBLE = 0.1
# A profile is taken at so many standard deviations of the quadratic picture.
_PROFILED = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
# Variances by which one may end below the fit for numerics alone.
_BELOW = 0.1


@eqx.filter_jit
def hessian_of(*args: Any) -> Array:
    """Of the cost, in the directions' coordinates, at a sharpness."""
    replay, places, plant, *rest, sharpness, vectors, z = args
    return full_hessian(residual_of(replay, places, replace(plant, sharpness=sharpness), *rest, vectors), z)


@dataclass(frozen=True)
class Told:
    """How well the fitted directions are told.

    Args:
        covariance: Of their coordinates, (r, r).
        white: Standard deviations as if noise were white, (r,).
        information: See `Precision`.
    """

    covariance: np.ndarray
    white: np.ndarray
    information: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Standard deviations of the directions' coordinates, (r,)."""
        return np.sqrt(np.diag(self.covariance))


def told_of(found: Found, hessian: np.ndarray | None = None) -> Told:
    """Precision of the fitted directions, one at least, from the residual's own colour; see `hessian_of`."""
    problem, r = found.problem, found.count
    shape, counts = problem.measured.shape, problem.weight > 0
    jacobian = np.asarray(found.minimum.jacobian).reshape(*shape, -1)[..., :r]
    e = np.asarray(found.minimum.residual).reshape(shape)
    deviation = problem.weight * (problem.measured - problem.measured.mean(axis=0))
    signal = float(np.linalg.norm(deviation))
    told = assess(
        [f"direction {k + 1}" for k in range(r)], jacobian, e, counts,
        signal, np.ones(r), hessian, crossed=problem.on == "both",
    )
    # Of the triangle: some directions are told a million times better than others.
    triangle = np.linalg.qr(jacobian.reshape(-1, r), mode="r")
    white = problem.noise(found.minimum, r) * np.linalg.norm(np.linalg.inv(triangle), axis=1)
    # A colour read off a hundred samples is itself uncertain: never less than white noise would leave.
    larger = np.maximum(1.0, white / told.std)
    of_seen = told.covariance * np.outer(larger, larger)
    return Told(of_seen, white, told.information)


def assessed(
    machine: Machine, found: Found, told: Told | None
) -> tuple[Precision, list[dict[str, Any]]]:
    """Precision of the parameters, and of the directions; None where no direction is told."""
    problem, r = found.problem, found.count
    if told is None:
        return _nothing_told(machine)
    names = [*machine.parameters.names, *problem.nuisances]
    z = np.asarray(found.minimum.theta)
    seen, held = found.vectors[:, :r], found.vectors[:, r:]
    slope = problem.prior.slope(np.asarray(problem.prior.outward(found.point)))
    whole = seen @ told.covariance @ seen.T + held @ held.T
    p = len(problem.places)
    left = np.sqrt(np.diag(whole))[:p]
    identifiable = left < _TOLD
    covariance = (whole * np.outer(slope, slope))[:p, :p]
    covariance[~identifiable] = covariance[:, ~identifiable] = np.nan
    stated = [
        {
            "combination": dict(zip(names, found.vectors[:, k].tolist(), strict=True)), "value": float(z[k]),
            "std": float(told.std[k]), "std_white": float(told.white[k]),
        }
        for k in range(r)
    ]
    blind = [c for c in (_named(names, v) for v in held.T) if any(n in c for n in names[:p])]
    return Precision(covariance, identifiable, blind, told.information), stated


def _nothing_told(machine: Machine) -> tuple[Precision, list[dict[str, Any]]]:
    """Of a log that tells no combination better than the guesses."""
    names = machine.parameters.names
    p = len(names)
    blind = [{n: 1.0} for n in names]
    return Precision(np.full((p, p), np.nan), np.zeros(p, bool), blind, np.zeros(0)), []


def _named(names: Sequence[str], vector: np.ndarray) -> dict[str, float]:
    return {n: float(v) for n, v in zip(names, vector, strict=True) if abs(v) > _NEGLIGIBLE}


def add_profiles(found: Found, stated: list[dict[str, Any]]) -> Steps[list[str]]:
    """Add to each direction its profile: by how many variances the cost rises when it is held elsewhere.

    Returns:
        What to remark: profiles that fall below the fit.
    """
    r, some = found.count, found.first
    if not r:
        return []
    best = np.asarray(found.minimum.theta)
    z = np.tile(best, (r, _PROFILED.size, 1))
    active = np.tile(np.arange(best.size) < r, (r, _PROFILED.size, 1))
    for k in range(r):
        z[k, :, k] += _PROFILED * stated[k]["std"]
        active[k, :, k] = False
    flat = (z.reshape(-1, best.size), active.reshape(-1, best.size))
    still = (NO_PULL, np.zeros(len(some)), some)
    args = (*found.problem.args, found.problem.ladder[-1], *still, *flat)
    _, costs, _, _ = yield Solve(fit_each, args)
    rise = 2 * (np.asarray(costs).reshape(r, -1) - float(found.minimum.cost))
    noise = found.problem.noise(found.minimum, r) ** 2
    for k in range(r):
        stated[k]["profile"] = {
            "at_std": _PROFILED.tolist(), "rise": (rise[k] / noise).tolist(),
        }
    below = [k + 1 for k in range(r) if np.nanmin(rise[k]) < -_BELOW * noise]
    words = "the profile of direction {} falls below the fit: there is a better optimum beside it"
    return [words.format(k) for k in below]
