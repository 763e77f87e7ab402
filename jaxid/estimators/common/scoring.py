"""Fisher's scoring for Gaussian likelihoods whose means and variances depend on the unknowns."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jaxid.arrays import Array, library
from jaxid.numerics.bounds import presses

# The fit has converged if the log-likelihood can rise by no more than this [nats]: about a hundredth of a
# standard deviation.
_TOLERANCE = 1e-5
# Damping at the start, and the largest one, relative to the diagonal of the information.
_DAMPING, _STUCK = 1e-3, 1e12
# Numbers that the second derivatives may hold at a time, over all directions: 64 MB in each array.
_AT_A_TIME = 8_000_000


class Scored(eqx.Module):
    """Result of the scoring, on the scale of the solver.

    Args:
        x: Unknowns, (p,).
        cost: Negative log-likelihood [nats].
        z: Residuals over their standard deviations, (time, k); zero for an entry that does not count.
        mean: Derivative of the residual over its standard deviation, (time, k, p).
        log_variance: Derivative of the logarithm of the variance, (time, k, p).
        gradient: Gradient of the cost, (p,).
        damping: Damping of the last step.
        steps: Number of evaluations.
        done: Whether the likelihood can rise no further.
    """

    x: Array
    cost: Array
    z: Array
    mean: Array
    log_variance: Array
    gradient: Array
    damping: Array
    steps: Array
    done: Array

    @property
    def converged(self) -> Array:
        """True if the likelihood is finite and can rise no further."""
        return self.done & library(self.cost).isfinite(self.cost) & (self.damping < _STUCK)

    @property
    def information(self) -> Float[Array, "p p"]:
        """Fisher's information on the unknowns, (p, p)."""
        rows, logs = (a.reshape(-1, self.x.size) for a in (self.mean, self.log_variance))
        return rows.T @ rows + 0.5 * logs.T @ logs


class _Trial(eqx.Module):
    """State of the iteration: the best point so far, and the next one to try.

    Args:
        best: Likelihood at the best point.
        normal: Information there, (p, p).
        trial: Next point, (p,).
        predicted: Fall of the cost that the quadratic model predicts for it [nats].
        growth: Factor of the damping if the trial is rejected.
    """

    best: Scored
    normal: Array
    trial: Array
    predicted: Array
    growth: Array


def maximise_likelihood(
    outputs: Callable[[Float[Array, " p"]], tuple[Float[Array, "time k"], Float[Array, "time k"]]],
    counts: Bool[Array, "time k"],
    x: Float[Array, " p"],
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
    max_steps: Array | int,
) -> Scored:
    """Maximise a Gaussian likelihood within bounds by Fisher's scoring with Marquardt's damping.

    Args:
        outputs: Residuals and their variances as functions of the unknowns.
        counts: Mask of the residuals that count.
        x: Unknowns at the start, of order one on a linear scale or logarithms.
        lower, upper: Bounds.
        max_steps: Largest number of evaluations.

    Source:
        Ljung (1999), System Identification, section 7.4, for the likelihood of innovations; damping after
        Nielsen (1999), IMM-REP-1999-05.
    """
    x = jnp.clip(x, lower, upper)

    def advance(s: _Trial) -> _Trial:
        cost, gradient, normal, arrays = _evaluated(outputs, counts, s.trial)
        was = s.best
        # A shape that a log does not show may run to a value at which the likelihood has no slope.
        sound = jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(normal))
        better, first = (cost < was.cost) & sound, ~jnp.isfinite(was.cost)
        gain = (was.cost - cost) / jnp.maximum(s.predicted, 1e-300)
        little = better & ~first & (was.cost - cost < _TOLERANCE)

        old = (was.x, was.cost, was.gradient, s.normal, (was.z, was.mean, was.log_variance))
        new = (s.trial, cost, gradient, normal, arrays)
        x, cost, gradient, normal, arrays = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        shrink = jnp.where(first, 1.0, jnp.where(gain < 0.5, 0.5, 0.1))
        damping = jnp.where(better, was.damping * shrink, was.damping * s.growth)
        growth = jnp.where(better, 2.0, 2 * s.growth)
        trial, predicted, cut = _next_trial(x, gradient, normal, damping, lower, upper)

        done = (little & (s.predicted < _TOLERANCE)) | (~cut & (predicted < 0.1 * _TOLERANCE))
        done |= (damping > _STUCK) | ((was.steps > 10) & ~jnp.isfinite(cost))
        z, mean, spread = arrays
        best = Scored(
            x=x,
            cost=cost,
            z=z,
            mean=mean,
            log_variance=spread,
            gradient=gradient,
            damping=damping,
            steps=was.steps + 1,
            done=done,
        )
        return _Trial(best, normal, trial, predicted, growth)

    first = _Trial(_unevaluated(x, counts), jnp.eye(x.size), x, jnp.asarray(0.0), jnp.asarray(2.0))
    end = jax.lax.while_loop(lambda s: ~s.best.done & (s.best.steps < max_steps), advance, first)
    return end.best


