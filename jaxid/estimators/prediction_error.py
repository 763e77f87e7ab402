"""Prediction error: maximum likelihood of the innovations of a Kalman filter on the plant's step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.consistency.law import noise_free_command
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.estimators.common.profile import need_names
from jaxid.estimators.common.scoring import Scored
from jaxid.estimators.common.shapes import shape_starts
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.innovations import STEPS, Innovations, fit_steps, hessian_steps, profile_steps
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.balance import Balance
from jaxid.numerics.lanes import Steps, run_alone
from jaxid.numerics.misspecified import std_under_misspecification, widening
from jaxid.numerics.precision import FISHER, FULL_HESSIAN, Precision, assess, hessian_notes
from jaxid.simulation.kalman import make_filter, slow_samples, smooth_steps
from jaxid.simulation.replay import Numerics, exact_numerics
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import needed_steps

# Evaluations that show which start is the best one.
SCREENING = 12
# Noise of the force at the start, as a part of the force; a large one makes a wrong model possible.
_FORCE_NOISE = 0.1
# Lowest noise of the force in turn, as a part of it. The likelihood of a machine without noise is a narrow
# curved valley: a fit at a higher noise leads close to its floor. The last one is below any drive's noise,
# and above the error of the steps at reversals.
_FLOORS = (1e-2, 1e-3, 1e-4)
# Largest noise of the force, as a part of it; noise of a reading, as a multiple of its first estimate.
_MOST, _READING_RANGE = 1e2, (1e-3, 1e3)
# Noise of the force, as a part of it, below which sticking is certain.
_QUIET = 1e-3
# Steps of the last fit of such a log for each one before.
_FINER = 4
# Pairs of simulated noise for the correction of the bias by noise of the command's reading.
PAIRS = 4
# Eigenvalue of the scaled information, relative to the largest, below which a direction is not corrected.
BLIND = 1e-10
# Lags of the test of whiteness, and the probability at which it rejects.
LAGS, REJECTS = 20, 1e-3


def prediction_error(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    rest_velocity: np.ndarray | None = None,
    command_noise: np.ndarray | None = None,
    alone: bool = False,
    hessian: bool = False,
    profile: Sequence[str] = (),
) -> Estimate:
    """Fit the unknowns, the noise of the force and the noise of the readings by maximum likelihood.

    An extended Kalman filter on the plant's step, driven by the logged command, predicts each reading from
    those before it. In open loop and in a loop the estimate is the same function of the log, because the
    command is measured. If the declared law explains the logged command but for white noise of its reading,
    the command of the law is used.

    Args:
        machine: The machine. Its sensor gives the first values of the noise.
        log: The log.
        start: A start of the fit beside the guesses, for example from `inverse_dynamics`, (p,).
        numerics: Settings of the integration; None: exact sticking and the steps that the plant needs.
        rest_velocity: Speed below which a sample of a machine with dry friction does not count, unless the
            force is free of noise, (n,) [m/s or rad/s]; None: all samples count.
        command_noise: Standard deviation with which the command was read, (m,), whose bias is removed; None:
            it was logged exactly.
        alone: Whether `start` is the only start, because it is known to be near the optimum.
        hessian: Whether the covariance uses the observed information in place of Fisher's; see
            `jaxid.numerics.precision.hessian_covariance`.
        profile: Names of the unknowns whose profile likelihood is computed; see
            `jaxid.estimators.common.profile`.

    Returns:
        The estimate. Its covariance is that of the likelihood, widened if the innovations are coloured. If
        the case states the true values, `least_std` of the details is the bound of Cramer and Rao there.

    Raises:
        InputError: If too few readings count, or a name in `profile` is not known.

    Source:
        Ljung (1999), System Identification, chapter 7; Astrom (1980), Automatica 16, for the innovations.
    """
    return run_alone(
        prediction_error_steps(
            machine,
            log,
            start=start,
            numerics=numerics,
            rest_velocity=rest_velocity,
            command_noise=command_noise,
            alone=alone,
            hessian=hessian,
            profile=profile,
        )
    )


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of a log with what a fit of it starts from.

    Args:
        problem: The likelihood, at the highest floor of the noise.
        machine: The machine at its guesses.
        log: The log, whose force is the command that drives the filter.
        numerics: Settings of the integration.
        applied: Command of the declared law, if it explains the logged one; None: the logged one drives.
        slow: Mask of the samples at rest, which do not count; None: all count.
        force: Size of the logged force, (m,).
        noise: Logarithms of the noise at the start, of the force and then of the readings, (m + k,).
        floors: Lower bounds on them, in turn.
    """

    problem: Innovations
    machine: Machine
    log: Log
    numerics: Numerics
    applied: np.ndarray | None
    slow: np.ndarray | None
    force: np.ndarray
    noise: np.ndarray
    floors: Sequence[np.ndarray]

    def sticks_surely(self, noise: np.ndarray) -> bool:
        """Check that there is so little noise of the force that it is known when a joint sticks."""
        if self.slow is None or self.applied is None:
            return False
        return bool(np.all(np.exp(noise[: len(self.force)]) < _QUIET * self.force))

    def at_rest_too(self, problem: Innovations) -> Innovations:
        """Return the likelihood with the samples at rest."""
        # So precise a fit shows the error of a step in which a joint comes to rest.
        finer = replace(self.numerics, substeps=_FINER * self.numerics.substeps)
        kalman = make_filter(self.machine, self.log, finer)
        counts = np.asarray(kalman.used)[:: kalman.every][:, list(self.log.measured)]
        return problem._replace(kalman=kalman, counts=counts)


