"""Effects between the logged command and the law of a controller: they set a field of the controller.

`command_delay` is `[controller] delay`, and `dead_band` is `[controller] dead_band`. The law of each is in
`jaxid.controllers.base`; `jaxid.controllers.with_effects` puts the values of these effects there.
"""

from __future__ import annotations

import numpy as np

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter

# Longest delay and lag from which a search starts [s].
_LONGEST = 0.2
# Axes and times of the curves of delay and lag.
_AFTER_A_STEP = ("time [s] after a step of the command", "reference of the controller")
_TIME = np.linspace(-0.2, 1.0, 241)


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

    title = "a command that reaches the controller late"
    formula = "reference of the controller at time t = reference(t − delay)"
    met = "field buses and networks between a planner and a servo"
    part = "controller"

    controller_field = "delay"
    of_reference = True

    delay: Array = parameter("time", "nonnegative", "delay of the reference")

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray]:
        return *_AFTER_A_STEP, _TIME, (_TIME >= float(self.delay)).astype(float)

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

    title = "a command that is smoothed"
    formula = "time_constant · dr/dt = reference − r, r being the command of the controller"
    met = "servos that filter their command"
    part = "controller"

    controller_field = "lag"
    of_reference = True

    time_constant: Array = parameter("time", "nonnegative", "T")

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray]:
        late = np.maximum(_TIME, 0.0) / max(float(self.time_constant), 1e-9)
        return *_AFTER_A_STEP, _TIME, 1.0 - np.exp(-late)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"time_constant": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"time_constant": s} for s in _times(scales)]


@register("velocity_limit")
class VelocityLimit(_OnCommand):
    """Limit of the command's velocity in front of the controller, which follows faster commands later.

    At each tick r'[k] = r'[k-1] + clip(r[k] - r'[k-1], -limit h, limit h) with h the controller's period.
    """

    title = "a command that is followed with a limited velocity"
    formula = "|dr/dt| ≤ limit, r being the command of the controller"
    met = "servos and drives with a largest speed of their set point, such as Dynamixel's profile velocity"
    part = "controller"

    controller_field = "speed"
    of_reference = True
    # A command of any machine is far slower.
    elsewhere = 1e9

    limit: Array = parameter("position/time", "positive", "largest velocity of the command")

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray]:
        time = np.linspace(-0.4, 1.6, 201) / float(self.limit)
        return *_AFTER_A_STEP, time, np.clip(float(self.limit) * time, 0.0, 1.0)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"limit": cls.elsewhere}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"limit": scales.peak_velocity * s} for s in (0.6, 0.8, 0.95, 1.1)]


@register("acceleration_limit")
class AccelerationLimit(_OnCommand):
    """Profile generator in front of the controller, which follows the command with a limited acceleration.

    Each command is the target of a point-to-point motion from the profile's present position and velocity:
    it speeds up by at most `limit`, and slows down so as to stop at the target. The profile has its steps
    at the ticks of the controller; see `jaxid.numerics.delays.accelerated`.
    """

    title = "a command that is followed with a limited acceleration"
    formula = "|d²r/dt²| ≤ limit, r being the command of the controller, which stops at the reference"
    met = "servos with a profile of motion of their own, such as Feetech's and Dynamixel's"
    part = "controller"

    controller_field = "acceleration"
    of_reference = True
    # A command of any machine is far slower.
    elsewhere = 1e9

    limit: Array = parameter("position/time2", "positive", "largest acceleration of the profile")

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray]:
        # A step of one, which takes 2 / sqrt(limit): half of the time to speed up, half to slow down.
        half = float(self.limit) ** -0.5
        time = np.linspace(-0.4, 2.4, 241) * half
        since = np.clip(time / half, 0.0, 2.0)
        reached = np.where(since < 1.0, 0.5 * since**2, 1.0 - 0.5 * (2.0 - since) ** 2)
        return *_AFTER_A_STEP, time, reached

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"limit": cls.elsewhere}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"limit": scales.acceleration * s} for s in (1.0, 2.0, 4.0, 8.0)]


@register("dead_band")
class DeadBand(_OnCommand):
    """The controller takes a position error below `width` for none, and a larger one as it is.

    Integrals add no error below it either; a gain on the velocity acts as ever.
    """

    title = "a dead band of the controller"
    formula = "error of the controller = 0 while |error| < width"
    met = "hobby servos and drives that avoid hunting at rest"
    part = "controller"

    controller_field = "dead_band"

    width: Array = parameter("position", "nonnegative", "one-sided; a larger error is not reduced")

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray]:
        error = np.linspace(-2.0, 2.0, 401) * float(self.width)
        taken = np.where(np.abs(error) < float(self.width), 0.0, error)
        return "position error", "error of the controller", error, taken

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
