"""Algebraic identification: the balance weighted by powers of time and integrated by parts.

Over a window that starts at t0, the balance is multiplied by (t - t0)^n and integrated n times, n
being the order of the highest derivative. Integration by parts turns every linear derivative of the
measurement into integrals of it, and all initial conditions vanish, because the weights are zero at t0. A
derivative of a measurement is taken only for forces that are nonlinear in the velocity (a sign, v |v|).

The coefficients of acceleration and velocity are derivatives of the plant's balance, which is stated
nowhere else.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.dynamics.residuals import drive_ratio, integrate_internal_states
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.estimators.common.windowed import Kernels, weighed, weights_steps
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.simulation.force_balance import ForceData, sharpened

# Length of a window in periods of the band edge; windows overlap by half. Shorter ones hold too little motion
# to separate inertia from friction, longer ones too much drift of the noise.
_WINDOW_PERIODS = 20
# Largest fraction of a window for which the axis may rest.
_LARGEST_REST = 0.05


def iterated_integral(x: Float[Array, "time k"], period: float, times: int) -> Float[Array, "time k"]:
    """Integrate several times from the first sample on, to fourth order.

    Each interval is integrated under the cubic through its four nearest samples.

    Args:
        x: Samples of the functions, (time, k).
        period: Sampling time [s].
        times: Number of integrations.
    """
    for _ in range(times):
        middle = (-x[:-3] + 13 * x[1:-2] + 13 * x[2:-1] - x[3:]) / 24
        first = (9 * x[0] + 19 * x[1] - 5 * x[2] + x[3]) / 24
        last = (x[-4] - 5 * x[-3] + 19 * x[-2] + 9 * x[-1]) / 24
        parts = jnp.concatenate([jnp.zeros_like(first)[None], first[None], middle, last[None]])
        x = period * jnp.cumsum(parts, axis=0)
    return x


def second_by_parts(t: Array, x: Array, moment: Array, twofold: Array) -> Array:
    """Return the double integral of t^2 x'' from x, the integral of t x and the double integral of x."""
    return t**2 * x - 4 * moment + 2 * twofold


def first_by_parts(moment: Array, twofold: Array) -> Array:
    """Return the double integral of t^2 x' from the integral of t^2 x and the double integral of t x."""
    return moment - 2 * twofold