def likelihood_of(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    rest_velocity: np.ndarray | None = None,
) -> Likelihood:
    """Return the likelihood of a log; see `prediction_error` for the arguments.

    Raises:
        InputError: If too few readings count.
    """
    if numerics is None:
        numerics = needed_numerics(machine, log, start)
    parameters, measured = machine.parameters, list(log.measured)
    applied = noise_free_command(machine, log)
    driven = log if applied is None else replace(log, force=applied)
    slow = None
    if rest_velocity is not None and slides(machine, log):
        slow = slow_samples(log, rest_velocity)
    kalman = make_filter(machine, driven, numerics, slow)
    counts = np.asarray(kalman.used)[:: kalman.every]
    counts = (counts if slow is None else counts & ~slow)[:, measured]
    if counts.sum() < 5 * len(parameters.free):
        slowest = 0.0 if rest_velocity is None else np.min(rest_velocity)
        raise InputError(
            f"only {int(counts.sum())} readings are of a motion faster than {slowest:.3g}",
            where=log.source,
            hint="take a log with more motion, lower [preprocess] rest_velocity, or use another method",
        )

    force = _force_scale(machine, log)
    stroke = np.maximum(np.ptp(log.readings, axis=0), 1e-300)
    reading = np.maximum(position_noise(machine, log), 1e-9 * stroke)[measured]
    noise = np.log(np.concatenate([_FORCE_NOISE * force, reading]))
    floors = [np.log(np.concatenate([f * force, _READING_RANGE[0] * reading])) for f in _FLOORS]
    problem = Innovations(
        kalman=kalman,
        places=parameters.places,
        plant=machine.plant,
        counts=counts,
        transform=Transform.of(parameters),
        bounds=parameters.bounds,
        low=floors[0],
        high=np.log(np.concatenate([_MOST * force, _READING_RANGE[1] * reading])),
    )
    return Likelihood(problem, machine, driven, numerics, applied, slow, force, noise, floors)


def needed_numerics(machine: Machine, log: Log, start: np.ndarray | None) -> Numerics:
    """Return the settings of the integration that a machine needs at its start."""
    # Guesses that are far off, such as inertias of no possible body, may need many more steps.
    near = machine if start is None else machine.with_estimate(np.clip(start, *machine.parameters.bounds))
    return exact_numerics(machine, log, needed_steps(near, log))


