"""Two models that explain a log equally well, and the evidence between them that an experiment would give.

The expected difference is an analytic function of the experiment: one rival is simulated, the residual of the
other is computed along that motion, and the part that its unknowns can absorb is removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller
from jaxid.discovery import candidates as cand
from jaxid.discovery.score import Score
from jaxid.experiment_design.limits import LimitCost
from jaxid.experiment_design.shapes import Shapes
from jaxid.model.plant import Plant
from jaxid.model.unknowns import scatter
from jaxid.numerics.kept import kept_jit
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.force_balance import ForceData, force_residual
from jaxid.simulation.loops import Drive, Trajectory, closed_loop, open_loop

if TYPE_CHECKING:
    from jaxid.discovery.search import Search

# Curvature below this part of the largest cannot be used by a fit.
_BLIND = 1e-10


@dataclass(frozen=True)
class Pair:
    """An effect that was named and one that explains the log equally well.

    Args:
        kinds: Kinds of both effects, the named one first.
        ports: Ports of both effects.
        thetas: All unknowns of the superset, with the one effect in place and with the other.
        active: Indices of the unknowns that each model fits.
        plant: Plant with both effects and those that both models share, without other candidates.
        index: Indices of that plant's unknowns in the superset's vector.
        places: Places of the unknowns in that plant.
    """

    kinds: tuple[str, str]
    ports: tuple[int, int]
    thetas: tuple[np.ndarray, np.ndarray]
    active: tuple[np.ndarray, np.ndarray]
    plant: Plant
    index: np.ndarray
    places: tuple

    @classmethod
    def of(cls, search: Search, named: cand.Candidate, rival: Score) -> Pair:
        """Build the models of an added effect and of an alternative to it.

        Args:
            search: The search at its end.
            named: The effect that was added.
            rival: The alternative, refitted.
        """
        superset = search.superset
        rest = [c for c in search.added if c is not named]
        plant, index, places = _reduced(superset, [*rest, named, rival.candidate])
        return cls(
            kinds=(named.kind, rival.candidate.kind),
            ports=(named.port, rival.candidate.port),
            thetas=(search.theta, rival.refitted),
            active=(search.fitted_by([*rest, named]), search.fitted_by([*rest, rival.candidate])),
            plant=plant,
            index=index,
            places=places,
        )

    def swapped(self) -> Pair:
        """Return the pair with the rival first."""
        return replace(
            self,
            kinds=self.kinds[::-1],
            ports=self.ports[::-1],
            thetas=self.thetas[::-1],
            active=self.active[::-1],
        )

    def smoother(self, factor: float) -> Pair:
        """Return the pair with a smoothed sign that is wider by a factor."""
        return replace(self, plant=self.plant.smoothed(factor * self.plant.smoothing.sharpness))

    def model(self, which: int) -> Plant:
        """Return the plant of the first (0) or of the second model (1)."""
        return scatter(self.places, self.plant, jnp.asarray(self.thetas[which][self.index]))


def _reduced(superset: cand.CandidateModel, keep: list[cand.Candidate]) -> tuple[Plant, np.ndarray, tuple]:
    """Return the superset's plant with some candidates only, their unknowns and the places of these."""
    drop = {cand.position(superset, c) for c in superset.candidates if all(c is not k for k in keep)}
    effects = superset.machine.plant.effects
    stays = [i for i in range(len(effects)) if i not in drop]
    plant = eqx.tree_at(lambda p: p.effects, superset.machine.plant, tuple(effects[i] for i in stays))
    index, places = [], []
    for k, (path, entry) in enumerate(superset.machine.parameters.places):
        if path[0] != "effects":
            places.append((path, entry))
        elif path[1] in stays:
            places.append((("effects", stays.index(path[1]), *path[2:]), entry))
        else:
            continue
        index.append(k)
    return plant, np.asarray(index, int), tuple(places)


