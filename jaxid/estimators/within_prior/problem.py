"""The residual of a fit within a prior, in whitened coordinates of the unknowns."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.common.minimisers import Minimiser
from jaxid.estimators.simulated_output import measured_output, output_residual, turning_steps
from jaxid.estimators.within_prior.prior import Prior
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.replay import Numerics, Replay, from_rest, make_replay, with_sensor
from jaxid.simulation.step_size import steps_with_numerical_damping, with_numerical_damping

# Friction that acts only while the speed grows can hold a velocity constant, and the cost has a kink at
# each such point. Such a machine is fitted by continuation: this friction is smoothed over these fractions
# of its width, one after the other.
_SHARPNESSES = (1.0, 0.3, 0.1)


class WeightedResidual(eqx.Module):
    """The simulated log less the measured one, weighted; a tree of arrays for compiled functions.

    Args:
        replay: The simulation of the log: the loop, or the plant under the measured force.
        places: Paths of the unknowns in the plant.
        plant: The plant, at any values of the unknowns.
        measured: Measured output, (time, k) [units of the columns].
        weight: Weight of each entry, zero for entries that do not count, (time, k).
        prior: Prior of the unknowns, followed by that of the nuisance parameters.
        on: Output that is compared: "position", "force" or "both".
    """

    replay: Replay
    places: tuple
    plant: Plant
    measured: Array
    weight: Array
    prior: Prior
    on: str

    def at_sharpness(self, sharpness: Array) -> WeightedResidual:
        """Return the residual with the smoothed sign of the friction at another sharpness."""
        return replace(self, plant=self.plant.smoothed(sharpness))

    def from_start(self, start: Array) -> WeightedResidual:
        """Return the residual from shifted initial positions of the joints with an encoder."""
        return replace(self, replay=self.replay.started(start))

    @property
    def nuisances(self) -> int:
        """Number of nuisance parameters behind the unknowns."""
        return self.prior.base.size - len(self.places)

    def of_values(self) -> Callable[[Array, Array], Array]:
        """Return the residual as a function of physical unknowns and nuisance parameters."""
        physical = output_residual(self.replay, self.places, self.plant, self.measured, self.weight, self.on)

        def residual(theta: Array, start: Array) -> Array:
            # The nuisance parameters are initial positions; initial velocities are known to be those of the
            # log.
            if start.size:
                start = self.replay.follow @ start
            return physical(jnp.concatenate([theta, start, jnp.zeros_like(start)]))

        return residual

    def along(self, vectors: Array, origin: Array | float = 0.0) -> Callable[[Array], Array]:
        """Return the residual as a function of coordinates z, at the whitened point origin + vectors z."""
        physical = self.of_values()

        def residual(z: Array) -> Array:
            return physical(*jnp.split(self.prior.outward(origin + vectors @ z), [len(self.places)]))

        return residual


class JointResidual(eqx.Module):
    """The residuals of several logs, one behind the other, by the unknowns of all.

    Args:
        members: The residual of each log.
        index: Number of each log's unknowns among those of all logs.
        prior: Prior of the unknowns of all logs, followed by the nuisance parameters of each log.
    """

    members: tuple[WeightedResidual, ...]
    index: tuple[Array, ...]
    prior: Prior

    @property
    def measured(self) -> Array:
        """Measured output of all logs, (time, k)."""
        return jnp.concatenate([member.measured for member in self.members])

    def at_sharpness(self, sharpness: Array) -> JointResidual:
        """Return the residual with the smoothed sign of the friction at another sharpness."""
        return replace(self, members=tuple(member.at_sharpness(sharpness) for member in self.members))

    def from_start(self, start: Array) -> JointResidual:
        """Return the residual with every log from shifted initial positions of the joints with an encoder."""
        return replace(self, members=tuple(member.from_start(start) for member in self.members))

    def along(self, vectors: Array, origin: Array | float = 0.0) -> Callable[[Array], Array]:
        """Return the residual as a function of coordinates z, at the whitened point origin + vectors z."""
        physical, nuisances = [m.of_values() for m in self.members], [m.nuisances for m in self.members]
        ends = np.cumsum([self.prior.base.size - sum(nuisances), *nuisances])[:-1].tolist()

        def residual(z: Array) -> Array:
            theta, *starts = jnp.split(self.prior.outward(origin + vectors @ z), ends)
            each = zip(physical, self.index, starts, strict=True)
            return jnp.concatenate([of_log(theta[index], start) for of_log, index, start in each])

        return residual


# What compiled functions of a fit compare.
Compared = WeightedResidual | JointResidual


@dataclass(frozen=True)
class Problem:
    """A fit within a prior, as arrays.

    Args:
        replay: The simulation of the log: the loop, or the plant under the measured force.
        places: Paths of the unknowns in the plant.
        plant: The plant, at any values of the unknowns.
        measured: Measured output, (time, k) [units of the columns].
        weight: Weight of each entry, zero for entries that do not count, (time, k).
        prior: Prior of the unknowns, followed by that of the nuisance parameters.
        on: Output that is compared: "position", "force" or "both".
        sharpnesses: Sharpness of the smoothed sign at each step of the continuation.
        encoders: Indices of the joints that have an encoder.
        minimiser: A solver of optimistix for the descents; None: jaxid's Levenberg-Marquardt.
        logs: Name, problem and numbers of the unknowns of each of several logs, which stand one behind the
            other in `measured` and `weight`; empty: there is one log.
    """

    replay: Replay
    places: tuple
    plant: Plant
    measured: np.ndarray
    weight: np.ndarray
    prior: Prior
    on: str
    sharpnesses: tuple[np.ndarray, ...]
    encoders: tuple[int, ...]
    minimiser: Minimiser | None = None
    logs: tuple[tuple[str, Problem, np.ndarray], ...] = ()

    @functools.cached_property
    def residual(self) -> Compared:
        """The residual, as an argument of compiled functions."""
        if self.logs:
            members = []
            for (_, problem, _), rows in zip(self.logs, self.slices, strict=True):
                own = replace(problem, measured=self.measured[rows], weight=self.weight[rows]).residual
                assert isinstance(own, WeightedResidual), "a log among others is one log"
                members.append(own)
            return JointResidual(tuple(members), tuple(index for *_, index in self.logs), self.prior)
        return WeightedResidual(
            replay=self.replay,
            places=self.places,
            plant=self.plant,
            measured=self.measured,
            weight=self.weight,
            prior=self.prior,
            on=self.on,
        )

    @classmethod
    def of(
        cls,
        machine: Machine,
        log: Log,
        prior: float,
        on: str,
        numerics: Numerics,
        widths: Mapping[str, float] | None = None,
    ) -> Problem:
        """Set up the fit of a machine to a log that begins at rest.

        The arguments are those of `jaxid.estimators.within_prior.fit.within_prior_steps`.

        Raises:
            InputError: If a guess is zero, or the loop cannot be simulated.
        """
        n, encoders = log.position.shape[1], tuple(np.flatnonzero(log.measured).tolist())

        # Numerical damping of unresolved springs allows larger steps.
        plant = with_numerical_damping(machine.plant, jnp.asarray(log.filled[0]), log.period)
        if plant is not machine.plant and numerics.set_valued:
            fewer = max(steps_with_numerical_damping(numerics.substeps, on), turning_steps(machine, log))
            numerics = replace(numerics, substeps=min(fewer, numerics.substeps))
        replay = from_rest(make_replay(machine, log, numerics))
        if on != "position":
            replay = with_sensor(replay, Sensor())

        # The initial positions are nuisance parameters, known to the standard deviation of the sensor.
        std = machine.sensor.position_std
        start = np.zeros(0) if std is None else np.broadcast_to(np.asarray(std), n)[[*encoders]]
        measured, counts = measured_output(machine, log, on)
        m = log.force.shape[1]
        rises = _rises(plant, np.zeros(n), np.zeros(m))
        sharpnesses = _SHARPNESSES if rises else (plant.smoothing.sharpness,)
        return cls(
            replay=replay,
            places=machine.parameters.places,
            plant=plant,
            measured=measured,
            weight=np.tile(counts.astype(float), (len(measured), 1)),
            prior=Prior.of(machine, prior, start, widths),
            on=on,
            sharpnesses=tuple(np.asarray(s) for s in sharpnesses),
            encoders=encoders,
        )

    @classmethod
    def joint(
        cls,
        machine: Machine,
        prior: float,
        logs: Sequence[tuple[str, Problem, np.ndarray]],
        widths: Mapping[str, float] | None = None,
    ) -> Problem:
        """Set up the fit of a machine to several logs.

        Args:
            machine: Machine of all logs, with their unknowns.
            prior: Relative standard deviation of the guesses.
            logs: Name of each log, its problem, and the numbers of its unknowns among those of all.
            widths: Standard deviations of single guesses, see `of`.
        """
        problems = [problem for _, problem, _ in logs]
        starts = [problem.prior.scale[len(problem.places) :] for problem in problems]
        first = max(problems, key=lambda problem: len(problem.sharpnesses))
        return replace(
            first,
            places=machine.parameters.places,
            plant=machine.plant,
            measured=np.concatenate([problem.measured for problem in problems]),
            weight=np.concatenate([problem.weight for problem in problems]),
            prior=Prior.of(machine, prior, np.concatenate(starts), widths),
            logs=tuple(logs),
        )

    @property
    def slices(self) -> list[slice]:
        """Rows of each log in `measured` and `weight`."""
        lengths = [len(problem.measured) for _, problem, _ in self.logs] or [len(self.measured)]
        ends = np.cumsum(lengths).tolist()
        return [slice(end - length, end) for end, length in zip(ends, lengths, strict=True)]

    @property
    def deviation(self) -> Float[np.ndarray, "time k"]:
        """Weighted deviation of the measured output from the mean of its log."""
        parts = [(self.measured[rows], self.weight[rows]) for rows in self.slices]
        return np.concatenate([weight * (measured - measured.mean(axis=0)) for measured, weight in parts])

    @property
    def nuisances(self) -> list[str]:
        """Names of the nuisance parameters, which follow the machine's unknowns."""
        if self.logs:
            return [f"{start} @ {name}" for name, problem, _ in self.logs for start in problem.nuisances]
        count = self.prior.base.size - len(self.places)
        return [f"start position {k + 1}" for k in self.encoders[:count]]

    def padded(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " q"]:
        """Return values of the unknowns followed by nuisance parameters of zero."""
        return np.concatenate([theta, np.zeros(self.prior.base.size - len(theta))])

    def reweighted(self, minimum: Minimum) -> tuple[Problem, Minimum]:
        """Weight each column of the residual of each log by its standard deviation, if there are several.

        Args:
            minimum: A minimum of this problem.

        Returns:
            The problem with the new weights, and the minimum rescaled to them.
        """
        counts = self.weight[0] > 0
        if counts.sum() == 1 and not self.logs:
            return self, minimum

        whole, weights, factors = np.asarray(minimum.residual).reshape(self.measured.shape), [], []
        for rows in self.slices:
            e, measured = whole[rows][:, counts] / self.weight[rows][0, counts], self.measured[rows]
            least = 1e-12 * np.std(measured[:, counts], axis=0)
            row, factor = np.zeros(len(counts)), np.zeros(len(counts))
            row[counts] = 1.0 / np.maximum(np.std(e, axis=0), least)
            factor[counts] = row[counts] / self.weight[rows][0, counts]
            weights.append(np.tile(row, (len(measured), 1)))
            factors.append(np.tile(factor, len(measured)))

        by = np.concatenate(factors)
        e, jacobian = by * np.asarray(minimum.residual), by[:, None] * np.asarray(minimum.jacobian)
        rescaled = replace(minimum, residual=e, jacobian=jacobian, cost=np.asarray(0.5 * e @ e))
        return replace(self, weight=np.concatenate(weights)), rescaled

    def noise(self, minimum: Minimum, count: float) -> float:
        """Return the standard deviation of the weighted residual, with `count` fitted parameters."""
        samples = int(np.sum(self.weight > 0))
        return float(np.sqrt(2 * float(minimum.cost) / max(samples - count, 1)))

    def criterion(self, minimum: Minimum) -> float:
        """Return (11) of Bogdan and Abba: squared residual over squared deviation from the mean [%]."""
        spread = np.sum(self.deviation**2)
        return float(100 * 2 * float(minimum.cost) / spread)


@eqx.filter_jit
def _rises(plant: Plant, q: Array, u: Array) -> bool:
    """Tell whether any friction acts only while the speed grows; decided when this is compiled."""
    return bool(plant.balance(q, q, q, u, jnp.zeros(()), plant.initial_states(u)).rises)
