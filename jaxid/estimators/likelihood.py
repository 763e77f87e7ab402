"""The likelihood of the innovations of one log, and the noise at which its fit starts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.consistency.law import LawCommand, noise_free_command
from jaxid.errors import InputError
from jaxid.estimators.common.levenberg_marquardt import Transform
from jaxid.estimators.innovations import Innovations
from jaxid.logs.log import Log
from jaxid.logs.prepare import smeared
from jaxid.machine import Machine
from jaxid.model.balance import Balance
from jaxid.numerics.affine import depends
from jaxid.simulation.kalman import KalmanFilter, make_filter, slow_samples, smooth_steps
from jaxid.simulation.replay import Numerics, exact_numerics
from jaxid.simulation.sensor_noise import position_noise
from jaxid.simulation.step_size import needed_steps

# Noise of the force at the start, as a part of the force; a large one makes a wrong model possible.
_FORCE_NOISE = 0.1
# Lowest noise of the force in turn, as a part of it. The likelihood of a machine without noise is a narrow
# curved valley: a fit at a higher noise leads close to its floor. The last one is below any drive's noise,
# and above the error of the steps at reversals, which is larger where joints push each other or friction
# changes with speed.
_FLOORS, _LOWEST = (1e-2, 1e-3, 1e-4), 1e-5
# That of a fit with the samples at rest, whose steps are finer.
_QUIETEST = 1e-6
# Largest noise of the force, as a part of it; noise of a reading, as a multiple of its first estimate.
_MOST, _READING_RANGE = 1e2, (1e-3, 1e3)
# Noise of the force, as a part of it, below which sticking is certain.
_QUIET = 1e-3
# First samples of a log with dry friction: a filter that begins with the wrong direction of motion takes the
# friction for certain, and keeps its error.
_BEGINS = 4
# Steps of the last fit of such a log for each one before, and least number with a lag in the drive or with
# friction that changes with speed.
_FINER = 4
# Factor on the steps that the fastest rate needs, in the last fit: the error of a joint that comes to rest
# behind a spring within a step grows with the square of that step.
_FINER_BY_RATE = 40.0


@dataclass(frozen=True)
class Likelihood:
    """The likelihood of a log with what a fit of it starts from.

    Args:
        problem: The likelihood, at the highest floor of the noise.
        machine: The machine at its guesses.
        log: The log, whose force is the command that drives the filter.
        numerics: Settings of the integration.
        law: Command of the declared law, if it explains the logged one; None: the logged one drives.
        unsure: Mask of the samples that never count, (time, n); None: all may count. Those are the first
            ones, as with dry friction the velocity at the start is not known well enough, and as a logged
            command that stands in place of that of the law has the noise of its reading; and those under a
            force whose recording is clipped.
        slow: Mask of the samples at rest, which do not count; None: all count.
        force: Size of the logged force, (m,).
        noise: Logarithms of the noise at the start, of the force and then of the readings, (m + k,).
        floors: Lower bounds on them, in turn.
        quietest: Lower bounds on them in a fit with the samples at rest that has come to the last of these;
            None: there are no lower ones.
    """

    problem: Innovations
    machine: Machine
    log: Log
    numerics: Numerics
    law: LawCommand | None
    unsure: np.ndarray | None
    slow: np.ndarray | None
    force: np.ndarray
    noise: np.ndarray
    floors: Sequence[np.ndarray]
    quietest: np.ndarray | None

    def sticks_surely(self, noise: np.ndarray) -> bool:
        """Check that there is so little noise of the force that it is known when a joint sticks."""
        if self.slow is None:
            return False
        return bool(np.all(np.exp(noise[: len(self.force)]) < _QUIET * self.force))

    def at_rest_too(self, problem: Innovations) -> Innovations:
        """Return the likelihood with the samples at rest."""
        # So precise a fit shows the error of a step in which a joint comes to rest.
        steps = _FINER * self.numerics.substeps
        if not self.machine.plant.coupled:  # joints that push each other take too long with still more
            steps = max(steps, needed_steps(self.machine, self.log, finer=_FINER_BY_RATE))
        finer = replace(self.numerics, substeps=steps)
        offset = None if self.law is None else self.law.offset
        kalman = make_filter(self.machine, self.log, finer, self.unsure, offset)
        return problem._replace(kalman=kalman, counts=_counted(kalman, self.log, self.unsure))


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
    law = noise_free_command(machine, log)
    driven = log if law is None else replace(log, force=law.command)
    slow = None
    if rest_velocity is not None and slides(machine, log):
        slow = slow_samples(log, rest_velocity)
    unsure = _unsure(log, _BEGINS if slow is not None else 0, 0 if law is None else law.logged)
    if unsure is not None:
        slow = unsure if slow is None else slow | unsure
    kalman = make_filter(machine, driven, numerics, slow, None if law is None else law.offset)
    counts = _counted(kalman, log, slow)
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
    rough = machine.plant.coupled or _friction_follows_speed(machine, log)
    lowest = _FLOORS if rough else (*_FLOORS, _LOWEST)
    floors = [np.log(np.concatenate([f * force, _READING_RANGE[0] * reading])) for f in lowest]
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
    return Likelihood(
        problem=problem,
        machine=machine,
        log=driven,
        numerics=numerics,
        law=law,
        unsure=unsure,
        slow=slow,
        force=force,
        noise=noise,
        floors=floors,
        quietest=None if rough else np.log(np.concatenate([_QUIETEST * force, _READING_RANGE[0] * reading])),
    )


def _unsure(log: Log, *first: int) -> np.ndarray | None:
    """Return the mask of the first samples and of those under a clipped force, (time, n); None for none.

    A clipped force acts from the sample before it at the earliest, and up to the one behind it.
    """
    if not any(first) and log.clipped is None:
        return None
    unsure = np.zeros(log.position.shape, bool)
    unsure[: max(first)] = True
    if log.clipped is not None:
        unsure |= smeared(np.asarray(np.any(log.clipped, axis=1, keepdims=True)), 1)
    return unsure


def _counted(kalman: KalmanFilter, log: Log, left_out: np.ndarray | None) -> np.ndarray:
    """Return the mask of the innovations that count, (time, k).

    Args:
        kalman: The filter.
        log: Its log.
        left_out: Mask of the samples that do not count, (time, n); None: all may count.
    """
    counts = np.asarray(kalman.used)[:: kalman.every]
    return (counts if left_out is None else counts & ~left_out)[:, list(log.measured)]


def needed_numerics(machine: Machine, log: Log, start: np.ndarray | None) -> Numerics:
    """Return the settings of the integration that a machine needs at its start."""
    # Guesses that are far off, such as inertias of no possible body, may need many more steps.
    near = machine if start is None else machine.with_estimate(np.clip(start, *machine.parameters.bounds))
    steps = needed_steps(near, log)
    own = machine.plant.initial_states(jnp.zeros(machine.gain.size))
    lags = bool(jax.tree.leaves(own)) and slides(machine, log)
    if lags or _friction_follows_speed(machine, log):
        # Behind a lag the force changes within a step, and with it the instant at which a joint turns. The
        # friction of one long step is that of its middle: its error looks like noise of the force, under
        # which the likelihood neither finds the friction's speed nor counts the samples at rest.
        steps = max(steps, _FINER)
    return exact_numerics(machine, log, steps)


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
    # Shapes tell: no operation is compiled.
    balance = _balance(machine, log)
    return bool(jax.eval_shape(balance, jnp.zeros_like(log.filled[0])).slides)


def _friction_follows_speed(machine: Machine, log: Log) -> bool:
    """Check that a level of dry friction changes with the velocity."""
    balance = _balance(machine, log)
    still = jnp.zeros_like(log.filled[0])
    return depends(lambda qd: [getattr(balance(qd), level) for level in ("dry", "stick")], (still,))


def _balance(machine: Machine, log: Log) -> Callable[[Array], Balance]:
    """Return the balance at the first sample as a function of the velocity, (n,)."""
    plant = machine.plant

    def balance(qd: Array) -> Balance:
        q, u = jnp.asarray(log.filled[0]), jnp.asarray(log.force[0])
        return plant.balance(q, qd, jnp.zeros_like(q), u, jnp.zeros(()), plant.initial_states(u))

    return balance
