"""A motor that moves a load through an elastic coupling."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import as_array, parameter
from jaxid.model.plant import Plant

_INERTIAS = ("motor_inertia", "load_inertia")
# Of motor, load and coupling.
_OF_LOAD = np.array([0.0, 1.0, 0.0])


class FlexibleAxis(Plant):
    """J_1 a_1 - s = u + effects; J_2 (a_2 + g) + s = effects; s = k e + d e', e = q_2 - q_1 - q_0.

    Joint 1 is the motor, joint 2 the load, both in the coordinate of the load; the drive acts on the
    motor. Ports are the two joints and then the coupling, by its elongation e. g acts along a
    vertical axis only, and on the load: what turns does not weigh.

    Args:
        motor_inertia: J_1 [kg or kg m^2].
        load_inertia: J_2 [kg or kg m^2].
        stiffness: k, of the coupling [N/m or N m/rad].
        damping: d, of the coupling [N s/m or N m s/rad].
        zero_offset: q_0, reading of the load minus that of the motor where the coupling is relaxed, or
            None for zero [m or rad].
        effects: Forces beside these, in the order of the drive.
        gravity: g [m/s^2].
        vertical: Whether weight acts along the axis (positive position is up).
        sharpness: Width of the smoothed sign over `velocity_scale`, dimensionless.
        velocity_scale: A typical velocity [m/s or rad/s].

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
        "position", "free", "load's reading minus motor's where the coupling is relaxed", optional=True
    )
    effects: tuple[Effect, ...] = eqx.field(default=(), kw_only=True)
    gravity: Array = eqx.field(converter=as_array, default=9.81, kw_only=True)
    sharpness: Array = eqx.field(converter=as_array, default=1e-3, kw_only=True)
    velocity_scale: Array = eqx.field(converter=as_array, default=1.0, kw_only=True)
    vertical: bool = eqx.field(static=True, default=False, kw_only=True)

    def own_inertia(self) -> Array:
        return jnp.stack([self.motor_inertia, self.load_inertia])

    @classmethod
    def springs(cls, joints: int) -> int:
        return 1

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        coupling = self.stiffness * self._elongation(q) + self.damping * (qd[1] - qd[0])
        weight = self.port_gravity(q)[: q.size]
        return self.own_inertia() * (qdd + weight) + jnp.stack([-coupling, coupling])

    def ports(self, q: Array) -> Array:
        return jnp.stack([q[0], q[1], self._elongation(q)])

    def _elongation(self, q: Array) -> Array:
        relaxed = 0.0 if self.zero_offset is None else self.zero_offset
        return q[1] - q[0] - relaxed

    def port_gravity(self, q: Array) -> Array:
        along = self.gravity if self.vertical else 0.0 * self.gravity
        return along * _OF_LOAD

    def port_normal(self, q: Array) -> Array:
        return self.load_inertia * self.gravity * _OF_LOAD

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        none = jnp.zeros(2)
        return (
            jnp.concatenate([none, self.stiffness[None]]),
            jnp.concatenate([none, self.damping[None]]),
        )

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        return (port,) if port < joints else (0, 1)

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        if effect.kind == "added_mass" and port < self.joints:
            return _INERTIAS[port], None
        if effect.kind == "linear_stiffness" and port == self.joints:
            return "stiffness", None
        return None
