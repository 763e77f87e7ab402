"""Levenberg-Marquardt of many fits side by side, with the Jacobian of each fit's end only.

A batch by `jax.vmap` selects residual and Jacobian of every fit after every evaluation. Here only sums over
the samples are selected, and the lanes of a processor are the fits. The step is that of
`levenberg_marquardt`, by `advanced_by_model`. One loop cannot serve both: a single fit ends with residual and
Jacobian in its state, and in a batch that is the copy which this loop avoids.
"""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Progress, Transform, advanced_by_model
from jaxid.numerics.lanes import accelerator

# Evaluations of a fit, at most; those that take more are for `levenberg_marquardt`.
_MAX_EVALUATIONS = 30


class Ends(eqx.Module):
    """The ends of fits side by side.

    Args:
        theta: Physical values, (fits, p).
        cost: Half the sums of squares, (fits,).
        steps: Numbers of evaluations, without those that wait for other fits, (fits,).
        converged: Whether the cost cannot fall further, (fits,).
        gram: Matrices J'J by the physical values, (fits, p, p).
        residual: Residual at the end, (time, fits, n).
        jacobian: Jacobian there by the physical values, (time, p, fits, n).
    """

    theta: Float[Array, "fits p"]
    cost: Float[Array, " fits"]
    steps: Array
    converged: Bool[Array, " fits"]
    gram: Float[Array, "fits p p"]
    residual: Float[Array, "time fits n"]
    jacobian: Float[Array, "time p fits n"]


def descend_side_by_side(
    residual: Callable[[Float[Array, "fits p"]], Float[Array, "time fits n"]],
    theta: Float[Array, "fits p"],
    transform: Transform,
    lower: Float[Array, "fits p"],
    upper: Float[Array, "fits p"],
) -> Ends:
    """Minimise half the sum of squares of many residuals, each as `levenberg_marquardt` does.

    Args:
        residual: Residuals of all fits as a function of their physical unknowns.
        theta: Physical values at the start.
        transform: Scale of the solver, without bodies.
        lower, upper: Bounds on the physical values.
    """
    bounds = jax.vmap(transform.bounds)(lower, upper)
    x = jnp.clip(jax.vmap(transform.inward)(theta), *bounds)
    scale = jnp.where(transform.log | (x == 0), 1.0, jnp.abs(x))
    begun = jax.vmap(lambda x, scale: Progress.at(x, scale, 0))(x, scale)
    # Traced once for both its shape and its Jacobian.
    residual = jax.jit(residual)
    shape = jax.eval_shape(residual, theta)
    samples, (fits, p) = shape.shape[0] * shape.shape[2], theta.shape

    def evaluated(x: Array) -> tuple[Array, Array, tuple[Array, Array, Array]]:
        theta = jax.vmap(transform.outward)(x)
        # All fits move at once in one unknown, so that the innermost axis is that of the fits.
        push = lambda d: jax.jvp(residual, (theta,), (jnp.broadcast_to(d, theta.shape),))
        e, jacobian = jax.vmap(push, out_axes=(None, 1))(jnp.eye(p))
        return e, jacobian, _sums(e, jacobian)

    def lasts(state: tuple) -> Array:
        progress, fresh, *_ = state
        going = ~progress.done & (progress.steps < _MAX_EVALUATIONS)
        return jnp.any(going | ~fresh)

    def once(state: tuple) -> tuple:
        progress, _, _, _, _ = state
        over = progress.done | (progress.steps >= _MAX_EVALUATIONS)
        # A fit that has ended waits at its best point, of which residual and Jacobian are wanted.
        at = jnp.where(over[:, None], progress.x, progress.trial)
        e, jacobian, (cost, gradient, gram) = evaluated(at)

        def advanced(p: Progress, cost: Array, gradient: Array, gram: Array, bounds: tuple) -> Progress:
            slope = jnp.asarray(transform.slope(transform.outward(p.trial)))
            model = (cost, slope * gradient, gram * jnp.outer(slope, slope))
            return advanced_by_model(p, model, p.kept, samples, bounds, jnp.ones(slope.shape, bool))

        new = jax.vmap(advanced)(progress, cost, gradient, gram, bounds)
        held = lambda old, new: jnp.where(over.reshape(-1, *(1,) * (new.ndim - 1)), old, new)
        progress = jax.tree.map(held, progress, new)
        return progress, jnp.all(progress.x == at, axis=1), e, jacobian, gram

    e = jnp.zeros(shape.shape)
    none = (e, jnp.zeros((len(e), p, *e.shape[1:])), jnp.zeros((fits, p, p)))
    progress, _, e, jacobian, gram = jax.lax.while_loop(lasts, once, (begun, jnp.zeros(fits, bool), *none))
    theta = jax.vmap(transform.outward)(progress.x)
    converged = progress.done & jnp.isfinite(progress.cost)
    return Ends(theta, progress.cost, progress.steps, converged, gram, e, jacobian)


def _sums(
    e: Float[Array, "time fits n"], jacobian: Float[Array, "time p fits n"]
) -> tuple[Float[Array, " fits"], Float[Array, "fits p"], Float[Array, "fits p p"]]:
    """Return half the sums of squares, J'e and J'J of all fits.

    On a processor they are added up sample by sample, so that a vector holds fits.
    """
    if accelerator():
        cost, gradient = 0.5 * jnp.einsum("tfn,tfn->f", e, e), jnp.einsum("tpfn,tfn->fp", jacobian, e)
        return cost, gradient, jnp.einsum("tpfn,tqfn->fpq", jacobian, jacobian)
    p = jacobian.shape[1]

    def add(sums: tuple, now: tuple) -> tuple[tuple, None]:
        e, j = now
        cost, gradient, gram = sums
        cost = cost + 0.5 * jnp.sum(e * e, axis=-1)
        gradient = gradient + jnp.sum(j * e, axis=-1)
        return (cost, gradient, gram + jnp.sum(j[:, None] * j[None], axis=-1)), None

    fits = e.shape[1]
    zero = (jnp.zeros(fits), jnp.zeros((p, fits)), jnp.zeros((p, p, fits)))
    (cost, gradient, gram), _ = jax.lax.scan(add, zero, (e, jacobian))
    return cost, gradient.T, jnp.moveaxis(gram, -1, 0)
