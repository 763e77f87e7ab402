"""Profile likelihoods: the rise of the cost if one quantity is held and all others are fitted again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
import scipy.interpolate
import scipy.stats
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.numerics.lanes import Steps

State = TypeVar("State")

# Offsets at which a profile is taken, in standard deviations.
OFFSETS = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
# Confidence of the intervals that a profile gives.
LEVELS = (0.68, 0.95)
# Rise of a profile that may be below the fit: an optimum is not converged to the last digit.
_BELOW = 0.1
BETTER = "the profile of {} falls below the fit: there is a better optimum beside it"


def profiled(
    refit: Callable[[State, float], Steps[tuple[State, float]]], start: State
) -> Steps[Float[np.ndarray, " k"]]:
    """Return the rise of twice the negative log-likelihood at all `OFFSETS`.

    Args:
        refit: Function from the state at a neighbour's optimum and an offset to the state at the optimum with
            the quantity held at that offset, and the rise there; NaN if the offset is not admissible.
        start: State of the fit.
    """
    rise = np.full(OFFSETS.size, np.nan)
    # From the fit outwards: each descent begins at the optimum of its neighbour.
    for side in (OFFSETS < 0, OFFSETS > 0):
        state = start
        places = np.flatnonzero(side)
        for i in places[np.argsort(np.abs(OFFSETS[places]))]:
            state, rise[i] = yield from refit(state, float(OFFSETS[i]))
    return rise


def falls_below(rise: Float[np.ndarray, " k"]) -> bool:
    """Check that a profile is lower than the fit by more than an optimum's rounding."""
    return bool(np.any(rise < -_BELOW))


def likelihood_interval(
    rise: Float[np.ndarray, " k"], level: float, offsets: Float[np.ndarray, " k"] = OFFSETS
) -> tuple[float, float]:
    """Return the ends of a likelihood interval as offsets from the fit; NaN beyond the outermost offset.

    The interval holds the offsets whose rise is below the quantile of chi-squared with one degree of freedom.
    Between the offsets the root of the rise, signed by its side, follows a monotone cubic; for a parabola it
    is a straight line.

    Args:
        rise: Rise of twice the negative log-likelihood at the offsets, (k,); NaN if not known.
        level: Confidence of the interval.
        offsets: Offsets in standard deviations, ascending and without zero, (k,).

    Source:
        Wilks (1938), Ann. Math. Statist. 9, 60-62; Venzon and Moolgavkar (1988), Appl. Statist. 37, 87-94.
    """
    reach = float(np.sqrt(scipy.stats.chi2.ppf(level, 1)))
    ends = []
    for side in (-1.0, 1.0):
        own = (np.sign(offsets) == side) & np.isfinite(rise)
        order = np.argsort(np.abs(offsets[own]))
        at = np.concatenate([[0.0], np.abs(offsets[own])[order]])
        root = np.concatenate([[0.0], np.sqrt(np.maximum(rise[own][order], 0.0))])
        beyond = np.flatnonzero(root >= reach)
        if not beyond.size:
            ends.append(np.nan)
            continue
        # A profile that dips again farther out belongs to another optimum.
        last = int(beyond[0]) + 1
        curve = scipy.interpolate.PchipInterpolator(at[:last], root[:last])
        crossing = curve.solve(reach, extrapolate=False)
        ends.append(side * float(crossing[0] if len(crossing) else at[last - 1]))
    return ends[0], ends[1]


def profile_entry(
    value: float,
    std: float,
    values: Float[np.ndarray, " k"],
    rise: Float[np.ndarray, " k"],
    variance_factor: float,
    unit: str,
) -> dict[str, Any]:
    """Return the entry of one unknown in `profiles` of result.json.

    Args:
        value: Estimate.
        std: Standard deviation, the step of the offsets.
        values: Values at which the unknown was held, (k,).
        rise: Rise of twice the negative log-likelihood there, (k,); NaN if not computed.
        variance_factor: Factor of the variance by the residual's colour; the rise was divided by it.
        unit: Label of the unit.
    """
    entry: dict[str, Any] = {
        "value": value,
        "std": std,
        "unit": unit,
        "at_std": OFFSETS.tolist(),
        "at": values.tolist(),
        "rise": [float(r) if np.isfinite(r) else None for r in rise],
        "variance_factor": variance_factor,
    }
    points = np.concatenate([values[OFFSETS < 0], [value], values[OFFSETS > 0]])
    offsets = np.concatenate([OFFSETS[OFFSETS < 0], [0.0], OFFSETS[OFFSETS > 0]])
    for level in LEVELS:
        ends = np.interp(likelihood_interval(rise, level), offsets, points)
        entry[f"interval_{round(100 * level)}"] = [float(x) if np.isfinite(x) else None for x in ends]
    return entry


def need_names(asked: Sequence[str], known: Sequence[str]) -> None:
    """Refuse a profile of something that is not an unknown of the case.

    Raises:
        InputError: If a name is not among the known ones.
    """
    for name in asked:
        if name not in known:
            raise InputError(f"profile: {name!r} is not an unknown of the case", hint=suggest(name, known))
