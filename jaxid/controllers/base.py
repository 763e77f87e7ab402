"""The interface of sampled controllers: a memory, and a command per tick."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.numerics.delays import accelerated, lagged, shifted, slewed
from jaxid.numerics.smooth import outside, sharp_clip


class Path(eqx.Module):
    """The reference of the driven joints, at one tick or at all ticks, one row each.

    Args:
        reference: Wanted position [m or rad].
        slope, curvature: Its derivatives; None for a controller that does not anticipate.
    """

    reference: Array
    slope: Array | None = None
    curvature: Array | None = None

    @property
    def derivatives(self) -> tuple[Array, Array]:
        """Slope and curvature, for a controller that anticipates."""
        assert self.slope is not None, "the path of a controller that anticipates"
        assert self.curvature is not None, "the path of a controller that anticipates"
        return self.slope, self.curvature


class Tick(eqx.Module):
    """The inputs of a controller at one tick.

    Args:
        joints: Measured coordinates of all joints.
        path: Reference of the driven joints.
        driven: Driven joints, 0-based, in the order of the drives.
        fresh: Whether the readings are new; else they are held from an earlier tick.
        velocity, acceleration: Measured values of all joints, if sensors give them; acceleration is the mean
            since the tick before. None: positions are to be differenced.
        renewed: Whether these measurements are new.
        measured: Command that the drives report for the interval just past; None, or NaN: as commanded.
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
        """Pick the entries of the driven joints from a quantity by joint."""
        whole = self.driven == tuple(range(x.size))
        return x if whole else jnp.stack([x[i] for i in self.driven])

    def at_joints(self, x: Float[Array, " m"]) -> Float[Array, " n"]:
        """Spread a quantity by drive over the joints; zero at joints without a drive."""
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
        """Wanted coordinates of the driven joints."""
        return self.path.reference


