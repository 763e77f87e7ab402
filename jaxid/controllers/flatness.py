"""Tracking by flatness: the plant's own balance gives the force for the acceleration asked of it."""

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
    """Forces of the drives along a trajectory of the flat output, which is every joint's position.

    Positions, velocities and accelerations are the trajectory and its derivatives; the balance gives the
    rest. Where not every joint is driven, a trajectory that the others would not follow by themselves
    asks for forces that no drive gives: these are left out.

    Args:
        plant: The plant; its dry friction is smoothed.
        path: Of all joints, one row an instant.
        drives: How many there are.

    Source:
        Wi, Ri, Ri & Ri, (3).
    """

    def forces(q: Array, v: Array, a: Array) -> Array:
        none = jnp.zeros(drives)
        own = plant.initial_states(none)
        return plant.at_drives(plant.balance(q, v, a, none, jnp.zeros(()), own).residual)

    return jax.vmap(forces)(path.reference, path.slope, path.curvature)


class Flatness(Controller):
    """u = force that the model's balance asks for at the measured positions and acceleration v.

    Every position is a flat output: it and two of its derivatives give all states and forces. With
    e = q - reference and the error's characteristic polynomial of the given poles,

        two poles:    v = reference'' - b1 e' - b0 e, e' from the measured velocity
        three poles:  v = reference'' - b2 e' - b1 e - b0 integral of e, e' from a reconstructed one

    The reconstructed velocity is the integral of the model's own acceleration at the measured
    positions under the command that was given; within `epsilon` it is the measured one, so that it
    does not drift while a joint sticks. The sign of dry friction is linear there.

    The model is the case's own at its guesses, with what acts on the joints; what sits in the drive
    (gain, lag, saturation) is not inverted. Joints without a drive follow as they will.

    Args:
        poles: Of the error, two or three negative reals [1/s].
        epsilon: Velocity within which the sign of dry friction is linear [m/s or rad/s].
        model: What the law takes for the plant.
        gain: Force per unit of the command, by drive.

    Source:
        Wi, Ri, Ri & Ri, (4)-(5) and (9)-(12). As printed, (4) derives v once more and (5), (10) lack
        the reference's marks; (8) integrates -c y / m and the sign of a difference, and drifts by up
        to mu g while sticking: here the balance is integrated as it stands, and reset at rest.
    """

    anticipates: ClassVar[bool] = True
    of_machine: ClassVar[tuple[str, ...]] = ("model", "gain")
    separate_drives: ClassVar[bool] = True

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
        """Whether the law sees a reconstructed velocity."""
        return len(self.poles) == 3

    def start_law(self, tick: Tick, velocity: Array, path: Path | None = None) -> Any:
        if not self.reconstructs:
            return None
        none = jnp.zeros_like(tick.position)
        return velocity, tick.joints, none, none, none

    def law(self, tick: Tick, velocity: Array, memory: Any, disturbance: Array) -> tuple:
        path, error = tick.path, tick.position - tick.reference
        if not self.reconstructs:
            b1, b0 = self.gains
            v = path.curvature - b1 * (tick.at_drives(velocity) - path.slope) - b0 * error
            return self._force(tick, velocity, v) / self.gain, None
        b2, b1, b0 = self.gains
        before, joints, force, integral, last = memory
        velocity = self._reconstructed(before, velocity, joints, tick.joints, force)
        integral = integral + 0.5 * self.period * (last + error)
        v = path.curvature - b2 * (tick.at_drives(velocity) - path.slope) - b1 * error - b0 * integral
        u = self._force(tick, velocity, v) / self.gain
        given = self.gain * self.clipped(u + disturbance)
        return u, (velocity, tick.joints, given, integral, error)

    def _reconstructed(
        self, before: Array, measured: Array, joints: Array, now: Array, force: Array
    ) -> Array:
        """Velocity a tick later: the midpoint rule on the model's acceleration."""
        first = before + 0.5 * self.period * self._acceleration(joints, before, force)
        moved = before + self.period * self._acceleration(0.5 * (joints + now), first, force)
        return jnp.where(jnp.abs(measured) < self.epsilon, measured, moved)

    def _acceleration(self, q: Array, v: Array, force: Array) -> Array:
        own = self.model.initial_states(force)
        reaction = self._reaction(q, v, force)
        return acceleration(self.model, State(q, v, own), force, jnp.zeros(()), reaction)

    def _force(self, tick: Tick, velocity: Array, v: Array) -> Array:
        """Force of the drives for accelerations v of the joints that are driven."""
        q, v = tick.joints, jnp.broadcast_to(v, len(tick.driven))
        none = jnp.zeros_like(v)
        asked = dict(zip(tick.driven, v, strict=True))
        wanted = jnp.stack([asked.get(i, jnp.zeros(())) for i in range(q.size)])
        own, reaction = self.model.initial_states(none), self._reaction(q, velocity, none)
        balance = self.model.balance(q, velocity, wanted, none, jnp.zeros(()), own, reaction)
        return tick.at_drives(balance.residual)

    def _reaction(self, q: Array, velocity: Array, force: Array) -> Array:
        """Dry friction by port, its sign linear within epsilon."""
        own, ports = self.model.initial_states(force), jnp.zeros_like(self.model.ports(q))
        zero = jnp.zeros_like(q)
        level = self.model.balance(q, velocity, zero, force, jnp.zeros(()), own, ports).dry
        speed = port_motion(self.model, q, velocity, zero)[1]
        return -level * sharp_clip(speed / self.epsilon, jnp.ones(()))
