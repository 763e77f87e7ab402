"""An effect in the drive: the motor delivers more or less torque, by where its rotor stands."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxid.model import Action, Effect, Scales, Signals, parameter


class DriveRipple(Effect):
    """u (1 + a cos(2 pi q / period + phase)): the force of the drive varies by the depth a."""

    adds_force = False
    in_drive = True

    depth: Array = parameter("1", "positive", "a, amplitude relative to the force")
    period: Array = parameter("position", "positive", "pitch of the ripple")
    phase: Array = parameter("angle", "free", "at q = 0")

    def act(self, x: Signals, state: None) -> Action:
        turn = 2 * jnp.pi * x.y / self.period + self.phase
        return Action(drive=x.u * (1.0 + self.depth * jnp.cos(turn)))

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"depth": 0.0, "period": 0.2 * scales.position, "phase": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Neighbouring periods differ by half a turn over the stroke, or a true ripple would fall between
        # them. Of three phases one has the right sign and at least half of the amplitude.
        return [
            {"depth": 0.1, "period": 2 * scales.position / turns, "phase": phase}
            for turns in np.arange(3.0, 20.0, 0.5)
            for phase in (0.0, 2 / 3 * np.pi, 4 / 3 * np.pi)
        ]

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"period": (0.0, 0.7 * scales.position), "depth": (0.0, 1.0)}
