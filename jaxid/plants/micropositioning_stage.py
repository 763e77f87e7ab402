"""A motor that moves a table through a screw, with or without play of its axial stiffness."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.model.effect import Effect
from jaxid.model.gears import WithGears
from jaxid.model.parameter import parameter
from jaxid.model.springs import WithSprings

_INERTIAS = ("motor_inertia", "table_mass")
_SCREW = ("inertia", "positive", "of the screw")


class Stage(WithGears):
    """The common part of both stages: a motor that turns a screw, and a table that it moves.

    Joint 1 is the motor with its screw, by its angle th [rad]; joint 2 the table, by its position x [m];
    the drive is a torque on the motor. R = pitch / 2 pi.

    Args:
        motor_inertia: Inertia J of the motor, and of the screw if that is not stated apart [kg m^2].
        table_mass: Mass M of the table [kg].
        pitch: Travel of the table for one turn of the motor [m].
        screw_inertia: Inertia of the screw, a part of J, or None [kg m^2].
    """

    kind = "micropositioning_stage"
    diagonal = True
    stage = True
    motions = ("rotary", "linear", "linear")
    usual_motion = "rotary"

    motor_inertia: Array = parameter("inertia", "positive", "of the motor", motion="rotary")
    table_mass: Array = parameter("inertia", "positive", "of the table", motion="linear")
    pitch: Array = parameter("position", "positive", "way of the table for a turn", motion="linear")
    # `screw_inertia` is optional: either stage declares it behind the parameters that it must have.

    @property
    def ratio(self) -> Array:
        """R, the travel of the table per angle of the motor [m/rad]."""
        return self.pitch / (2 * np.pi)

    def port_ratios(self, q: Array) -> Array:
        along = jnp.broadcast_to(self.ratio, (self.ports(q).size - 1,))
        return jnp.concatenate([jnp.ones(1), along])

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        return (_INERTIAS[port], None) if effect.kind == "added_mass" and port < 2 else None


class MicropositioningStage(Stage, WithSprings):
    """J th'' + R s = u + effects; M x'' = s + effects; s = k (R th - x) + d (R th' - x').

    The port behind motor and table is the elongation x - R th of the screw.

    Args:
        stiffness: Axial stiffness k of screw, nut and bearing [N/m].
        damping: Damping d in parallel with it, or None for none [N s/m].

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
        return jnp.stack([_turning(self), self.table_mass])

    def inertial(self, q: Array, qd: Array, qdd: Array) -> Array:
        damping = 0.0 if self.damping is None else self.damping
        pull = self.stiffness * self.elongations(q)[0] + damping * self.elongations(qd)[0]
        return self.own_inertia() * qdd + jnp.stack([-self.ratio * pull, pull])

    def elongations(self, q: Array) -> Array:
        return (q[1] - self.ratio * q[0])[None]

    def spring_laws(self) -> tuple[Array, Array]:
        damping = jnp.zeros(()) if self.damping is None else self.damping
        return self.stiffness[None], damping[None]

    def equivalent_parameter(self, effect: type[Effect], port: int) -> tuple[str, int | None] | None:
        of_screw = effect.kind == "linear_stiffness" and port == self.joints
        return ("stiffness", None) if of_screw else super().equivalent_parameter(effect, port)


class RigidMicropositioningStage(Stage):
    """(J + R^2 M) th'' = u + R (effects on the table) + effects; x = R th.

    `MicropositioningStage` with a rigid screw, for logs that are sampled far below its 1 kHz. Effects act on
    the motor or the table, as there; such a log identifies only sums of their forces, and of J and R^2 M.

    Source:
        Bogdan and Abba, as there, with (3) replaced by x_t = R theta_m.
    """

    screw_inertia: Array | None = parameter(*_SCREW, optional=True, motion="rotary")

    def own_inertia(self) -> Array:
        return (_turning(self) + self.ratio**2 * self.table_mass)[None]

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
        # One coordinate does not separate motor and table: effects are named at the table, except those
        # of the drive and at rest.
        at_motor = effect.in_drive or effect.break_away_level is not None
        return super().accepts(effect, port, drives) and port == (0 if at_motor else 1)


def _turning(stage: MicropositioningStage | RigidMicropositioningStage) -> Array:
    """Return the inertia of all that turns [kg m^2]."""
    return stage.motor_inertia + (0.0 if stage.screw_inertia is None else stage.screw_inertia)


# Classes by the coupling that a case states.
Stage.couplings = {"elastic": MicropositioningStage, "rigid": RigidMicropositioningStage}
