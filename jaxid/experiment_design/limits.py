"""Limits of an experiment on a machine: stroke, speed and force."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.experiment_design.shapes import largest
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.schema import stated
from jaxid.settings import LimitsTable
from jaxid.simulation.loops import Trajectory

# From this part of a limit on, an experiment is penalised: at the limit by as much as a factor e in evidence.
_FROM = 0.97

if TYPE_CHECKING:
    from jaxid.experiment_design.shapes import Shapes

# Amplitudes tried until the machine keeps within its limits.
_AMPLITUDES = (1.0, 0.95, 0.9, 0.8, 0.7, 0.5, 0.3, 0.15, 0.07)


@dataclass(frozen=True)
class Limits:
    """Bounds on the motion and on the command, by joint and by drive.

    Args:
        low, high: Ends of the stroke [m or rad].
        speed: Largest speed [m/s or rad/s].
        force: Largest magnitude of the command, in units of the command.
        stated: Those of "stroke", "speed" and "force" that the case gives; the others are those of the log.
    """

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " m"]
    stated: tuple[str, ...] = ()

    @classmethod
    def of(cls, table: LimitsTable, machine: Machine, log: Log, data: Prepared) -> Limits:
        """Take the limits that a case states, and the extremes of the log for the others.

        Without a stated force the limit is the controller's saturation, if it has one, since the drive is
        known to stand it.

        Args:
            table: Table [limits] of the case.
            machine: The machine of the log.
            log, data: The log, before and after preparation.
        """
        n, m = log.position.shape[1], log.force.shape[1]
        stroke = table.stroke
        if stroke is None:
            low, high = data.q.min(axis=0), data.q.max(axis=0)
        else:
            low, high = np.broadcast_to(np.asarray(stroke, float), (n, 2)).T
        speed = np.abs(data.qd).max(axis=0) if table.speed is None else table.speed
        saturation = None if machine.controller is None else machine.controller.limit
        used = np.abs(log.force).max(axis=0) if saturation is None else np.asarray(saturation)
        force = used if table.force is None else table.force
        return cls(
            low=np.array(low, float),
            high=np.array(high, float),
            speed=np.broadcast_to(speed, n).astype(float),
            force=np.broadcast_to(force, m).astype(float),
            stated=tuple(stated(table)),
        )

    def broken(self, peaks: Peaks) -> bool:
        """Check if a run exceeds the limits or diverged."""
        return bool(
            np.any(peaks.low < self.low)
            or np.any(peaks.high > self.high)
            or np.any(peaks.speed > self.speed)
            or np.any(peaks.force > self.force)
            or not np.all(np.isfinite(peaks.speed))
        )


def kept_within(
    limits: Limits, shapes: Shapes, p: Float[np.ndarray, " p"], peaks_of: Callable[[np.ndarray], Peaks]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "time m"], Peaks] | None:
    """Find the largest amplitude at which a machine keeps within its limits.

    Args:
        limits: Limits of the experiment.
        shapes: Family of signals.
        p: Numbers of the signal in its family.
        peaks_of: Function from a signal to the extremes of its run.

    Returns:
        Numbers, signal and extremes at that amplitude; None if the limits are exceeded at every amplitude.
    """
    for factor in _AMPLITUDES:
        smaller = shapes.smaller(p, factor)
        signal = shapes.signal(smaller)
        peaks = peaks_of(signal)
        if not limits.broken(peaks):
            return smaller, signal, peaks
    return None


@dataclass(frozen=True)
class Peaks:
    """Extremes of a run; the fields are those of `Limits`."""

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    speed: Float[np.ndarray, " n"]
    force: Float[np.ndarray, " m"]

    @classmethod
    def of(cls, position: np.ndarray, velocity: np.ndarray, command: np.ndarray) -> Peaks:
        """Compute the extremes of runs with time on the axis before the last."""

        def most(x: np.ndarray) -> np.ndarray:
            return np.max(x.reshape(-1, x.shape[-1]), axis=0)

        return cls(-most(-position), most(position), most(np.abs(velocity)), most(np.abs(command)))


class LimitCost(eqx.Module):
    """`Limits` as JAX arrays, with a cost for gradients."""

    low: Array
    high: Array
    speed: Array
    force: Array

    @classmethod
    def of(cls, limits: Limits) -> LimitCost:
        """Collect the arrays of limits."""
        return cls(*(jnp.asarray(x) for x in (limits.low, limits.high, limits.speed, limits.force)))

    def cost(self, run: Trajectory) -> Array:
        """Return the cost of a motion near the limits or beyond; zero well within."""
        half = 0.5 * (self.high - self.low)
        off = jnp.abs(run.position - 0.5 * (self.low + self.high)) / half
        parts = (off, jnp.abs(run.velocity) / self.speed, jnp.abs(run.command) / self.force)
        costs = [jnp.sum(jnp.square(jax.nn.relu(largest(x) - _FROM) / (1 - _FROM))) for x in parts]
        return costs[0] + costs[1] + costs[2]
