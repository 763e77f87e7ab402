"""Levenberg-Marquardt within bounds as one compiled function, and the scale of its unknowns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, PyTree, Scalar

from jaxid.arms.pseudo_inertia import log_cholesky, of_log_cholesky
from jaxid.arrays import Array, library
from jaxid.estimators.common.interior import inner_start
from jaxid.model.unknowns import Parameters
from jaxid.numerics.bounds import presses

# Damping at the start, relative to the diagonal of the normal matrix.
DAMPING = 1e-4
# A fit has converged if the cost can fall by no more than this part of itself: with 10^4 samples that is
# 10^-4 of a standard deviation.
_TOLERANCE = 1e-12
# It has also converged if a step fails to lower the cost and its predicted fall is at most _FLAT, with 10^4
# samples a hundredth of a standard deviation: sticking and rounding make the last digits of a cost rough.
# Only a step with a damping below _WHOLE counts, because the predicted fall of a short step is always small.
_FLAT = 1e-8
_WHOLE = 1e-2
# Fits of bodies may take more evaluations and have a looser tolerance: their unidentifiable coordinates move
# far along curves.
BODY_STEPS = 500
BODY_TOLERANCE = 1e-9
# It has also converged if the cost exceeds a known lower bound by no more than this part of itself, divided
# by the number of residuals: also a hundredth of a standard deviation. If the steps have run out, the fall
# that the whole step predicts must be as small.
_SURE = 1e-4
# It has also converged if a step fails to lower the cost with a damping above _STUCK and a predicted fall of
# at most _ROUGH, with 10^4 samples a tenth of a standard deviation.
_ROUGH = 1e-6
_STUCK = 1e3
# An unknown whose size changes the residual by less than this part of the first residual has no effect: its
# column contains rounding, and a division by it would send the unknown to 1e15.
_NOTHING = 1e-12


class Transform(eqx.Module):
    """Map from physical values to the scale of the solver and back.

    Positive unknowns are fitted as their logarithms (in the force domain only those in which the balance is
    nonlinear), the ten parameters of a body as its `log_cholesky`, and other unknowns without a transform.
    The solver itself scales the unknowns to order one, by the columns of the Jacobian.

    Args:
        log: Mask of the unknowns that are fitted as their logarithms, (p,).
        lower, upper: Bounds on the coordinates of the bodies, (bodies, 10).
        bodies: Places of the ten parameters of each body.
        affine: Whether the residual is known to be affine in the physical values.
    """

    log: Bool[Array, " p"]
    lower: Float[Array, "bodies 10"] = eqx.field(default_factory=lambda: np.zeros((0, 10)))
    upper: Float[Array, "bodies 10"] = eqx.field(default_factory=lambda: np.zeros((0, 10)))
    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True, default=())
    affine: bool = eqx.field(static=True, default=False)

    @classmethod
    def of(cls, parameters: Parameters) -> Transform:
        """Return the transform of a set of unknowns."""
        log = np.asarray([f.sign == "positive" for f in parameters.free], dtype=bool)
        bodies = parameters.bodies
        lower, upper = (np.array([getattr(b, s) for b in bodies]).reshape(-1, 10) for s in ("lower", "upper"))
        return cls(log, lower, upper, tuple(b.places for b in bodies))

    def inward(self, theta: Float[Array, " p"]) -> Float[Array, " p"]:
        """Transform physical values to the solver's scale."""
        xp = library(self.log, theta)
        # A bound of zero has no logarithm, which is meant; JAX does not warn of it either.
        with np.errstate(divide="ignore"):
            logs = xp.log(xp.where(self.log, theta, 1.0))
        return self._with_bodies(xp.where(self.log, logs, theta), log_cholesky, theta)

    def outward(self, x: Float[Array, " p"]) -> Float[Array, " p"]:
        """Transform values on the solver's scale to physical values."""
        xp = library(self.log, x)
        with np.errstate(over="ignore"):
            values = xp.exp(xp.where(self.log, x, 0.0))
        return self._with_bodies(xp.where(self.log, values, x), of_log_cholesky, x)

    def bounds(self, lower: Float[Array, " p"], upper: Float[Array, " p"]) -> tuple[Array, Array]:
        """Transform bounds on the physical values to the solver's scale; bodies have separate bounds."""
        plain = Transform(self.log)
        out = []
        for bound, coordinates in ((lower, self.lower), (upper, self.upper)):
            bound = plain.inward(bound)
            for places, values in zip(self.bodies, coordinates, strict=True):
                bound = jnp.asarray(bound).at[np.array(places)].set(values)
            out.append(bound)
        return out[0], out[1]

    def physical(self, jacobian: Float[Array, "rows p"], theta: Float[Array, " p"]) -> Array:
        """Convert a Jacobian by the solver's values to one by the physical values theta."""
        out = jacobian / self.slope(theta)
        for places in map(np.array, self.bodies):
            out = (
                jnp.asarray(out)
                .at[:, places]
                .set(jacobian[:, places] @ jax.jacfwd(log_cholesky)(theta[places]))
            )
        return out

    def inner(self, jacobian: Float[Array, "rows p"], theta: Float[Array, " p"]) -> Array:
        """Convert a Jacobian by the physical values theta to one by the solver's values."""
        out = jacobian * self.slope(theta)
        for places in map(np.array, self.bodies):
            turned = jacobian[:, places] @ _slope_of_body(theta[places])
            out = jnp.asarray(out).at[:, places].set(turned)
        return out

    def _with_bodies(self, out: Array, f: Callable[[Array], Array], values: Array) -> Array:
        for places in map(np.array, self.bodies):
            out = jnp.asarray(out).at[places].set(f(values[places]))
        return out

    def slope(self, theta: Float[Array, " p"]) -> Float[Array, " p"]:
        """Return the derivative of physical by solver values, (p,), for unknowns that belong to no body."""
        return library(self.log, theta).where(self.log, theta, 1.0)


