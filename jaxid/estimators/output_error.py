"""Gradient-based fit of the simulated to the measured position.

The simulation runs in closed loop if the controller is known, else in open loop over the whole log. If an
error would grow without bound, it runs in segments that restart from the log.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Minimum, Transform
from jaxid.estimators.common.minimise import failure_text, minimise
from jaxid.estimators.common.minimisers import Minimiser, minimiser_name, minimiser_of
from jaxid.estimators.common.profile import BETTER, OFFSETS, falls_below, need_names, profile_entry, profiled
from jaxid.estimators.estimate import Estimate
from jaxid.gap import SHORT
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import REFERENCE, scatter
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.lanes import SolveRequest, Steps, run_alone
from jaxid.numerics.misspecified import std_under_misspecification
from jaxid.numerics.precision import Precision, assess, full_hessian, hessian_notes
from jaxid.simulation.kalman import rounded_readings
from jaxid.simulation.loops import Drive, needed_substeps
from jaxid.simulation.replay import (
    LONGEST_MEMORY,
    Numerics,
    Replay,
    exact_numerics,
    from_rest,
    make_replay,
    start_shows,
    with_fitted_start,
)
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.solvers import RELATIVE

# An open-loop run whose RMS distance from the log exceeds this part of the log's standard deviation is cut
# into segments.
_LOST = 0.5
# The start of an open-loop run is fitted with the unknowns only if the residual's RMS is within this
# factor of the position noise. Otherwise the error of the model would bias the start, which the first
# samples determine far better.
NOISE_LIMITED = 3.0
CLEARLY = 10.0
# See `turning_steps`: factor of a step's error, its allowed part of the noise, and the most steps.
_TURNING = 0.04
_LITTLE = 0.1
_MOST = 4
# Least steps a sample of a free motion.
_FREE = 4
# Number of segments; each is long enough to show friction and short enough not to drift away.
_SEGMENTS = 40


def output_residual(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, on: str = "position"
) -> Callable[[Array], Array]:
    """Return measured minus simulated output as a function of the unknowns, (time, k), weighted.

    The unknowns may end with changes of the position and velocity at the start, (2 n,).
    """

    def residual(theta: Array) -> Array:
        extra = theta[len(places) :]
        nudge = extra if extra.size else None
        run = replay.following(places, theta)(scatter(places, plant, theta), nudge)
        outputs: dict[str, tuple[Array, ...]] = {
            "position": (run.position,),
            "velocity": (run.velocity,),
            "force": (replay.drive.gain * run.command,),
        }
        outputs["both"] = outputs["position"] + outputs["force"]
        return weight * (measured - jnp.concatenate(outputs[on], axis=1))

    return residual


def need_loop(machine: Machine, log: Log, what: str, other: str) -> None:
    """Refuse an open loop, whose force is the logged one, so that the fit would compare it with itself.

    Args:
        machine: The machine that is simulated.
        log: The log, named in the message.
        what: Request that needs the loop, for the message.
        other: Alternative to naming the controller, for the hint.

    Raises:
        InputError: If the machine has no controller.
    """
    if machine.controller is None:
        raise InputError(
            f"{what} needs a loop, whose simulation gives a force",
            where=log.source,
            hint=f"name the controller in [controller] and the reference's column in [log], {other}",
        )


def _need_force(machine: Machine, log: Log, on: str) -> None:
    """Refuse a fit of a force that was not logged.

    Raises:
        InputError: If the log has no force.
    """
    if machine.unforced(log):
        raise InputError(
            f"the log has no force, which a fit on {on} compares", where=log.source, hint="fit position"
        )


def measured_output(machine: Machine, log: Log, on: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a log's output, (time, k), and the mask of columns that count; see `output_residual`."""
    force = log.force * machine.gain
    outputs = {"position": (log.filled,), "force": (force,), "both": (log.filled, force)}
    outputs["velocity"] = (log.readings,)
    counts = {"position": log.measured, "velocity": log.measured, "force": (True,) * force.shape[1]}
    counts["both"] = counts["position"] + counts["force"]
    return np.concatenate(outputs[on], axis=1), np.array(counts[on])


@kept_jit
def _fit(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Array,
    weight: Array,
    theta: Array,
    transform: Transform,
    bounds: tuple[Array, Array],
    on: str,
    active: Array,
    minimiser: Minimiser | None,
) -> Minimum:
    residual = output_residual(replay, places, plant, measured, weight, on)
    return minimise(residual, theta, transform, *bounds, active, minimiser)


