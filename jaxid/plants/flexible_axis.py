"""A motor that moves a load through an elastic coupling."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import parameter
from jaxid.model.springs import WithSprings
from jaxid.model.weight import WithWeight

_INERTIAS = ("motor_inertia", "load_inertia")
# Of motor, load and coupling.
_OF_LOAD = np.array([0.0, 1.0, 0.0])


class FlexibleAxis(WithSprings, WithWeight):
    """J_1 a_1 - s = u + effects; J_2 (a_2 + g) + s = effects; s = k e + d e', e = q_2 - q_1 - q_0.

    Joint 1 is the motor, joint 2 the load, both in the coordinate of the load; the drive acts on the
    motor. Ports are the two joints and then the coupling, by its elongation e. g acts along a
    vertical axis only, and on the load only.

    Args:
        motor_inertia: J_1 [kg or kg m^2].
        load_inertia: J_2 [kg or kg m^2].
        stiffness: k, of the coupling [N/m or N m/rad].
        damping: d, of the coupling [N s/m or N m s/rad].
        zero_offset: q_0, reading of the load minus that of the motor at a relaxed coupling, or None for
            zero [m or rad].

    Source:
        Janot, Gautier, Jubien and Vandanjon, "Experimental joint stiffness identification depending
        on measurements availability", equation (2).
    """

    kind = "flexible_axis"
    joints = 2
    diagonal = True
    load = 1
    actuated = (0,)

    motor_inertia: Array = parameter("inertia", "positive", "of the motor's side")
    load_inertia: Array = parameter("inertia", "positive", "of the load's side")
    stiffness: Array = parameter("force/position", "positive", "of the coupling")
    damping: Array = parameter("force*time/position", "nonnegative", "of the coupling")
    zero_offset: Array | None = parameter(
        "position", "free", "load's reading minus motor's at a relaxed coupling", optional=True
    )

    def own_inertia(self) -> Array:
        return jnp.stack([self.motor_inertia, self.load_inertia])

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        coupling = self.stiffness * self.elongations(q)[0] + self.damping * (qd[1] - qd[0])
        weight = self.port_gravity(q)[: q.size]
        return self.own_inertia() * (qdd + weight) + jnp.stack([-coupling, coupling])

    def elongations(self, q: Array) -> Array:
        relaxed = 0.0 if self.zero_offset is None else self.zero_offset
        return (q[1] - q[0] - relaxed)[None]

    def spring_laws(self) -> tuple[Array, Array]:
        return self.stiffness[None], self.damping[None]

    def port_gravity(self, q: Array) -> Array:
        along = self.gravity if self.vertical else 0.0 * self.gravity
        return along * _OF_LOAD

    def port_normal(self, q: Array) -> Array:
        return self.load_inertia * self.gravity * _OF_LOAD

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        if effect.kind == "added_mass" and port < self.joints:
            return _INERTIAS[port], None
        if effect.kind == "linear_stiffness" and port == self.joints:
            return "stiffness", None
        return None
