"""Computed torque: the model's inverse dynamics along the reference, fed forward beside a PD law."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers.base import Controller, Path, Tick
from jaxid.model.plant import Plant

# Least gain of a drive that a command is divided by.
_LEAST_GAIN = 0.1


def inverse_dynamics(
    plant: Plant, q: Float[Array, " n"], qd: Float[Array, " n"], qdd: Float[Array, " n"], drives: int
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Compute the forces for a motion: those without friction, and those for friction [N or N m].

    Friction is the part that depends on the velocity and is not inertial; weight, springs, offsets and ripple
    belong to the first part, evaluated at rest.
    """
    none, now, still = jnp.zeros(drives), jnp.zeros(()), jnp.zeros_like(q)
    own = plant.initial_states(none)
    resting = plant.balance(q, still, qdd, none, now, own, jnp.zeros_like(plant.ports(q))).residual
    smooth = plant.inertial(q, qd, qdd) + resting - plant.inertial(q, still, qdd)
    return smooth, plant.balance(q, qd, qdd, none, now, own).residual - smooth


def drive_gains(plant: Plant, drives: int) -> Float[Array, " m"]:
    """Return the gain of each drive, applied over declared force: the product of its effects of that kind."""
    out = [jnp.ones(())] * drives
    for e in plant.effects:
        j = plant.drive_of(e.port, drives)
        if e.drive_gain is not None and j is not None:
            out[j] = out[j] * getattr(e, e.drive_gain)
    return jnp.stack(out)


class FeedForward(Controller):
    """A PD law with the forces of a model along the reference, over the drives' gains. Abstract.

        u = (kp (r - q) + kd (r' - q') + (dynamics + friction) / gain) / gains

    r' is differenced like q', so that both have the same delay; if the velocity is measured, it is the
    derivative of the reference. If readings are held, the parts of the PD law are held with them.

    Args:
        kp, kd: Gains in units of the command, as those of `PD`.
        model: Model of the plant that the law uses.
        gain: Force per unit of the command, by drive.
        dynamics: Whether forces without friction are fed forward.
        friction: Whether friction is fed forward.
        gains: Whether the command is divided by the drives' gains.
        epsilon: Velocity of the reference over which dry friction changes its sign [m/s or rad/s].

    Source:
        Righettini et al. (2025), Robotics 14, 36, (15)-(18) and (23), with its switches a, b and c.
        Corrected: forces of joints become torques of motors by -D_m^-T; here that is the declared gain.
    """

    anticipates: ClassVar[bool] = True
    every_drive: ClassVar[bool] = True

    kp: Array
    kd: Array
    model: Plant
    gain: Array
    dynamics: bool = eqx.field(static=True, default=True, kw_only=True)
    friction: eqx.AbstractVar[bool]
    gains: bool = eqx.field(static=True, default=True, kw_only=True)
    epsilon: Array = eqx.field(default=1e-3, kw_only=True)

    def start_feedback(self, tick: Tick) -> tuple[Array, Array]:
        """Return past references, and the last parts of the PD law."""
        back = self.period * jnp.arange(1, self.velocity_average + 1)[:, None]
        return tick.reference - back * tick.path.derivatives[0], jnp.zeros((2, tick.reference.size))

    def feedback(self, tick: Tick, velocity: Array, memory: tuple) -> tuple[Array, tuple]:
        """Compute the command of the PD law, and its memory."""
        past, held = memory
        slope = (tick.reference - past[-1]) / (self.velocity_average * self.period)
        measured = tick.velocity is not None
        slope = tick.path.derivatives[0] if measured else slope
        error = self.error(tick)
        parts = self.kp * error, self.kd * (slope - tick.at_drives(velocity))
        fresh = tick.fresh, tick.renewed if measured else tick.fresh
        held = jnp.stack([jnp.where(f, u, old) for f, u, old in zip(fresh, parts, held, strict=True)])
        return held[0] + held[1], (jnp.concatenate([tick.reference[None], past[:-1]]), held)

    def fed(self, model: Plant, tick: Tick) -> tuple[Array, Array]:
        """Compute the commands of a model along the reference, without friction and for friction."""
        model = model.smoothed(jnp.ones(()), jnp.asarray(self.epsilon))
        q, qd, qdd = (tick.at_joints(x) for x in (tick.path.reference, *tick.path.derivatives))
        smooth, friction = inverse_dynamics(model, q, qd, qdd, len(tick.driven))
        return tick.at_drives(smooth) / self.gain, tick.at_drives(friction) / self.gain

    def over_gains(self, u: Array, model: Plant) -> Array:
        """Divide a command by the drives' gains."""
        return u / jnp.maximum(drive_gains(model, u.size), _LEAST_GAIN)


class ComputedTorque(FeedForward):
    """`FeedForward` with a fixed model: that of the case, at its guesses."""

    of_machine: ClassVar[tuple[str, ...]] = ("model", "gain")

    friction: bool = eqx.field(static=True, default=False, kw_only=True)

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> Any:
        return self.start_feedback(tick)

    def law(self, tick: Tick, velocity: Array, memory: Any, disturbance: Array) -> tuple:
        u, memory = self.feedback(tick, velocity, memory)
        smooth, friction = self.fed(self.model, tick)
        u = u + smooth if self.dynamics else u
        u = u + friction if self.friction else u
        return self.over_gains(u, self.model) if self.gains else u, memory
