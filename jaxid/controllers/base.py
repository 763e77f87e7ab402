"""What every sampled controller offers: a memory and a command per tick."""

from __future__ import annotations

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from jaxid.smooth import sharp_clip


class Tick(eqx.Module):
    """All that a controller sees at one tick.

    Args:
        position: Measured coordinates.
        reference: Where they should be.
    """

    position: Float[Array, " n"]
    reference: Float[Array, " n"]


class Controller(eqx.Module):
    """A sampled law: the command it computes is held until its next tick.

    Args:
        period: Sampling time [s].
        limit: The command is clipped to plus or minus this; None: never.
        velocity_average: Velocity is the backward difference of the mean of so many samples.
    """

    period: float = eqx.field(static=True, kw_only=True)
    limit: Array | None = eqx.field(default=None, kw_only=True)
    velocity_average: int = eqx.field(static=True, default=1, kw_only=True)

    def start(self, position: Array, velocity: Array, reference: Array) -> Any:
        """Memory of a controller that has watched the motion pass at constant velocity."""
        ticks = range(1, self.velocity_average + 1)
        past = tuple(position - k * self.period * velocity for k in ticks)
        return past, self.start_law(reference)

    def start_law(self, reference: Array) -> Any:
        """Memory of the law itself."""
        return None

    def law(self, tick: Tick, velocity: Array, memory: Any, disturbance: Array) -> tuple:
        """Command before the limit, and the law's new memory."""
        raise NotImplementedError

    def command(self, tick: Tick, memory: Any, disturbance: Array) -> tuple[Array, Any]:
        """Command of one tick, disturbance added and limit applied, and the new memory.

        With p the mean of the last `velocity_average` positions, velocity is
        (p[k] - p[k-1]) / period, which telescopes to two positions.
        """
        past, inner = memory
        velocity = (tick.position - past[-1]) / (self.velocity_average * self.period)
        u, inner = self.law(tick, velocity, inner, disturbance)
        return self.clipped(u + disturbance), ((tick.position, *past[:-1]), inner)

    def clipped(self, u: Array) -> Array:
        """The command within its limit."""
        return u if self.limit is None else sharp_clip(u, self.limit)
