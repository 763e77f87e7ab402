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
    """Forces that a motion takes: without friction, and for friction beside that [N or N m].

    Friction is what depends on the velocity and is not inertial; weight, springs, offsets and ripple are of
    the first part, evaluated where nothing moves.
    """
    none, now, still = jnp.zeros(drives), jnp.zeros(()), jnp.zeros_like(q)
    own = plant.initial_states(none)
    resting = plant.balance(q, still, qdd, none, now, own, jnp.zeros_like(plant.ports(q))).residual
    smooth = plant.inertial(q, qd, qdd) + resting - plant.inertial(q, still, qdd)
    return smooth, plant.balance(q, qd, qdd, none, now, own).residual - smooth


def drive_gains(plant: Plant, drives: int) -> Float[Array, " m"]:
    """Gain of each drive, applied over declared force: the product of its effects of that kind."""
    out = [jnp.ones(())] * drives
    for e in plant.effects:
        j = plant.drive_of(e.port, drives)
        if e.drive_gain is not None and j is not None:
            out[j] = out[j] * getattr(e, e.drive_gain)
    return jnp.stack(out)


class FeedForward(Controller):
    """A PD law and what a model asks for along the reference, over the drives' gains. Abstract.

        u = (kp (r - q) + kd (r' - q') + (dynamics + friction) / gain) / gains

    r' is differenced as q' is, so that both are late by as much; where the velocity is measured, it is the
    reference's own. Where readings are held, the parts of the PD law are held with them.

    Args:
        kp, kd: In units of the command, as those of `PD`.
        model: What the law takes for the plant.
        gain: Force per unit of the command, by drive.
        dynamics: Whether forces without friction are fed forward.
        friction: Whether friction is.
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
        """Past references, and the PD law's last parts."""
        back = self.period * jnp.arange(1, self.velocity_average + 1)[:, None]
        return tick.reference - back * tick.path.slope, jnp.zeros((2, tick.reference.size))

    def feedback(self, tick: Tick, velocity: Array, memory: tuple) -> tuple[Array, tuple]:
        """The PD law's command, and its memory."""
        past, held = memory
        slope = (tick.reference - past[-1]) / (self.velocity_average * self.period)
        measured = tick.velocity is not None
        slope = tick.path.slope if measured else slope
        error = tick.reference - tick.position
        parts = self.kp * error, self.kd * (slope - tick.at_drives(velocity))
        fresh = tick.fresh, tick.renewed if measured else tick.fresh
        held = jnp.stack([jnp.where(f, u, old) for f, u, old in zip(fresh, parts, held, strict=True)])
        return held[0] + held[1], (jnp.concatenate([tick.reference[None], past[:-1]]), held)

    def fed(self, model: Plant, tick: Tick) -> tuple[Array, Array]:
        """What a model asks for along the reference, without friction and for it, in units of the command."""
        width = (jnp.ones(()), jnp.asarray(self.epsilon))
        model = eqx.tree_at(lambda p: (p.sharpness, p.velocity_scale), model, width)
        path = (tick.path.reference, tick.path.slope, tick.path.curvature)
        motion = (tick.at_joints(x) for x in path)
        forces = inverse_dynamics(model, *motion, len(tick.driven))
        return tuple(tick.at_drives(f) / self.gain for f in forces)

    def over_gains(self, u: Array, model: Plant) -> Array:
        """The command that gives what is asked for, through the drives' gains."""
        return u / jnp.maximum(drive_gains(model, u.size), _LEAST_GAIN)


class ComputedTorque(FeedForward):
    """`FeedForward` of a model that stays as it is: the case's own, at its guesses."""

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
