"""Two models that explain a log alike, and how far an experiment would drive them apart.

The expected difference is an analytic function of the experiment: one rival is simulated, the
other's balance is read along that motion, and what its own unknowns can absorb is taken out.
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
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.force_balance import ForceData, force_residual
from jaxid.simulation.loops import Drive, Trajectory, closed_loop, open_loop

if TYPE_CHECKING:
    from jaxid.discovery.search import Search

# Curvature below this part of the largest is nothing that a fit could use.
_BLIND = 1e-10


@dataclass(frozen=True)
class Pair:
    """An effect that was named and one that explains the log alike.

    Args:
        kinds: Their names, the named one first.
        labels: The same with their places.
        thetas: All unknowns of the union, with the one effect in place and with the other.
        active: Indices of the unknowns that each model fits.
        plant: The machine with both effects and what both models share, no other candidates.
        index: Unknowns of that plant in the union's vector.
        places: Where they go in it.
    """

    kinds: tuple[str, str]
    ports: tuple[int, int]
    thetas: tuple[np.ndarray, np.ndarray]
    active: tuple[np.ndarray, np.ndarray]
    plant: Plant
    index: np.ndarray
    places: tuple

    @classmethod
    def of(cls, search: Search, own: cand.Candidate, rival: Score) -> Pair:
        """The models of an effect added and of an alternative to it.

        Args:
            search: The search, at its end.
            own: The effect added.
            rival: The alternative, refitted.
        """
        union = search.superset
        rest = [c for c in search.added if c is not own]
        base = union.base
        active = [
            np.concatenate([base, *[r.index for r in rest], c.index]).astype(int)
            for c in (own, rival.candidate)
        ]
        plant, index, places = _reduced(union, [*rest, own, rival.candidate])
        return cls(
            (own.kind, rival.candidate.kind),
            (own.port, rival.candidate.port),
            (search.theta, rival.theta),
            tuple(active),
            plant,
            index,
            places,
        )

    def turned(self) -> Pair:
        """The same with the rival first."""
        kinds, ports, thetas, active = (x[::-1] for x in (self.kinds, self.ports, self.thetas, self.active))
        return Pair(kinds, ports, thetas, active, self.plant, self.index, self.places)

    def rounder(self, factor: float) -> Pair:
        """The same with a sign so many times as wide."""
        plant = eqx.tree_at(lambda p: p.sharpness, self.plant, factor * self.plant.sharpness)
        return replace(self, plant=plant)

    def model(self, which: int) -> Plant:
        """The plant of one of them."""
        return scatter(self.places, self.plant, jnp.asarray(self.thetas[which][self.index]))


def _reduced(union: cand.CandidateModel, keep: list[cand.Candidate]) -> tuple[Plant, np.ndarray, tuple]:
    """The union's plant without the candidates that neither model has."""
    drop = {cand.position(union, c) for c in union.candidates if all(c is not k for k in keep)}
    effects = union.machine.plant.effects
    stays = [i for i in range(len(effects)) if i not in drop]
    plant = eqx.tree_at(lambda p: p.effects, union.machine.plant, tuple(effects[i] for i in stays))
    index, places = [], []
    for k, (path, entry) in enumerate(union.machine.parameters.places):
        if path[0] != "effects":
            places.append((path, entry))
        elif path[1] in stays:
            places.append((("effects", stays.index(path[1]), *path[2:]), entry))
        else:
            continue
        index.append(k)
    return plant, np.asarray(index, int), tuple(places)


class Experiment(eqx.Module):
    """How an experiment runs: the loop, or the drive alone, and what is read of it.

    Args:
        drive: How the command acts.
        controller: The law; None: the signal is the command itself.
        start: Position at the start, (n,); in a loop the joints that are driven start on the reference.
        driven: Those joints, 0-based.
        every: The log holds one tick in so many.
        period: Of the log [s].
        data: Holds how forces are filtered; its arrays are not used.
        rest: Velocity below which a sample counts as at rest, (n,).
        whiten: Filter that turns the log's noise into unit white noise, (n, order + 1).
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
        """Motion of a plant from rest under a reference or a command, at the samples of its log.

        Args:
            plant: The plant.
            signal: Reference or command at every tick.
            sensor: What reads the position; absent: exact.
            noise: Standard normal numbers for its noise; absent: none.
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
        """Position at the start of a signal with this first value."""
        if self.controller is None:
            return self.start
        return self.start.at[jnp.asarray(self.driven)].set(first)

    def seen(self, run: Trajectory) -> tuple[ForceData, Float[Array, "kept n"]]:
        """A motion as inverse dynamics takes it, and how much each sample counts."""
        slope = jnp.gradient(run.velocity, axis=0) / self.period
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
        """A force as rows of unit white noise."""
        columns = [jnp.convolve(x, w)[: x.size] for x, w in zip(e.T, self.whiten, strict=True)]
        return jnp.stack(columns, axis=1)