@jax.jit
def _slope_of_body(ten: Float[Array, " 10"]) -> Float[Array, "10 10"]:
    """Return the derivative of a body's parameters by its `log_cholesky`."""
    return jax.jacfwd(of_log_cholesky)(log_cholesky(ten))


class Minimum(eqx.Module):
    """Result of the solver.

    Args:
        theta: Physical values at the minimum, (p,).
        cost: Half the sum of squares.
        steps: Number of evaluations of residual and Jacobian.
        converged: Whether the cost cannot fall further.
        residual: Residual at theta, flat; empty if it is not kept.
        jacobian: Jacobian of the residual by the physical values, (rows, p); empty if it is not kept.
        failure: Index of the reason why a solver of optimistix did not converge, see
            `jaxid.estimators.common.minimise`; None for jaxid's solver.
    """

    theta: Float[Array, " p"]
    cost: Float[Array, ""]
    steps: Array
    converged: Array
    residual: Array
    jacobian: Array
    failure: Array | None = None


class Progress(eqx.Module):
    """The state of a descent on the solver's scale; an interrupted descent continues to the same bits.

    Args:
        trial: Point to evaluate next.
        predicted: Predicted fall of the cost at the trial point.
        x, cost, gradient, normal: Best point, and the quadratic model of the cost at that point.
        kept: Residual and Jacobian at the best point; empty if they are not kept.
        damping, growth: Damping of the next step, and its factor after a refused one.
        scale: Sizes of the unknowns at the start.
        nothing: 2-norm of a change of the residual that counts as none.
        steps: Evaluations so far.
        done: Whether the cost can fall no further, or is not finite.
        aux: Auxiliary output of the residual at the best point; None if it has none.
    """

    trial: Array
    predicted: Array
    x: Array
    cost: Array
    gradient: Array
    normal: Array
    kept: tuple[Array, Array]
    damping: Array
    growth: Array
    scale: Array
    nothing: Array
    steps: Array
    done: Array
    aux: Any = None

    @classmethod
    def at(cls, x: Array, scale: Array, size: int, damping: Array | float = DAMPING) -> Progress:
        """Return the state at a start; `size` is the length of the kept residual, zero to keep none.

        The arrays are numpy's if x is one, because JAX's take longer to create outside of compiled code.
        """
        p, xp = x.size, np if isinstance(x, np.ndarray) else jnp
        return cls(
            trial=x,
            predicted=xp.asarray(0.0),
            x=x,
            cost=xp.asarray(np.inf),
            gradient=xp.zeros(p),
            normal=xp.zeros((p, p)),
            kept=(xp.zeros(size), xp.zeros((size, p))),
            damping=xp.asarray(damping),
            growth=xp.asarray(2.0),
            scale=scale,
            nothing=xp.asarray(0.0),
            steps=xp.asarray(0),
            done=xp.asarray(False),
        )

    def minimum(self, transform: Transform) -> Minimum:
        """Return the best point as a result."""
        theta = transform.outward(self.x)
        return Minimum(
            theta,
            self.cost,
            self.steps,
            self.done & jnp.isfinite(self.cost),
            self.kept[0],
            transform.physical(self.kept[1], theta),
        )


