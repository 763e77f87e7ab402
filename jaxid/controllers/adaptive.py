"""Computed torque whose model is identified in the loop, sample by sample."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.controllers.base import Path, Tick
from jaxid.controllers.computed_torque import FeedForward
from jaxid.model.unknowns import scatter

# A law is given its estimator, and imports none: `RealTime` of `jaxid.estimators.recursive.real_time`, with
# the memory and what it tells of `jaxid.estimators.recursive.recursion`.
RealTime = RecursiveMemory = RecursiveEstimate = Any

# Instants of the reference at which columns are looked at, at most.
_LOOKS = 500


class LearnedUnknowns(eqx.Module):
    """What the law has found.

    Args:
        theta: Estimate of the unknowns.
        closed: Whether it takes part in the command.
    """

    theta: Float[Array, " p"]
    closed: Bool[Array, ""]


class Learning(eqx.Module):
    """What `Adaptive` keeps from tick to tick.

    Args:
        feedback: Of the PD law.
        recursion: Of the estimator.
        information: Of its start (see `jaxid.estimators.recursive.recursion.Recursion`).
        share: By how much an unknown's error of one moves the force, over the force: root mean squares along
            the reference.
        found: So far.
        positions: Readings of the last 2 reach ticks, the newest first.
        commands: Measured, of the intervals between them, likewise.
        ticks: So far.
    """

    feedback: tuple
    recursion: RecursiveMemory
    information: Float[Array, " p"]
    share: Float[Array, " p"]
    found: LearnedUnknowns
    positions: Float[Array, "past n"]
    commands: Float[Array, "past m"]
    ticks: Array


class Adaptive(FeedForward):
    """`FeedForward` of a model whose unknowns are identified in the loop.

    Every tick with new readings gives the estimator a sample: measured motion, and measured command. Where
    no sensor measures velocity and acceleration, they are differences of positions `reach` ticks apart, the
    command is averaged with the weights that the second difference has (exact for a held command), and a
    sample is taken every `reach` ticks.

    Until all unknowns are told well enough, dynamics at the guesses are all that is fed forward (switches b
    and c are open). An unknown is, where its standard deviation, times the root mean square of its column
    along the reference, is below `tolerance` times that of the force, and its start has no more say in it.
    From then on the command is that of the estimate at every tick, and never goes back.

    Args:
        estimator: Of the case's unknowns.
        regularization: As how many samples the start counts.
        tolerance: See above.
        reach: In ticks; 0: `velocity_average`.
        renewal: Ticks between new readings of inertial sensors.

    Source:
        Righettini et al. (2025), Robotics 14, 36, 2 and figure 1; it states no criterion of convergence.
    """

    of_machine: ClassVar[tuple[str, ...]] = ("model", "gain", "estimator", "renewal")

    friction: bool = eqx.field(static=True, default=True, kw_only=True)
    estimator: RealTime = eqx.field(kw_only=True)
    regularization: Array = eqx.field(default=1e-3, kw_only=True)
    tolerance: Array = eqx.field(default=0.02, kw_only=True)
    reach: int = eqx.field(static=True, default=0, kw_only=True)
    renewal: int = eqx.field(static=True, default=1, kw_only=True)

    @property
    def stride(self) -> int:
        """Ticks between the positions that are differenced."""
        return self.reach or self.velocity_average

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> Learning:
        path = jax.tree.map(lambda x: jnp.asarray(x)[None], tick.path) if path is None else path
        square, force = _along(self, path, tick.driven)
        back = self.period * jnp.arange(1, 2 * self.stride + 1)[:, None]
        start = jnp.asarray(self.estimator.recursion.start)
        information = self.regularization * square
        return Learning(
            self.start_feedback(tick),
            self._recursion(information).memory(),
            information,
            jnp.sqrt(square) / force,
            LearnedUnknowns(start, jnp.zeros((), bool)),
            tick.joints - back * velocity,
            jnp.zeros((2 * self.stride, len(tick.driven))),
            jnp.zeros((), int),
        )

    def law(self, tick: Tick, velocity: Array, memory: Learning, disturbance: Array) -> tuple:
        learnt = self._learn(tick, memory)
        closed, theta = learnt.found.closed, learnt.found.theta
        u, feedback = self.feedback(tick, velocity, memory.feedback)
        guess = jnp.asarray(self.estimator.guess)
        model = scatter(self.estimator.places, self.model, jnp.where(closed, theta, guess))
        smooth, friction = self.fed(model, tick)
        u = u + smooth if self.dynamics else u
        u = u + jnp.where(closed, friction, 0.0) if self.friction else u
        u = jnp.where(closed, self.over_gains(u, model), u) if self.gains else u
        given = self.clipped(u + disturbance)
        commands = jnp.concatenate([given[None], learnt.commands[:-1]])
        return u, eqx.tree_at(lambda m: (m.feedback, m.commands), learnt, (feedback, commands))

    def resumed(self, start: Any, saved: Any) -> Any:
        kept = lambda memory: (memory[1].recursion, memory[1].information, memory[1].found)
        return eqx.tree_at(kept, start, kept(saved))

    def learned(self, memory: Any) -> LearnedUnknowns:
        """What has been found, of the memory that `command` returns."""
        return memory[1].found

    @eqx.filter_jit
    def estimate(self, memory: Any) -> RecursiveEstimate:
        """What the estimator says, of the memory that `command` returns."""
        return self._recursion(memory[1].information).estimate(memory[1].recursion)

    def _recursion(self, information: Array, ticks: int = 1) -> Any:
        """The recursion with its start, of samples so many ticks apart: what it forgets is by time."""
        recursion = self.estimator.recursion
        values = information, jnp.asarray(recursion.forgetting) ** ticks
        return eqx.tree_at(lambda r: (r.information, r.forgetting), recursion, values)

    def _learn(self, tick: Tick, memory: Learning) -> Learning:
        """With this tick's sample; the newest of the commands is its own, until measured better."""
        if tick.measured is not None:
            newest = jnp.where(jnp.isnan(tick.measured), memory.commands[0], tick.measured)
            newest = jnp.concatenate([newest[None], memory.commands[1:]])
            memory = eqx.tree_at(lambda m: m.commands, memory, newest)
        sample, ready = self._sample(tick, memory)
        rows, target, counts = self.estimator.rows(*sample)
        apart = self.stride if tick.acceleration is None else self.renewal
        recursion = self._recursion(memory.information, apart)
        new, _ = recursion.update(memory.recursion, rows, target, counts & ready & tick.fresh)
        done, share = memory.found.closed, memory.share
        closed = jax.lax.cond(
            done, lambda: jnp.ones((), bool), lambda: self._converged(recursion, new, share)
        )
        theta = recursion.estimate(new).theta if recursion.instrument else new.theta
        positions = jnp.concatenate([tick.joints[None], memory.positions[:-1]])
        return Learning(
            memory.feedback,
            new,
            memory.information,
            memory.share,
            LearnedUnknowns(theta, closed),
            positions,
            memory.commands,
            memory.ticks + 1,
        )

    def _converged(self, recursion: Any, memory: RecursiveMemory, share: Array) -> Array:
        told = recursion.estimate(memory)
        # Rows enough that the residual tells the noise.
        enough = told.effective > 10 * share.size
        return enough & jnp.all(told.identifiable & (told.std * share < self.tolerance))

    def _sample(self, tick: Tick, memory: Learning) -> tuple[tuple, Array]:
        """Position, velocity, acceleration and command at one instant, and whether there is a new one."""
        if tick.acceleration is not None:
            # The command that the acceleration answers to is that of the interval just past.
            sample = (tick.joints, tick.velocity, tick.acceleration, memory.commands[0])
            return sample, (memory.ticks > 0) & tick.renewed
        d, now = self.stride, tick.joints
        middle, last = memory.positions[d - 1], memory.positions[2 * d - 1]
        velocity = (now - last) / (2 * d * self.period)
        acceleration = (now - 2 * middle + last) / (d * self.period) ** 2
        at = np.arange(2 * d) + 0.5
        weights = np.minimum(at, 2 * d - at) / d**2
        command = weights @ memory.commands
        ready = (memory.ticks >= 2 * d) & (memory.ticks % d == 0)
        return (middle, velocity, acceleration, command), ready


@eqx.filter_jit
def _along(law: Adaptive, path: Path, driven: tuple[int, ...]) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Mean square of each unknown's column, and root mean square of the force, along a reference."""
    step = max(1, -(-len(path.reference) // _LOOKS))
    path = jax.tree.map(lambda x: jnp.asarray(x)[::step], path)

    def one(now: Path) -> tuple:
        tick = Tick(jnp.zeros(len(driven)), now, driven)
        u = law.fed(law.model, tick)[0]
        motion = (tick.at_joints(x) for x in (now.reference, now.slope, now.curvature))
        return *law.estimator.rows(*motion, u)[::2], tick.at_joints(law.gain * u)

    return law.estimator.sizes(*jax.vmap(one)(path))
