"""Fits of output error to many simulated logs of a loop: one compiled program from noise to intervals.

Its arrays hold a chunk of runs side by side. Decisions that a single fit takes from its log are taken once,
for the nominal log. A run that would decide otherwise is left to the estimators.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Generic

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import A, Array
from jaxid.controllers import Controller
from jaxid.estimators.common.levenberg_marquardt import Transform, levenberg_marquardt
from jaxid.estimators.common.shapes import shapes
from jaxid.estimators.common.side_by_side import Ends, descend_side_by_side
from jaxid.estimators.inverse_dynamics import linear_scale, linear_unknowns
from jaxid.gap import SHORT
from jaxid.logs.prepare import Recipe, counted_as, reach_around
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.model.unknowns import scatter
from jaxid.numerics.coloured_noise import autoregressions, sandwiches
from jaxid.numerics.filters import high_band_std_of_rows, spectral_rows
from jaxid.numerics.lanes import accelerator, cores, side_by_side
from jaxid.numerics.precision import assess_from_sums, deviations
from jaxid.sensors.encoder import Sensor
from jaxid.session import Session, enough
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.force_balance import ForceData, force_residual, size_of_force
from jaxid.simulation.loops import Drive, closed_loop
from jaxid.simulation.replay import Numerics, Replay, line_at, make_replay, start_shows_by_run
from jaxid.studies.levels import Level
from jaxid.studies.plan import Draw, Plan
from jaxid.studies.rows import Arrays, converged, tracking_of

# The unknowns of a start are identifiable if a standard deviation, as a force, is at most this part of the
# measured one: as in `jaxid.numerics.precision`.
_SURELY = 0.5
# Runs side by side on a processor: twice as many no longer fit its caches.
_LANES = 8
# First samples that the velocity at the start is read from.
_HEAD = 64

# Position, velocity, acceleration, force, and whether a kept sample counts, as in `ForceData`.
_Motion = tuple[Array, Array, Array, Array, Array]


class _Level(eqx.Module):
    """Everything that the runs of a level have in common.

    Args:
        plant, places: The simulated plant, and the places of its unknowns.
        drive, controller, signal, disturbance, position, velocity, sensor: Its loop, see `closed_loop`.
        model, model_places: The plant of the model, and the places of its unknowns.
        gain: Declared force per unit of command.
        replay: The simulation of the nominal log.
        rest_velocity: Scale of the smoothed sign in the balance, see `force_balance.sharpened`.
        linear, transform: Scales of the unknowns in the balance and in the fit.
        recipe: Filter of the logs.
        reach: Number of samples that are omitted around stops and reversals.
        hold: Time for which a command is held [s].
        damping: Damping of the fit to the balance.
        enough: Samples of motion that a log must have.
    """

    plant: Plant
    drive: Drive
    controller: Controller
    signal: Array
    disturbance: Array
    position: Array
    velocity: Array
    sensor: Sensor
    model: Plant
    gain: Array
    replay: Replay
    rest_velocity: Array
    linear: Transform
    transform: Transform
    places: tuple = eqx.field(static=True)
    model_places: tuple = eqx.field(static=True)
    recipe: Recipe = eqx.field(static=True)
    reach: int = eqx.field(static=True)
    hold: float = eqx.field(static=True)
    damping: float = eqx.field(static=True)
    enough: int = eqx.field(static=True)

    @classmethod
    def of(cls, level: Level, session: Session, numerics: Numerics) -> _Level:
        """Collect them from a level and the session of its nominal log."""
        scene, model, recipe, data = level.scene, level.machine, session.recipe, session.fit.data
        machine, controller = scene.machine, scene.machine.controller
        assert controller is not None, "only loops are fitted so"
        times = scene.drive.period * np.arange(len(scene.signal))
        transform, damping = linear_scale(model)
        return cls(
            plant=machine.plant,
            drive=scene.drive,
            controller=controller,
            signal=scene.signal,
            disturbance=disturbance_at(machine.disturbance, times),
            position=scene.position,
            velocity=scene.velocity,
            sensor=machine.sensor,
            model=model.plant,
            gain=np.asarray(model.gain),
            replay=make_replay(session.machine, session.fit.log, numerics),
            rest_velocity=typical_velocity(model.plant, np.asarray(recipe.rest_velocity)[None], np.min),
            linear=transform,
            transform=Transform.of(model.parameters),
            places=machine.parameters.places,
            model_places=model.parameters.places,
            recipe=recipe,
            reach=reach_around(data.qd, recipe),
            hold=recipe.hold_of(machine.hold, model.hold_period or data.period),
            damping=damping,
            enough=enough(model),
        )


class _Found(eqx.Module, Generic[A]):
    """Results of the program, by run.

    Args:
        theta, steps: Estimates and numbers of evaluations, (runs, p) and (runs,).
        gram, meat: Matrices J'J and J'RJ of the fit, (runs, p, p) each.
        signal: 2-norm of the centred readings, (runs,).
        tracking: Tracking errors, see `tracking_of`.
        good: Whether no decision of the run differs from that of the nominal log, (runs,).
        balance: Matrix J'J of the balance, (runs, p, p); its cost (runs,), and size of the force (runs,).
    """

    theta: Float[A, "runs p"]
    steps: A
    gram: Float[A, "runs p p"]
    meat: Float[A, "runs p p"]
    signal: Float[A, " runs"]
    tracking: Float[A, "runs drives 2"]
    good: Bool[A, " runs"]
    balance: tuple[Float[A, "runs p p"], Float[A, " runs"], Float[A, " runs"]]


@dataclass(frozen=True)
class LoopFits:
    """Fits of output error at one level of a study.

    Args:
        plan: The study.
        machine: The machine of the model, at the guesses.
        level: Everything that the runs have in common.
    """

    plan: Plan
    machine: Machine
    level: _Level
    _device: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, plan: Plan, level: Level, session: Session, numerics: Numerics | None) -> LoopFits | None:
        """Return the fits of a level; None if any of them may take a decision that is not taken here.

        Args:
            plan: The study.
            level: The level.
            session: The session of its nominal log.
            numerics: Integration of the fits.
        """
        case, machine, recipe = level.model, level.machine, session.recipe
        if plan.estimators != ("output_error",) or numerics is None or level.scene.machine.controller is None:
            return None
        stated, sensor, law = case.output_error, level.scene.machine.sensor, level.scene.machine.controller
        plain = (
            not case.fits_within_prior("output_error")
            and not case.identification.physically_consistent
            and not case.identification.hessian
            and not case.identification.profile
            and stated.on == "position"
            and stated.start == "inverse_dynamics"
            and stated.minimiser is None
            and numerics.solver is None
            and numerics.segment is None
            and "estimator" not in law.of_machine
            and sensor.inertial is None
            and machine.unknown_reference is None
            and not isinstance(machine.disturbance, str)
            and recipe.derivatives == "spectral"
            and not recipe.keeps_reversals
            and recipe.median is None
            and all(session.fit.log.measured)
            and session.fit.log.samples > SHORT
            and not machine.parameters.bodies
            and bool(np.all(linear_unknowns(machine)))
            and not np.any(shapes(machine))
            and not _delays(machine)
        )
        return cls(plan, machine, _Level.of(level, session, numerics)) if plain else None

    def fitted(self, drawn: Sequence[Draw]) -> tuple[Bool[np.ndarray, " runs"], Arrays]:
        """Fit the runs that have these draws.

        Args:
            drawn: Truth, start and generator of each run.

        Returns:
            The mask of the runs that are done, and the columns of all of them with their `tracking`,
            (1, runs, ...) each. The others are left to the estimators, which draw the same noise.
        """
        lanes = self.plan.chunk if accelerator() else min(self.plan.chunk, _LANES)
        parts = [self._fitted(drawn[first : first + lanes], lanes) for first in range(0, len(drawn), lanes)]
        done = np.concatenate([done for done, _ in parts])
        return done, {n: np.concatenate([columns[n] for _, columns in parts], axis=1) for n in parts[0][1]}

    def _fitted(self, drawn: Sequence[Draw], lanes: int) -> tuple[np.ndarray, Arrays]:
        """Fit the runs of one call; fewer than its lanes are filled up, so that one shape serves all."""
        filled = [*range(len(drawn)), *[len(drawn) - 1] * (lanes - len(drawn))]
        truth, start = np.stack([drawn[k][0] for k in filled]), np.stack([drawn[k][1] for k in filled])
        bounds = self.machine.parameters.bounds_at(start)
        noise = self._noise(drawn, lanes)
        # An accelerator has memory for one chunk; on a processor each thread has its own.
        with self._device if accelerator() else contextlib.nullcontext():
            filled_up = _program(self.level, truth, start, bounds, *noise)
            found: _Found[np.ndarray] = jax.tree.map(lambda x: np.asarray(x)[: len(drawn)], filled_up)
        std, known = deviations(found.gram, found.meat, found.signal, _scale(found.theta))
        identifiable = np.ones(std.shape, bool)
        good = found.good & _identified(start[: len(drawn)], *found.balance)
        for k in np.flatnonzero(good & ~known):
            sums = found.gram[k], found.meat[k], float(found.signal[k]), _scale(found.theta[k])
            precision = assess_from_sums(self.machine.parameters.names, *sums)
            std[k], identifiable[k] = precision.std, precision.identifiable
        columns = converged(found.theta, std, identifiable, found.steps)
        return good, columns | {"tracking": found.tracking[None]}

    def _noise(self, drawn: Sequence[Draw], lanes: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw the noise of readings and logged commands, as `Scene.simulated_log` does."""
        level, ticks = self.level, len(self.level.signal)
        rows, logged = len(range(0, ticks, level.replay.every)), level.sensor.force_noise is not None
        make = np.empty if len(drawn) == lanes and logged else np.zeros
        of_readings = make((lanes, ticks, len(level.position)))
        of_command = make((lanes, rows, level.gain.size))

        def draw(k: int) -> None:
            rng = drawn[k][2]
            rng.standard_normal(out=of_readings[k])
            if logged:
                rng.standard_normal(out=of_command[k])

        # On a processor the chunks of a study are in threads already.
        with ThreadPoolExecutor(cores() if accelerator() else 1) as pool:
            list(pool.map(draw, range(len(drawn))))
        return of_readings, of_command


