"""How well a fit within a prior tells each combination of unknowns, and each unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import Array
from jaxid.estimators.within_prior.posterior import loss_of, most_probable
from jaxid.estimators.within_prior.problem import RoundsResult, residual_of
from jaxid.machine import Machine
from jaxid.numerics.lanes import Steps
from jaxid.numerics.precision import Precision, assess, full_hessian

# A parameter is told where what is left of its prior is less than this.
_TOLD = 0.5
# Entries of a combination below this are left out when it is named.
_NEGLIGIBLE = 0.1
# A profile is taken at so many standard deviations of the quadratic picture.
_PROFILED = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
# Variances by which one may end below the fit, which is not told to the last digit.
_BELOW = 0.1


@eqx.filter_jit
def hessian_of(*args: Any) -> Array:
    """Of the cost, in the directions' coordinates, at a sharpness."""
    replay, places, plant, *rest, sharpness, vectors, z = args
    return full_hessian(residual_of(replay, places, plant.smoothed(sharpness), *rest, vectors), z)


@dataclass(frozen=True)
class DirectionPrecision:
    """How well the fitted directions are told.

    Args:
        covariance: Of their coordinates, (r, r).
        white: Standard deviations by the log alone, as if noise were white, (r,).
        information: See `Precision`.
        whole: Covariance of all unknowns in units of the prior; none where what is held counts as its prior.
    """

    covariance: np.ndarray
    white: np.ndarray
    information: np.ndarray
    whole: np.ndarray | None = None

    @property
    def std(self) -> np.ndarray:
        """Standard deviations of the directions' coordinates, (r,)."""
        return np.sqrt(np.diag(self.covariance))


def precision_of_directions(found: RoundsResult) -> DirectionPrecision:
    """Precision of the fitted directions, one at least, by the log alone: from the residual's own colour."""
    problem, r = found.problem, found.count
    shape, counts = problem.measured.shape, problem.weight > 0
    jacobian = np.asarray(found.minimum.jacobian).reshape(*shape, -1)[..., :r]
    e = np.asarray(found.minimum.residual).reshape(shape)
    deviation = problem.weight * (problem.measured - problem.measured.mean(axis=0))
    signal = float(np.linalg.norm(deviation))
    told = assess(
        [f"direction {k + 1}" for k in range(r)],
        jacobian,
        e,
        counts,
        signal,
        np.ones(r),
        crossed=problem.on == "both",
    )
    # Of the triangle: some directions are told a million times better than others.
    triangle = np.linalg.qr(jacobian.reshape(-1, r), mode="r")
    white = problem.noise(found.minimum, r) * np.linalg.norm(np.linalg.inv(triangle), axis=1)
    # A colour read off a hundred samples is itself uncertain: never less than white noise would leave.
    larger = np.maximum(1.0, white / told.std)
    of_seen = told.covariance * np.outer(larger, larger)
    return DirectionPrecision(of_seen, white, told.information)


def with_guesses(found: RoundsResult, told: DirectionPrecision, whole: np.ndarray) -> DirectionPrecision:
    """With the guesses counted in.

    Args:
        found: The fit.
        told: By the log alone.
        whole: Covariance of all unknowns by guesses and log, as if noise were white.
    """
    seen = found.vectors[:, : found.count]
    along = np.eye(len(whole)) + (seen * (told.std / told.white - 1.0)) @ seen.T
    whole = along @ whole @ along.T
    return replace(told, covariance=seen.T @ whole @ seen, whole=whole)


def assessed(
    machine: Machine, found: RoundsResult, told: DirectionPrecision | None
) -> tuple[Precision, list[dict[str, Any]]]:
    """Precision of the parameters, and of the directions; None where no direction is told."""
    problem, r = found.problem, found.count
    if told is None:
        return _nothing_told(machine)
    names = [*machine.parameters.names, *problem.nuisances]
    z = np.asarray(found.minimum.theta)
    seen, held = found.vectors[:, :r], found.vectors[:, r:]
    whole = seen @ told.covariance @ seen.T + held @ held.T if told.whole is None else told.whole
    slope = problem.prior.slope(np.asarray(problem.prior.outward(found.point)))
    p = len(problem.places)
    left = np.sqrt(np.diag(whole))[:p]
    identifiable = left < _TOLD
    covariance = (whole * np.outer(slope, slope))[:p, :p]
    covariance[~identifiable] = covariance[:, ~identifiable] = np.nan
    stated = [
        {
            "combination": dict(zip(names, found.vectors[:, k].tolist(), strict=True)),
            "value": float(z[k]),
            "std": float(told.std[k]),
            "std_white": float(told.white[k]),
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


def add_profiles(found: RoundsResult, noise: float, stated: list[dict[str, Any]]) -> Steps[list[str]]:
    """Add to each direction its profile: twice the nats by which guess and log speak against it elsewhere.

    Returns:
        What to remark: profiles that fall below the fit.
    """
    best, words = found.point, []
    below = "the profile of direction {} falls below the fit: there is a better optimum beside it"
    for k, direction in enumerate(stated):
        along, rise = found.vectors[:, k], np.full(_PROFILED.size, np.nan)
        lowest = loss_of(noise, found.minimum, best)
        # From the fit outwards: each begins where its neighbour ended.
        for side in (_PROFILED < 0, _PROFILED > 0):
            w, before = best, 0.0
            places = np.flatnonzero(side)
            for i in places[np.argsort(np.abs(_PROFILED[places]))]:
                w = w + (_PROFILED[i] - before) * direction["std"] * along
                before = _PROFILED[i]
                w, here, _ = yield from most_probable(found.problem, noise, w, held=along)
                rise[i] = 2 * (loss_of(noise, here, w) - lowest)
        direction["profile"] = {"at_std": _PROFILED.tolist(), "rise": rise.tolist()}
        if np.nanmin(rise) < -_BELOW:
            words.append(below.format(k + 1))
    return words
