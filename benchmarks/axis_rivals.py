"""The axis of the speed benchmarks by scipy, diffrax and optimistix."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.integrate
import scipy.optimize
from numba import njit

from benchmarks.axis import PLACES, TRANSFORM
from benchmarks.axis_loops import ideal_forward, rk4_forward
from jaxid.model.unknowns import scatter
from jaxid.plants import Axis
from jaxid.simulation.loops import with_diffrax
from jaxid.simulation.replay import Replay


def lm_fit(loop_name: str, reference: np.ndarray, measured: np.ndarray, loop: tuple, start):
    """Fit by scipy's Levenberg-Marquardt, with finite differences through a numba loop.

    Args:
        loop_name: "smooth" or "ideal" friction.
        reference, measured: Positions [m], (time,).
        loop: Known values of the loop; see `benchmarks.axis_loops`.
        start: Parameters at the start, (4,).
    """
    forward = {"smooth": rk4_forward, "ideal": ideal_forward}[loop_name]
    out = np.empty(len(reference))

    def residual(theta: np.ndarray) -> np.ndarray:
        forward(tuple(theta), reference, loop, (0.0, 0.0), out)
        return measured - out

    return scipy.optimize.least_squares(residual, start, method="lm", x_scale="jac")


@njit
def _rates(t, x, theta, force, period, width):
    """Return the rates of position and velocity under a held force, for scipy."""
    m, c, f, f0 = theta
    u = force[min(int(t / period), len(force) - 1)]
    return np.array([x[1], (u - c * x[1] - f * np.tanh(x[1] / width) + f0) / m])


def solve_ivp(theta: tuple, force: np.ndarray, period: float, width: float, atol: float) -> np.ndarray:
    """Simulate the position [m], (time,), by scipy's RK45 at rtol 1e-6, with rates compiled by numba.

    Args:
        theta: Parameters, (4,).
        force: Force of the loop [N], (time,), held from sample to sample.
        period: Time between samples [s].
        width: Width of the smoothed sign [m/s].
        atol: Absolute tolerance of position [m] and velocity [m/s].
    """
    times = period * np.arange(len(force))
    solution = scipy.integrate.solve_ivp(
        _rates,
        (0.0, times[-1]),
        [0.0, 0.0],
        "RK45",
        t_eval=times,
        rtol=1e-6,
        atol=atol,
        args=(theta, force, period, width),
    )
    return solution.y[0]


@eqx.filter_jit
def tsit5(base: Axis, force: jax.Array, period: float) -> jax.Array:
    """Simulate the position [m], (time,), by diffrax's Tsit5, one step a sample, under a held force [N]."""
    times = period * jnp.arange(force.size)

    def held(t: jax.Array) -> jax.Array:
        return force[jnp.clip((t / period + 1e-6).astype(int), 0, force.size - 1)][None]

    zero = jnp.zeros(1)
    return with_diffrax(base, held, times, zero, zero, step_length=period)[0][:, 0]


# Either stops where neither cost nor unknowns move by more than 1e-8 of themselves.
OPTIMISTIX = {
    "LevenbergMarquardt": optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8),
    "Dogleg": optx.Dogleg(rtol=1e-8, atol=1e-8),
}


@eqx.filter_jit
def optimistix_fit(
    solver: optx.AbstractLeastSquaresSolver,
    run: Replay,
    base: Axis,
    start: jax.Array,
    measured: jax.Array,
    scaled: bool,
) -> tuple[jax.Array, jax.Array]:
    """Fit by a solver of optimistix, on the residual of jaxid and from its start.

    The damping of such a solver is the same for all unknowns, so that their scale matters.

    Args:
        solver: The solver.
        run, base: The run, and the plant.
        start: Parameters at the start, (4,).
        measured: Measured position [m], (time,).
        scaled: Whether start and residual are scaled to order one, which a user would do by hand; if not, the
            unknowns have the scale of jaxid's solver.

    Returns:
        The parameters, (4,), and half the sum of squares [m^2].
    """
    unit = jnp.abs(start) if scaled else jnp.ones_like(start)
    inward, outward = (
        (lambda x: x / unit, lambda x: x * unit) if scaled else (TRANSFORM.inward, TRANSFORM.outward)
    )

    def residual(theta: jax.Array) -> jax.Array:
        return measured - run(scatter(PLACES, base, theta)).position[:, 0]

    weight = 1 / jnp.sqrt(jnp.mean(residual(start) ** 2)) if scaled else 1.0
    found = optx.least_squares(
        lambda x, _: weight * residual(outward(x)), solver, inward(start), max_steps=500
    )
    return outward(found.value), 0.5 * jnp.sum(residual(outward(found.value)) ** 2)
