"""The residual of a fit within a prior, in whitened coordinates of the unknowns."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
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

    def along(self, vectors: Array, origin: Array | float = 0.0) -> Callable[[Array], Array]:
        """Return the residual as a function of coordinates z, at the whitened point origin + vectors z."""
        physical = output_residual(self.replay, self.places, self.plant, self.measured, self.weight, self.on)

        def residual(z: Array) -> Array:
            # The nuisance parameters behind the unknowns are initial positions; initial velocities are
            # known to be those of the log.
            theta, start = jnp.split(self.prior.outward(origin + vectors @ z), [len(self.places)])
            if start.size:
                start = self.replay.follow @ start
            return physical(jnp.concatenate([theta, start, jnp.zeros_like(start)]))

        return residual


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

    @functools.cached_property
    def residual(self) -> WeightedResidual:
        """The residual, as an argument of compiled functions."""
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

    @property
    def nuisances(self) -> list[str]:
        """Names of the nuisance parameters, which follow the machine's unknowns."""
        count = self.prior.base.size - len(self.places)
        return [f"start position {k + 1}" for k in self.encoders[:count]]

    def padded(self, theta: Float[np.ndarray, " p"]) -> Float[np.ndarray, " q"]:
        """Return values of the unknowns followed by nuisance parameters of zero."""
        return np.concatenate([theta, np.zeros(self.prior.base.size - len(theta))])

    def reweighted(self, minimum: Minimum) -> tuple[Problem, Minimum]:
        """Weight each column of the residual by its standard deviation, if there are several.

        Args:
            minimum: A minimum of this problem.

        Returns:
            The problem with the new weights, and the minimum rescaled to them.
        """
        counts = self.weight[0] > 0
        if counts.sum() == 1:
            return self, minimum

        e = np.asarray(minimum.residual).reshape(self.measured.shape)[:, counts] / self.weight[0, counts]
        least = 1e-12 * np.std(self.measured[:, counts], axis=0)
        row, factor = np.zeros(len(counts)), np.zeros(len(counts))
        row[counts] = 1.0 / np.maximum(np.std(e, axis=0), least)
        factor[counts] = row[counts] / self.weight[0, counts]

        by = np.tile(factor, len(self.measured))
        e, jacobian = by * np.asarray(minimum.residual), by[:, None] * np.asarray(minimum.jacobian)
        rescaled = replace(minimum, residual=e, jacobian=jacobian, cost=np.asarray(0.5 * e @ e))
        return replace(self, weight=np.tile(row, (len(self.measured), 1))), rescaled

    def noise(self, minimum: Minimum, count: float) -> float:
        """Return the standard deviation of the weighted residual, with `count` fitted parameters."""
        samples = int(np.sum(self.weight > 0))
        return float(np.sqrt(2 * float(minimum.cost) / max(samples - count, 1)))

    def criterion(self, minimum: Minimum) -> float:
        """Return (11) of Bogdan and Abba: squared residual over squared deviation from the mean [%]."""
        spread = np.sum((self.weight * (self.measured - self.measured.mean(axis=0))) ** 2)
        return float(100 * 2 * float(minimum.cost) / spread)


@eqx.filter_jit
def _rises(plant: Plant, q: Array, u: Array) -> bool:
    """Tell whether any friction acts only while the speed grows; decided when this is compiled."""
    return bool(plant.balance(q, q, q, u, jnp.zeros(()), plant.initial_states(u)).rises)