def prediction_error_steps(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    rest_velocity: np.ndarray | None = None,
    command_noise: np.ndarray | None = None,
    alone: bool = False,
    hessian: bool = False,
    profile: Sequence[str] = (),
) -> Steps[Estimate]:
    """Run `prediction_error` as a generator of solve requests."""
    need_names(profile, machine.parameters.names)
    begun = likelihood_of(machine, log, start=start, numerics=numerics, rest_velocity=rest_velocity)
    parameters, problem, noise, force = machine.parameters, begun.problem, begun.noise, begun.force
    transform, bounds, applied = problem.transform, problem.bounds, begun.applied

    # Beside another method's start the guesses matter for shapes only, whose likelihood has several maxima.
    p, m, steps = len(parameters.free), len(force), 0
    shapes = [] if alone else shape_starts(machine, parameters.guess)
    starts = [parameters.guess, *shapes] if shapes or start is None else []
    if start is not None:
        starts.insert(0, np.clip(start, *bounds))
    theta, trials = starts[0], []
    for at in starts if len(starts) > 1 else ():
        trials.append((yield from fit_steps(problem, at, noise, SCREENING)))
    if trials:
        best = min(trials, key=lambda trial: np.nan_to_num(float(trial.cost), nan=np.inf))
        theta, noise = np.asarray(transform.outward(best.x[:p])), best.x[p:]
        steps = sum(int(trial.steps) for trial in trials)

    scored = None
    for floor in begun.floors:
        problem = problem._replace(low=floor)
        scored = yield from fit_steps(problem, theta, noise, STEPS)
        theta, noise = np.asarray(transform.outward(scored.x[:p])), np.asarray(scored.x[p:])
        steps += int(scored.steps)
        if np.all(noise[:m] > floor[:m] + 1e-3) or not np.isfinite(float(scored.cost)):
            break
    assert scored is not None, "there is at least one floor"

    # Without noise of the force it is known when a joint sticks, and samples at rest count too.
    if begun.sticks_surely(noise):
        problem = begun.at_rest_too(problem)
        scored = yield from fit_steps(problem, theta, noise, STEPS)
        theta, steps = np.asarray(transform.outward(scored.x[:p])), steps + int(scored.steps)

    read = np.zeros(m)
    if bool(scored.converged) and applied is None and command_noise is not None and np.any(command_noise > 0):
        x, read = yield from _corrected_steps(problem, scored, theta, command_noise)
        theta = np.clip(transform.outward(x), *bounds)
    estimate = _estimate(machine, problem, theta, scored, by_law=applied is not None, read=read, steps=steps)

    true = [free.true for free in parameters.free]
    if true and None not in true and estimate.converged:
        truth = np.array(true, dtype=np.float64)
        there = yield from fit_steps(problem, truth, noise, 1)
        bound = _precision(parameters.names, problem, truth, there).std
        values = dict(zip(parameters.names, bound.tolist(), strict=True))
        estimate = replace(estimate, details={**estimate.details, "least_std": values})
    if hessian:
        estimate = yield from _by_hessian(estimate, problem, scored)
    if not profile:
        return estimate
    profiles, notes = yield from profile_steps(problem, machine, theta, scored, estimate.precision, profile)
    return replace(
        estimate, notes=(*estimate.notes, *notes), details={**estimate.details, "profiles": profiles}
    )


