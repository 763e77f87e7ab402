"""Least squares within bounds by any solver of optimistix, on jaxid's scale and with jaxid's result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import (
    BoundedLevenbergMarquardt,
    Minimum,
    Progress,
    Transform,
    levenberg_marquardt,
)

if TYPE_CHECKING:
    from jaxid.estimators.common.minimisers import Minimiser

# Largest numbers of steps: solvers with a Jacobian need tens, those without need hundreds.
_STEPS, _MANY_STEPS = 256, 4096
# Weight of a pull towards the start, on a scale on which residual and unknowns are of order one: it makes
# every linear system of a solver regular. Estimates move by less than 1e-4 standard deviations, even if the
# residual falls to 1e-6 of its start.
_PULL = 1e-8
# A start at a bound is moved inside by this part of the unknown's size: the slope of the bounds' transform is
# zero at the bound itself. An end within `_SNAP` of a bound is at the bound.
_INSIDE, _SNAP = 1e-3, 1e-6
# A result counts as a minimum if the best step from it would lower the cost by less than a hundredth of a
# standard deviation does; of a residual that is rounding, by less than this part of the first cost.
_NEAR, _ZERO = 1e-4, 1e-16

# Reasons why a minimiser did not converge, by `Minimum.failure`; 0: it did.
FAILURES = (
    "converged",
    "no convergence within its {steps} steps",
    "the residual is not finite where it ended",
    "it diverged",
    "a linear solve in it failed: the log may not determine all unknowns",
    "it stopped where the cost can still fall",
)
_MOST_STEPS, _NONFINITE, _DIVERGED, _LINEAR, _NO_MINIMUM = range(1, len(FAILURES))


def minimise(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]],
    theta: Float[Array, " p"],
    transform: Transform,
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
    active: Bool[Array, " p"] | None = None,
    minimiser: Minimiser | None = None,
    keep: bool = True,
) -> Minimum:
    """Minimise half the sum of squares of `residual` within bounds by any minimiser.

    Args:
        residual: Residual as a function of the physical unknowns; entries that do not count are zero.
        theta: Physical values at the start.
        transform: Scale of the solver.
        lower, upper: Bounds on the physical values.
        active: Mask of the unknowns that may move, (p,); None: all.
        minimiser: A solver of optimistix, see `minimise_on_scale`; None: `levenberg_marquardt`.
        keep: Whether the result holds residual and Jacobian.

    Returns:
        The minimum; `converged` is true if the cost cannot fall noticeably further, also if the minimiser
        reported a failure.
    """
    if minimiser is None or theta.size == 0:
        return levenberg_marquardt(residual, theta, transform, lower, upper, active, keep=keep)
    bounds = transform.bounds(jnp.asarray(lower), jnp.asarray(upper))
    x = jnp.clip(transform.inward(theta), *bounds)
    size = jnp.where(transform.log | (x == 0), 1.0, jnp.abs(x))
    moves = jnp.ones(x.size, bool) if active is None else jnp.asarray(active)
    progress, failure = minimise_on_scale(
        minimiser, jax.jit(lambda x: residual(transform.outward(x)).ravel()), x, size, bounds, moves, keep
    )
    return replace(progress.minimum(transform), failure=failure)


def minimise_on_scale(
    minimiser: Minimiser,
    residual: Callable[[Float[Array, " p"]], Float[Array, " rows"]],
    x: Float[Array, " p"],
    size: Float[Array, " p"],
    bounds: tuple[Float[Array, " p"], Float[Array, " p"]],
    active: Bool[Array, " p"],
    keep: bool = True,
) -> tuple[Progress, Array]:
    """Run a minimiser on the solver's scale, and judge its end by one step of Levenberg-Marquardt.

    Solvers of optimistix know no bounds: each bounded unknown is a smooth function of an unbounded coordinate
    z, x = lower + size (sqrt(z^2 + 1) - 1) with one bound and a sine with two. Unknowns are in units of their
    size at the start; the residual has RMS one there, or norm one for a minimiser of scalar functions.
    Derivatives are forward-mode.

    Args:
        minimiser: The solver of optimistix.
        residual: Residual as a function of the solver's unknowns, flat.
        x: Start, within the bounds.
        size: Sizes of the unknowns, positive.
        bounds: Lower and upper bounds on the solver's unknowns.
        active: Unknowns that may move.
        keep: Whether the result holds residual and Jacobian.

    Returns:
        The end, with the minimiser's number of steps, and an index in `FAILURES`. `done` is true at a
        minimum, also if the minimiser ran out of steps.

    Source:
        The bounds' transforms are those of Minuit: James and Roos (1975), Comput. Phys. Commun. 10, 343-367.
    """
    scalar = isinstance(minimiser, optx.AbstractMinimiser)
    inward, outward = _unbounded(size, *bounds)
    first = residual(x)
    square = jnp.sum(first**2)
    counted = 1 if scalar else jnp.maximum(jnp.sum(first != 0), 1)
    weight = jnp.sqrt(counted / jnp.where(square > 0, square, 1.0))
    z = inward(x)

    def scaled(z: Array, args: None) -> Array:
        moved = jnp.where(active, outward(z), x)
        return jnp.concatenate([weight * residual(moved), _PULL * (z - start)])

    start = z
    solution = optx.least_squares(
        scaled,
        minimiser,
        z,
        options={"jac": "fwd", "autodiff_mode": "fwd"},
        max_steps=_MANY_STEPS if scalar else _STEPS,
        throw=False,
    )
    ended = _snapped(jnp.where(active, outward(solution.value), x), size, bounds)

    # One step of the projected Levenberg-Marquardt gives residual and Jacobian, and shows whether this is a
    # minimum within the bounds.
    judge = BoundedLevenbergMarquardt(rtol=_NEAR / first.size, atol=_ZERO * 0.5 * square)
    options = {"lower": bounds[0], "upper": bounds[1], "active": active}
    begun = Progress.at(ended, size, first.size if keep else 0)
    progress = judge.step(lambda x, args: (residual(x), None), ended, None, options, begun, frozenset())[1]
    failure = jnp.where(progress.done & jnp.isfinite(progress.cost), 0, _reason(solution.result))
    failure = jnp.where(jnp.isfinite(progress.cost), failure, _NONFINITE)
    return replace(progress, steps=solution.stats["num_steps"]), failure


def _reason(result: optx.RESULTS) -> Array:
    """Return the index in `FAILURES` for the report of a minimiser that has not ended at a minimum."""
    reason = jnp.where(result == optx.RESULTS.successful, _NO_MINIMUM, _LINEAR)
    for reported, place in (
        (optx.RESULTS.nonlinear_max_steps_reached, _MOST_STEPS),
        (optx.RESULTS.nonfinite, _NONFINITE),
        (optx.RESULTS.nonlinear_divergence, _DIVERGED),
    ):
        reason = jnp.where(result == reported, place, reason)
    return reason


def _unbounded(
    size: Float[Array, " p"], lower: Float[Array, " p"], upper: Float[Array, " p"]
) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Return the maps to and from coordinates that have no bounds, each of order one."""
    below, above = jnp.isfinite(lower), jnp.isfinite(upper)
    both, either = below & above, below ^ above
    # Unused values must be finite too, because their derivatives would otherwise be NaN.
    wall = jnp.where(below, lower, jnp.where(above, upper, 0.0))
    sign = jnp.where(below, 1.0, -1.0)
    middle = jnp.where(both, 0.5 * (jnp.where(both, lower, 0.0) + jnp.where(both, upper, 0.0)), 0.0)
    half = jnp.where(both, 0.5 * (jnp.where(both, upper, 0.0) - jnp.where(both, lower, 0.0)), 1.0)
    half = jnp.where(half > 0, half, 1.0)

    def inward(x: Array) -> Array:
        away = 1.0 + jnp.maximum(sign * (x - wall) / size, _INSIDE)
        most = 1.0 - jnp.minimum(_INSIDE * size / half, 0.5)
        one = jnp.sqrt(jnp.where(either, away, 1.0) ** 2 - 1.0)
        two = half / size * jnp.arcsin(jnp.clip((x - middle) / half, -most, most))
        return jnp.where(both, two, jnp.where(either, one, x / size))

    def outward(z: Array) -> Array:
        one = wall + sign * size * (jnp.sqrt(z**2 + 1.0) - 1.0)
        two = middle + half * jnp.sin(size * z / half)
        return jnp.where(both, two, jnp.where(either, one, size * z))

    return inward, outward


def _snapped(x: Array, size: Array, bounds: tuple[Array, Array]) -> Array:
    """Return the unknowns within the bounds, and at a bound if they are next to it."""
    lower, upper = bounds
    x = jnp.where(x - lower <= _SNAP * size, lower, x)
    return jnp.clip(jnp.where(upper - x <= _SNAP * size, upper, x), lower, upper)


def failure_text(minimum: Minimum, name: str) -> str:
    """Return the reason why a minimiser did not converge, with its name."""
    place = 0 if minimum.failure is None else int(np.asarray(minimum.failure))
    return f"{name}: {FAILURES[place].format(steps=int(minimum.steps))}"
