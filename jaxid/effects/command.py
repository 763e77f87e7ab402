"""Effects between the logged command and the law of a controller: they set a field of the controller.

`command_delay` is `[controller] delay`, and `dead_band` is `[controller] dead_band`. The law of each is in
`jaxid.controllers.base`; `jaxid.controllers.with_effects` puts the values of these effects there.
"""

from __future__ import annotations

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter

# Longest delay and lag from which a search starts [s].
_LONGEST = 0.2


class _OnCommand(Effect):
    """Base of effects that act on the reference or on the error of a controller, and add no force."""

    adds_force = False
    in_drive = True
    on_request = True
    without_force = True

    def act(self, x: Signals, state: None) -> Action:
        return Action()


@register("command_delay")
class CommandDelay(_OnCommand):
    """The reference reaches the controller later; between two ticks it is interpolated."""

    controller_field = "delay"
    of_reference = True

    delay: Array = parameter("time", "nonnegative", "delay of the reference")

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"delay": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"delay": s} for s in _times(scales)]


@register("command_lag")
class CommandLag(_OnCommand):
    """First-order lag of the reference in front of the controller: T dr'/dt = r - r'.

    At each tick r'[k] = r'[k-1] + h / (T + h) (r[k] - r'[k-1]) with h the controller's period (backward
    Euler): the mean delay is T exactly, and without T the reference passes.
    """

    controller_field = "lag"
    of_reference = True

    time_constant: Array = parameter("time", "nonnegative", "T")

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"time_constant": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"time_constant": s} for s in _times(scales)]


@register("dead_band")
class DeadBand(_OnCommand):
    """The controller takes a position error below `width` for none, and a larger one as it is.

    Integrals add no error below it either; a gain on the velocity acts as ever.
    """

    controller_field = "dead_band"

    width: Array = parameter("position", "nonnegative", "one-sided; a larger error is not reduced")

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"width": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"width": scales.position * s} for s in (2e-3, 6e-3, 0.02, 0.06)]


def _times(scales: Scales) -> list[float]:
    """Return delays from which a search starts: none, and some samples, up to the longest plausible one."""
    samples = [scales.period * s for s in (1.0, 4.0, 16.0, 64.0)]
    return [0.0, *[s for s in samples if s <= _LONGEST]]
