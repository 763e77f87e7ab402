"""Friction with memory."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array

from jaxid import smooth
from jaxid.effects.registry import register
from jaxid.model import Action, Effect, Scales, Signals, parameter


@register("hysteresis")
class Hysteresis(Effect):
    """Presliding friction: a spring of `stiffness` at reversal that slips at `level`.

    Dahl's model: force -f, df/dt = k v - (k / F) |v| f. The state is the force over the level, so
    that it stays of order one whatever the machine.

    Source:
        Dahl (1968), "A solid friction model", with exponent one.
    """

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
        return [
            {"stiffness": scales.force / (scales.position * s), "level": scales.force}
            for s in slips
        ]
