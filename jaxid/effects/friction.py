"""Friction as a function of velocity: dry (set-valued at rest) and viscous laws."""

from __future__ import annotations

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter
from jaxid.numerics import smooth


@register("viscous_friction")
class ViscousFriction(Effect):
    """-c v."""

    title = "viscous friction"
    formula = "−coefficient · v"
    met = "lubricated guides, bearings and seals, and eddy currents"
    part = "load"

    in_robot_file = True
    without_force = True

    any_direction = True
    viscous_coefficient = "coefficient"

    coefficient: Array = parameter("force*time/position", "nonnegative", "c, drag per velocity")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.yd)


@register("back_emf_damping")
class BackEmfDamping(Effect):
    """-c v: what the back-EMF takes off the force of a drive whose voltage is the command.

    `[actuator]` with torque_constant and resistance adds it, known. Viscous friction looks the same, and
    one of the two must be known.

    Source:
        The equations of a permanent-magnet DC motor without inductance: c = k_t k_e / R.
    """

    title = "damping by the back-EMF"
    formula = "−coefficient · v"
    met = "motors that are driven by a voltage"
    part = "drive"

    on_request = True

    coefficient: Array = parameter("force*time/position", "nonnegative", "c, drag per velocity")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.yd)


@register("coulomb_friction")
class CoulombFriction(Effect):
    """-F sign v, set-valued at rest; F is `level`, or `friction_coefficient` times normal force."""

    title = "dry friction"
    formula = "−level · sign v"
    met = "guides, bearings and seals under preload, brushes and brakes"
    part = "load"

    in_robot_file = True
    without_force = True

    sliding_level = "level"
    alternatives = ("level", "friction_coefficient")

    level: Array | None = parameter("force", "nonnegative", "F, sliding friction", optional=True)
    friction_coefficient: Array | None = parameter(
        "1", "nonnegative", "mu, in place of the level: F = mu m g", optional=True
    )

    def act(self, x: Signals, state: None) -> Action:
        if self.level is not None:
            return Action(dry=self.level)
        assert self.friction_coefficient is not None, "one of the alternatives is given"
        return Action(dry=self.friction_coefficient * x.normal)

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"level": scales.force}]


@register("static_friction")
class StaticFriction(Effect):
    """Break-away force above the sliding friction, at rest only."""

    title = "break-away friction"
    formula = "up to level more than dry friction, at rest only"
    met = "guides, bearings and seals after a rest"
    part = "load"

    break_away_level = "level"

    level: Array = parameter("force", "nonnegative", "break-away force above Coulomb's")

    def act(self, x: Signals, state: None) -> Action:
        return Action(stick=self.level)


@register("stribeck_friction")
class StribeckFriction(Effect):
    """-F_s exp(-(v/v_s)^2) sign v: the part above Coulomb friction at low velocity."""

    title = "Stribeck friction"
    formula = "−level · exp(−(v / velocity)²) · sign v"
    met = "oil- and grease-lubricated guides, bearings and seals at low speed, where the film is thin"
    part = "load"

    without_force = True

    stribeck_velocity = "velocity"

    level: Array = parameter("force", "nonnegative", "F_s, excess at low velocity")
    velocity: Array = parameter("position/time", "positive", "v_s, where the excess fades")

    def act(self, x: Signals, state: None) -> Action:
        return Action(dry=self.level * jnp.exp(-((x.yd / self.velocity) ** 2)))

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        widths = (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)
        return [{"level": scales.force, "velocity": scales.velocity * w} for w in widths]


@register("load_friction")
class LoadFriction(Effect):
    """-mu |tau| sign v, set-valued at rest; tau is the drive's torque at the joint, before friction.

    Friction of a gear, whose teeth press with the torque that it transmits. mu is `coefficient` while the
    motor drives the load, and `back` while the load drives the motor, tau v < 0; without `back` the two are
    the same. At rest the level adds to that which must be overcome.

    Source:
        Duclusaud et al. (2025), "Extended friction models for the physics simulation of servo actuators",
        models 3 and 5: friction in proportion to the load, the same or by direction of the power.
    """

    title = "friction that grows with the load"
    formula = "−coefficient · |u| · sign v"
    met = "worm and high-ratio gears, such as those of small servos"
    part = "gear"

    needs_drive = True
    on_request = True
    without_force = True

    coefficient: Array = parameter("1", "nonnegative", "mu while the motor drives")
    back: Array | None = parameter("1", "nonnegative", "mu while the load drives", optional=True)

    adds_force = False

    def act(self, x: Signals, state: None) -> Action:
        part = self.coefficient
        if self.back is not None:
            part = jnp.where(x.u * x.yd < 0, self.back, part)
        return Action(dry=part * jnp.abs(x.u))

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"coefficient": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"coefficient": 0.0}, {"coefficient": 0.1}]


@register("asymmetric_viscous")
class AsymmetricViscous(Effect):
    """-c |v|: viscous friction that differs by direction."""

    title = "viscous friction that differs by direction"
    formula = "−coefficient · |v|"
    met = "lip seals, valves and wipers, which act unlike in both directions"
    part = "load"

    coefficient: Array = parameter("force*time/position", "free", "c, half the difference")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * smooth.absolute(x.yd, x.width))


@register("quadratic_drag")
class QuadraticDrag(Effect):
    """-c v |v|."""

    title = "quadratic drag"
    formula = "−coefficient · v · |v|"
    met = "motion through air, water or oil, and fans"
    part = "load"

    without_force = True

    coefficient: Array = parameter("force*time2/position2", "free", "c")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.yd * smooth.absolute(x.yd, x.width))


@register("cubic_friction")
class CubicFriction(Effect):
    """-c v^3."""

    title = "friction that grows with the cube of the velocity"
    formula = "−coefficient · v³"
    met = "joints of robots at high speed, and lubricants whose film grows"
    part = "load"

    coefficient: Array = parameter("force*time3/position3", "free", "c")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.yd**3)


@register("quartic_friction")
class QuarticFriction(Effect):
    """-c v^3 |v|."""

    title = "friction that grows with the fourth power of the velocity"
    formula = "−coefficient · v³ · |v|"
    met = "joints of robots over a wide range of speed"
    part = "load"

    coefficient: Array = parameter("force*time4/position4", "free", "c")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.yd**3 * smooth.absolute(x.yd, x.width))


@register("friction_drift")
class FrictionDrift(Effect):
    """Every dry-friction level times (1 + rate t), t from the start of the log."""

    title = "friction that changes with time"
    formula = "dry friction · (1 + rate · t)"
    met = "warming bearings and gears"
    part = "load"

    adds_force = False

    rate: Array = parameter("1/time", "free", "relative change of the levels")

    def act(self, x: Signals, state: None) -> Action:
        return Action()

    def dry_drift(self, t: Array) -> Array:
        return self.rate * t

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"rate": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"rate": 0.0}]
