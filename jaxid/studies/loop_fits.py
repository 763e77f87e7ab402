"""Fits of output error to many simulated logs of a loop, as three compiled programs for a chunk of runs.

One program simulates and reads the logs, one solves their balances for the starts, and one fits. Between
them are transforms and sums of all runs at once. Decisions that a single fit takes from its log are taken
once, for the nominal log. A run that would decide otherwise is left to the estimators.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Transform, levenberg_marquardt
from jaxid.estimators.common.shapes import shapes
from jaxid.estimators.common.side_by_side import Ends, descend_side_by_side
from jaxid.estimators.inverse_dynamics import linear_scale, linear_unknowns
from jaxid.gap import SHORT
from jaxid.logs.prepare import Recipe, counted
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.smoothing import typical_velocity
from jaxid.model.unknowns import scatter
from jaxid.numerics.filters import Decimator, high_band_std_of_rows, spectral_rows
from jaxid.numerics.lanes import side_by_side
from jaxid.numerics.precision import NoiseModel, assess_from_sums, sandwich
from jaxid.session import Session, enough
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.force_balance import ForceData, force_residual, size_of_force
from jaxid.simulation.loops import closed_loop
from jaxid.simulation.replay import Numerics, Replay, line_at, make_replay, start_shows_by_run
from jaxid.studies.levels import Level
from jaxid.studies.plan import Plan, accelerator
from jaxid.studies.rows import RunRow

# The unknowns of a start are identifiable if a standard deviation, as a force, is at most this part of the
# measured one: as in `jaxid.numerics.precision`.
_SURELY = 0.5
# Runs side by side on a processor: twice as many no longer fit its caches.
_LANES = 8
# Samples of a Jacobian that are copied at once.
_AT_ONCE = 1000


# Rows of a run by estimator, its reference, and the motion that followed it, (time, n).
Fitted = tuple[list[RunRow], np.ndarray | None, np.ndarray]


@dataclass(frozen=True)
class _Logs:
    """Simulated logs of a chunk of runs.

    Args:
        position: Readings, (time, runs, n).
        force: Logged commands, (time, runs, m).
        followed: True positions at the samples, (time, runs, n).
    """

    position: np.ndarray
    force: np.ndarray
    followed: np.ndarray


@dataclass(frozen=True)
class LoopFits:
    """Fits of output error at one level of a study.

    Args:
        plan: The study.
        level: The level.
        machine: The machine of the model, at the guesses.
        recipe: Filter of the logs.
        replay: The simulation of the nominal log.
    """

    plan: Plan
    level: Level
    machine: Machine
    recipe: Recipe
    replay: Replay

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
            and recipe.median is None
            and all(session.fit.log.measured)
            and session.fit.log.samples > SHORT
            and not machine.parameters.bodies
            and bool(np.all(linear_unknowns(machine)))
            and not np.any(shapes(machine))
            and not _delays(machine)
        )
        if not plain:
            return None
        return cls(plan, level, machine, recipe, make_replay(session.machine, session.fit.log, numerics))

    def rows(self, runs: Sequence[int]) -> list[Fitted | None]:
        """Return for each run its row, the reference and the true motion; None for a run that is left.

        Args:
            runs: Numbers of the runs; fewer than a chunk are filled up, so that one shape serves all.
        """
        lanes = self.plan.chunk if accelerator() else min(self.plan.chunk, _LANES)
        groups = [runs[first : first + lanes] for first in range(0, len(runs), lanes)]
        return [row for group in groups for row in self._rows_of_group(group, lanes)]

    def _rows_of_group(self, runs: Sequence[int], lanes: int) -> list:
        filled = [*runs, *[runs[-1]] * (lanes - len(runs))]
        drawn = [self.plan.drawn(k) for k in filled]
        logs = self._simulated(drawn)
        sound = np.all(np.isfinite(logs.position), axis=(0, 2)) & np.all(
            np.isfinite(logs.followed), axis=(0, 2)
        )
        if not np.any(sound):
            return [None] * len(runs)
        by_run = np.ascontiguousarray(np.moveaxis(logs.position, 0, -1))
        guesses = np.stack([start for _, start, _ in drawn])
        theta, velocity, good = self._starts(logs, by_run, guesses)
        ends = self._fitted(logs, by_run, theta, velocity)
        return self._rows(logs, ends, sound & good)[: len(runs)]

    def _simulated(self, drawn: list[tuple[np.ndarray, np.ndarray, np.random.Generator]]) -> _Logs:
        """Simulate and read the logs; every run draws its noise as `Scene.simulated_log` does."""
        scene = self.level.scene
        machine, ticks = scene.machine, len(scene.signal)
        joints, drives = self.machine.plant.joints, machine.gain.size
        pick = slice(None, None, scene.every)
        noise = np.empty((len(drawn), ticks, joints))
        samples = len(range(0, ticks, scene.every))
        of_command = np.zeros((len(drawn), samples, drives))
        for k, (_, _, rng) in enumerate(drawn):
            rng.standard_normal(out=noise[k])
            if machine.sensor.force_noise is not None:
                rng.standard_normal(out=of_command[k])
        truth = np.stack([truth for truth, _, _ in drawn])
        extra = disturbance_at(machine.disturbance, scene.drive.period * np.arange(ticks))
        run = _simulate(
            machine.parameters.places, machine.plant, scene.drive, machine.controller, scene.signal, extra,
            scene.position, scene.velocity, machine.sensor, truth, noise,
        )  # fmt: skip
        position, command, reading = (np.asarray(x)[pick] for x in run)
        read = lambda u, e: np.asarray(machine.sensor.read_command(u, e))
        return _Logs(reading, read(command, np.swapaxes(of_command, 0, 1)), position)

    def _starts(
        self, logs: _Logs, by_run: Float[np.ndarray, "runs n time"], guesses: Float[np.ndarray, "runs p"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve the balances; return the starts, the scales of the velocity, and the mask of sound starts."""
        recipe, machine, period = self.recipe, self.machine, self.replay.drive.period * self.replay.every
        runs, n, time = by_run.shape
        motion = spectral_rows(by_run.reshape(runs * n, time), period, recipe.cutoff_hz)
        q, qd, qdd = (np.moveaxis(x.reshape(runs, n, time), 1, 2) for x in motion)
        counts = np.stack([counted(v, recipe, (True,) * n)[1] for v in qd])
        lower, upper = self._bounds(guesses)

        plant = machine.plant.smoothed(np.asarray(1 / 3), self._rest_velocity())
        hold = recipe.hold_of(self.level.scene.machine.hold, machine.hold_period or period)
        transform, damping = linear_scale(machine)
        force = np.swapaxes(logs.force, 0, 1) * machine.gain
        found = _solve_balances(
            plant, machine.parameters.places, (q, qd, qdd, force, counts.astype(float)),
            period, hold, recipe.decimator, guesses, transform, (lower, upper), damping,
        )  # fmt: skip
        theta, cost, gram, size, converged = (np.asarray(x) for x in found)
        good = converged & (counts.sum(axis=(1, 2)) >= enough(machine))
        good &= np.all((theta >= lower) & (theta <= upper), axis=1)
        return theta, self._velocities(qd), good & self._identified(guesses, cost, gram, size)

    def _velocities(self, qd: Float[np.ndarray, "runs time n"]) -> np.ndarray:
        """Return the scale of the smoothed sign's velocity by run, as a session takes it from its log."""
        plant = self.machine.plant
        if len(plant.velocity_groups()) == 1:
            return np.sqrt(np.mean(qd**2, axis=(1, 2)))
        rms = lambda v: float(np.sqrt(np.mean(v**2)))
        return np.stack([typical_velocity(plant, v, rms) for v in qd])

    def _rest_velocity(self) -> np.ndarray:
        """Return the velocity scale of the smoothed sign in the balance, see `force_balance.sharpened`."""
        return typical_velocity(self.machine.plant, np.asarray(self.recipe.rest_velocity)[None], np.min)

    def _bounds(self, theta: Float[np.ndarray, "runs p"]) -> tuple[np.ndarray, np.ndarray]:
        bounds = [self.machine.parameters.with_guess(row.tolist()).bounds for row in theta]
        return np.stack([lower for lower, _ in bounds]), np.stack([upper for _, upper in bounds])

    def _identified(
        self, guesses: np.ndarray, cost: np.ndarray, gram: np.ndarray, size: np.ndarray
    ) -> np.ndarray:
        """Return whether the balance identifies all unknowns, whatever the colour of its residual, (runs,).

        The variance of a sum over the samples is at most their number times that of one sample, which is
        twice the cost; a padded transform may double it. A run that fails here may still be identified.
        """
        norm = np.sqrt(np.einsum("kii->ki", gram))
        scale = np.where(guesses != 0, guesses, 1.0)
        alive = np.all(norm * np.abs(scale) > 1e-9 * size[:, None], axis=1)
        safe = np.where(norm > 0, norm, 1.0)
        smallest = np.linalg.eigvalsh(gram / (safe[:, :, None] * safe[:, None]))[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.sqrt(4 * cost / smallest)
        return alive & (smallest > 1e-9) & (spread <= _SURELY * size)

    def _fitted(self, logs: _Logs, by_run: np.ndarray, theta: np.ndarray, velocity: np.ndarray) -> Ends:
        """Fit from the starts."""
        runs, n, time = by_run.shape
        period = self.replay.drive.period * self.replay.every
        noise = high_band_std_of_rows(by_run.reshape(runs * n, time))
        head = logs.position[:64].reshape(-1, runs * n)
        begun = line_at(head, period, 0, noise)[1].reshape(runs, n)
        transform = Transform.of(self.machine.parameters)
        return _fit(
            self.replay, self.machine.parameters.places, self.machine.plant, logs.position,
            (logs.position[0], begun, velocity), theta, transform, self._bounds(theta),
        )  # fmt: skip

    def _rows(self, logs: _Logs, ends: Ends, good: np.ndarray) -> list:
        names, reference = self.machine.parameters.names, self.level.scene.signal[:: self.level.scene.every]
        theta, gram, steps = (np.asarray(x) for x in (ends.theta, ends.gram, ends.steps))
        converged, residual = np.asarray(ends.converged), np.asarray(ends.residual)
        jacobian = _by_run(np.asarray(ends.jacobian))
        runs, n = residual.shape[1:]
        e = np.moveaxis(residual, 0, -1).reshape(runs * n, -1)
        noises = NoiseModel.fit_each(np.where(np.isfinite(e), e, 0.0))
        centred = logs.position - logs.position.mean(axis=0)
        signal = np.sqrt(np.sum(centred**2, axis=(0, 2)))
        shows = start_shows_by_run(residual)
        out: list = []
        for k in range(runs):
            if not (good[k] and converged[k]) or shows[k]:
                out.append(None)
                continue
            own = noises[k * n : (k + 1) * n]
            white = n == 1 and not own[0].coefficients.size
            meat = own[0].innovation ** 2 * gram[k] if white else sum(
                sandwich(jacobian[k, i].T, noise) for i, noise in enumerate(own)
            )  # fmt: skip
            scale = np.where(theta[k] != 0, theta[k], 1.0)
            found = assess_from_sums(names, gram[k], np.asarray(meat), float(signal[k]), scale)
            row = RunRow.fitted(theta[k], found.std, found.identifiable, int(steps[k]))
            out.append(([row], reference, logs.followed[:, k]))
        return out


def _by_run(jacobian: Float[np.ndarray, "time p runs n"]) -> Float[np.ndarray, "runs n p time"]:
    """Return Jacobians run by run; a few samples after the others, which then stay in the cache."""
    time, p, runs, n = jacobian.shape
    out = np.empty((runs, n, p, time))
    for first in range(0, time, _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        out[..., part] = jacobian[part].transpose(2, 3, 1, 0)
    return out


def _delays(machine: Machine) -> bool:
    """Check that a loop may have to keep more past commands as a fit goes on."""
    return any(e.delays_command() for e in machine.plant.effects)


@side_by_side
def _simulate(
    places: tuple,
    plant: Plant,
    drive: Any,
    controller: Any,
    signal: Array,
    extra: Array,
    position: Array,
    velocity: Array,
    sensor: Any,
    truth: Float[Array, "runs p"],
    noise: Float[Array, "runs ticks n"],
) -> tuple[Array, Array, Array]:
    """Return position, command and reading of all runs at every tick, (ticks, runs, width)."""

    def one(truth: Array, noise: Array) -> tuple[Array, Array, Array]:
        own = scatter(places, plant, truth)
        run = closed_loop(own, drive, controller, signal, extra, position, velocity, sensor, noise)
        return run.position, run.command, run.reading

    return jax.vmap(one, out_axes=1)(truth, noise)


@side_by_side
def _solve_balances(
    plant: Plant,
    places: tuple,
    arrays: tuple[Array, Array, Array, Array, Array],
    period: float,
    hold: float,
    decimator: Decimator,
    theta: Float[Array, "runs p"],
    transform: Transform,
    bounds: tuple[Array, Array],
    damping: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Return estimates of inverse dynamics, cost, J'J, size of the force, and convergence, by run."""

    def one(theta: Array, lower: Array, upper: Array, arrays: tuple) -> tuple:
        every = (True,) * arrays[0].shape[1]
        q, qd, qdd, force, weight = arrays
        data = ForceData(q, qd, qdd, force, weight, jnp.zeros(()), period, hold, decimator, every)
        balance = lambda x: (data.weight * force_residual(scatter(places, plant, x), data)).ravel()
        # The balance is linear in the unknowns: its columns are computed once.
        push = lambda d: jax.jvp(balance, (theta,), (d,))
        here, columns = jax.vmap(push, out_axes=(None, 1))(jnp.eye(theta.size))
        fit = levenberg_marquardt(
            lambda x: here + columns @ (x - theta),
            theta,
            transform,
            lower,
            upper,
            damping=damping,
            keep=False,
        )
        return fit.theta, fit.cost, columns.T @ columns, size_of_force(plant, data), fit.converged

    return jax.vmap(one)(theta, *bounds, arrays)


@side_by_side
def _fit(
    replay: Replay,
    places: tuple,
    plant: Plant,
    measured: Float[Array, "time runs n"],
    starts: tuple[Array, Array, Array],
    theta: Float[Array, "runs p"],
    transform: Transform,
    bounds: tuple[Array, Array],
) -> Ends:
    def one(theta: Array, position: Array, velocity: Array, scale: Array) -> Array:
        run = replace(replay, position=position, velocity=velocity)
        return run(scatter(places, plant.smoothed(velocity_scale=scale), theta)).position

    residual = lambda theta: measured - jax.vmap(one, out_axes=1)(theta, *starts)
    return descend_side_by_side(residual, theta, transform, *bounds)