def _scale(theta: np.ndarray) -> np.ndarray:
    return np.where(theta != 0, theta, 1.0)


def _identified(
    guesses: Float[np.ndarray, "runs p"],
    gram: Float[np.ndarray, "runs p p"],
    cost: Float[np.ndarray, " runs"],
    size: Float[np.ndarray, " runs"],
) -> Bool[np.ndarray, " runs"]:
    """Return whether the balance identifies all unknowns, whatever the colour of its residual.

    The variance of a sum over the samples is at most their number times that of one sample, which is
    twice the cost; a padded transform may double it. A run that fails here may still be identified.
    """
    norm = np.sqrt(np.einsum("kii->ki", gram))
    alive = np.all(norm * np.abs(_scale(guesses)) > 1e-9 * size[:, None], axis=1)
    safe = np.where(norm > 0, norm, 1.0)
    scaled = np.where(alive[:, None, None], gram / (safe[:, :, None] * safe[:, None]), 0.0)
    smallest = np.linalg.eigvalsh(scaled)[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(4 * cost / smallest)
    return alive & (smallest > 1e-9) & (spread <= _SURELY * size)


def _delays(machine: Machine) -> bool:
    """Check that a loop may have to keep more past commands as a fit goes on."""
    return any(e.delays_command() for e in machine.plant.effects)


@side_by_side
def _program(
    level: _Level,
    truth: Float[Array, "runs q"],
    start: Float[Array, "runs p"],
    bounds: tuple[Float[Array, "runs p"], Float[Array, "runs p"]],
    noise: Float[Array, "runs ticks n"],
    noise_of_command: Float[Array, "runs time m"],
) -> _Found[Array]:
    """Simulate, read, filter and fit all runs, and sum up what their intervals need."""
    every, period = level.replay.every, level.replay.drive.period * level.replay.every
    position, command, reading = (x[::every] for x in _simulated(level, truth, noise))
    force = level.sensor.read_command(command, jnp.swapaxes(noise_of_command, 0, 1))
    time, runs, n = reading.shape
    rows = jnp.moveaxis(reading, 0, -1).reshape(runs * n, time)

    smooth = spectral_rows(rows, period, level.recipe.cutoff_hz)
    q, qd, qdd = (jnp.swapaxes(x.reshape(runs, n, time), 1, 2) for x in smooth)
    counts, same = jax.vmap(lambda v: counted_as(v, level.recipe, level.reach))(qd)
    arrays = (q, qd, qdd, jnp.swapaxes(force, 0, 1) * level.gain, counts.astype(float))
    begun, balance, solved = _started(level, start, bounds, arrays)

    std = high_band_std_of_rows(rows)
    velocity = line_at(reading[:_HEAD].reshape(-1, runs * n), period, 0, std)[1].reshape(runs, n)
    rms = lambda v: jnp.sqrt(jnp.mean(v**2))
    speed = jax.vmap(lambda v: typical_velocity(level.model, v, rms))(qd)
    ends = _ends(level, reading, (reading[0], velocity, speed), begun, bounds)

    models = autoregressions(jnp.moveaxis(ends.residual, 0, -1).reshape(runs * n, time))
    columns = jnp.transpose(ends.jacobian, (2, 3, 1, 0)).reshape(runs * n, -1, time)
    meat = sandwiches(columns, *models)
    driven = list(level.plant.driven(n))
    finite = lambda x: jnp.all(jnp.isfinite(x), axis=(0, 2))
    inside = jnp.all((begun >= bounds[0]) & (begun <= bounds[1]), axis=1)
    return _Found(
        theta=ends.theta,
        steps=ends.steps,
        gram=ends.gram,
        meat=jnp.sum(meat.reshape(runs, n, *meat.shape[1:]), axis=1),
        signal=jnp.sqrt(jnp.sum((reading - jnp.mean(reading, axis=0)) ** 2, axis=(0, 2))),
        tracking=tracking_of(level.signal[::every, None], position[:, :, driven]),
        good=finite(position) & finite(reading) & same & solved & inside
        & (jnp.sum(counts, axis=(1, 2)) >= level.enough)
        & ends.converged & ~start_shows_by_run(ends.residual),
        balance=balance,
    )  # fmt: skip


def _simulated(
    level: _Level, truth: Float[Array, "runs q"], noise: Float[Array, "runs ticks n"]
) -> tuple[Array, Array, Array]:
    """Return position, command and reading of all runs at every tick, (ticks, runs, width)."""

    def one(truth: Array, noise: Array) -> tuple[Array, Array, Array]:
        plant = scatter(level.places, level.plant, truth)
        loop = (level.drive, level.controller, level.signal, level.disturbance)
        run = closed_loop(plant, *loop, level.position, level.velocity, level.sensor, noise)
        return run.position, run.command, run.reading

    return jax.vmap(one, out_axes=1)(truth, noise)


def _started(
    level: _Level, start: Float[Array, "runs p"], bounds: tuple[Array, Array], arrays: _Motion
) -> tuple[Array, tuple[Array, Array, Array], Array]:
    """Return estimates of inverse dynamics, its sums as `_Found.balance` has them, and its convergence."""
    plant = level.model.smoothed(np.asarray(1 / 3), level.rest_velocity)
    period, decimator = level.replay.drive.period * level.replay.every, level.recipe.decimator
    every = (True,) * arrays[0].shape[2]

    def one(theta: Array, lower: Array, upper: Array, arrays: _Motion) -> tuple:
        data = ForceData(*arrays, jnp.zeros(()), period, np.asarray(level.hold), decimator, every)

        def balance(x: Array) -> Array:
            return (data.weight * force_residual(scatter(level.model_places, plant, x), data)).ravel()

        # The balance is linear in the unknowns: its columns are computed once.
        push = lambda d: jax.jvp(balance, (theta,), (d,))
        here, columns = jax.vmap(push, out_axes=(None, 1))(jnp.eye(theta.size))
        line, damping = lambda x: here + columns @ (x - theta), level.damping
        fit = levenberg_marquardt(line, theta, level.linear, lower, upper, damping=damping, keep=False)
        return fit.theta, (columns.T @ columns, fit.cost, size_of_force(plant, data)), fit.converged

    return jax.vmap(one)(start, *bounds, arrays)


def _ends(
    level: _Level,
    measured: Float[Array, "time runs n"],
    starts: tuple[Float[Array, "runs n"], Float[Array, "runs n"], Array],
    theta: Float[Array, "runs p"],
    bounds: tuple[Array, Array],
) -> Ends:
    """Fit from position and velocity at the start, and the scale of the smoothed sign's velocity."""

    def one(theta: Array, position: Array, velocity: Array, scale: Array) -> Array:
        run = replace(level.replay, position=position, velocity=velocity)
        plant = level.model.smoothed(velocity_scale=scale)
        return run(scatter(level.model_places, plant, theta)).position

    residual = lambda theta: measured - jax.vmap(one, out_axes=1)(theta, *starts)
    return descend_side_by_side(residual, theta, level.transform, *bounds)