def levenberg_marquardt(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]],
    theta: Float[Array, " p"],
    transform: Transform,
    lower: Float[Array, " p"],
    upper: Float[Array, " p"],
    active: Bool[Array, " p"] | None = None,
    max_steps: int | None = None,
    keep: bool = True,
    damping: float = DAMPING,
    tolerance: float = _TOLERANCE,
) -> Minimum:
    """Minimise half the sum of squares of `residual` within bounds.

    It uses the forward-mode Jacobian, Marquardt's scaling and Nielsen's damping. Steps are projected on the
    bounds, and unknowns that press against a bound rest. The compiled function contains a single copy of the
    residual's Jacobian, since a second copy doubles the compile time; vmap it over starts or data.

    Args:
        residual: Residual as a function of the physical unknowns; entries that do not count are zero.
        theta: Physical values at the start.
        transform: Scale of the solver.
        lower, upper: Bounds on the physical values.
        active: Mask of the unknowns that may move, (p,); None: all.
        max_steps: Largest number of evaluations; None: 60, or 500 with bodies.
        keep: Whether to return residual and Jacobian; batches without them need less memory.
        damping: Damping at the start, relative to the diagonal; a linear problem needs none.
        tolerance: The fit has converged if the cost can fall by no more than this part of itself.

    Returns:
        The minimum; `converged` is false if the steps ran out or the residual is not finite.

    Source:
        Marquardt (1963); damping after Nielsen (1999), IMM-REP-1999-05.
    """
    if theta.size == 0:  # nothing is unknown: only the residual is asked for
        e = residual(theta).ravel()
        cost, kept = 0.5 * e @ e, e if keep else e[:0]
        return Minimum(
            theta,
            cost,
            jnp.asarray(1),
            jnp.isfinite(cost),
            kept,
            jnp.zeros((kept.size, 0)),
        )

    # With jit the residual is traced once for both its shape and its Jacobian.
    residual, floor = jax.jit(residual), -jnp.inf
    if transform.affine:
        columns = jax.jacfwd(residual)(theta).reshape(-1, theta.size)
        rest = residual(theta).ravel() - columns @ theta
        residual = lambda theta: columns @ theta + rest
        theta, floor = inner_start(columns, rest, theta, transform.bodies, eliminated)
    if transform.bodies:
        tolerance = max(tolerance, BODY_TOLERANCE)
    max_steps = max_steps or (BODY_STEPS if transform.bodies else 60)

    bounds = transform.bounds(jnp.asarray(lower), jnp.asarray(upper))
    x0 = jnp.clip(transform.inward(theta), *bounds)
    scale = jnp.where(transform.log | (x0 == 0), 1.0, jnp.abs(x0))
    on_scale = lambda x: residual(transform.outward(x))
    solver = BoundedLevenbergMarquardt(rtol=tolerance, damping=damping, keep=keep)
    options = {"lower": bounds[0], "upper": bounds[1], "active": active, "floor": floor, "scale": scale}
    solution = optx.least_squares(
        lambda x, args: on_scale(x), solver, x0, options=options, max_steps=max_steps, throw=False
    )

    # The value equals that of the state, but only the value carries the implicit derivatives.
    minimum = replace(solution.state, x=solution.value).minimum(transform)
    moves = jnp.ones(x0.size, bool) if active is None else jnp.asarray(active)
    size = jax.eval_shape(residual, theta).size
    return replace(minimum, converged=minimum.converged | _at_minimum(solution.state, size, bounds, moves))


