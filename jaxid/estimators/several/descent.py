"""Damped descent of a cost that is a sum over logs, whose parts are compiled calls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxid.numerics.bounds import presses
from jaxid.numerics.lanes import Steps

# Damping at the start, and beyond which a descent is stuck, relative to the diagonal of the normal matrix.
_DAMPING, _STUCK = 1e-4, 1e12
# A descent also ends if a step fails to lower the cost and its predicted fall is at most this many times the
# tolerance: sticking and rounding make the last digits of a cost rough.
_ROUGH, _WHOLE = 100.0, 1e-2


class Model(NamedTuple):
    """A cost and its quadratic model at a point.

    Args:
        cost: The cost.
        gradient: Its gradient, (q,).
        normal: Positive semidefinite part of its second derivative, (q, q).
        content: Terms from which the cost was computed.
    """

    cost: float
    gradient: Float[np.ndarray, " q"]
    normal: Float[np.ndarray, "q q"]
    content: Any

    @property
    def finite(self) -> bool:
        """True if all numbers are finite."""
        return bool(
            np.isfinite(self.cost) and np.all(np.isfinite(self.gradient)) and np.all(np.isfinite(self.normal))
        )


@dataclass(frozen=True)
class Descent:
    """End of a descent.

    Args:
        x: Best point, (q,).
        model: The cost there.
        converged: Whether the cost can fall no further.
        steps: Number of evaluations.
    """

    x: Float[np.ndarray, " q"]
    model: Model
    converged: bool
    steps: int


def descent_steps(
    evaluate: Callable[[np.ndarray], Steps[Model]],
    x: Float[np.ndarray, " q"],
    bounds: tuple[Float[np.ndarray, " q"], Float[np.ndarray, " q"]],
    *,
    tolerance: tuple[float, float],
    max_steps: int,
    active: Bool[np.ndarray, " q"] | None = None,
    damping: float = _DAMPING,
) -> Steps[Descent]:
    """Minimise a cost within bounds by Marquardt's damped steps.

    Args:
        evaluate: Function that returns the cost and its model at a point.
        x: Start.
        bounds: Lower and upper bounds.
        tolerance: The descent has converged if the cost can fall by no more than the first part of itself
            plus the second number.
        max_steps: Largest number of evaluations.
        active: Mask of the unknowns that may move; None: all.
        damping: Damping of the first step; a linear problem needs none.

    Source:
        Marquardt (1963); damping after Nielsen (1999), IMM-REP-1999-05.
    """
    lower, upper = bounds
    x, growth = np.clip(x, lower, upper), 2.0
    active = np.ones(x.size, bool) if active is None else active
    best, steps = (yield from evaluate(x)), 1
    if not best.finite:
        return Descent(x, best, False, steps)
    if not active.any():
        return Descent(x, best, True, steps)

    while steps < max_steps:
        pressed = presses(x, best.gradient, lower, upper)
        aim = x + _step(best, damping, active & ~pressed)
        trial = np.clip(aim, lower, upper)
        change = trial - x
        predicted = float(-change @ best.gradient - 0.5 * change @ best.normal @ change)
        enough = tolerance[0] * abs(best.cost) + tolerance[1]
        if np.array_equal(trial, aim) and predicted <= enough:
            return Descent(x, best, True, steps)
        new, steps = (yield from evaluate(trial)), steps + 1
        if new.finite and new.cost < best.cost:
            fall = best.cost - new.cost
            # Beside a bound the prediction may be far too small.
            ratio = min(fall / max(predicted, 1e-300), 2.0)
            damping, growth = damping * max(1 / 3, 1 - (2 * ratio - 1) ** 3), 2.0
            x, best = trial, new
            if fall <= enough and 0 < predicted <= enough:
                return Descent(x, best, True, steps)
            continue
        rough = damping < _WHOLE and 0 < predicted <= _ROUGH * enough
        if rough or damping > _STUCK:
            return Descent(x, best, True, steps)
        damping, growth = max(damping, 1e-12) * growth, 2 * growth
    return Descent(x, best, False, steps)


def _step(model: Model, damping: float, free: Bool[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
    """Return the damped step of the free unknowns."""
    size = np.sqrt(np.maximum(np.diag(model.normal), 0.0))
    free = free & (size > 0)
    if not free.any():
        return np.zeros(size.size)
    own = np.ix_(free, free)
    matrix = model.normal[own] / np.outer(size[free], size[free]) + (damping + 1e-13) * np.eye(free.sum())
    out = np.zeros(size.size)
    out[free] = -np.linalg.solve(matrix, model.gradient[free] / size[free]) / size[free]
    return out