@kept_jit
def _hessian(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    return full_hessian(output_residual(replay, places, plant, measured, weight, on), theta)


@kept_jit
def _residual(
    replay: Replay, places: tuple, plant: Plant, measured: Array, weight: Array, theta: Array, on: str
) -> Array:
    return output_residual(replay, places, plant, measured, weight, on)(theta)


def position_jacobian(machine: Machine, log: Log, numerics: Numerics) -> np.ndarray:
    """Return the derivative of the simulated position by the unknowns at their guesses, (time, n, p).

    Args:
        machine: The machine to simulate.
        log: Log whose input drives the machine.
        numerics: Settings of the integration.
    """
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    unknown = machine.parameters
    measured = jnp.asarray(log.filled)
    return -np.asarray(_jacobian(replay, unknown.places, machine.plant, measured, unknown.guess))


@kept_jit
def _jacobian(replay: Replay, places: tuple, plant: Plant, measured: Array, theta: Array) -> Array:
    residual = output_residual(replay, places, plant, measured, jnp.ones(measured.shape))
    return jax.jacfwd(residual)(theta)


def output_error(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
) -> Estimate:
    """Fit the unknowns so that the simulated position, or force, matches the measured one.

    Args:
        machine: The machine; its controller closes the loop.
        log: The log with the measured output.
        start: Start of the fit in place of the guesses, for example from `inverse_dynamics`, (p,).
        numerics: Settings of the integration; None: chosen from plant and log.
        hessian: Whether the covariance uses the full Hessian in place of Gauss-Newton's; see
            `jaxid.numerics.precision.hessian_covariance`.
        profile: Names of the unknowns whose profile likelihood is computed; see
            `jaxid.estimators.common.profile`.
        on: One of `jaxid.names.OUTPUTS`. With "both" each column is divided by the standard deviation of its
            residual in a fit of position. A fit of the force needs a closed loop.
        minimiser: One of `jaxid.estimators.common.minimisers.MINIMISERS`, or a solver of optimistix; None:
            `jaxid.estimators.common.levenberg_marquardt`.

    Returns:
        The estimate; its covariance accounts for a coloured residual.

    Raises:
        InputError: If the force is fitted without a closed loop, or the minimiser or a name in `profile` is
            not known.
    """
    return run_alone(
        output_error_steps(
            machine,
            log,
            start=start,
            numerics=numerics,
            hessian=hessian,
            profile=profile,
            on=on,
            minimiser=minimiser,
        )
    )


def output_error_steps(
    machine: Machine,
    log: Log,
    *,
    start: np.ndarray | None = None,
    numerics: Numerics | None = None,
    hessian: bool = False,
    profile: Sequence[str] = (),
    on: str = "position",
    minimiser: str | Minimiser | None = None,
) -> Steps[Estimate]:
    """Run `output_error` as a generator of solve requests."""
    solver = minimiser_of(minimiser)
    need_names(profile, machine.parameters.names)
    if on != "position":
        need_loop(machine, log, f"output_error on {on}", "or fit position")
        _need_force(machine, log, on)
    elif log.integrated:
        on = "velocity"
    machine = machine if start is None else machine.with_estimate(start)
    chosen = numerics is None
    numerics = numerics or choose_numerics(machine, log)
    replay = make_replay(machine, log, numerics)
    replay = with_fitted_start(replay, machine.plant, log)
    looped = replay.controller is not None
    fixed = numerics.segment or (looped and log.samples > SHORT)
    nuisance = 0 if fixed else 2 * log.position.shape[1]
    p = len(machine.parameters.free)
    active = np.arange(p + nuisance) < p
    problem: tuple[Any, ...] = _problem(machine, replay, log, nuisance, "position" if on == "both" else on)
    if machine.unknown_reference is not None:
        # With a wrong reference the machine's parameters would diverge: fit the reference's unknowns first.
        minimum = yield SolveRequest(_fit, (*problem, _of_course(machine, active), solver))
        problem = (*problem[:5], minimum.theta, *problem[6:])
    minimum = yield SolveRequest(_fit, (*problem, active, solver))
    while chosen and forgets(machine, numerics, np.asarray(minimum.theta)[:p]):
        # Beyond the past commands that are kept a longer delay has no effect: keep more, and go on.
        numerics = replace(numerics, longest_delay=2 * numerics.longest_delay)
        longer = make_replay(machine, log, numerics)
        problem = (longer, *problem[1:5], minimum.theta, *problem[6:])
        minimum = yield SolveRequest(_fit, (*problem, active, solver))
    if on == "both":
        problem = _problem(machine.with_estimate(np.asarray(minimum.theta)[:p]), replay, log, nuisance, on)
        e = yield SolveRequest(_residual, (*problem[:6], on))
        spread = np.maximum(np.std(np.asarray(e), axis=0), 1e-12 * np.std(problem[3], axis=0))
        problem = (*problem[:4], problem[4] / spread, *problem[5:])
        minimum = yield SolveRequest(_fit, (*problem, active, solver))
    if looped and not nuisance and not numerics.segment:
        left = np.asarray(minimum.residual).reshape(problem[3].shape)
        if start_shows(left[:, np.any(problem[4] > 0, axis=0)]):
            # The log may begin with a jerk from rest, so that its first readings give no velocity.
            rested = (from_rest(problem[0]), *problem[1:5], minimum.theta, *problem[6:])
            other = yield SolveRequest(_fit, (*rested, active, solver))
            if bool(other.converged) and float(other.cost) < float(minimum.cost):
                problem, minimum = rested, other
    if nuisance and looped:
        every = np.ones(p + nuisance, bool)
        freed = yield SolveRequest(_fit, (*problem, every, solver))
        spare = CLEARLY * nuisance / max(problem[3].size - p - nuisance, 1)
        if bool(freed.converged) and float(freed.cost) * (1 + spare) < float(minimum.cost):
            minimum, active = freed, every
    elif nuisance:
        problem, active = _with_start(machine, log, problem, minimum)
        minimum = yield SolveRequest(_fit, (*problem, active, solver))
    measured, weight = problem[3], problem[4]
    e = np.asarray(minimum.residual).reshape(measured.shape)
    counts = np.asarray(weight) > 0
    jacobian = np.asarray(minimum.jacobian).reshape(*e.shape, -1)
    theta = np.asarray(minimum.theta)
    names = [*machine.parameters.names, *[f"start {i}" for i in range(nuisance)]][: active.sum()]
    full = np.asarray((yield SolveRequest(_hessian, (*problem[:5], minimum.theta, on)))) if hessian else None
    precision = assess(
        names,
        jacobian[..., active],
        e,
        counts,
        float(np.linalg.norm(weight * (measured - measured.mean(axis=0)))),
        np.where(theta != 0, theta, 1.0)[active],
        None if full is None else full[np.ix_(active, active)],
        crossed=on == "both",
    ).first(machine.parameters.names)
    converged = bool(minimum.converged)
    profiles, remarks = yield from _profiles(problem, active, minimum, solver, machine, precision, profile)
    remarks = [*hessian_notes(precision, hessian), *remarks]
    return Estimate(
        method="output_error",
        machine=machine.with_estimate(theta[:p]),
        theta=theta[:p],
        precision=precision,
        converged=converged,
        message="converged" if converged else _failure(minimum, minimiser),
        residual=np.where(counts, e, np.nan),
        samples=int(counts.sum()),
        steps=int(minimum.steps),
        notes=(*notes_of(machine, numerics, log, on, minimiser), *remarks),
        details=({"profiles": profiles} if profile else {}) | kept_delay(machine, numerics),
        std_misspecified=std_under_misspecification(jacobian[..., active], e, counts)[:p],
    )


def _profiles(
    problem: tuple,
    active: np.ndarray,
    minimum: Minimum,
    solver: Minimiser | None,
    machine: Machine,
    precision: Precision,
    asked: Sequence[str],
) -> Steps[tuple[dict[str, Any], list[str]]]:
    """Compute the profile likelihood of some unknowns, and notes about those that have none.

    The cost takes the residual for white. Its rise is divided by the variance of the white residual that
    would give the unknown the same standard deviation as the coloured one.

    Args:
        problem: Arguments of `_fit`, up to the mask.
        active: Mask of the unknowns of the fit, (p + nuisance,).
        minimum: The fit.
        solver: Its minimiser.
        machine: The machine, with its unknowns.
        precision: Precision of the unknowns.
        asked: Names of the unknowns.

    Source:
        Chandler and Bate (2007), Biometrika 94, 167-183: an independence likelihood, scaled vertically.
    """
    profiles, notes = {}, []
    theta, (lower, upper) = np.asarray(minimum.theta), problem[7]
    white = 2 * float(minimum.cost) / max(np.sum(problem[4] > 0) - active.sum(), 1)
    bound = np.isin(np.arange(theta.size), [k for b in machine.parameters.bodies for k in b.places])
    for name in asked:
        k = machine.parameters.names.index(name)
        if not precision.identifiable[k] or precision.equivalent_variance is None:
            notes.append(f"no profile of {name}: it is not identifiable from this log")
            continue
        if bound[k]:
            notes.append(f"no profile of {name}: it belongs to a link that is kept physically consistent")
            continue
        std, variance = float(precision.std[k]), float(precision.equivalent_variance[k])
        others = active & (np.arange(theta.size) != k)

        def refit(
            at: np.ndarray,
            offset: float,
            k: int = k,
            others: np.ndarray = others,
            of: tuple = (std, variance),
        ) -> Steps[tuple[np.ndarray, float]]:
            held = theta[k] + offset * of[0]
            if not lower[k] < held < upper[k]:
                return at, np.nan
            start = np.where(np.arange(theta.size) == k, held, at)
            there = yield SolveRequest(_fit, (*problem[:5], start, *problem[6:], others, solver))
            rise = 2 * (float(there.cost) - float(minimum.cost)) / of[1]
            return np.asarray(there.theta), rise if bool(there.converged) else np.nan

        rise = yield from profiled(refit, theta)
        notes += [BETTER.format(name)] if falls_below(rise) else []
        unit = machine.parameters.free[k].unit
        profiles[name] = profile_entry(
            float(theta[k]), std, theta[k] + OFFSETS * std, rise, variance / white, unit
        )
    if profiles:
        notes.append(
            "profiles: the residual counts as Gaussian, and its colour as a constant factor of the variance"
        )
    return profiles, notes


def forgets(machine: Machine, numerics: Numerics, theta: np.ndarray) -> bool:
    """Check that a fitted delay reaches the end of the past commands, and that a loop can keep more."""
    if machine.controller is None or not 0 < numerics.longest_delay <= LONGEST_MEMORY // 2:
        return False
    fitted = machine.with_estimate(theta).plant
    delay = float(np.max(np.asarray(fitted.command_delays(machine.gain.size))))
    return bool(delay >= (numerics.longest_delay - 1) * machine.controller.period)


def kept_delay(machine: Machine, numerics: Numerics) -> dict[str, float]:
    """Return the longest delay that a simulated loop has, `longest_delay` [s]; empty without any delay."""
    if machine.controller is None or not numerics.longest_delay:
        return {}
    return {"longest_delay": numerics.longest_delay * machine.controller.period}


def _of_course(machine: Machine, active: np.ndarray) -> np.ndarray:
    """Return the mask of the unknowns of the reference."""
    own = np.zeros_like(active)
    own[: len(machine.parameters.free)] = [path[0] == REFERENCE for path, _ in machine.parameters.places]
    return own


def _with_start(machine: Machine, log: Log, problem: tuple, minimum: Minimum) -> tuple[tuple, np.ndarray]:
    """Return the problem with the start refitted to the fitted plant, and the mask of its active unknowns.

    The start is active if the residual is no larger than noise.
    """
    p = len(machine.parameters.free)
    fitted = machine.with_estimate(np.asarray(minimum.theta)[:p])
    replay = with_fitted_start(problem[0], fitted.plant, log)
    problem = (replay, *problem[1:5], minimum.theta, *problem[6:])
    rms = np.sqrt(np.mean(np.square(minimum.residual)))
    noise = position_noise(machine, log)
    free = bool(rms <= NOISE_LIMITED * np.max(noise))
    active = (np.arange(len(minimum.theta)) < p) | free
    return problem, active


def _problem(machine: Machine, replay: Replay, log: Log, nuisance: int, on: str) -> tuple:
    parameters, (measured, counts) = machine.parameters, measured_output(machine, log, on)
    lower, upper = parameters.bounds
    free = np.full(nuisance, np.inf)
    transform = Transform.of(parameters)
    transform = replace(transform, log=np.concatenate([transform.log, np.zeros(nuisance, bool)]))
    weight = np.tile(counts.astype(float), (len(measured), 1))
    if log.passive and on == "position":
        # A free motion ends at rest, where one rounding error stands in every reading.
        weight = weight * rounded_readings(machine, log)
    return (
        replay,
        parameters.places,
        machine.plant,
        measured,
        weight,
        np.concatenate([parameters.guess, np.zeros(nuisance)]),
        transform,
        (np.concatenate([lower, -free]), np.concatenate([upper, free])),
        on,
    )


def choose_numerics(
    machine: Machine, log: Log, *, segments: bool = True, solver: str | None = None
) -> Numerics:
    """Choose the integration that suits a machine and its log.

    Dry friction sticks exactly. Its gradient is exact too, because the force is continuous at the onset of
    sliding. With break-away friction it is not, so that friction is smoothed; likewise with a solver of
    diffrax.

    Args:
        machine: The machine to simulate.
        log: The log that drives it.
        segments: Whether an open-loop run may be cut into segments.
        solver: One of `jaxid.names.SOLVERS`; None: fixed steps.
    """
    breaks_away = any(e.break_away_level is not None for e in machine.plant.effects)
    exact = exact_numerics(machine, log, 1 if solver else None)
    numerics = replace(
        exact,
        substeps=1 if solver else max(exact.substeps, turning_steps(machine, log)),
        set_valued=not breaks_away and solver is None,
        solver=solver,
    )
    if log.passive and solver is None:
        # Without noise of a force the phase of a swing is so precise that it shows the error of a step.
        numerics = replace(numerics, substeps=max(numerics.substeps, _FREE))
    if not numerics.set_valued and solver is None:
        numerics = replace(numerics, substeps=max(numerics.substeps, _sharp_steps(machine, log)))
    if machine.controller is not None or not segments:
        return numerics
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    run = eqx.filter_jit(lambda r, p: r(p).position)(replay, machine.plant)
    off = np.sqrt(np.nanmean((np.asarray(run) - log.position) ** 2))
    if np.isfinite(off) and off < _LOST * np.nanstd(log.position):
        return numerics
    length = max(20, log.samples // _SEGMENTS)
    return replace(numerics, segment=length)


def turning_steps(machine: Machine, log: Log) -> int:
    """Return the steps per sample that keep the error at reversals of dry friction below the noise.

    A joint that comes to rest within a step h is afterwards off by about 0.04 F / m h^2 with F its dry
    friction; a tenth of a reading's noise is small enough for thousands of samples.
    """
    plant, inertia = machine.plant, machine.plant.own_inertia()
    noise = position_noise(machine, log)
    if inertia is None or not np.any(noise > 0):
        return 1
    period = machine.controller.period if machine.controller is not None else log.period
    # Noise of a velocity moves an integrated position by as much in one sample.
    noise = noise * log.period if log.integrated else noise
    n = log.position.shape[1]
    zero, u = jnp.zeros(n), jnp.zeros(log.force.shape[1])
    q = jnp.asarray(log.filled[0])
    dry = np.asarray(_levels(plant, q, zero, u))[:n]
    off = _TURNING * np.max(np.abs(dry) / np.broadcast_to(np.asarray(inertia), n)) * period**2
    return int(np.clip(np.ceil(np.sqrt(off / (_LITTLE * np.min(noise[noise > 0])))), 1, _MOST))


@kept_jit
def _levels(plant: Plant, q: Array, v: Array, u: Array) -> Array:
    """Return the level of dry friction at rest by port, including break-away [N or N m]."""
    levels = plant.balance(q, v, v, u, jnp.zeros(()), plant.initial_states(u))
    return levels.dry + levels.stick


def _sharp_steps(machine: Machine, log: Log) -> int:
    """Return the steps per sample that the smoothed sign needs; with fewer steps the gradient is wrong."""
    period = machine.controller.period if machine.controller is not None else log.period
    picks = np.linspace(0, log.samples - 1, 50).astype(int)
    q, u = jnp.asarray(log.filled[picks]), jnp.asarray(log.force[picks] * machine.gain)
    drive = Drive(jnp.asarray(machine.gain), period)
    return needed_substeps(machine.plant, drive, q, jnp.zeros_like(q), u)


def _failure(minimum: Minimum, minimiser: str | Minimiser | None) -> str:
    if not np.isfinite(float(minimum.cost)):
        return "the simulation diverged from these starting values"
    if minimum.failure is not None:
        return failure_text(minimum, minimiser_name(minimiser))
    return f"no convergence within {int(minimum.steps)} steps"


def notes_of(
    machine: Machine,
    numerics: Numerics,
    log: Log,
    on: str,
    minimiser: str | Minimiser | None = None,
) -> tuple[str, ...]:
    """Return remarks for the user about simulation and minimisation."""
    where = "in the loop" if machine.controller is not None else "open loop"
    how = "sticks exactly" if numerics.sticks else "is smoothed"
    steps = f"{numerics.substeps} step(s) a sample"
    if numerics.solver is not None:
        steps = f"by diffrax's {numerics.solver}, each step within {RELATIVE:g}"
    notes = [f"simulated {where}, {steps}; dry friction {how}"]
    if on != "position":
        notes.append(f"fitted on {'position and force' if on == 'both' else on}")
    if numerics.segment:
        seconds = numerics.segment * log.period
        notes.append(f"restarted from the log every {seconds:.3g} s, because it would drift off otherwise")
    if minimiser_of(minimiser) is not None:
        notes.append(f"minimised by {minimiser_name(minimiser)}")
    return tuple(notes)
