"""What every sampled controller offers: a memory and a command per tick."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.numerics.smooth import sharp_clip


class Path(eqx.Module):
    """Where the driven joints should be: at one tick, or at all, one row each.

    Args:
        reference: Position [m or rad].
        slope, curvature: Its derivatives; None for a controller that does not anticipate.
    """

    reference: Array
    slope: Array | None = None
    curvature: Array | None = None


class Tick(eqx.Module):
    """All that a controller sees at one tick.

    Args:
        joints: Measured coordinates of all joints.
        path: Where those that are driven should be.
        driven: Which these are, 0-based, in the order of the drives.
        fresh: Whether the readings are new; else they are held from an earlier tick.
        velocity, acceleration: Of all joints, where sensors measure them; acceleration is the mean since
            the tick before. None: positions are to be differenced.
        renewed: Whether these are new.
        measured: Command that the drives report for the interval just past; None, or NaN: as it was given.
    """

    joints: Float[Array, " n"]
    path: Path
    driven: tuple[int, ...] = eqx.field(static=True)
    fresh: Array | bool = True
    velocity: Float[Array, " n"] | None = None
    acceleration: Float[Array, " n"] | None = None
    measured: Float[Array, " m"] | None = None
    renewed: Array | bool = True

    def at_drives(self, x: Float[Array, " n"]) -> Float[Array, " m"]:
        """Of a quantity by joint, the entries of the driven ones."""
        whole = self.driven == tuple(range(x.size))
        return x if whole else jnp.stack([x[i] for i in self.driven])

    def at_joints(self, x: Float[Array, " m"]) -> Float[Array, " n"]:
        """A quantity by drive at its joints; zero at those that none drives."""
        n = self.joints.size
        if self.driven == tuple(range(n)):
            return x
        zero = jnp.zeros((), x.dtype)
        return jnp.stack([x[self.driven.index(i)] if i in self.driven else zero for i in range(n)])

    @property
    def position(self) -> Float[Array, " m"]:
        """Measured coordinates of the driven joints."""
        return self.at_drives(self.joints)

    @property
    def reference(self) -> Float[Array, " m"]:
        """Where they should be."""
        return self.path.reference


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

    # Whether the law needs the reference's derivatives.
    anticipates: ClassVar[bool] = False
    # Fields that no case states: the machine's own model, gain and estimator.
    of_machine: ClassVar[tuple[str, ...]] = ()
    # Whether it needs a drive at every joint.
    every_drive: ClassVar[bool] = False
    # Whether joints without a drive are allowed only if their accelerations enter no other joint's balance.
    separate_drives: ClassVar[bool] = False

    def path(self, reference: Float[Array, "ticks m"]) -> Path:
        """The reference as the law needs it, at every tick; differences are central."""
        if not self.anticipates:
            return Path(reference)
        before = jnp.concatenate([2 * reference[:1] - reference[1:2], reference[:-1]])
        after = jnp.concatenate([reference[1:], 2 * reference[-1:] - reference[-2:-1]])
        curvature = (after - 2 * reference + before) / self.period**2
        return Path(reference, (after - before) / (2 * self.period), curvature)

    def start(self, tick: Tick, velocity: Float[Array, " n"], path: Path | None = None) -> Any:
        """Memory of a controller that has watched the joints pass at constant velocity.

        Args:
            tick: The first.
            velocity: Of all joints.
            path: The whole course, for a law that looks ahead on it.
        """
        ticks = range(1, self.velocity_average + 1)
        past = tuple(tick.joints - k * self.period * velocity for k in ticks)
        return past, self.start_law(tick, velocity, path)

    def start_law(self, tick: Tick, velocity: Float[Array, " n"], path: Path | None = None) -> Any:
        """Memory of the law itself."""
        return None

    def resumed(self, start: Any, saved: Any) -> Any:
        """A memory at the start of a new run with what was identified in an earlier one."""
        return start

    def learned(self, memory: Any) -> Any:
        """What a law that identifies has found so far; None of one that does not."""
        return None

    def law(self, tick: Tick, velocity: Float[Array, " n"], memory: Any, disturbance: Array) -> tuple:
        """Command before the limit, and the law's new memory; velocity is of all joints."""
        raise NotImplementedError

    def command(self, tick: Tick, memory: Any, disturbance: Array) -> tuple[Array, Any]:
        """Command of one tick, disturbance added and limit applied, and the new memory.

        With p the mean of the last `velocity_average` positions, velocity is
        (p[k] - p[k-1]) / period, which telescopes to two positions.
        """
        past, inner = memory
        velocity = tick.velocity
        if velocity is None:
            velocity = (tick.joints - past[-1]) / (self.velocity_average * self.period)
        u, inner = self.law(tick, velocity, inner, disturbance)
        return self.clipped(u + disturbance), ((tick.joints, *past[:-1]), inner)

    def clipped(self, u: Array) -> Array:
        """The command within its limit."""
        return u if self.limit is None else sharp_clip(u, self.limit)