def _corrected_steps(
    problem: Innovations, scored: Scored, theta: np.ndarray, command_noise: np.ndarray
) -> Steps[tuple[np.ndarray, np.ndarray]]:
    """Remove the bias by noise with which the command was read; return the estimates and the noise.

    The filter takes the logged command for the applied one plus an error that is independent of the log.
    Noise of the reading is not independent: like noise of a regressor it makes the force count too little. As
    much noise again, simulated, has the same effect once more: the shift of the optimum, by one step of the
    scoring, is subtracted. Pairs of opposite noise cancel in first order.

    Args:
        problem: The likelihood.
        scored: The fit.
        theta: Its estimates, (p,).
        command_noise: Noise with which the command was read, (m,).

    Returns:
        The estimates on the scale of the solver, (p,), and the noise for which they were corrected, (m,).

    Source:
        Cook & Stefanski (1994), JASA 89, simulation-extrapolation.
    """
    kalman, p, drives = problem.kalman, len(theta), problem.kalman.command.shape[1]
    x = np.asarray(scored.x)
    read = np.minimum(command_noise, np.exp(x[p : p + drives]))
    noise = x[p:].copy()
    noise[:drives] += 0.5 * np.log1p((read / np.exp(noise[:drives])) ** 2)

    def at(command: np.ndarray) -> Steps[Scored]:
        shifted = problem._replace(kalman=eqx.tree_at(lambda k: k.command, kalman, command))
        return fit_steps(shifted, theta, noise, 1)

    command, every = np.asarray(kalman.command), kalman.every
    information = (yield from at(command)).information
    rng, gradients = np.random.default_rng(0), []
    for _ in range(PAIRS):
        more = read * rng.standard_normal((len(command[::every]), drives))
        more = np.repeat(more, every, axis=0)[: len(command)]
        for sign in (1.0, -1.0):
            gradients.append((yield from at(command + sign * more)).gradient)
    if not np.all(np.isfinite(information)) or not np.all(np.isfinite(gradients)):
        return x[:p], np.zeros(drives)

    size = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = np.linalg.pinv(information / np.outer(size, size), rcond=BLIND, hermitian=True)
    shift = -inverse @ (np.mean(gradients, axis=0) / size) / size
    return x[:p] - shift[:p], read


def _force_scale(machine: Machine, log: Log) -> Float[np.ndarray, " m"]:
    """Return the typical size of each command, in its unit, (m,).

    That of a constant force is its level. Of a machine that nothing drives it is the command that would
    accelerate the masses as they were, at the guesses.
    """
    if log.passive:
        speed = smooth_steps(log) / log.period
        inertia = machine.plant.own_inertia()
        mass = 1.0 if inertia is None else np.asarray(inertia)
        own = np.sqrt(np.mean((mass * np.gradient(speed, log.period, axis=0)) ** 2, axis=0))
        driven = machine.plant.driven(machine.plant.joints)[: log.force.shape[1]]
        return np.maximum(np.max(own[list(driven)]) / np.abs(machine.gain), 1e-300)
    spread, size = np.std(log.force, axis=0), np.sqrt(np.mean(log.force**2, axis=0))
    return np.maximum(np.where(spread > 1e-9 * size, spread, size), 1e-300)


def slides(machine: Machine, log: Log) -> bool:
    """Check that dry friction acts somewhere."""
    plant = machine.plant

    def balance(q: Array, u: Array) -> Balance:
        zero = jnp.zeros_like(q)
        return plant.balance(q, zero, zero, u, jnp.zeros(()), plant.initial_states(u))

    # Shapes tell: no operation is compiled.
    return bool(jax.eval_shape(balance, log.filled[0], log.force[0]).slides)


def _estimate(
    machine: Machine,
    problem: Innovations,
    theta: np.ndarray,
    scored: Scored,
    *,
    by_law: bool,
    read: np.ndarray,
    steps: int,
) -> Estimate:
    """Return the estimate of a fit, with its precision, its noise and a test of its innovations.

    Args:
        machine: The machine at its guesses.
        problem: The likelihood.
        theta: Estimates, (p,).
        scored: The fit.
        by_law: Whether the command was computed by the declared law.
        read: Noise with which the command was read, (m,).
        steps: Evaluations of all fits.
    """
    names, counts, drives = machine.parameters.names, np.asarray(problem.counts), len(read)
    z, jacobian = np.asarray(scored.z), _slopes(problem, scored)
    plain = _precision(names, problem, theta, scored)

    noise = np.exp(np.asarray(scored.x)[len(theta) :])
    p_values = [whiteness(e[c]) for e, c in zip(z.T, counts.T, strict=True)]
    notes = ["noise of the force and of the readings was estimated with the unknowns"]
    if by_law:
        notes.append(
            "the command was computed by the declared law from the logged readings: the logged one is the "
            "same but for white noise of its reading"
        )
    if min(p_values) < REJECTS:
        notes.append(
            "the innovations are not white (rounding, coloured noise or an incomplete model): the standard "
            "deviations are widened accordingly"
        )
    converged = bool(scored.converged) and bool(np.all(np.isfinite(theta)))
    return Estimate(
        method="prediction_error",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=plain.widened(widening(plain, jacobian, z, counts)),
        converged=converged,
        message="converged" if converged else f"no convergence within {steps} steps",
        residual=np.where(counts, z, np.nan),
        std_misspecified=std_under_misspecification(jacobian, z, counts),
        samples=int(counts.sum()),
        steps=steps,
        notes=tuple(notes),
        details={
            "noise": {
                "force": noise[:drives],
                "force_reading": read,
                "velocity" if problem.kalman.of_velocity else "position": noise[drives:],
            },
            "log_likelihood": -float(scored.cost),
            "whiteness": {"lags": LAGS, "p": p_values},
        },
    )


