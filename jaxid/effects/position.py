"""Forces that depend on position alone, and constant ones."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter


@register("constant_force")
class ConstantForce(Effect):
    """F0: an offset of the drive, or Coulomb levels that differ by direction."""

    title = "a constant force"
    formula = "+level"
    met = "weight balances, cable chains, an offset of the drive, friction that differs by direction"
    part = "load"

    in_robot_file = True
    without_force = True

    level: Array = parameter("force", "free", "F0")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=self.level)


@register("linear_stiffness")
class LinearStiffness(Effect):
    """-k q."""

    title = "a spring"
    formula = "−coefficient · q"
    met = "flexures, hoses, cable chains, bellows"
    part = "gear"

    in_robot_file = True
    without_force = True

    of_spring = True

    coefficient: Array = parameter("force/position", "free", "k")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.y)


@register("quadratic_stiffness")
class QuadraticStiffness(Effect):
    """-k2 q^2."""

    title = "a spring that is stiffer on one side"
    formula = "−coefficient · q²"
    met = "hoses and preloaded flexures"
    part = "gear"

    of_spring = True

    coefficient: Array = parameter("force/position2", "free", "k2")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.y**2)


@register("cubic_stiffness")
class CubicStiffness(Effect):
    """-k3 q^3."""

    title = "a spring that stiffens"
    formula = "−coefficient · q³"
    met = "flexures, belts and rubber at large elongation"
    part = "gear"

    of_spring = True

    coefficient: Array = parameter("force/position3", "free", "k3")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.coefficient * x.y**3)


@register("unbalance")
class Unbalance(Effect):
    """-m r g cos(q + phase): the weight of a mass off the axis of a joint that turns.

    The phase is zero if the mass is level with the axis at q = 0, and -pi/2 if it hangs below it. Mass and
    distance enter as their product only.

    Source:
        The torque of a point mass on a lever, m g r cos of its angle above the horizontal.
    """

    title = "an unbalanced mass"
    formula = "−moment · g · cos(q + phase)"
    met = "joints that turn with their centre of mass off the axis"
    part = "load"

    without_force = True

    of_rotary = True
    in_links = True

    moment: Array = parameter("moment", "nonnegative", "m r, mass times distance from the axis")
    phase: Array = parameter("angle", "free", "of the mass above the horizontal at q = 0")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.moment * x.field * jnp.cos(x.y + self.phase))

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Of three phases one has the right sign and at least half of the strength.
        moment = scales.natural("moment")
        return [{"moment": moment, "phase": phase} for phase in (0.0, 2 / 3 * np.pi, 4 / 3 * np.pi)]


@register("cogging")
class Cogging(Effect):
    """-A cos(2 pi q / period + phase): a force periodic in position."""

    title = "a ripple over the position"
    formula = "−amplitude · cos(2π · q / period + phase)"
    met = "motors with iron cores (cogging), teeth of belts and gears, ball screws (once a turn or a ball)"
    part = "drive"

    amplitude: Array = parameter("force", "positive", "A")
    period: Array = parameter("position", "positive", "pitch of the ripple")
    phase: Array = parameter("angle", "free", "of the ripple at q = 0")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.amplitude * jnp.cos(2 * jnp.pi * x.y / self.period + self.phase))

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Below two turns over the stroke a ripple imitates any smooth force of position.
        return _ripples(scales, 2.0, 60.0)

    @classmethod
    def finer_starts(cls, scales: Scales) -> list[dict[str, float]]:
        return _ripples(scales, 60.0, 400.0)

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"period": (0.0, 1.2 * scales.position)}


def _ripples(scales: Scales, least: float, most: float) -> list[dict[str, float]]:
    """Return starts of a ripple with least to most turns over the stroke."""
    # Neighbouring periods differ by half a turn over the stroke, or a true ripple would fall between them.
    # Of three phases one has the right sign and at least half of the amplitude.
    return [
        {"amplitude": scales.force, "period": 2 * scales.position / turns, "phase": phase}
        for turns in np.arange(least, most, 0.5)
        for phase in (0.0, 2 / 3 * np.pi, 4 / 3 * np.pi)
    ]
