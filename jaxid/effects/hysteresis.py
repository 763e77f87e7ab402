"""Friction with memory."""

from __future__ import annotations

import jax.numpy as jnp

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter
from jaxid.numerics import smooth


@register("hysteresis")
class Hysteresis(Effect):
    """Presliding friction: a spring of `stiffness` at reversal that slips at `level`.

    Dahl's model: force -f, df/dt = k v - (k / F) |v| f. The state is the force over the level, which is of
    order one on any machine.

    Source:
        Dahl (1968), "A solid friction model", with exponent one.
    """

    title = "presliding friction"
    formula = "a spring of stiffness at each reversal, which slips at level"
    met = "rolling guides and preloaded bearings within some micrometres of a reversal"
    part = "load"

    stiffness: Array = parameter("force/position", "positive", "k, at reversal")
    level: Array = parameter("force", "positive", "F, where it slips")

    def act(self, x: Signals, state: Array) -> Action:
        level = self.level * x.dry_scale
        rate = (x.yd - smooth.absolute(x.yd, x.width) * state) * self.stiffness / level
        return Action(force=-level * state, rate=rate)

    def initial_state(self, u: Array) -> Array:
        return jnp.zeros_like(u)

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # The presliding distance level / stiffness runs from a thousandth of the stroke to half.
        slips = (0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
        return [{"stiffness": scales.force / (scales.position * s), "level": scales.force} for s in slips]


@register("velocity_hysteresis")
class VelocityHysteresis(Effect):
    """-C exp(-(v/v_s)^2) sign v while speed grows, nothing while it falls: Stribeck's friction with memory.

    C is `level` forwards and `level_negative` backwards; without the latter it is the same in both
    directions. The law as printed has no solution if a force exceeds friction without this term but not
    with it: the velocity is then constant, and the term balances the rest of the force. At rest it adds to
    the level that holds.

    Source:
        Bogdan and Abba, "Identification of mechanical parameters at low velocities for a micropositioning
        stage using a velocity hysteresis model", (7), (9), (10). (10) lacks a minus sign: as printed the
        term drives the table when it moves backwards.
    """

    title = "Stribeck friction with memory"
    formula = "−level · exp(−(v / velocity)²) · sign v while the speed grows"
    met = "lubricated contacts whose film lags behind the speed"
    part = "load"

    of_stages = True

    level: Array = parameter("force", "nonnegative", "C, above sliding friction at low velocity")
    velocity: Array = parameter("position/time", "positive", "v_s, where it fades")
    level_negative: Array | None = parameter(
        "force", "nonnegative", "C for negative velocity, where it differs", optional=True
    )

    def act(self, x: Signals, state: None) -> Action:
        fading = jnp.exp(-((x.yd / self.velocity) ** 2))
        back = self.level if self.level_negative is None else self.level_negative
        return Action(rising=(self.level * fading, back * fading))

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # A level for each direction: one level for both would hide that they differ.
        levels = {"level": scales.force, "level_negative": scales.force}
        return [levels | {"velocity": scales.velocity * w} for w in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7)]
