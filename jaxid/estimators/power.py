"""Energy balances over windows: no acceleration is needed.

The balance of forces times the velocities is a balance of powers. Its inertial part is the rate
of the kinetic energy, minus half of the power due to the changing mass. Over a window w that opens and
closes smoothly, it is integrated by parts:

    int w qd' M qdd  =  - int w' T  -  int w qd' (dM/dt) qd / 2,      T = qd' M qd / 2,

so that it needs no derivative beyond the velocity. M is the slope of the plant's balance in the
accelerations, and dM/dt the slope of M along the motion. All other forces, including weight and springs,
are multiplied by the velocity and integrated directly. At rest no force does work: the
undetermined friction force is multiplied by zero. Only windows in whose middle a joint with dry friction
stops or turns are excluded.

If no joint's acceleration enters another's balance, each joint has its equation; otherwise
the machine has a single one.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Bool, Float

from jaxid.arms.base_parameters import base_parameters
from jaxid.arrays import Array
from jaxid.dynamics.residuals import drive_ratio, integrate_internal_states
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform, levenberg_marquardt
from jaxid.estimators.common.windowed import Kernels, weighed, weights_steps
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared, lasting
from jaxid.machine import Machine
from jaxid.model.balance import Balance
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.simulation.force_balance import ForceData, sharpened

# Least prominence of a peak of the speed, relative to the RMS speed.
_HILL = 0.5
# Length of a window over the mean length of a peak: four on its rise and four on its fall, half overlapping.
_A_HILL = 0.125
# Least length of a window in periods of the band's edge: shorter windows contain mostly noise.
_SHORTEST = 2.0
# Least number of windows per unknown.
_FEWEST = 2


class PowerData(eqx.Module):
    """A prepared log and its windows.

    Args:
        data: Arrays of the prepared log.
        weight: Weight of each window's equations, (window, k); zero for a window without motion.
        half: Half the length of a window [samples].
        first: Sample at which the first window opens.
    """

    data: ForceData
    weight: Float[Array, "window k"]
    half: int = eqx.field(static=True)
    first: int = eqx.field(static=True)


def power_residual(plant: Plant, windows: PowerData) -> Float[Array, "window k"]:
    """Return the weighted residual of the energy balance in every window [N or N m].

    It has one column per joint if the mass is diagonal, else one for the machine.

    Source:
        Gautier (1997), ICRA: Dynamic identification of robots with power model. Here each window
        opens and closes smoothly, so that the velocity at its ends is not needed.
    """
    kinetic, power = _energies(plant, windows.data)
    half, period = windows.half, windows.data.period
    # The window is evaluated at the middles of samples, so that both halves mirror each other.
    s = (np.arange(half) + 0.5) / half
    up, slope = window(s), window_slope(s) / half
    count = windows.weight.shape[0] + 1
    stretch = slice(windows.first, windows.first + count * half)

    def halves(x: Array) -> Array:
        return x[stretch].reshape(count, half, -1)

    def over(x: Array, by: np.ndarray) -> Array:
        return jnp.einsum("i,hik->hk", by, halves(x))

    # The closing half is the mirror image of the opening half, with the opposite sign of the slope.
    opened = period * over(power, up) - over(kinetic, slope)
    closed = period * over(power, up[::-1]) + over(kinetic, slope[::-1])
    return windows.weight * (opened[:-1] + closed[1:])


def window(s: np.ndarray) -> np.ndarray:
    """Return a smooth window that is one at s = 1 and zero at s = 0 and 2, with a smooth slope.

    It is so smooth that the plain sum over samples is the integral, to fourth order in their distance.
    """
    return np.sin(0.5 * np.pi * s) ** 4


def window_slope(s: np.ndarray) -> np.ndarray:
    """Return the derivative of `window`."""
    return 2 * np.pi * np.sin(0.5 * np.pi * s) ** 3 * np.cos(0.5 * np.pi * s)


def _energies(plant: Plant, data: ForceData) -> tuple[Float[Array, "time k"], Float[Array, "time k"]]:
    """Return the kinetic energy [J], and the power of all other forces minus v' (dM/dt) v / 2 [W].

    Both are in declared units: they are divided by the ratio of the force at the load to the declared one.
    """
    joints = data.q.shape[1]
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    # The accelerations affect only the internal states of effects that use them.
    own = integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)
    times = data.start + data.period * jnp.arange(data.q.shape[0])
    apart = plant.diagonal or joints == 1

    def at(q: Array, v: Array, u: Array, t: Array, own: tuple) -> tuple[Array, ...]:
        zero, one = jnp.zeros_like(q), jnp.ones_like(q)

        def mass(q: Array) -> Array:
            balance = lambda a: plant.balance(q, v, a, u, t, own).residual
            return jax.jvp(balance, (zero,), (one,))[1] if apart else jax.jacfwd(balance)(zero)

        rest = plant.balance(q, v, zero, u, t, own)
        return *jax.jvp(mass, (q,), (v,)), rest.residual, rest.drive

    mass, rate, rest, drive = jax.vmap(at)(data.q, data.qd, u, times, own)
    v = data.qd
    if apart:
        ratio = drive_ratio(plant, drive, u, joints)
        return 0.5 * mass * v**2 / ratio, v * (rest - 0.5 * rate * v) / ratio
    ratio = jnp.sqrt((jnp.sum(drive**2) + 1e-300) / (jnp.sum(u**2) + 1e-300))
    kinetic = 0.5 * jnp.einsum("ti,tij,tj->t", v, mass, v)
    power = jnp.einsum("ti,ti->t", v, rest) - 0.5 * jnp.einsum("ti,tij,tj->t", v, rate, v)
    return kinetic[:, None] / ratio, power[:, None] / ratio


@eqx.filter_jit
def _solve(
    plant: Plant,
    places: tuple,
    windows: PowerData,
    theta: Array,
    transform: Transform,
    bounds: tuple[Array, Array],
    damping: float,
) -> Minimum:
    def residual(theta: Array) -> Array:
        return power_residual(scatter(places, plant, theta), windows)

    return levenberg_marquardt(residual, theta, transform, *bounds, damping=damping)


@eqx.filter_jit
def power_and_columns(
    plant: Plant, places: tuple, windows: PowerData, theta: Float[Array, " p"]
) -> tuple[Float[Array, "window k"], Float[Array, "window k p"]]:
    """Return the weighted residual of the energy balance in every window, and its Jacobian."""

    def residual(theta: Array) -> tuple[Array, Array]:
        e = power_residual(scatter(places, plant, theta), windows)
        return e, e

    jacobian, e = jax.jacfwd(residual, has_aux=True)(theta)
    return e, jacobian


def kernels_of(windows: PowerData) -> Kernels:
    """Return the weights of the forces of all joints in the rows that count, see `power_residual`."""
    data, length, joints = windows.data, 2 * windows.half, windows.data.q.shape[1]
    by_sample = data.period * window((np.arange(length) + 0.5) / windows.half)
    at, column = np.nonzero(windows.weight > 0)
    starts = windows.first + at * windows.half
    weight = np.asarray(windows.weight)[at, column]
    speed = np.asarray(data.qd)[starts[:, None] + np.arange(length)]
    values = weight[:, None, None] * by_sample * np.moveaxis(speed, 1, 2)
    if windows.weight.shape[1] == joints:
        values[column[:, None] != np.arange(joints)] = 0.0
    return Kernels(values, starts)


def power(machine: Machine, data: Prepared, log: Log | None = None) -> Estimate:
    """Fit the unknowns to balances of energy over windows by least squares.

    Args:
        machine: The machine.
        data: The prepared log, of which the filtered velocity is used and not the acceleration.
        log: The log before preparation, for the noise of its readings; None: these count as exact.

    Returns:
        The estimate.

    Raises:
        InputError: If the log is too short for the number of windows that the unknowns need.
    """
    return run_alone(power_steps(machine, data, log))


def power_steps(machine: Machine, data: Prepared, log: Log | None = None) -> Steps[Estimate]:
    """Run `power` as a generator of solve requests."""
    windows, unit = windows_of(machine, data)
    plant, parameters = sharpened(machine.plant, data), machine.parameters
    transform, damping = linear_scale(machine)
    options = (transform, parameters.bounds, damping)

    def solved(windows: PowerData, theta: Array) -> SolveRequest:
        return SolveRequest(_solve, (plant, parameters.places, windows, theta, *options))

    fit = yield solved(windows, parameters.guess)
    rows = np.asarray(windows.weight > 0)
    weight, covariance = yield from weights_steps(machine, log, data, kernels_of(windows), fit, rows, unit)
    fit = yield solved(eqx.tree_at(lambda w: w.weight, windows, windows.weight * weight), fit.theta)
    theta, e, precision = weighed(machine, fit, rows, weight, covariance, unit)

    converged = bool(fit.converged) and bool(np.all(np.isfinite(theta)))
    length = 2 * windows.half * data.period
    return Estimate(
        method="power",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else f"no convergence within {int(fit.steps)} steps",
        residual=np.where(rows, e, np.nan),
        samples=int(rows.sum()),
        steps=int(fit.steps),
        notes=(f"{int(rows.sum())} windows of {length:.3g} s, half overlapping: four on a rise of speed",),
    )


def windows_of(machine: Machine, data: Prepared) -> tuple[PowerData, float]:
    """Return the windows over a log, and the RMS force of its drives [N or N m].

    The energy of a window is divided by the root of the product of its integrals of w^2 and (w qd)^2. The
    residual is then a force, whose noise is as large in slow windows as in fast ones. In a single equation
    for all joints the speed of each joint is weighted by the noise of its force.
    """
    joints, period = data.q.shape[1], data.period
    half, first = _half(data), data.recipe.trim * data.recipe.decimation
    count = (len(data.q) - 2 * first) // half - 1
    apart = machine.plant.diagonal or joints == 1
    fewest = _FEWEST * _asked(machine)
    if count * (joints if apart else 1) < fewest:
        raise InputError(
            f"only {max(count, 0)} windows of {2 * half * period:.3g} s fit into the log",
            hint="take a longer log, or use inverse_dynamics",
        )

    slowest, halts = np.asarray(data.recipe.rest_velocity), _halts(machine.plant, data)
    speed = data.qd
    if not apart:
        share = _noise_shares(data)
        speed, slowest = (np.sqrt(np.sum((share * x) ** 2, axis=-1, keepdims=True)) for x in (speed, slowest))
        halts = np.any(halts, axis=1, keepdims=True)

    weigh = window((np.arange(2 * half) + 0.5) / half)
    middle = slice(half // 2, 2 * half - half // 2)
    cut = [slice(k, k + 2 * half) for k in first + half * np.arange(count)]
    squares = np.stack([weigh**2 @ speed[c] ** 2 for c in cut])
    moves = squares > slowest**2 * np.sum(weigh**2)
    passes = np.stack([np.any(halts[c][middle], axis=0) for c in cut])
    # If windows without reversals are too few, those with reversals count too.
    counts = moves & ~passes if np.sum(moves & ~passes) >= fewest else moves

    mean = period * np.sqrt(np.where(counts, squares, 1.0) * np.sum(weigh**2))
    force = float(np.sqrt(np.mean((data.force - data.force.mean(axis=0)) ** 2)))
    return PowerData(ForceData.of(data), np.where(counts, 1 / mean, 0.0), half, first), force


def _asked(machine: Machine) -> int:
    """Return the number of unknowns; of physically consistent links only identifiable sums count."""
    unknown = machine.parameters
    if not unknown.bodies:
        return len(unknown.free)
    sums = base_parameters(machine.plant).chosen_names
    each = zip(unknown.free, unknown.in_bodies, strict=True)
    return sum(not within or f.parameter in sums for f, within in each)


def _noise_shares(data: Prepared) -> Float[np.ndarray, " n"]:
    """Return the noise of each joint's force relative to the RMS of all, (n,); ones if not available.

    The noise is estimated from the high band of the force.
    """
    noise = signals.high_band_std(data.force)
    if noise.size != data.q.shape[1] or not np.all(noise > 0):
        return np.ones(data.q.shape[1])
    return noise / np.sqrt(np.mean(noise**2))


def _halts(plant: Plant, data: Prepared) -> Bool[np.ndarray, "time n"]:
    """Return the mask of samples at which a joint with dry friction rests or turns, (time, n).

    Friction jumps there, or holds the joint. The band-limited velocity is not exactly zero, and does not
    reverse exactly when the machine does, so that energy seems to be lost. A stated recipe keeps
    reversals, as it does in inverse dynamics.
    """
    joints, u = data.q.shape[1], data.force[0]

    def at_start(plant: Plant) -> Balance:
        return plant.balance(
            data.q[0], data.qd[0], data.qdd[0], u, jnp.zeros(()), plant.initial_states(jnp.asarray(u))
        )

    # Traced, because a plain number outside of compiled code counts as no contribution.
    slides = eqx.filter_eval_shape(at_start, plant).slides
    dry = {i for port in slides for i in plant.joints_loaded_by(port, joints)}
    halts = np.abs(data.qd) < np.asarray(data.recipe.rest_velocity)
    if data.recipe.keeps_reversals:
        halts = lasting(halts, 2 * data.recipe.decimation)
    else:
        halts |= np.diff(np.sign(data.qd), axis=0, append=np.sign(data.qd[-1:])) != 0
    return halts & np.array([i in dry for i in range(joints)])


def _half(data: Prepared) -> int:
    """Return half the length of a window [samples], from the joint whose speed changes fastest."""
    shortest = []
    for v in np.abs(data.qd).T:
        hills, _ = scipy.signal.find_peaks(v, prominence=_HILL * np.sqrt(np.mean(v**2)))
        shortest.append(_A_HILL * len(v) / max(len(hills), 1))
    least = _SHORTEST / (data.recipe.band_hz(1 / data.period) * data.period)
    return max(4, int(np.ceil(max(min(shortest), least) / 2)))