def _evaluated(
    outputs: Callable[[Array], tuple[Array, Array]], counts: Array, x: Array
) -> tuple[Array, Array, Array, tuple[Array, Array, Array]]:
    """Return cost, gradient (p,), information (p, p), and the arrays of `Scored` at a point."""
    p = x.size

    def pair(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        e, variance = outputs(x)
        return (e, jnp.log(variance)), (e, variance)

    (slope, log_slope), (e, variance) = jax.jacfwd(pair, has_aux=True)(x)
    root = jnp.sqrt(variance)
    z = jnp.where(counts, e / root, 0.0)
    mean = jnp.where(counts[..., None], slope / root[..., None], 0.0)
    spread = jnp.where(counts[..., None], log_slope, 0.0)

    cost = 0.5 * jnp.sum(z**2 + jnp.where(counts, jnp.log(variance), 0.0))
    gradient = jnp.einsum("tk,tkp->p", z, mean) + 0.5 * jnp.einsum("tk,tkp->p", 1 - z**2, spread)

    rows, logs = mean.reshape(-1, p), spread.reshape(-1, p)
    # Far from the optimum the observed information on a variance exceeds the expected one.
    weight = jnp.maximum(jnp.square(z).ravel(), 1.0)[:, None]
    return cost, gradient, rows.T @ rows + 0.5 * logs.T @ (weight * logs), (z, mean, spread)


def _next_trial(
    x: Array, gradient: Array, normal: Array, damping: Array, lower: Array, upper: Array
) -> tuple[Array, Array, Array]:
    """Return the damped step's end within the bounds, the fall that it predicts, and if a bound cut it."""
    # An unknown that presses against a bound rests.
    rests = presses(x, gradient, lower, upper)
    size = jnp.sqrt(jnp.maximum(jnp.diag(normal), 1e-300))
    scaled = jnp.where(rests[:, None] | rests[None, :], 0.0, normal / jnp.outer(size, size))
    scaled = scaled + jnp.diag(jnp.where(rests, 1.0, damping + 1e-14))
    whole = -jnp.linalg.solve(scaled, jnp.where(rests, 0.0, gradient) / size) / size

    trial = jnp.clip(x + whole, lower, upper)
    predicted = -(gradient @ whole + 0.5 * whole @ normal @ whole)
    return trial, predicted, jnp.any(trial != x + whole)


def _unevaluated(x: Array, counts: Array) -> Scored:
    """Return the state at a start whose likelihood is not known yet."""
    empty = jnp.zeros((*counts.shape, x.size))
    return Scored(
        x=x,
        cost=jnp.asarray(jnp.inf),
        z=jnp.zeros(counts.shape),
        mean=empty,
        log_variance=empty,
        gradient=jnp.zeros(x.size),
        damping=jnp.asarray(_DAMPING),
        steps=jnp.asarray(0),
        done=jnp.asarray(False),
    )


def observed_information(
    outputs: Callable[[Float[Array, " p"]], tuple[Float[Array, "time k"], Float[Array, "time k"]]],
    counts: Bool[Array, "time k"],
    x: Float[Array, " p"],
) -> Float[Array, "p p"]:
    """Return the observed information: the second derivative of the negative log-likelihood, (p, p).

    It is differentiated forward twice, so that no step of a filter is kept in memory. A long log takes its
    directions in several passes.

    Args:
        outputs: Residuals and their variances as functions of the unknowns.
        counts: Mask of the residuals that count.
        x: Unknowns.

    Source:
        Efron and Hinkley (1978), Biometrika 65, 457-482.
    """

    def cost(x: Array) -> Array:
        e, variance = outputs(x)
        return 0.5 * jnp.sum(jnp.where(counts, e**2 / variance + jnp.log(variance), 0.0))

    def column(direction: Array) -> Array:
        return jax.jvp(jax.jacfwd(cost), (x,), (direction,))[1]

    together = max(1, _AT_A_TIME // max(counts.size * x.size, 1))
    return jax.lax.map(column, jnp.eye(x.size), batch_size=min(together, x.size))
