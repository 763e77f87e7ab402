"""An effect with an internal state: LuGre friction, bristles between two surfaces."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array

from jaxid.model import Action, Effect, Scales, Signals, parameter
from jaxid.numerics import smooth


class LuGreFriction(Effect):
    """-(s0 z + s1 z'), with z' = v - s0 |v| z / g(v) and g(v) = Fc + (Fs - Fc) exp(-(v / vs)^2).

    z is the mean deflection of the bristles. The state here is s0 z / Fc, of order one on any machine.

    Source:
        Canudas de Wit, Olsson, Astrom and Lischinsky (1995), "A new model for control of systems with
        friction", IEEE TAC 40(3), without the viscous term, which is `viscous_friction`.
    """

    sliding_level = "coulomb"
    stribeck_velocity = "velocity"

    stiffness: Array = parameter("force/position", "positive", "s0, of the bristles at reversal")
    damping: Array = parameter("force*time/position", "nonnegative", "s1, of the bristles")
    coulomb: Array = parameter("force", "positive", "Fc, level while sliding")
    static: Array = parameter("force", "positive", "Fs, level at low velocity")
    velocity: Array = parameter("position/time", "positive", "vs, over which Fs falls to Fc")

    def act(self, x: Signals, state: Array) -> Action:
        # A drift of dry friction (`friction_drift`) scales both levels.
        coulomb, static = self.coulomb * x.dry_scale, self.static * x.dry_scale
        level = coulomb + (static - coulomb) * jnp.exp(-((x.yd / self.velocity) ** 2))
        speed = smooth.absolute(x.yd, x.width)
        rate = self.stiffness * (x.yd / coulomb - speed * state / level)
        deflection_rate = rate * coulomb / self.stiffness
        return Action(force=-(coulomb * state + self.damping * deflection_rate), rate=rate)

    def initial_state(self, u: Array) -> Array:
        # Relaxed bristles, whatever the drive's force is.
        return jnp.zeros_like(u)

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # The sliding distance Fc / s0 runs from a thousandth of the stroke to a tenth.
        force = scales.force
        return [
            {
                "stiffness": force / (slip * scales.position),
                "damping": 0.01 * force / scales.velocity,
                "coulomb": force,
                "static": 1.5 * force,
                "velocity": share * scales.velocity,
            }
            for slip in (0.001, 0.01, 0.1)
            for share in (0.05, 0.2)
        ]

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        # Every force of the effect is in proportion to these four; the velocity is a shape.
        first = cls.starts(scales)[0]
        return {name: value * (1.0 if name == "velocity" else 1e-9) for name, value in first.items()}