def _by_hessian(estimate: Estimate, problem: Innovations, scored: Scored) -> Steps[Estimate]:
    """Replace Fisher's information in the covariance by the full Hessian, if that is positive definite.

    Args:
        estimate: Estimate with its precision by Fisher's information.
        problem: The likelihood.
        scored: The fit.
    """
    full = yield from hessian_steps(problem, scored)
    if full is None:
        precision = replace(estimate.precision, curvature=np.full(2, np.nan))
    else:
        names, theta = estimate.names, estimate.theta
        # Errors that outlast their colour's model widen both by the same factors.
        plain, curved = (_precision(names, problem, theta, scored, h) for h in (None, full))
        jacobian, z, counts = _slopes(problem, scored), np.asarray(scored.z), np.asarray(problem.counts)
        precision = curved.widened(widening(plain, jacobian, z, counts))
    notes = hessian_notes(precision, True, FISHER)
    return replace(estimate, precision=precision, notes=(*estimate.notes, *notes))


def _slopes(problem: Innovations, scored: Scored) -> Float[np.ndarray, "time k p"]:
    """Return the derivatives of the innovations, over their standard deviations, by the unknowns in SI."""
    p = problem.bounds[0].size
    # The slopes are those at the optimum, before the correction.
    fitted = problem.transform.outward(scored.x[:p])
    rows = problem.transform.physical(scored.mean[..., :p].reshape(scored.z.size, p), fitted)
    return np.asarray(rows).reshape(*scored.z.shape, p)


def _precision(
    names: list[str],
    problem: Innovations,
    theta: np.ndarray,
    scored: Scored,
    hessian: Float[np.ndarray, "p p"] | None = None,
) -> Precision:
    """Return the precision by Fisher's information of the innovations, or by the observed one.

    Args:
        names: Names of the unknowns.
        problem: The likelihood.
        theta: Estimates, (p,).
        scored: The fit.
        hessian: Observed information, which is used if it is positive definite, (p, p); None: not known.
    """
    counts, jacobian = np.asarray(problem.counts), _slopes(problem, scored)

    # An unknown is identifiable if its standard deviation changes the innovations less than the largest
    # effect of any unknown does.
    scale = np.where(theta != 0, theta, 1.0)
    effect = np.linalg.norm((jacobian * scale).reshape(scored.z.size, len(theta)), axis=0)
    largest = float(np.max(effect, initial=0.0))
    precision = assess(names, jacobian, np.asarray(scored.z), counts, largest, scale, hessian)
    return replace(precision, kind=FULL_HESSIAN if precision.kind == FULL_HESSIAN else FISHER)


def whiteness(z: Float[np.ndarray, " time"], lags: int = LAGS) -> float:
    """Return the probability that white noise has autocorrelations as large as these.

    Source:
        Ljung & Box (1978), Biometrika 65, statistic of the first `lags` autocorrelations.
    """
    samples, z = len(z), z - z.mean()
    lags = min(lags, samples // 5)
    power = z @ z
    if lags < 1 or power <= 0:
        return 1.0
    r = np.array([z[k:] @ z[:-k] for k in range(1, lags + 1)]) / power
    statistic = samples * (samples + 2) * np.sum(r**2 / (samples - np.arange(1, lags + 1)))
    return float(scipy.stats.chi2.sf(statistic, lags))
