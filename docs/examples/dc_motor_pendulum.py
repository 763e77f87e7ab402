"""A pendulum on the shaft of a DC motor whose voltage is logged, not its torque."""

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.model.effect import Action, Effect, Signals
from jaxid.model.parameter import parameter
from jaxid.model.weight import WithGravity


class Pendulum(WithGravity):
    """J q'' + m r g sin q = torque of the motor + effects; q is the angle from hanging down [rad]."""

    kind = "pendulum"
    usual_motion = "rotary"

    inertia: Array = parameter("inertia", "positive", "J, of all that turns, about the shaft")
    first_moment: Array = parameter("inertia*position", "positive", "m r, of the pendulum", motion="linear")

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self.inertia * qdd + self.first_moment * self.gravity * jnp.sin(q)


class Armature(Effect):
    """L di/dt + R i = V - k q', torque = k i, written for the torque: T torque' = u - b q' - torque.

    The declared force u of the drive is the stall torque (k/R) V: k/R is the gain of [actuator].
    """

    kind = "armature"
    adds_force = False
    in_drive = True

    time_constant: Array = parameter("time", "positive", "T = L/R")
    back_emf: Array = parameter("force*time/position", "nonnegative", "b = k^2/R")

    def act(self, x: Signals, state: Array) -> Action:
        return Action(drive=state, rate=(x.u - self.back_emf * x.yd - state) / self.time_constant)

    def initial_state(self, u: Array) -> Array:
        return u
