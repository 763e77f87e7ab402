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
from jaxid.numerics.kept import kept_jit

# A law is given its estimator, and imports none: `RealTime` of `jaxid.estimators.recursive.real_time`, with
# the memory and the estimate of `jaxid.estimators.recursive.recursion`.
RealTime = RecursiveMemory = RecursiveEstimate = Any

# Largest number of instants of the reference at which columns are evaluated.
_INSTANTS = 500


class LearnedUnknowns(eqx.Module):
    """The unknowns that the law has identified.

    Args:
        theta: Estimate of the unknowns.
        closed: Whether the estimate is used in the command.
    """

    theta: Float[Array, " p"]
    closed: Bool[Array, ""]


class Learning(eqx.Module):
    """The memory of `Adaptive` between ticks.

    Args:
        feedback: Memory of the PD law.
        recursion: Memory of the estimator.
        information: Information of its start (see `jaxid.estimators.recursive.recursion.Recursion`).
        share: Change of the force by an error of one in each unknown, over the force: root mean squares
            along the reference.
        found: The unknowns identified so far.
        positions: Readings of the last 2 reach ticks, the newest first.
        commands: Measured commands of the intervals between them, the newest first.
        ticks: Number of ticks so far.
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

    Every tick with new readings gives the estimator a sample: measured motion, and measured command. If no
    sensor measures velocity and acceleration, they are differences of positions `reach` ticks apart, the
    command is averaged with the weights of the second difference (exact for a held command), and a
    sample is taken every `reach` ticks.

    Until all unknowns are precise enough, only the dynamics at the guesses are fed forward (switches b and c
    are open). An unknown is precise enough if its standard deviation, times the root mean square of its
    column along the reference, is below `tolerance` times that of the force, and its start no longer
    determines it. From then on the command uses the estimate of every tick, and never the guesses again.

    Args:
        estimator: Estimator of the unknowns of the case.
        regularization: Weight of the start, in samples.
        tolerance: Relative precision at which the estimate is used, see above.
        reach: Distance of differenced positions in ticks; 0: `velocity_average`.
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
        path = path or jax.tree.map(lambda x: jnp.asarray(x)[None], tick.path)
        assert path is not None, "a tick has a path"
        square, force = _along(self, path, tick.driven)
        back = self.period * jnp.arange(1, 2 * self.stride + 1)[:, None]
        start = jnp.asarray(self.estimator.recursion.start)
        information = self.regularization * square
        return Learning(
            feedback=self.start_feedback(tick),
            recursion=self._recursion(information).memory(),
            information=information,
            share=jnp.sqrt(square) / force,
            found=LearnedUnknowns(start, jnp.zeros((), bool)),
            positions=tick.joints - back * velocity,
            commands=jnp.zeros((2 * self.stride, len(tick.driven))),
            ticks=jnp.zeros((), int),
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
        """Return the unknowns identified so far, from the memory that `command` returns."""
        return memory[1].found

    @eqx.filter_jit
    def estimate(self, memory: Any) -> RecursiveEstimate:
        """Return the estimate with its precision, from the memory that `command` returns."""
        return self._recursion(memory[1].information).estimate(memory[1].recursion)

    def _recursion(self, information: Array, ticks: int = 1) -> Any:
        """Return the recursion with its start, for samples that many ticks apart: it forgets by time."""
        recursion = self.estimator.recursion
        values = information, jnp.asarray(recursion.forgetting) ** ticks
        return eqx.tree_at(lambda r: (r.information, r.forgetting), recursion, values)

    def _learn(self, tick: Tick, memory: Learning) -> Learning:
        """Update the memory by the sample of this tick, with the newest command as given until measured."""
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
            feedback=memory.feedback,
            recursion=new,
            information=memory.information,
            share=memory.share,
            found=LearnedUnknowns(theta, closed),
            positions=positions,
            commands=memory.commands,
            ticks=memory.ticks + 1,
        )

    def _converged(self, recursion: Any, memory: RecursiveMemory, share: Array) -> Array:
        estimate = recursion.estimate(memory)
        # Enough rows to estimate the noise from the residual.
        enough = estimate.effective > 10 * share.size
        return enough & jnp.all(estimate.identifiable & (estimate.std * share < self.tolerance))

    def _sample(self, tick: Tick, memory: Learning) -> tuple[tuple, Array]:
        """Return position, velocity, acceleration and command at one instant, and a flag if they are new."""
        if tick.acceleration is not None:
            # The acceleration belongs to the command of the interval just past.
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


@kept_jit
def _along(law: Adaptive, path: Path, driven: tuple[int, ...]) -> tuple[Float[Array, " p"], Float[Array, ""]]:
    """Return the mean square of each unknown's column, and the RMS of the force, along a reference."""
    step = max(1, -(-len(path.reference) // _INSTANTS))
    path = jax.tree.map(lambda x: jnp.asarray(x)[::step], path)

    def one(now: Path) -> tuple:
        tick = Tick(jnp.zeros(len(driven)), now, driven)
        u = law.fed(law.model, tick)[0]
        motion = (tick.at_joints(x) for x in (now.reference, *now.derivatives))
        return *law.estimator.rows(*motion, u)[::2], tick.at_joints(law.gain * u)

    return law.estimator.sizes(*jax.vmap(one)(path))
