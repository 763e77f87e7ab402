"""Effects that add to the inertia."""

from __future__ import annotations

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Signals
from jaxid.model.parameter import parameter


@register("added_mass")
class AddedMass(Effect):
    """-m (a + g): extra inertia, and its weight if gravity acts along the joint."""

    title = "an added mass"
    formula = "−mass · (a + g)"
    met = "tools, payloads, rotors behind a gear, forgotten parts"
    part = "load"

    in_robot_file = True

    any_direction = True

    mass: Array = parameter("inertia", "free", "m")

    def act(self, x: Signals, state: None) -> Action:
        return Action(force=-self.mass * (x.ydd + x.gravity))