class Controller(eqx.Module):
    """A sampled law: the command it computes is held until its next tick.

    Args:
        period: Sampling time [s].
        limit: Bound of the magnitude of the command; None: no bound.
        delay: Transport delay of the reference [s], one for all drives or one each; None: none. Between two
            ticks the delayed reference is interpolated, so that derivatives by the delay exist.
        lag: Time constant of a first-order lag of the reference [s], as for `delay`; None: none. See `path`.
        speed: Largest velocity of the reference that the law follows [m/s or rad/s], as for `delay`; None: no
            limit. See `path`.
        acceleration: Largest acceleration of the reference that the law follows [m/s^2 or rad/s^2], as for
            `delay`; None: no limit. See `path`.
        dead_band: Position error that counts as zero, with all smaller ones [m or rad], as for `delay`; None:
            none. A larger error is not reduced.
        velocity_average: Number of samples whose mean is differenced backwards for the velocity.
        own_velocity: Whether the drive measures the velocity, so that no position is differenced for it.
    """

    period: float = eqx.field(static=True, kw_only=True)
    limit: Array | None = eqx.field(default=None, kw_only=True)
    delay: Array | None = eqx.field(default=None, kw_only=True)
    lag: Array | None = eqx.field(default=None, kw_only=True)
    speed: Array | None = eqx.field(default=None, kw_only=True)
    acceleration: Array | None = eqx.field(default=None, kw_only=True)
    dead_band: Array | None = eqx.field(default=None, kw_only=True)
    velocity_average: int = eqx.field(static=True, default=1, kw_only=True)
    own_velocity: bool = eqx.field(static=True, default=False, kw_only=True)

    # Whether the law needs the reference's derivatives.
    anticipates: ClassVar[bool] = False
    # Fields that no case states: model, gain and estimator of the machine.
    of_machine: ClassVar[tuple[str, ...]] = ()
    # Whether its command depends on the difference of reference and position, which a dead band can hide.
    sees_error: ClassVar[bool] = True
    # Whether the law needs a drive at every joint.
    every_drive: ClassVar[bool] = False
    # Whether joints without a drive are allowed only if their accelerations enter no other joint's balance.
    separate_drives: ClassVar[bool] = False

    def path(self, reference: Float[Array, "ticks m"]) -> Path:
        """Return the reference behind delay, lag and limits, with the derivatives that the law needs.

        The lag takes a step of backward Euler at each tick, so that without a time constant the reference
        passes; it has settled at the first reference. The limits are those of
        `jaxid.numerics.delays.slewed` and `jaxid.numerics.delays.accelerated`. Derivatives are central
        differences.
        """
        if self.delay is not None:
            reference = shifted(reference, self.delay / self.period)
        if self.lag is not None:
            reference = lagged(reference, self.period / (self.period + self.lag))
        if self.speed is not None:
            reference = slewed(reference, self.speed, self.period)
        if self.acceleration is not None:
            reference = accelerated(reference, self.acceleration, self.period)
        if not self.anticipates:
            return Path(reference)
        before = jnp.concatenate([2 * reference[:1] - reference[1:2], reference[:-1]])
        after = jnp.concatenate([reference[1:], 2 * reference[-1:] - reference[-2:-1]])
        curvature = (after - 2 * reference + before) / self.period**2
        return Path(reference, (after - before) / (2 * self.period), curvature)

    def start(self, tick: Tick, velocity: Float[Array, " n"], path: Path | None = None) -> Any:
        """Return the memory of a controller after joints have moved at constant velocity.

        Args:
            tick: The first tick.
            velocity: Velocity of all joints [m/s or rad/s].
            path: The whole reference, for a law that uses its future.
        """
        ticks = range(1, self.velocity_average + 1)
        past = tuple(tick.joints - k * self.period * velocity for k in ticks)
        return past, self.start_law(tick, velocity, path)

    def start_law(self, tick: Tick, velocity: Float[Array, " n"], path: Path | None = None) -> Any:
        """Return the initial memory of the law itself."""
        return None

    def resumed(self, start: Any, saved: Any) -> Any:
        """Return a memory for the start of a new run, with the unknowns identified in an earlier one."""
        return start

    def learned(self, memory: Any) -> Any:
        """Return the unknowns that the law has identified so far; None for a law without an estimator."""
        return None

    def law(self, tick: Tick, velocity: Float[Array, " n"], memory: Any, disturbance: Array) -> tuple:
        """Compute the command before the limit, and the new memory; velocity is that of all joints."""
        raise NotImplementedError

    def command(self, tick: Tick, memory: Any, disturbance: Array) -> tuple[Array, Any]:
        """Compute the command of one tick, disturbance added and limit applied, and the new memory.

        With p the mean of the last `velocity_average` positions, velocity is
        (p[k] - p[k-1]) / period, which telescopes to two positions.
        """
        past, inner = memory
        velocity = tick.velocity
        if velocity is None:
            velocity = (tick.joints - past[-1]) / (self.velocity_average * self.period)
        u, inner = self.law(tick, velocity, inner, disturbance)
        return self.clipped(u + disturbance), ((tick.joints, *past[:-1]), inner)

    def error(self, tick: Tick) -> Array:
        """Return the position error of the driven joints that the law sees."""
        error = tick.reference - tick.position
        return error if self.dead_band is None else outside(error, self.dead_band)

    def clipped(self, u: Array) -> Array:
        """Clip the command to its limit."""
        return u if self.limit is None else sharp_clip(u, self.limit)


def with_effects(controller: Controller, plant: Plant, drives: int) -> Controller:
    """Return a controller with the fields that effects of the plant set, such as a delay of the command.

    Args:
        controller: The controller of the case.
        plant: The plant with its effects.
        drives: Number of drives.
    """
    by_field: dict[str, list[Array | float]] = {}
    for e in plant.effects:
        drive = plant.drive_of(e.port, drives)
        if e.controller_field is None or drive is None:
            continue
        stated = getattr(controller, e.controller_field)
        known: list[Array | float] = [e.elsewhere] * drives
        if stated is not None:
            known = list(jnp.broadcast_to(jnp.asarray(stated), (drives,)))
        (value,) = (getattr(e, name) for name in parameters_of(type(e)))
        by_field.setdefault(e.controller_field, known)[drive] = value
    fields = {name: jnp.stack([jnp.asarray(v, float) for v in values]) for name, values in by_field.items()}
    return replace(controller, **fields) if fields else controller
