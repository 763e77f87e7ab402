"""What happens between the declared force and the force at the load."""

from __future__ import annotations

from jaxtyping import Array

from jaxid import smooth
from jaxid.effects.registry import register
from jaxid.model import Action, Effect, Scales, Signals, parameter

# Corner of the saturation, relative to its limit: 0.7e-3 of the limit is missing at the corner.
_CORNER = 1e-3


@register("actuator_gain")
class ActuatorGain(Effect):
    """The force is gain times the declared one.

    Of a drive with a current loop the declared force is the measured torque, or, where the regulator is fast,
    the wanted one. With k_T the motor's torque constant and k_T^ what the drive takes it for, k_S the factor
    of its current sensor and H the static gain of its regulator,

        actual / wanted   = k_T H / (k_T^ (1 + k_S H))
        measured / wanted = k_S H / (1 + k_S H)
        actual / measured = k_T / (k_T^ k_S) = gain, whatever H is.

    Source:
        Righettini et al. (2025), Robotics 14(4), 36, (6), (19)-(23). As printed the denominator of (19)
        has k_T^ k_T where k_T^ belongs; (23) holds at any H, not in the limit only.
    """

    adds_force = False
    in_drive = True

    gain: Array = parameter("1", "positive", "applied over declared force")

    def act(self, x: Signals, state: None) -> Action:
        return Action(drive=self.gain * x.u)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"gain": 1.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"gain": 1.0}]


@register("actuator_lag")
class ActuatorLag(Effect):
    """First-order lag between declared and applied force: T df/dt = u - f."""

    adds_force = False
    in_drive = True

    time_constant: Array = parameter("time", "positive", "T")

    def act(self, x: Signals, state: Array) -> Action:
        return Action(drive=state, rate=(x.u - state) / self.time_constant)

    def initial_state(self, u: Array) -> Array:
        return u

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"time_constant": 1e-4 * scales.period}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"time_constant": scales.period * s} for s in (0.5, 1.0, 2.0, 4.0, 10.0, 25.0)]


@register("input_delay")
class InputDelay(Effect):
    """The declared force acts later."""

    adds_force = False
    in_drive = True

    delay: Array = parameter("time", "nonnegative", "delay")

    def act(self, x: Signals, state: None) -> Action:
        return Action()

    def command_delay(self) -> Array:
        return self.delay

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"delay": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"delay": scales.period * s} for s in (0.0, 1.0, 2.0, 4.0, 8.0)]


@register("saturation")
class Saturation(Effect):
    """The force at the load is clipped to plus or minus limit."""

    adds_force = False
    in_drive = True

    limit: Array = parameter("force", "positive", "largest force")

    def act(self, x: Signals, state: None) -> Action:
        return Action(drive=smooth.clip(x.u, self.limit, _CORNER * self.limit))

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"limit": 10 * scales.peak_force}

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"limit": (0.0, 20 * scales.peak_force)}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"limit": scales.peak_force * s} for s in (0.97, 0.9, 0.8, 0.65, 0.5, 0.35)]
