"""A motor that moves a table through a screw, with or without play of its axial stiffness."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.parameter import as_array, parameter
from jaxid.model.plant import Plant

_INERTIAS = ("motor_inertia", "table_mass")
_MOTIONS = ("rotary", "linear", "linear")
_SCREW = ("inertia", "positive", "of the screw")


class Stage(Plant):
    """What the stage has with either screw: a motor that turns it, and a table that it moves.

    Joint 1 is the motor with its screw, by its angle th [rad]; joint 2 the table, by its position x [m];
    the drive is a torque on the motor. R = pitch / 2 pi.

    Args:
        motor_inertia: J, of the motor, and of the screw where that is not stated apart [kg m^2].
        table_mass: M [kg].
        pitch: Way of the table for a turn of the motor [m].
        screw_inertia: Of the screw, a part of J, or None [kg m^2].
        effects: Forces beside these, in the order of the drive.
        sharpness: Width of the smoothed sign over `velocity_scale`, dimensionless.
        velocity_scale: A typical velocity of the motor [rad/s].
    """

    kind = "micropositioning_stage"
    diagonal = True
    stage = True
    usual_motion = _MOTIONS[0]

    motor_inertia: Array = parameter("inertia", "positive", "of the motor", motion="rotary")
    table_mass: Array = parameter("inertia", "positive", "of the table", motion="linear")
    pitch: Array = parameter("position", "positive", "way of the table for a turn", motion="linear")
    # And `screw_inertia`, which may be absent: either stage declares it behind what it must have.
    effects: tuple[Effect, ...] = eqx.field(default=(), kw_only=True)
    sharpness: Array = eqx.field(converter=as_array, default=1e-3, kw_only=True)
    velocity_scale: Array = eqx.field(converter=as_array, default=1.0, kw_only=True)

    @property
    def ratio(self) -> Array:
        """R: way of the table for an angle of the motor [m/rad]."""
        return self.pitch / (2 * np.pi)

    @property
    def turning(self) -> Array:
        """Inertia of all that turns [kg m^2]."""
        return self.motor_inertia + (0.0 if self.screw_inertia is None else self.screw_inertia)

    def motion(self, port: int) -> str:
        return _MOTIONS[port]

    def port_width(self, q: Array) -> Array:
        along = jnp.broadcast_to(self.ratio, (self.ports(q).size - 1,))
        return self.width * jnp.concatenate([jnp.ones(1), along])

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        return (_INERTIAS[port], None) if effect.kind == "added_mass" and port < 2 else None


class MicropositioningStage(Stage):
    """J th'' + R s = u + effects; M x'' = s + effects; s = k (R th - x) + d (R th' - x').

    The port behind motor and table is the elongation x - R th of the screw.

    Args:
        stiffness: k, axial, of screw, nut and bearing [N/m].
        damping: d, beside it, or None for none [N s/m].

    Source:
        Bogdan and Abba, "Identification of mechanical parameters at low velocities for a micropositioning
        stage using a velocity hysteresis model", (1)-(5). Table 1 gives a stiffness of 1.6e-2 N/rad, which
        would carry the table's friction after 487 rad only; velocities in rad/s would need 2.4 s for the
        0.3 mm that take 0.5 s: they are rev/s.
    """

    joints = 2
    load = 1
    actuated = (0,)

    stiffness: Array = parameter("force/position", "positive", "axial, of the screw", motion="linear")
    screw_inertia: Array | None = parameter(*_SCREW, optional=True, motion="rotary")
    damping: Array | None = parameter(
        "force*time/position", "nonnegative", "beside the stiffness", optional=True, motion="linear"
    )

    def own_inertia(self) -> Array:
        return jnp.stack([self.turning, self.table_mass])

    @classmethod
    def springs(cls, joints: int) -> int:
        return 1

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        damping = 0.0 if self.damping is None else self.damping
        pull = self.stiffness * self._elongation(q) + damping * self._elongation(qd)
        return self.own_inertia() * qdd + jnp.stack([-self.ratio * pull, pull])

    def ports(self, q: Array) -> Array:
        return jnp.stack([q[0], q[1], self._elongation(q)])

    def _elongation(self, q: Array) -> Array:
        return q[1] - self.ratio * q[0]

    def port_spring(self, q: Array) -> tuple[Array, Array]:
        none = jnp.zeros(2)
        damping = jnp.zeros(()) if self.damping is None else self.damping
        return jnp.concatenate([none, self.stiffness[None]]), jnp.concatenate([none, damping[None]])

    def joints_loaded_by(self, port: int, joints: int) -> tuple[int, ...]:
        return (port,) if port < joints else (0, 1)

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        of_screw = effect.kind == "linear_stiffness" and port == self.joints
        return ("stiffness", None) if of_screw else super().equivalent_parameter(effect, port)


class RigidMicropositioningStage(Stage):
    """(J + R^2 M) th'' = u + R (effects on the table) + effects; x = R th.

    `MicropositioningStage` with a screw that does not give: what a log sees that is sampled far below its
    1 kHz. Effects act on the motor or the table, as there; of what they do, and of J and M, such a log
    tells sums only.

    Source:
        Bogdan and Abba, as there, with (3) replaced by x_t = R theta_m.
    """

    screw_inertia: Array | None = parameter(*_SCREW, optional=True, motion="rotary")

    def own_inertia(self) -> Array:
        return (self.turning + self.ratio**2 * self.table_mass)[None]

    @classmethod
    def bodies(cls, joints: int) -> int:
        return 2

    @property
    def geared(self) -> tuple[tuple[int, int, Array], ...]:
        return ((1, 0, self.ratio),)

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        return self.own_inertia() * qdd

    def ports(self, q: Array) -> Array:
        return jnp.stack([q[0], self.ratio * q[0]])

    def accepts(self, effect: type[Effect], port: int, drives: int) -> bool:
        # Of what one coordinate cannot tell apart: the table's, but for what sits in the drive or at rest.
        at_motor = effect.in_drive or effect.break_away_level is not None
        return super().accepts(effect, port, drives) and port == (0 if at_motor else 1)


# By the coupling that a case states.
Stage.couplings = {"elastic": MicropositioningStage, "rigid": RigidMicropositioningStage}
