"""Energy balances over windows: no acceleration is needed.

The balance of forces times the velocities is a balance of powers. What is inertial in it is the rate
of the kinetic energy, less half of what the mass changes by; over a window that opens and closes
smoothly, w, it is integrated by parts:

    int w qd' M qdd  =  - int w' T  -  int w qd' (dM/dt) qd / 2,      T = qd' M qd / 2,

so that it takes no more than the velocity. M is read off the plant's one balance, as its slope in the
accelerations, and its rate as the slope of that along the motion. All else, weight and springs
included, is force times velocity, integrated as it is. At rest nothing does work: a force of friction
that is anything there is multiplied by zero. Only windows in whose middle a joint with dry friction
stops or turns are left out.

Where no joint's acceleration enters another's balance, each joint has an equation of its own, else
the machine has one.
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
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import linear_scale
from jaxid.logs.prepare import Prepared, lasting
from jaxid.machine import Machine
from jaxid.model.balance import Balance
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics import filters as signals
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.precision import assess
from jaxid.simulation.force_balance import ForceData, sharpened

# A hill of speed stands out by this part of the RMS speed.
_HILL = 0.5
# Windows, over the mean length of a hill: four on its rise and four on its fall, half overlapping.
_A_HILL = 0.125
# Windows are no shorter than so many periods of the band's edge: below, they hold little but noise.
_SHORTEST = 2.0
# Windows for each unknown, at least.
_FEWEST = 2


class PowerData(eqx.Module):
    """What windows are cut from.

    Args:
        data: The log.
        weight: Of each window's equation, (window, k): zero where nothing moves in it.
        half: Half the length of a window, in samples.
        first: Sample at which the first window opens.
    """

    data: ForceData
    weight: Float[Array, "window k"]
    half: int = eqx.field(static=True)
    first: int = eqx.field(static=True)


def power_residual(plant: Plant, windows: PowerData) -> Float[Array, "window k"]:
    """Return the energy missing for balance in every window, over its weight [N or N m].

    A column a joint where the mass is diagonal, else one for the machine.

    Source:
        Gautier (1997), ICRA: Dynamic identification of robots with power model; here each window
        opens and closes smoothly, which asks for no velocity at its very ends.
    """
    kinetic, power = _energies(plant, windows.data)
    half, period = windows.half, windows.data.period
    # At the middles of samples, so that both halves mirror each other.
    s = (np.arange(half) + 0.5) / half
    up, slope = window(s), window_slope(s) / half
    count = windows.weight.shape[0] + 1
    stretch = slice(windows.first, windows.first + count * half)

    def halves(x: Array) -> Array:
        return x[stretch].reshape(count, half, -1)

    def over(x: Array, by: np.ndarray) -> Array:
        return jnp.einsum("i,hik->hk", by, halves(x))

    # What closes is the mirror of what opens, with the slope's sign turned.
    opened = period * over(power, up) - over(kinetic, slope)
    closed = period * over(power, up[::-1]) + over(kinetic, slope[::-1])
    return windows.weight * (opened[:-1] + closed[1:])


def window(s: np.ndarray) -> np.ndarray:
    """Return a window that is open at 1 and closed at 0 and 2, with no corner in its slope.

    Of smoother ones the plain sum over samples is the integral, to fourth order in their distance.
    """
    return np.sin(0.5 * np.pi * s) ** 4


def window_slope(s: np.ndarray) -> np.ndarray:
    """Return the derivative of `window`."""
    return 2 * np.pi * np.sin(0.5 * np.pi * s) ** 3 * np.cos(0.5 * np.pi * s)


def _energies(plant: Plant, data: ForceData) -> tuple[Float[Array, "time k"], Float[Array, "time k"]]:
    """Return the kinetic energy [J], and the power of all else less half the rate of the mass [W].

    In declared units: over the ratio of the force at the load to the declared one.
    """
    joints = data.q.shape[1]
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    # Accelerations reach own states only, of effects that look at them.
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


def power(machine: Machine, data: Prepared) -> Estimate:
    """Fit the unknowns to balances of energy over windows by least squares.

    Args:
        machine: The machine.
        data: The log, prepared: its filtered velocity counts, its accelerations do not.

    Returns:
        The estimate; its covariance takes the residual's colour into account.

    Raises:
        InputError: If the log is too short for as many windows as the unknowns ask for.
    """
    return run_alone(power_steps(machine, data))


def power_steps(machine: Machine, data: Prepared) -> Steps[Estimate]:
    """Run `power`, one solve at a time."""
    windows, unit = _windows(machine, data)
    plant, parameters = sharpened(machine.plant, data), machine.parameters
    transform, damping = linear_scale(machine)
    fit = yield SolveRequest(
        _solve,
        (
            plant,
            parameters.places,
            windows,
            parameters.guess,
            transform,
            parameters.bounds,
            damping,
        ),
    )
    rows = windows.weight > 0
    theta, e = np.asarray(fit.theta), np.asarray(fit.residual).reshape(rows.shape)
    jacobian = np.asarray(fit.jacobian).reshape(*rows.shape, -1)
    precision = assess(
        parameters.names,
        jacobian,
        e,
        np.asarray(rows),
        float(unit * np.sqrt(rows.sum())),
        np.where(theta != 0, theta, 1.0),
    )
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


def _windows(machine: Machine, data: Prepared) -> tuple[PowerData, float]:
    """Return the windows over a log, and the RMS force of its drives [N or N m].

    A window's energy is taken over the root of its integrals of w^2 and (w qd)^2: what is left is
    then a force, whose noise is as large in slow windows as in fast ones. In one equation for all joints
    each one's speed counts by the noise of its force.
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
    # A motion that is all reversals keeps them: there is no other.
    counts = moves & ~passes if np.sum(moves & ~passes) >= fewest else moves
    mean = period * np.sqrt(np.where(counts, squares, 1.0) * np.sum(weigh**2))
    force = float(np.sqrt(np.mean((data.force - data.force.mean(axis=0)) ** 2)))
    return PowerData(ForceData.of(data), np.where(counts, 1 / mean, 0.0), half, first), force


def _asked(machine: Machine) -> int:
    """Return the number of unknowns of an equation; of bodies only identifiable sums count."""
    unknown = machine.parameters
    if not unknown.bodies:
        return len(unknown.free)
    sums = base_parameters(machine.plant).chosen_names
    within = {k for body in unknown.bodies for k in body.places}
    return sum(k not in within or f.name in sums for k, f in enumerate(unknown.free))


def _noise_shares(data: Prepared) -> Float[np.ndarray, " n"]:
    """Return the noise of each joint's force over that of all, from its high band; ones if unavailable."""
    noise = signals.high_band_std(data.force)
    if noise.size != data.q.shape[1] or not np.all(noise > 0):
        return np.ones(data.q.shape[1])
    return noise / np.sqrt(np.mean(noise**2))


def _halts(plant: Plant, data: Prepared) -> Bool[np.ndarray, "time n"]:
    """Return the samples at which a joint with dry friction rests or turns.

    Friction jumps there, or holds; its velocity, limited to a band, is neither zero nor reverses
    quite when the machine does, so that energy seems to be lost. A stated recipe keeps what only
    turns, as it does in inverse dynamics.
    """
    joints, u = data.q.shape[1], data.force[0]

    def at_start(plant: Plant) -> Balance:
        return plant.balance(
            data.q[0], data.qd[0], data.qdd[0], u, jnp.zeros(()), plant.initial_states(jnp.asarray(u))
        )

    # Traced: a number that no compiled code sees counts as nothing there.
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
