"""A force: a magnet at the end stop of an axis pulls the slide towards q = 0."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from jaxid.model import Action, Effect, Scales, Signals, parameter


class MagneticPull(Effect):
    """-A exp(-q / d): the pull falls to a third within the reach d."""

    strength: Array = parameter("force", "nonnegative", "A, pull at q = 0")
    reach: Array = parameter("position", "positive", "d, stroke over which the pull falls to 1/e")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.strength * jnp.exp(-x.y / self.reach))

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # The reach enters nonlinearly: one start for each size of it, relative to half the stroke.
        reaches = (0.03, 0.1, 0.3, 1.0)
        return [{"strength": scales.force, "reach": part * scales.position} for part in reaches]
