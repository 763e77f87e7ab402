"""The same axis by scipy and by diffrax: what one would otherwise call."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate
import scipy.optimize
from axis_loops import ideal_forward, rk4_forward
from numba import njit

from jaxid.plants import Axis
from jaxid.simulation import with_diffrax


def lm_fit(loop_name: str, reference: np.ndarray, measured: np.ndarray, loop: tuple, start):
    """scipy's Levenberg-Marquardt, finite differences through a numba loop."""
    forward = {"smooth": rk4_forward, "ideal": ideal_forward}[loop_name]
    out = np.empty(len(reference))

    def residual(theta: np.ndarray) -> np.ndarray:
        forward(tuple(theta), reference, loop, (0.0, 0.0), out)
        return measured - out

    return scipy.optimize.least_squares(residual, start, method="lm", x_scale="jac")


@njit
def _rates(t, x, theta, force, period, width):
    m, c, f, f0 = theta
    u = force[min(int(t / period), len(force) - 1)]
    return np.array([x[1], (u - c * x[1] - f * np.tanh(x[1] / width) + f0) / m])


def solve_ivp(
    theta: tuple, force: np.ndarray, period: float, width: float, atol: float
) -> np.ndarray:
    """RK45 at rtol 1e-6 under the held force that the loop gave; the right-hand side by numba."""
    times = period * np.arange(len(force))
    solution = scipy.integrate.solve_ivp(
        _rates, (0.0, times[-1]), [0.0, 0.0], "RK45", t_eval=times, rtol=1e-6, atol=atol,
        args=(theta, force, period, width),
    )
    return solution.y[0]


@eqx.filter_jit
def tsit5(base: Axis, force: jax.Array, period: float) -> jax.Array:
    """diffrax's Tsit5, one step a sample, under the same force looked up by index."""
    times = period * jnp.arange(force.size)

    def held(t: jax.Array) -> jax.Array:
        return force[jnp.clip((t / period + 1e-6).astype(int), 0, force.size - 1)][None]

    zero = jnp.zeros(1)
    return with_diffrax(base, held, times, zero, zero, step_length=period)[0][:, 0]
