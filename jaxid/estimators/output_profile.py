"""Profile likelihood of the unknowns of a fit of simulated outputs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxid.estimators.common.profile import BETTER, OFFSETS, falls_below, profile_entry, profiled
from jaxid.machine import Machine
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Precision


def profile_steps(
    fit: Callable[[np.ndarray, np.ndarray], SolveRequest],
    found: tuple[np.ndarray, float, int, tuple[np.ndarray, np.ndarray], np.ndarray],
    machine: Machine,
    precision: Precision,
    asked: Sequence[str],
) -> Steps[tuple[dict[str, Any], list[str]]]:
    """Compute the profile likelihood of some unknowns, and notes about those that have none.

    The cost takes the residual for white. Its rise is divided by the variance of the white residual that
    would give the unknown the same standard deviation as the coloured one.

    Args:
        fit: Function that requests a fit from values of all unknowns, of which those of a mask move.
        found: The fit: values of all unknowns, cost, residuals that count, bounds, and mask of the unknowns.
        machine: The machine, with its unknowns.
        precision: Precision of the unknowns.
        asked: Names of the unknowns.

    Source:
        Chandler and Bate (2007), Biometrika 94, 167-183: an independence likelihood, scaled vertically.
    """
    profiles, notes = {}, []
    theta, cost, count, (lower, upper), active = found
    white = 2 * cost / max(count - active.sum(), 1)
    bound = machine.parameters.in_bodies
    for name in asked:
        k = machine.parameters.names.index(name)
        if not precision.identifiable[k] or precision.equivalent_variance is None:
            notes.append(f"no profile of {name}: it is not identifiable from this log")
            continue
        if bound[k]:
            notes.append(f"no profile of {name}: it belongs to a link that is kept physically consistent")
            continue
        std, variance = float(precision.std[k]), float(precision.equivalent_variance[k])
        others = active & (np.arange(theta.size) != k)

        def refit(
            at: np.ndarray,
            offset: float,
            k: int = k,
            others: np.ndarray = others,
            of: tuple = (std, variance),
        ) -> Steps[tuple[np.ndarray, float]]:
            held = theta[k] + offset * of[0]
            if not lower[k] < held < upper[k]:
                return at, np.nan
            there = yield fit(np.where(np.arange(theta.size) == k, held, at), others)
            rise = 2 * (float(there.cost) - cost) / of[1]
            return np.asarray(there.theta), rise if bool(there.converged) else np.nan

        rise = yield from profiled(refit, theta)
        notes += [BETTER.format(name)] if falls_below(rise) else []
        unit = machine.parameters.free[k].unit
        profiles[name] = profile_entry(
            float(theta[k]), std, theta[k] + OFFSETS * std, rise, variance / white, unit
        )
    if profiles:
        notes.append(
            "profiles: the residual counts as Gaussian, and its colour as a constant factor of the variance"
        )
    return profiles, notes