class ModelPair(eqx.Module):
    """Both rivals as compiled code takes them.

    Args:
        plant: Their common plant.
        thetas: Unknowns of each, (2, m).
        masks: One for the unknowns that each fits, (2, m).
        places: Where the unknowns go.
    """

    plant: Plant
    thetas: Float[Array, "2 m"]
    masks: Float[Array, "2 m"]
    places: tuple = eqx.field(static=True)

    @classmethod
    def of(cls, pair: Pair) -> ModelPair:
        """The arrays of a pair."""
        masks = [np.isin(pair.index, active).astype(float) for active in pair.active]
        thetas = [theta[pair.index] for theta in pair.thetas]
        return cls(pair.plant, jnp.asarray(thetas), jnp.asarray(masks), pair.places)


def expected(
    bench: Experiment, duel: ModelPair, signal: Float[Array, "ticks m"], bounds: LimitCost
) -> tuple[Float[Array, " 2"], Array]:
    """Evidence [nats] by which each rival, being true, would beat the other; and what limits cost."""

    def one(true: Array, other: Array, mask: Array) -> tuple[Array, Array]:
        own = scatter(duel.places, duel.plant, true)
        run = bench.run(own, signal)
        data, weight = bench.seen(run)
        root = jnp.sqrt(weight)

        # The true model's own residual is what numerics leave: it is in the other's alike.
        def apart(theta: Array, data: ForceData, root: Array) -> Array:
            e = force_residual(scatter(duel.places, duel.plant, theta), data)
            return (root * bench.white(e - force_residual(own, data))).ravel()

        absorbed = jax.lax.stop_gradient(
            _absorbed(lambda theta: apart(theta, *jax.lax.stop_gradient((data, root))), other, mask)
        )
        # At the best fit its derivative does not matter: it is held while the signal moves.
        d, change = jax.jvp(lambda theta: apart(theta, data, root), (other,), (absorbed,))
        rows = jnp.sum(weight)
        nats = 0.5 * rows * jnp.log1p(jnp.sum((d + change) ** 2) / jnp.maximum(rows, 1.0))
        return nats, bounds.cost(run)

    nats, cost = jax.vmap(one)(duel.thetas, duel.thetas[::-1], duel.masks[::-1])
    return nats, jnp.sum(cost)


def _absorbed(apart, theta: Array, mask: Array) -> Array:
    """Change of the unknowns that takes most of a difference away."""

    def both(theta: Array) -> tuple[Array, Array]:
        d = apart(theta)
        return d, d

    jacobian, d = jax.jacfwd(both, has_aux=True)(theta)
    jacobian = jacobian * mask
    norm = jnp.linalg.norm(jacobian, axis=0)
    norm = jnp.where(norm > 0, norm, 1.0)
    values, vectors = jnp.linalg.eigh((jacobian / norm).T @ (jacobian / norm))
    inverse = jnp.where(values > _BLIND * values[-1], 1 / jnp.maximum(values, 1e-300), 0.0)
    return -(vectors @ (inverse * (vectors.T @ ((jacobian / norm).T @ d)))) / norm


@eqx.filter_jit
def loss(
    p: Float[Array, " p"], bench: Experiment, duel: ModelPair, shapes: Shapes, bounds: LimitCost
) -> tuple[Array, Array]:
    """What to minimise, and its gradient: minus the logarithms of both evidences, plus what limits cost."""

    def of(p: Array) -> tuple[Array, Array]:
        nats, cost = expected(bench, duel, shapes(p), bounds)
        value = -0.5 * jnp.sum(jnp.log(nats + 1e-3)) + cost
        return value, value

    # Of several joints forwards, though it takes four times as long: the code that XLA of jaxlib 0.10
    # makes of the way back through three masses of which one has presliding ends in a segmentation fault.
    differentiate = jax.jacfwd if bench.start.size > 1 else jax.grad
    slope, value = differentiate(of, has_aux=True)(p)
    return value, slope