def weak_motion(q: Float[Array, "time n"], period: float) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compute the double integrals of t^2 q'' and t^2 q' over a window by parts.

    Args:
        q: Measured positions, (time, n) [m or rad].
        period: Sampling time [s].

    Returns:
        Both integrals up to the window's end, (n,) each.

    Source:
        By parts: int int t^2 q'' = t^2 q - 4 int t q + 2 int int q, and
        int int t^2 q' = int t^2 q - 2 int int t q.
    """
    t = (period * jnp.arange(q.shape[0]))[:, None]

    def once(x: Array) -> Array:
        return iterated_integral(x, period, 1)

    acceleration = second_by_parts(t, q, once(t * q), once(once(q)))
    return acceleration[-1], first_by_parts(once(t**2 * q), once(once(t * q)))[-1]


@eqx.filter_jit
def weak_residual(
    plant: Plant, data: ForceData, raw: Float[Array, "time n"], length: int
) -> Float[Array, "window n"]:
    """Compute the balance of each window, times (t - t0)^2 and integrated twice up to the window's end.

    The balance is M a + C v + rest, with M and C constant over a window. The terms linear in a and v are
    computed from the measured position by parts. The rest is evaluated at the measured position and the
    filtered velocity. C is the mean slope at plus and minus a high velocity; any constant would do, because
    its error is part of the rest.

    Args:
        plant: The plant.
        data: The filtered log.
        raw: Measured positions, (time, n) [m or rad].
        length: Number of samples in a window; windows overlap by half.

    Returns:
        One row per window, over t^4 / 12: a weighted mean of the residual force, (window, n) [N or N m].
    """
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    states = integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)
    times = data.start + data.period * jnp.arange(raw.shape[0])
    fast = jnp.abs(data.qd).max(axis=0)

    def split(q: Array, v: Array, u: Array, t: Array, states: tuple) -> tuple[Array, ...]:
        def residual(v: Array, a: Array) -> Array:
            return plant.balance(q, v, a, u, t, states).residual

        zero = jnp.zeros_like(v)
        mass = jax.jacfwd(residual, argnums=1)(v, zero)
        slope = jax.jacfwd(residual)
        damping = 0.5 * (slope(fast, zero) + slope(-fast, zero))
        drive = plant.balance(q, v, zero, u, t, states).drive
        return mass, damping, residual(v, zero) - damping @ v, drive

    mass, damping, rest, drive = jax.vmap(split)(raw, data.qd, u, times, states)

    def window(start: Array) -> Array:
        def cut(x: Array) -> Array:
            return jax.lax.dynamic_slice_in_dim(x, start, length)

        t = (data.period * jnp.arange(length))[:, None]
        acceleration, velocity = weak_motion(cut(raw), data.period)
        force = iterated_integral(t**2 * cut(rest), data.period, 2)[-1]
        return cut(mass)[0] @ acceleration + cut(damping)[0] @ velocity + force

    starts = jnp.arange(0, raw.shape[0] - length + 1, length // 2)
    span = data.period * (length - 1)
    return jax.vmap(window)(starts) * 12 / span**4 / drive_ratio(plant, drive, u, raw.shape[1])


@eqx.filter_jit
def _solve(
    plant: Plant,
    places: tuple,
    data: ForceData,
    raw: Array,
    length: int,
    weight: Array,
    theta: Array,
    transform: Transform,
    damping: float,
    bounds: tuple[Array, Array],
) -> Minimum:
    def residual(theta: Array) -> Array:
        return weight * weak_residual(scatter(places, plant, theta), data, raw, length)

    return levenberg_marquardt(residual, theta, transform, *bounds, damping=damping)


@eqx.filter_jit
def windows_and_columns(
    plant: Plant, places: tuple, data: ForceData, raw: Array, length: int, theta: Float[Array, " p"]
) -> tuple[Float[Array, "window n"], Float[Array, "window n p"]]:
    """Return the residual of each window, see `weak_residual`, and its Jacobian."""

    def residual(theta: Array) -> tuple[Array, Array]:
        e = weak_residual(scatter(places, plant, theta), data, raw, length)
        return e, e

    jacobian, e = jax.jacfwd(residual, has_aux=True)(theta)
    return e, jacobian


def windows_without_rest(
    machine: Machine, log: Log, data: Prepared
) -> tuple[int, Bool[np.ndarray, "window n"]]:
    """Return the samples of a window, and the mask of the windows in which a joint hardly rests.

    Raises:
        InputError: If too few windows remain.
    """
    cutoff = data.recipe.motion_hz(log.rate_hz)
    length = int(min(_WINDOW_PERIODS / (cutoff * log.period), log.samples / 8))
    starts = np.arange(0, log.samples - length + 1, length // 2)

    # Windows with a rest do not count.
    slow = np.abs(data.qd) < np.asarray(data.recipe.rest_velocity)
    rests = np.stack([slow[k : k + length].mean(axis=0) for k in starts])
    rows = rests < _LARGEST_REST
    if rows.sum() < 2 * len(machine.parameters.free):
        raise InputError(
            f"only {int(rows.sum())} windows of {length * log.period:.3g} s are without a rest",
            where=log.source,
            hint="take a log with longer motion, or use inverse_dynamics",
        )
    return length, rows


def kernels_of(length: int, rows: Bool[np.ndarray, "window n"], period: float) -> Kernels:
    """Return the weights of a force in the rows that count, see `weak_residual`.

    The double integral of t^2 f up to the end T of a window is that of (T - t) t^2 f.

    Args:
        length: Number of samples in a window.
        rows: Mask of the rows that count.
        period: Sampling time [s].
    """
    t = period * np.arange(length)
    weight = (t[-1] - t) * t**2 * period * 12 / t[-1] ** 4
    window, joint = np.nonzero(rows)
    values = np.zeros((len(window), rows.shape[1], length))
    values[np.arange(len(window)), joint] = weight
    return Kernels(values, window * (length // 2))


def algebraic(machine: Machine, log: Log, data: Prepared) -> Estimate:
    """Fit the unknowns to windows of iterated integrals by least squares.

    Args:
        machine: The machine whose unknowns are estimated.
        log: The log, whose measured positions are integrated without a filter.
        data: The filtered log: its velocity is used for forces that are nonlinear in it.

    Returns:
        The estimate. Windows in which the axis rests for more than a twentieth of the time are omitted: the
        force that holds a stuck axis is not in the balance.

    Raises:
        InputError: If too few windows remain.
    """
    return run_alone(algebraic_steps(machine, log, data))


def algebraic_steps(machine: Machine, log: Log, data: Prepared) -> Steps[Estimate]:
    """Estimate like `algebraic`, one solve request at a time."""
    plant, arrays = sharpened(machine.plant, data), ForceData.of(data)
    length, rows = windows_without_rest(machine, log, data)
    parameters = machine.parameters
    options = (*linear_scale(machine), parameters.bounds)

    def solved(weight: np.ndarray, theta: Array) -> SolveRequest:
        problem = (plant, parameters.places, arrays, log.position, length, weight, theta)
        return SolveRequest(_solve, (*problem, *options))

    fit = yield solved(rows.astype(float), parameters.guess)
    force = float(np.sqrt(np.mean((data.force - data.force.mean(axis=0)) ** 2)))
    kernels = kernels_of(length, rows, data.period)
    weight, covariance = yield from weights_steps(machine, log, data, kernels, fit, rows, force)
    fit = yield solved(weight, fit.theta)
    theta, e, precision = weighed(machine, fit, rows, weight, covariance, force)

    converged = bool(fit.converged)
    return Estimate(
        method="algebraic",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else f"no convergence within {int(fit.steps)} steps",
        residual=np.where(rows, e, np.nan),
        samples=int(rows.sum()),
        steps=int(fit.steps),
        notes=(f"{int(rows.sum())} windows of {length * log.period:.3g} s, half overlapping",),
    )