class Experiment(eqx.Module):
    """An experiment in the loop or with the drive alone, and the evaluation of its log.

    Args:
        drive: Gain, hold and integration of the command.
        controller: Law of the loop; None: the signal is the command itself.
        start: Position at the start, (n,); in a loop the driven joints start on the reference.
        driven: Indices of the driven joints, from 0.
        every: Number of ticks in a sample of the log.
        period: Sampling time of the log [s].
        data: Filter of the forces; its arrays are not used.
        rest: Velocity below which a sample counts as at rest, (n,).
        whiten: Filter from the log's noise to unit white noise, (n, order + 1).
    """

    drive: Drive
    controller: Controller | None
    start: Float[Array, " n"]
    driven: tuple[int, ...] = eqx.field(static=True)
    every: int = eqx.field(static=True)
    period: float = eqx.field(static=True)
    data: ForceData
    rest: Float[Array, " n"]
    whiten: Float[Array, "n order"]

    def run(
        self,
        plant: Plant,
        signal: Float[Array, "ticks m"],
        sensor: Sensor | None = None,
        noise: Float[Array, "ticks n"] | None = None,
    ) -> Trajectory:
        """Simulate a plant from rest under a reference or a command, at the samples of its log.

        Args:
            plant: The plant to simulate.
            signal: Reference or command at every tick.
            sensor: Sensor of the position; None: exact readings.
            noise: Standard normal numbers for its noise; None: no noise.
        """
        zero = jnp.zeros_like(self.start)
        if self.controller is None:
            run = open_loop(plant, self.drive, signal, self.start, zero)
            if sensor is not None:
                run = eqx.tree_at(lambda r: r.reading, run, sensor.read(run.position, noise))
        else:
            none = jnp.zeros((signal.shape[0], 1))
            start = self.start_of(signal[0])
            run = closed_loop(plant, self.drive, self.controller, signal, none, start, zero, sensor, noise)
        return jax.tree.map(lambda a: a[:: self.every], run)

    def start_of(self, first: Float[Array, " m"]) -> Float[Array, " n"]:
        """Return the position at the start of a signal with this first value."""
        if self.controller is None:
            return self.start
        return jnp.asarray(self.start).at[jnp.asarray(self.driven)].set(first)

    def force_data(self, run: Trajectory) -> tuple[ForceData, Float[Array, "kept n"]]:
        """Return a motion as data of the force domain, and the weight of each sample, zero at rest."""
        slope = jnp.asarray(jnp.gradient(run.velocity, axis=0)) / self.period
        force = self.drive.gain * run.command
        data = eqx.tree_at(
            lambda d: (d.q, d.qd, d.qdd, d.force),
            self.data,
            (run.position, run.velocity, slope, force),
        )

        d = self.data.decimator
        kept = run.velocity[:: d.factor] if d.filters else run.velocity
        kept = kept[d.trim : kept.shape[0] - d.trim]
        return data, 1 - jnp.exp(-jnp.square(kept / self.rest))

    def white(self, e: Float[Array, "kept n"]) -> Float[Array, "kept n"]:
        """Whiten a force by the filter of each joint."""
        # No convolution of XLA: with jaxlib 0.10 that of three joints, differentiated, ends the process in a
        # segmentation fault.
        order = self.whiten.shape[1] - 1
        before = jnp.concatenate([jnp.zeros((order, e.shape[1])), e])
        shifted = [before[order - lag : order - lag + e.shape[0]] for lag in range(order + 1)]
        terms = (x * w for x, w in zip(shifted, self.whiten.T, strict=True))
        return sum(terms, start=jnp.zeros_like(e))


class ModelPair(eqx.Module):
    """Arrays of both rivals for compiled code.

    Args:
        plant: The common plant of both.
        thetas: Unknowns of each model, (2, m).
        masks: One for the unknowns that each model fits, else zero, (2, m).
        places: Places of the unknowns in the plant.
    """

    plant: Plant
    thetas: Float[Array, "2 m"]
    masks: Float[Array, "2 m"]
    places: tuple = eqx.field(static=True)

    @classmethod
    def of(cls, pair: Pair) -> ModelPair:
        """Collect the arrays of a pair."""
        masks = [np.isin(pair.index, active).astype(float) for active in pair.active]
        thetas = [theta[pair.index] for theta in pair.thetas]
        return cls(pair.plant, jnp.asarray(thetas), jnp.asarray(masks), pair.places)


def expected(
    experiment: Experiment, models: ModelPair, signal: Float[Array, "ticks m"], bounds: LimitCost
) -> tuple[Float[Array, " 2"], Array]:
    """Compute the evidence of each rival over the other if it is true [nats], and the cost of the limits."""

    def one(true: Array, other: Array, mask: Array) -> tuple[Array, Array]:
        true_plant = scatter(models.places, models.plant, true)
        run = experiment.run(true_plant, signal)
        data, weight = experiment.force_data(run)
        root = jnp.sqrt(weight)

        # The residual of the true model is numerical error, which is part of the other's residual too.
        def difference(theta: Array, data: ForceData, root: Array) -> Array:
            e = force_residual(scatter(models.places, models.plant, theta), data)
            return (root * experiment.white(e - force_residual(true_plant, data))).ravel()

        absorbed = jax.lax.stop_gradient(
            _absorbed(lambda theta: difference(theta, *jax.lax.stop_gradient((data, root))), other, mask)
        )
        # At the best fit the derivative in the absorbed change is zero: it is held while the signal moves.
        d, change = jax.jvp(lambda theta: difference(theta, data, root), (other,), (absorbed,))
        rows = jnp.sum(weight)
        nats = 0.5 * rows * jnp.log1p(jnp.sum((d + change) ** 2) / jnp.maximum(rows, 1.0))
        return nats, bounds.cost(run)

    nats, cost = jax.vmap(one)(models.thetas, models.thetas[::-1], models.masks[::-1])
    return nats, jnp.sum(cost)


def _absorbed(difference, theta: Array, mask: Array) -> Array:
    """Return the change of the unknowns that minimises a difference."""

    def both(theta: Array) -> tuple[Array, Array]:
        d = difference(theta)
        return d, d

    jacobian, d = jax.jacfwd(both, has_aux=True)(theta)
    jacobian = jacobian * mask
    norm = jnp.linalg.norm(jacobian, axis=0)
    norm = jnp.where(norm > 0, norm, 1.0)
    values, vectors = jnp.linalg.eigh((jacobian / norm).T @ (jacobian / norm))
    inverse = jnp.where(values > _BLIND * values[-1], 1 / jnp.maximum(values, 1e-300), 0.0)
    return -(vectors @ (inverse * (vectors.T @ ((jacobian / norm).T @ d)))) / norm


@kept_jit
def loss(
    p: Float[Array, " p"], experiment: Experiment, models: ModelPair, shapes: Shapes, bounds: LimitCost
) -> tuple[Array, Array]:
    """Compute minus the mean logarithm of both evidences plus the cost of the limits, and its gradient."""

    def of(p: Array) -> tuple[Array, Array]:
        nats, cost = expected(experiment, models, shapes(p), bounds)
        value = -0.5 * jnp.sum(jnp.log(nats + 1e-3)) + cost
        return value, value

    slope, value = jax.grad(of, has_aux=True)(p)
    return value, slope
