"""Algebraic identification: the balance weighted by powers of time and integrated by parts.

Over a window that starts at t0, the balance is multiplied by (t - t0)^n and integrated n times, n
being the order of the highest derivative. By parts, every derivative of the measurement that
stands linearly turns into plain integrals of it, and every initial condition vanishes, because
all weights are zero at t0. No derivative of a measurement is taken except where the physics is
nonlinear in velocity (a sign, v |v|).

The columns are not written down a second time: the coefficients of acceleration and velocity are
the plant's own balance, differentiated.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.dynamics.residuals import drive_ratio, integrate_internal_states
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.precision import assess
from jaxid.simulation.force_balance import ForceData, sharpened

# Windows: so many periods of the band edge each, half overlapping. Shorter ones hold too little
# motion to tell inertia from friction, longer ones too much of the noise's drift.
_WINDOW_PERIODS = 20
# Part of a window for which the axis may rest.
_LARGEST_REST = 0.05


def iterated_integral(x: Float[Array, "time k"], period: float, times: int) -> Float[Array, "time k"]:
    """Integrate from the first sample on, so many times over.

    Fourth order: each interval is integrated under the cubic through its four nearest samples.
    """
    for _ in range(times):
        middle = (-x[:-3] + 13 * x[1:-2] + 13 * x[2:-1] - x[3:]) / 24
        first = (9 * x[0] + 19 * x[1] - 5 * x[2] + x[3]) / 24
        last = (x[-4] - 5 * x[-3] + 19 * x[-2] + 9 * x[-1]) / 24
        parts = jnp.concatenate([jnp.zeros_like(first)[None], first[None], middle, last[None]])
        x = period * jnp.cumsum(parts, axis=0)
    return x


def second_by_parts(t: Array, x: Array, moment: Array, twofold: Array) -> Array:
    """Double integral of t^2 x'' from x, the integral of t x and the double integral of x."""
    return t**2 * x - 4 * moment + 2 * twofold


def first_by_parts(moment: Array, twofold: Array) -> Array:
    """Double integral of t^2 x' from the integral of t^2 x and the double integral of t x."""
    return moment - 2 * twofold


def weak_motion(q: Float[Array, "time n"], period: float) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Double integrals of t^2 q'' and t^2 q' over a window, derivatives taken by parts.

    Returns:
        Both integrals up to the window's end.

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
    """Balance of each window, times (t - t0)^2 and integrated twice up to the window's end.

    The balance is M a + C v + rest, M and C constant over a window. What is linear in a and v is
    taken from the measured position by parts; the rest sees the measured position and, where it
    depends on velocity, the filtered one. C is the mean slope at plus and minus a high velocity:
    any constant would do, since what it misses stays in the rest.

    Args:
        plant: The plant.
        data: The log, prepared.
        raw: Measured positions, (time, n).
        length: Samples of a window; windows overlap by half.

    Returns:
        One row a window, over t^4 / 12: a weighted mean of the residual force [N or N m].
    """
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    own = integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)
    times = data.start + data.period * jnp.arange(raw.shape[0])
    fast = jnp.abs(data.qd).max(axis=0)

    def split(q: Array, v: Array, u: Array, t: Array, own: tuple) -> tuple[Array, ...]:
        def residual(v: Array, a: Array) -> Array:
            return plant.balance(q, v, a, u, t, own).residual

        zero = jnp.zeros_like(v)
        mass = jax.jacfwd(residual, argnums=1)(v, zero)
        slope = jax.jacfwd(residual)
        damping = 0.5 * (slope(fast, zero) + slope(-fast, zero))
        drive = plant.balance(q, v, zero, u, t, own).drive
        return mass, damping, residual(v, zero) - damping @ v, drive

    mass, damping, rest, drive = jax.vmap(split)(raw, data.qd, u, times, own)

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


def algebraic(machine: Machine, log: Log, data: Prepared) -> Estimate:
    """Fit the unknowns to windows of iterated integrals by least squares.

    Args:
        machine: The machine.
        log: The log: its measured positions are integrated as they are.
        data: The same, prepared: filtered velocity for what is nonlinear in it.

    Returns:
        The estimate. Windows of which the axis rests for more than a twentieth are left out: the
        force of a stuck axis is not in the balance.

    Raises:
        InputError: If too few windows are left.
    """
    return run_alone(algebraic_steps(machine, log, data))


def algebraic_steps(machine: Machine, log: Log, data: Prepared) -> Steps[Estimate]:
    """`algebraic`, as what is to be solved."""
    plant, arrays = sharpened(machine.plant, data), ForceData.of(data)
    cutoff = data.recipe.motion_hz(log.rate_hz)
    length = int(min(_WINDOW_PERIODS / (cutoff * log.period), log.samples / 8))
    starts = np.arange(0, log.samples - length + 1, length // 2)
    slow = np.abs(data.qd) < np.asarray(data.recipe.rest_velocity)
    rests = np.stack([slow[k : k + length].mean(axis=0) for k in starts])
    rows = rests < _LARGEST_REST
    parameters = machine.parameters
    if rows.sum() < 2 * len(parameters.free):
        raise InputError(
            f"only {int(rows.sum())} windows of {length * log.period:.3g} s hold no rest",
            where=log.source,
            hint="take a log with longer motion, or use inverse_dynamics",
        )
    fit = yield SolveRequest(
        _solve,
        (
            plant,
            parameters.places,
            arrays,
            log.position,
            length,
            np.asarray(rows, dtype=float),
            parameters.guess,
            *linear_scale(machine),
            parameters.bounds,
        ),
    )
    theta, e = np.asarray(fit.theta), np.asarray(fit.residual).reshape(rows.shape)
    jacobian = np.asarray(fit.jacobian).reshape(*rows.shape, -1)
    force = float(np.sqrt(np.mean((data.force - data.force.mean(axis=0)) ** 2)))
    precision = assess(
        parameters.names,
        jacobian,
        e,
        rows,
        force * np.sqrt(rows.sum()),
        np.where(theta != 0, theta, 1.0),
    )
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
