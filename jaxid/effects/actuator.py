"""Effects in the drive: between the declared force and the force at the load."""

from __future__ import annotations

import numpy as np

from jaxid.arrays import Array
from jaxid.effects.registry import register
from jaxid.model.effect import Action, Effect, Scales, Signals
from jaxid.model.parameter import parameter
from jaxid.numerics import smooth

# Corner of the saturation, relative to its limit: 0.7e-3 of the limit is missing at the corner.
_CORNER = 1e-3


@register("actuator_gain")
class ActuatorGain(Effect):
    """The force is gain times the declared one.

    In a drive with a current loop the declared force is the measured torque, or the wanted torque if the
    regulator is fast. With k_T the motor's torque constant, k_T^ the value that the drive assumes for it, k_S
    the factor of its current sensor and H the static gain of its regulator,

        actual / wanted   = k_T H / (k_T^ (1 + k_S H))
        measured / wanted = k_S H / (1 + k_S H)
        actual / measured = k_T / (k_T^ k_S) = gain, whatever H is.

    Source:
        Righettini et al. (2025), Robotics 14(4), 36, (6), (19)-(23). As printed the denominator of (19)
        has k_T^ k_T in place of k_T^; (23) holds at any H, not in the limit only.
    """

    title = "a drive whose force differs from the declared one by a factor"
    formula = "force of the drive = gain · u"
    met = "a torque constant from a data sheet, warm magnets, losses of a gear"
    part = "drive"

    adds_force = False
    in_drive = True

    drive_gain = "gain"

    gain: Array = parameter("1", "positive", "applied over declared force")

    def act(self, x: Signals, state: None) -> Action:
        return Action(drive=self.gain * x.u)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"gain": 1.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"gain": 1.0}]


@register("actuator_offset")
class ActuatorOffset(Effect):
    """The force is the declared one plus a constant, before later effects of the drive.

    A saturation behind it, or a limit by the supply's voltage, cuts off more on one side. If neither acts,
    it is `constant_force` by another name. An unknown offset before an unknown saturation needs bounds: far
    beyond the limit the drive is a constant.

    Source:
        "PA-10 traineeship", section 5.2: an amplifier adds an offset to the command that it receives.
    """

    title = "an offset of the drive"
    formula = "force of the drive = u + level"
    shown_at = {"level": 0.3}
    met = "amplifiers with an uncalibrated zero, and current sensors that drift"
    part = "drive"

    adds_force = False
    in_drive = True
    on_request = True

    level: Array = parameter("force", "free", "added to the declared force")

    def act(self, x: Signals, state: None) -> Action:
        return Action(drive=x.u + self.level)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"level": 0.0}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        return [{"level": 0.0}]


@register("actuator_lag")
class ActuatorLag(Effect):
    """First-order lag between declared and applied force: T df/dt = u - f."""

    title = "a drive that follows its command with a lag"
    formula = "time_constant · df/dt = u − f, f being the force of the drive"
    met = "slow current loops, pneumatic and hydraulic valves, filtered commands"
    part = "drive"

    without_force = True

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

    title = "a command that acts late"
    formula = "force of the drive at time t = u(t − delay)"
    met = "field buses, computing time of a controller, and clocks of loggers that differ"
    part = "drive"

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

    title = "a drive at its limit"
    formula = "force of the drive = u, held between −limit and +limit"
    met = "current limits and peak torque of motors"
    part = "drive"

    without_force = True
    duplicates_field = "limit"

    adds_force = False
    in_drive = True

    limit: Array = parameter("force", "positive", "largest force")

    def act(self, x: Signals, state: None) -> Action:
        return Action(drive=smooth.clip(x.u, self.limit, _CORNER * self.limit))

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"limit": 10 * scales.largest_force}

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        return {"limit": (0.0, 20 * scales.largest_force)}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # A command may reach far beyond what the drive gives.
        limits = [scales.peak_force * s for s in (0.97, 0.9, 0.8, 0.65, 0.5, 0.35, 0.2, 0.1)]
        if scales.largest_force > scales.peak_force:
            # A change of the command between two rows of the log is answered by a short, large force.
            limits += [*np.geomspace(1.2 * scales.peak_force, 0.97 * scales.largest_force, 5)]
        return [{"limit": float(limit)} for limit in limits]

    @classmethod
    def finer_starts(cls, scales: Scales) -> list[dict[str, float]]:
        # A drive that is at its limit for much of the log: only starts near the limit are better than none.
        # A fast loop whose drive is too weak may ask for much more than the limit.
        return [{"limit": float(limit)} for limit in scales.peak_force * np.geomspace(0.001, 0.9, 40)]


@register("voltage_limit")
class VoltageLimit(Effect):
    """The supply's voltage limits the force, more so at higher speed.

    A current that needs more voltage than the supply has, |R i + k v| > U, is limited to that voltage: with
    the stall force k U / R and the no-load velocity U / k, and u the force of the wanted current,

        force = clip(u + stall v / velocity, -stall, stall) - stall v / velocity.

    The limit falls in a line from `stall` at rest to zero at `velocity`, beyond which the supply brakes;
    against the motion it is larger by the same amount. k is the motor's constant times its reduction, in N
    or N m per A, equally in V per m/s or rad/s; the inductance is neglected.

    Source:
        "PA-10 traineeship", (5.4)-(5.5), without the inductance, as there.
    """

    title = "a supply whose voltage runs out"
    formula = "|force of the drive| ≤ stall · (1 − v / velocity)"
    shown_at = {"stall": 1.0, "velocity": 1.0}
    met = "small servos and battery drives at high speed"
    part = "drive"

    without_force_on_request = True

    adds_force = False
    in_drive = True
    on_request = True

    stall: Array = parameter("force", "positive", "largest force at rest, k U / R")
    velocity: Array = parameter("position/time", "positive", "without load, U / k")

    def act(self, x: Signals, state: None) -> Action:
        lost = self.stall * x.yd / self.velocity
        return Action(drive=smooth.clip(x.u + lost, self.stall, _CORNER * self.stall) - lost)

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        return {"stall": 10 * scales.largest_force, "velocity": 4 * scales.peak_velocity}

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        # A limit that hardly falls over the log's speeds is a saturation.
        return {"stall": (0.0, 20 * scales.largest_force), "velocity": (0.0, 5 * scales.peak_velocity)}

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        # Lines that cut off corners of the log's plane of velocity and force. A loop commands more than a
        # supply has: they begin below the largest force.
        steep = [(0.6, 1.1), (1.0, 1.05), (3.0, 1.02)]
        flat = [(0.3, 1.5), (0.3, 3.0), (0.6, 2.0), (1.2, 1.5), (3.0, 1.3)]
        force, velocity = scales.peak_force, scales.peak_velocity
        return [{"stall": f * force, "velocity": v * velocity} for f, v in (*steep, *flat)]