def descend(
    residual: Callable[[Float[Array, " p"]], Float[Array, "..."]],
    progress: Progress,
    bounds: tuple[Float[Array, " p"], Float[Array, " p"]],
    max_steps: Array | int,
    active: Bool[Array, " p"] | None = None,
    tolerance: Array | float = _TOLERANCE,
    floor: Array | float = -np.inf,
) -> Progress:
    """Continue a descent; it works like `levenberg_marquardt`, but on the solver's scale.

    Args:
        residual: Residual as a function of the solver's unknowns.
        progress: State of the descent.
        bounds: Lower and upper bounds on the solver's unknowns.
        max_steps: Total number of evaluations, including earlier ones, at which to stop.
        active, tolerance: Options of `levenberg_marquardt`.
        floor: Lower bound of the cost; a descent close to it has also converged.
    """
    solver = BoundedLevenbergMarquardt(rtol=tolerance)
    options = {"lower": bounds[0], "upper": bounds[1], "active": active, "floor": floor}
    fn = lambda x, args: (residual(x), None)

    def advance(p: Progress) -> Progress:
        return solver.step(fn, p.x, None, options, p, frozenset())[1]

    return jax.lax.while_loop(lambda p: ~p.done & (p.steps < max_steps), advance, progress)


class BoundedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt within bounds, as a solver of `optimistix.least_squares`.

    It uses Marquardt's scaling and Nielsen's damping. Steps are projected on the bounds, and unknowns that
    press against a bound rest. Each step evaluates the residual and its forward-mode Jacobian once.

    Supports the following `options` of `optimistix.least_squares`, each optional:

    - `lower`, `upper`: bounds, trees like the unknowns.
    - `active`: which unknowns may move, a tree of booleans like the unknowns.
    - `scale`: sizes of the unknowns, a tree like them; an unknown whose size moves the residual by less than
      1e-12 of its first norm rests. Default: the absolute values at the start, one for zeros.
    - `floor`: a value below which the cost is known not to fall.

    Args:
        rtol: The solve ends if half the sum of squares can fall by no more than this part of itself.
        atol: The solve also ends if that can fall by no more than this.
        damping: Damping of the first step, relative to the diagonal of the normal matrix.
        keep: Whether the state holds residual and Jacobian at the best point, which needs more memory.
        norm: Required by optimistix and not used: the cost alone decides.

    Source:
        Marquardt (1963); damping after Nielsen (1999), IMM-REP-1999-05.
    """

    rtol: float | Array = _TOLERANCE
    atol: float | Array = 0.0
    damping: float | Array = DAMPING
    keep: bool = eqx.field(static=True, default=True)
    norm: Callable[[PyTree], Scalar] = eqx.field(static=True, default=optx.max_norm)

    def init(
        self,
        fn: Callable[[PyTree, Any], tuple[PyTree, Any]],
        y: PyTree,
        args: Any,
        options: dict[str, Any],
        f_struct: PyTree[jax.ShapeDtypeStruct],
        aux_struct: PyTree[jax.ShapeDtypeStruct],
        tags: frozenset[object],
    ) -> Progress:
        x = jnp.clip(ravel_pytree(y)[0], *_bounds_of(options, y))
        scale = options.get("scale")
        scale = jnp.where(x == 0, 1.0, jnp.abs(x)) if scale is None else ravel_pytree(scale)[0]
        size = sum(f.size for f in jax.tree.leaves(f_struct)) if self.keep else 0
        aux = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), aux_struct)
        return replace(Progress.at(x, scale, size, self.damping), aux=aux)

    def step(
        self,
        fn: Callable[[PyTree, Any], tuple[PyTree, Any]],
        y: PyTree,
        args: Any,
        options: dict[str, Any],
        state: Progress,
        tags: frozenset[object],
    ) -> tuple[PyTree, Progress, Any]:
        unravel = ravel_pytree(y)[1]
        active = options.get("active")
        moves = jnp.ones(state.x.size, bool) if active is None else jnp.asarray(ravel_pytree(active)[0])

        def flat(x: Array) -> tuple[Array, tuple[Array, Any]]:
            out, aux = fn(unravel(jnp.asarray(x)), args)
            e = ravel_pytree(out)[0]
            return e, (e, aux)

        jacobian, (e, aux) = jax.jacfwd(flat, has_aux=True)(state.trial)
        tolerances = (self.rtol, self.atol, options.get("floor", -np.inf))
        state = _advanced(state, e, aux, jacobian, _bounds_of(options, y), moves, *tolerances)
        return unravel(jnp.asarray(state.x)), state, state.aux

    def terminate(
        self,
        fn: Callable[[PyTree, Any], tuple[PyTree, Any]],
        y: PyTree,
        args: Any,
        options: dict[str, Any],
        state: Progress,
        tags: frozenset[object],
    ) -> tuple[Bool[jax.Array, ""], optx.RESULTS]:
        lost = state.done & ~jnp.isfinite(state.cost)
        result = optx.RESULTS.where(lost, optx.RESULTS.nonfinite, optx.RESULTS.successful)
        return jnp.asarray(state.done), result

    def postprocess(
        self,
        fn: Callable[[PyTree, Any], tuple[PyTree, Any]],
        y: PyTree,
        aux: Any,
        args: Any,
        options: dict[str, Any],
        state: Progress,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree, Any, dict[str, Any]]:
        return y, aux, {}


def _bounds_of(options: dict[str, Any], y: PyTree) -> tuple[Array | float, Array | float]:
    """Return the bounds of a solve, flat; infinite if none are given."""
    lower, upper = options.get("lower"), options.get("upper")
    return (
        -np.inf if lower is None else ravel_pytree(lower)[0],
        np.inf if upper is None else ravel_pytree(upper)[0],
    )


def _advanced(
    p: Progress,
    e: Array,
    aux: Any,
    jacobian: Array,
    bounds: tuple[Array | float, Array | float],
    moves: Bool[Array, " p"],
    rtol: Array | float,
    atol: Array | float,
    floor: Array | float,
) -> Progress:
    """Accept or reject the trial point from its residual and Jacobian, and choose the next one."""
    kept = (e, jacobian) if p.kept[0].size > 0 else p.kept
    model = (0.5 * e @ e, jacobian.T @ e, jacobian.T @ jacobian)
    return advanced_by_model(p, model, kept, e.size, bounds, moves, rtol, atol, floor, aux)


def advanced_by_model(
    p: Progress,
    model: tuple[Array, Array, Array],
    kept: tuple[Array, Array],
    size: int,
    bounds: tuple[Array | float, Array | float],
    moves: Bool[Array, " p"],
    rtol: Array | float = _TOLERANCE,
    atol: Array | float = 0.0,
    floor: Array | float = -np.inf,
    aux: Any = None,
) -> Progress:
    """Accept or reject the trial point from the quadratic model of the cost there, and choose the next one.

    Args:
        p: The descent, whose trial point was evaluated.
        model: Cost, gradient (p,) and normal matrix (p, p) at the trial point, on the solver's scale.
        kept: Residual and Jacobian at the trial point; empty if they are not kept.
        size: Number of residuals.
        bounds: Lower and upper bounds on the solver's scale.
        moves: Mask of the unknowns that may move, (p,).
        rtol, atol: The descent has converged if the cost can fall by at most rtol times itself plus atol.
        floor: Known lower bound of the cost.
        aux: Auxiliary output of the residual at the trial point.
    """
    lower, upper = bounds
    cost = model[0]
    first = p.steps == 0
    better = first | (cost < p.cost)
    ratio = (p.cost - cost) / jnp.maximum(p.predicted, 1e-300)
    shrink = jnp.where(first, 1.0, jnp.maximum(1 / 3, 1 - (2 * ratio - 1) ** 3))
    damping = jnp.clip(p.damping * jnp.where(better, shrink, p.growth), 1e-15, 1e20)

    x, cost, gradient, normal, kept, aux = jax.tree.map(
        lambda new, old: jnp.where(better, new, old),
        (p.trial, *model, kept, aux),
        (p.x, p.cost, p.gradient, p.normal, p.kept, p.aux),
    )

    nothing = jnp.where(first, _NOTHING * jnp.sqrt(2.0 * model[0]), p.nothing)
    # Checked at every step: a velocity has no effect while its friction level is zero, and one later.
    moves = moves & (p.scale * jnp.sqrt(jnp.diag(normal)) > nothing)
    pressed = presses(x, gradient, lower, upper)
    aim = x + _step(gradient, normal, damping, moves & ~pressed)
    trial = jnp.clip(aim, lower, upper)
    # The prediction is for the actual step, which a bound may shorten.
    change = trial - x
    predicted = -change @ gradient - 0.5 * change @ normal @ change
    # A step that a bound shortened does not show convergence: its unknown only rests from now on.
    small = (predicted <= rtol * cost + atol) & jnp.all(trial == aim)
    # The predicted fall of a step that a bound changed may be negative.
    flat = (p.damping < _WHOLE) & (p.predicted > 0) & (p.predicted <= _FLAT * p.cost)
    rough = ~better & (flat | ((damping > _STUCK) & (p.predicted <= _ROUGH * p.cost)))
    stuck = rough | (~better & (damping > 1e12))
    growth = jnp.where(better, 2.0, 2 * p.growth)
    return Progress(
        trial=trial,
        predicted=predicted,
        x=x,
        cost=cost,
        gradient=gradient,
        normal=normal,
        kept=kept,
        damping=damping,
        growth=growth,
        scale=p.scale,
        nothing=nothing,
        steps=p.steps + 1,
        done=small | stuck | ~jnp.isfinite(cost) | (cost - floor <= _SURE / size * cost),
        aux=aux,
    )


def _at_minimum(p: Progress, size: int, bounds: tuple[Array, Array], moves: Bool[Array, " p"]) -> Array:
    """Check that the whole step from the best point would lower the cost by far less than noise.

    A cost that rounding or sticking makes rough may fall a little at every step until the steps run out.
    """
    lower, upper = bounds
    moves = moves & (p.scale * jnp.sqrt(jnp.diag(p.normal)) > p.nothing)
    pressed = presses(p.x, p.gradient, lower, upper)
    change = _step(p.gradient, p.normal, jnp.asarray(0.0), moves & ~pressed)
    fall = -change @ p.gradient - 0.5 * change @ p.normal @ change
    return jnp.isfinite(p.cost) & (fall >= 0) & (fall <= _SURE / size * p.cost)


def _step(gradient: Array, normal: Array, damping: Array, free: Bool[Array, " p"]) -> Array:
    """Return the damped step of the free unknowns."""
    scale = jnp.sqrt(jnp.where(free, jnp.diag(normal), 0.0))
    scale = jnp.where(scale > 0, scale, 1.0)
    normal = jnp.where(jnp.outer(jnp.asarray(free), jnp.asarray(free)), normal / jnp.outer(scale, scale), 0.0)
    # A small damping keeps unidentifiable directions at rest.
    matrix = normal + jnp.diag(jnp.where(free, damping + 1e-13, 1.0))
    gradient = jnp.where(free, gradient / scale, 0.0)
    return -eliminated(matrix, gradient[:, None])[:, 0] / scale


def eliminated(matrix: Float[Array, "p p"], b: Float[Array, "p k"]) -> Float[Array, "p k"]:
    """Solve by Gauss-Jordan elimination without pivoting, for a positive definite symmetric part.

    It replaces LAPACK: a batch of LAPACK's factorisations waits for threads of the pool on which it runs,
    and two batches at once, as in studies, then wait for each other for ever (jaxlib 0.10.2).
    """

    def eliminate(k: Array, rows: Array) -> Array:
        pivot = rows[k] / rows[k, k]
        rows = rows - rows[:, k, None] * pivot
        return jnp.asarray(rows).at[k].set(pivot)

    rows = jnp.concatenate([matrix, b], axis=1)
    return jax.lax.fori_loop(0, len(b), eliminate, rows)[:, len(b) :]
