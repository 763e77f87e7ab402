"""Levenberg-Marquardt within bounds, compiled whole; and the scales it works on."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxid.parameters import Parameters

# A fit has converged where the cost can fall by no more than this part of itself: with 10^4
# samples that is 10^-5 of a standard deviation.
_TOLERANCE = 1e-12


class Transform(eqx.Module):
    """Physical values to the scale of the solver and back: one object, one inverse.

    What must be positive is fitted as its logarithm; the rest as it is. Scaling to order one is
    the solver's own (it scales by the columns of the Jacobian).
    """

    log: Bool[Array, " p"]

    @classmethod
    def of(cls, parameters: Parameters) -> Transform:
        """The transform of a set of unknowns."""
        return cls(jnp.asarray([f.sign == "positive" for f in parameters.free], dtype=bool))

    def inward(self, theta: Float[Array, " p"]) -> Float[Array, " p"]:
        """Physical to solver."""
        return jnp.where(self.log, jnp.log(jnp.where(self.log, theta, 1.0)), theta)

    def outward(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Solver to physical."""
        return jnp.where(self.log, jnp.exp(jnp.where(self.log, x, 0.0)), x)

    def slope(self, theta: Float[Array, " p"]) -> Float[Array, " p"]:
        """d physical / d solver, for Jacobians."""
        return jnp.where(self.log, theta, 1.0)


class Minimum(eqx.Module):
    """What the solver returns.

    Args:
        theta: Physical values.
        cost: Half the sum of squares.
        steps: Evaluations of the Jacobian.
        converged: Whether the cost could fall no further.
    """

    theta: Float[Array, " p"]
    cost: Float[Array, ""]
    steps: Array
    converged: Array


class _Progress(eqx.Module):
    x: Array
    cost: Array
    gradient: Array
    normal: Array
    damping: Array
    growth: Array
    steps: Array
    done: Array


def levenberg_marquardt(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]],
    theta: Float[Array, " p"],
    transform: Transform,
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
    active: Bool[Array, " p"] | None = None,
    max_steps: int = 60,
) -> Minimum:
    """Minimise half the sum of squares of `residual` within bounds.

    Forward-mode Jacobian, Marquardt's scaling, Nielsen's damping; steps are projected on the
    bounds and unknowns that press against one rest. Compiles whole: vmap it over starts or data.

    Args:
        residual: Residual as a function of the physical unknowns; entries that are not to count
            are zero.
        theta: Start.
        transform: Scale of the solver.
        lower, upper: Bounds on the physical values.
        active: Which unknowns may move; absent: all.
        max_steps: Most evaluations.

    Returns:
        The minimum; `converged` is false where the steps ran out or the residual is not finite.

    Source:
        Marquardt (1963); damping after Nielsen (1999), IMM-REP-1999-05.
    """
    lower, upper = transform.inward(lower), transform.inward(upper)
    moves = jnp.ones(theta.size, bool) if active is None else active

    def equations(x: Array) -> tuple[Array, Array, Array]:
        def flat(x: Array) -> tuple[Array, Array]:
            e = residual(transform.outward(x)).ravel()
            return e, e

        jacobian, e = jax.jacfwd(flat, has_aux=True)(x)
        return 0.5 * e @ e, jacobian.T @ e, jacobian.T @ jacobian

    def advance(p: _Progress) -> _Progress:
        pressed = ((p.x <= lower) & (p.gradient > 0)) | ((p.x >= upper) & (p.gradient < 0))
        free = moves & ~pressed
        change, predicted = _step(p, free)
        x = jnp.clip(p.x + change, lower, upper)
        cost, gradient, normal = equations(x)
        better = cost < p.cost
        ratio = (p.cost - cost) / jnp.maximum(predicted, 1e-300)
        shrink = jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3)
        damping = jnp.where(better, p.damping * shrink, p.damping * p.growth)
        small = predicted <= _TOLERANCE * p.cost
        stuck = ~better & (p.damping > 1e12)
        return _Progress(
            jnp.where(better, x, p.x),
            jnp.where(better, cost, p.cost),
            jnp.where(better, gradient, p.gradient),
            jnp.where(better, normal, p.normal),
            jnp.maximum(damping, 1e-15),
            jnp.where(better, 2.0, 2 * p.growth),
            p.steps + 1,
            small | stuck,
        )

    x0 = jnp.clip(transform.inward(theta), lower, upper)
    start = _Progress(
        x0, *equations(x0), jnp.asarray(1e-4), jnp.asarray(2.0), jnp.asarray(1), jnp.asarray(False)
    )
    end = jax.lax.while_loop(lambda p: ~p.done & (p.steps < max_steps), advance, start)
    return Minimum(
        transform.outward(end.x), end.cost, end.steps, end.done & jnp.isfinite(end.cost)
    )


def _step(p: _Progress, free: Bool[Array, " p"]) -> tuple[Array, Array]:
    """Damped step of the free unknowns, and by how much it should lower the cost."""
    scale = jnp.sqrt(jnp.where(free, jnp.diag(p.normal), 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    normal = p.normal / jnp.outer(scale, scale)
    both = jnp.outer(free, free)
    matrix = jnp.where(both, normal, 0.0) + jnp.diag(jnp.where(free, p.damping, 1.0))
    # A trace of damping keeps directions that the data cannot tell where they are.
    matrix = matrix + 1e-13 * jnp.eye(free.size)
    gradient = jnp.where(free, p.gradient / scale, 0.0)
    change = -jnp.linalg.solve(matrix, gradient)
    predicted = -change @ gradient - 0.5 * change @ jnp.where(both, normal, 0.0) @ change
    return change / scale, predicted
