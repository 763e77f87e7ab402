"""Tracking by flatness: the balance of the plant gives the force for a wanted acceleration."""

from __future__ import annotations

from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers.base import Controller, Path, Tick
from jaxid.dynamics.rhs import State, acceleration
from jaxid.model.balance import port_motion
from jaxid.model.plant import Plant
from jaxid.numerics.smooth import sharp_clip


def flat_inputs(plant: Plant, path: Path, drives: int) -> Float[Array, "time m"]:
    """Compute the forces of the drives along a trajectory of the flat output, the position of all joints.

    Positions, velocities and accelerations are the trajectory and its derivatives; the balance gives the
    forces. If a joint has no drive, a trajectory that it would not follow by itself needs a force that no
    drive gives: such forces are left out.

    Args:
        plant: The plant; its dry friction is smoothed.
        path: Trajectory of all joints, one row for each instant.
        drives: Number of drives.

    Source:
        Wi, Ri, Ri & Ri, (3).
    """

    def forces(q: Array, v: Array, a: Array) -> Array:
        none = jnp.zeros(drives)
        internal = plant.initial_states(none)
        return plant.at_drives(plant.balance(q, v, a, none, jnp.zeros(()), internal).residual)

    return jax.vmap(forces)(path.reference, *path.derivatives)


class Flatness(Controller):
    """u = force of the model's balance at the measured positions and the acceleration v.

    Every position is a flat output: with two of its derivatives it gives all states and forces. With
    e = q - reference and the error's characteristic polynomial of the given poles,

        two poles:    v = reference'' - b1 e' - b0 e, e' from the measured velocity
        three poles:  v = reference'' - b2 e' - b1 e - b0 integral of e, e' from a reconstructed one

    The reconstructed velocity is the integral of the acceleration of the model at the measured
    positions under the given command; within `epsilon` it is the measured one, so that it
    does not drift while a joint sticks. The sign of dry friction is linear there.

    The model is that of the case at its guesses, with the effects on the joints; those in the drive
    (gain, lag, saturation) are not inverted. Joints without a drive are not controlled.

    Args:
        poles: Poles of the error, two or three negative reals [1/s].
        epsilon: Velocity within which the sign of dry friction is linear [m/s or rad/s].
        model: Model of the plant that the law uses.
        gain: Force per unit of the command, by drive.

    Source:
        Wi, Ri, Ri & Ri, (4)-(5) and (9)-(12). As printed, (4) derives v once more and (5), (10) lack
        the reference's marks; (8) integrates -c y / m and the sign of a difference, and drifts by up
        to mu g while sticking: here the whole balance is integrated, and reset at rest.
    """

    anticipates: ClassVar[bool] = True
    of_machine: ClassVar[tuple[str, ...]] = ("model", "gain")
    separate_drives: ClassVar[bool] = True
    sees_error: ClassVar[bool] = False

    poles: tuple[float, ...] = eqx.field(static=True, converter=tuple)
    epsilon: Array
    model: Plant
    gain: Array

    @property
    def gains(self) -> tuple[float, ...]:
        """Coefficients b of the error's polynomial, the highest power (one) left out."""
        return tuple(float(b) for b in np.poly(self.poles)[1:])

    @property
    def reconstructs(self) -> bool:
        """True if the law uses a reconstructed velocity."""
        return len(self.poles) == 3

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> Any:
        if not self.reconstructs:
            return None
        none = jnp.zeros_like(tick.position)
        return velocity, tick.joints, none, none, none

    def law(self, tick: Tick, velocity: Array, memory: Any, disturbance: Array) -> tuple:
        (slope, curvature), error = tick.path.derivatives, tick.position - tick.reference
        if not self.reconstructs:
            b1, b0 = self.gains
            v = curvature - b1 * (tick.at_drives(velocity) - slope) - b0 * error
            return self._force(tick, velocity, v) / self.gain, None
        b2, b1, b0 = self.gains
        before, joints, force, integral, last = memory
        velocity = self._reconstructed(before, velocity, joints, tick.joints, force)
        integral = integral + 0.5 * self.period * (last + error)
        v = curvature - b2 * (tick.at_drives(velocity) - slope) - b1 * error - b0 * integral
        u = self._force(tick, velocity, v) / self.gain
        given = self.gain * self.clipped(u + disturbance)
        return u, (velocity, tick.joints, given, integral, error)

    def _reconstructed(
        self, before: Array, measured: Array, joints: Array, now: Array, force: Array
    ) -> Array:
        """Compute the velocity a tick later by the midpoint rule on the acceleration of the model."""
        first = before + 0.5 * self.period * self._acceleration(joints, before, force)
        moved = before + self.period * self._acceleration(0.5 * (joints + now), first, force)
        return jnp.where(jnp.abs(measured) < self.epsilon, measured, moved)

    def _acceleration(self, q: Array, v: Array, force: Array) -> Array:
        internal = self.model.initial_states(force)
        reaction = self._reaction(q, v, force)
        return acceleration(self.model, State(q, v, internal), force, jnp.zeros(()), reaction)

    def _force(self, tick: Tick, velocity: Array, v: Array) -> Array:
        """Compute the force of the drives for accelerations v of the driven joints."""
        q, v = tick.joints, jnp.broadcast_to(v, len(tick.driven))
        none = jnp.zeros_like(v)
        asked = dict(zip(tick.driven, v, strict=True))
        wanted = jnp.stack([asked.get(i, jnp.zeros(())) for i in range(q.size)])
        internal, reaction = self.model.initial_states(none), self._reaction(q, velocity, none)
        balance = self.model.balance(q, velocity, wanted, none, jnp.zeros(()), internal, reaction)
        return tick.at_drives(balance.residual)

    def _reaction(self, q: Array, velocity: Array, force: Array) -> Array:
        """Compute dry friction by port, with a sign that is linear within epsilon."""
        internal, ports = self.model.initial_states(force), jnp.zeros_like(self.model.ports(q))
        zero = jnp.zeros_like(q)
        level = self.model.balance(q, velocity, zero, force, jnp.zeros(()), internal, ports).dry
        speed = port_motion(self.model, q, velocity, zero)[1]
        return -level * sharp_clip(speed / self.epsilon, jnp.ones(()))
