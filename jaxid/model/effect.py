"""Physical effects: their signals, their actions, and initial values for a search."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import numpy as np

from jaxid.arrays import Array
from jaxid.model.parameter import ParameterInfo, need_one, parameters_of

# Acceleration of gravity [m/s^2] of a case that does not state one.
STANDARD_GRAVITY = 9.81


class Signals(eqx.Module):
    """The signals that an effect may use, in the coordinate of its port.

    Args:
        y: Coordinate of the port [m or rad].
        yd: Velocity of the port [m/s or rad/s].
        ydd: Acceleration of the port [m/s^2 or rad/s^2].
        u: Force of the drive after the effects declared before this one [N or N m]; zero for a
            port without a drive.
        t: Time from the start of the log [s].
        width: Velocity over which the sign is smoothed.
        dry_scale: Factor on every level of dry friction (drift).
        gravity: Acceleration of gravity along the port; zero on a horizontal axis [m/s^2].
        normal: Force that presses the sliding surfaces together [N].
        stiffness: Stiffness of the plant's spring whose elongation is the port [N/m or N m/rad]; else zero.
        damping: Damping of this spring [N s/m or N m s/rad]; else zero.
        field: Magnitude of the acceleration of gravity, whatever the direction of the port [m/s^2].
        elongating: Second derivative of the elongation of an added spring, which a plant with links behind it
            knows [m/s^2 or rad/s^2]; None: the effect computes it.
    """

    y: Array
    yd: Array
    ydd: Array
    u: Array
    t: Array
    width: Array
    dry_scale: Array
    gravity: Array
    normal: Array
    stiffness: Array
    damping: Array
    field: Array | float = STANDARD_GRAVITY
    elongating: Array | None = None


class Action(eqx.Module):
    """All that an effect may do; every entry may be left out.

    Args:
        force: Force on the port [N or N m]; may depend on the acceleration (added mass).
        dry: Level of set-valued friction; its force is -dry times a direction in [-1, 1].
        stick: Level above `dry` that must be overcome to leave rest.
        rising: Level above `dry` while speed grows, forwards and backwards.
        drive: Force of the drive after this effect, in place of `Signals.u` [N or N m].
        rate: Time derivative of the effect's internal state; affine in that state.
    """

    force: Array | float = 0.0
    dry: Array | float = 0.0
    stick: Array | float = 0.0
    rising: tuple[Array, Array] | None = None
    drive: Array | None = None
    rate: Array | None = None


@dataclass(frozen=True)
class Scales:
    """The sizes of the quantities of a log. They set the start of a search, never its result.

    Args:
        position: Half the stroke. velocity, acceleration, force: root mean squares while moving.
        peak_velocity, peak_force: Largest absolute values.
        period: Sampling time [s].
        duration: Length of the log [s].
        between: Largest absolute force between the rows of a log that is slower than its loop; zero if it is
            not known.
        farthest: Largest distance from the origin of the position; zero: half the stroke.
    """

    position: float
    velocity: float
    acceleration: float
    force: float
    peak_velocity: float
    peak_force: float
    period: float
    duration: float
    between: float = 0.0
    farthest: float = 0.0

    @property
    def largest_force(self) -> float:
        """Largest absolute force, at the rows of the log or between them."""
        return max(self.peak_force, self.between)

    def natural(self, dimension: str) -> float:
        """Return the size at which a parameter of this dimension would explain all of the force."""
        base = {
            "angle": 1.0,
            "force": self.force,
            "position": self.position,
            "time": self.position / self.velocity,
            "moment": self.force / STANDARD_GRAVITY,
        }
        if "inertia" in dimension:
            base["inertia"] = self.force / self.acceleration
        over, _, under = dimension.partition("/")
        # A spring acts by its distance from the origin, which may exceed a short stroke a hundred times.
        if "position" in under and "time" not in over:
            base["position"] = max(self.position, self.farthest)
        value = 1.0
        for words, sign in ((over, 1), (under, -1)):
            for word in words.split("*") if words not in ("", "1") else ():
                match = re.fullmatch(r"([a-z]+)(\d?)", word)
                assert match is not None, f"{word!r} is no base quantity"
                value *= base[match[1]] ** (sign * int(match[2] or 1))
        return value


class Effect(eqx.Module):
    """A physical effect that can be added to a plant.

    A subclass declares its parameters with `parameter`, implements `act`, and is registered with
    `jaxid.effects.register`. Nothing else is needed for the command line, the regressor, the
    search and the tables to know it.
    """

    kind: ClassVar[str]
    # Words of reports and lists: name in a sentence; formula in the names of the parameters, with q the
    # position, v the velocity and u the force that the drive is asked for; machines in which the effect is
    # met; part of the drive chain on which it acts: "controller", "drive", "gear" or "load".
    title: ClassVar[str] = ""
    formula: ClassVar[str] = ""
    met: ClassVar[str] = ""
    part: ClassVar[str] = ""
    # Values of parameters in a curve, where the usual ones show little.
    shown_at: ClassVar[Mapping[str, float]] = {}
    port: int = eqx.field(static=True, default=0, kw_only=True)

    # Optional parameters that replace each other: exactly one of them is given.
    alternatives: ClassVar[tuple[str, ...]] = ()

    def __check_init__(self) -> None:
        given = {name for name in self.alternatives if getattr(self, name) is not None}
        need_one(getattr(self, "kind", type(self).__name__), self.alternatives, given)

    def act(self, x: Signals, state: Any) -> Action:
        """Compute the action at one instant; `state` is as `initial_state` gives it, or None."""
        raise NotImplementedError

    def initial_state(self, u: Array) -> Array | None:
        """Return the internal state after the drive has long been at `u`; None without memory.

        A number, or a vector whose rate has constant coefficients (a linear oscillator).
        """
        return None

    def curve(self) -> tuple[str, str, np.ndarray, np.ndarray] | None:
        """Return names and values of the curve of an effect that adds no force; None: it has none."""
        return None

    def command_delay(self) -> Array | float:
        """Return the delay that the effect adds to the command [s]."""
        return 0.0

    def dry_drift(self, t: Array) -> Array | float:
        """Return the relative change of every dry-friction level at time t."""
        return 0.0

    # Whether the effect is an additional force, in proportion to those of its parameters
    # that carry a force. False for an effect in the drive or on other effects.
    adds_force: ClassVar[bool] = True
    # Whether it changes the force that the drive of its joint delivers.
    in_drive: ClassVar[bool] = False
    # Whether it acts on joints with a drive only, although it leaves the force of the drive as it is.
    needs_drive: ClassVar[bool] = False
    # Field of the controller that its only parameter sets; None: it does not act on the controller.
    controller_field: ClassVar[str | None] = None
    # Value of that field at a drive without the effect.
    elsewhere: ClassVar[float] = 0.0
    # Whether that field is one of the reference, which every law follows.
    of_reference: ClassVar[bool] = False
    # Field of the controller of which it is the same further along the drive; None: there is none.
    duplicates_field: ClassVar[str | None] = None
    # Whether a search of a log without a force, in its simulated loop, tries it.
    without_force: ClassVar[bool] = False
    # Whether such a search tries it only if [discover] requests it, because it takes long or seldom acts.
    without_force_on_request: ClassVar[bool] = False
    # Whether a robot's file has room for it at a joint, as one strength.
    in_robot_file: ClassVar[bool] = False
    # Whether it is the law of a spring; on a plant with springs it acts on an elongation.
    of_spring: ClassVar[bool] = False
    # True if only a plant with springs can have it, False if only one without; None: any plant.
    with_springs: ClassVar[bool | None] = None
    # Whether it acts on joints that turn only.
    of_rotary: ClassVar[bool] = False
    # Whether it is the same along every direction: then it may act on a tool, which moves along several.
    any_direction: ClassVar[bool] = False
    # Whether a search tries it on stages only: on other machines it would absorb any difference by direction.
    of_stages: ClassVar[bool] = False
    # Whether a search tries it only if [discover] requests it; otherwise it would replace a simpler effect.
    on_request: ClassVar[bool] = False

    # Whether a plant with links has it by their masses: a search there tries it on request only.
    in_links: ClassVar[bool] = False

    # Properties that shared code needs from effects of every kind. The first five name a parameter, or are
    # None if the effect has no such parameter.
    # Level of dry friction while sliding (Coulomb's, LuGre's).
    sliding_level: ClassVar[str | None] = None
    # Level above sliding friction that must be overcome to leave rest, and that acts at rest only.
    break_away_level: ClassVar[str | None] = None
    # Velocity over which dry friction falls to its sliding level (Stribeck's).
    stribeck_velocity: ClassVar[str | None] = None
    # Coefficient of friction in proportion to the velocity.
    viscous_coefficient: ClassVar[str | None] = None
    # Factor from the declared force of the drive to the applied one.
    drive_gain: ClassVar[str | None] = None

    @property
    def shifts_time(self) -> bool:
        """True if the effect may shift the force of a drive in time."""
        changes = not self.adds_force and self.drive_gain is None
        return changes or self.delays_command()

    # Whether it puts a part of the inertia behind an additional spring, so that the machine resonates.
    adds_spring: ClassVar[bool] = False
    # Class of the same effect at a joint of a plant without springs; None: there is none.
    of_joint: ClassVar[type[Effect] | None] = None
    # Kind as which a case states it, where that is another one than results use; None: it is the same.
    case_kind: ClassVar[str | None] = None
    # Whether it lets a spring of the plant pass no force in a part of its range (a clearance).
    opens_spring: ClassVar[bool] = False

    @classmethod
    def delays_command(cls) -> bool:
        """Check that the class delays the command: simulated loops then remember past commands."""
        return cls.command_delay is not Effect.command_delay

    @classmethod
    def starts(cls, scales: Scales) -> list[dict[str, float]]:
        """Return the values from which a search starts, one dictionary per start.

        A linear parameter needs one start of natural size. A nonlinear one needs a grid that is
        fine enough for least squares to converge.
        """
        own = parameters_of(cls).items()
        return [{n: scales.natural(i.dimension) for n, i in own if not i.optional}]

    @classmethod
    def finer_starts(cls, scales: Scales) -> list[dict[str, float]]:
        """Return further values from which a search starts where nothing else explains the log.

        They are for so many starts that every search would pay for them (a ripple of hundreds of periods, a
        limit that holds for much of a log).
        A search in simulated loops does not use them.
        """
        return []

    @classmethod
    def limits(cls, scales: Scales) -> dict[str, tuple[float, float]]:
        """Return the bounds within which a search keeps a parameter, in addition to its sign.

        Beyond them the effect would only imitate another (a ripple longer than the stroke is any
        smooth force of position).
        """
        return {}

    @classmethod
    def neutral(cls, scales: Scales) -> dict[str, float]:
        """Return values at which the effect is almost zero and its derivatives still exist."""
        return scaled(cls, cls.starts(scales)[0], 1e-9)


class AddedSpring(Effect):
    """An effect that puts a part J of the inertia, or of a plant's links, behind a spring."""

    adds_spring = True

    if TYPE_CHECKING:  # a field here would be the first parameter of every subclass
        load_inertia: Array

    def spring(self, state: Any) -> tuple[Array, Array, Array]:
        """Return elongation, its rate, and the pull of the spring on the joint, from the internal state."""
        raise NotImplementedError

    def pulling(self, pull: Array) -> Any:
        """Return the internal state at rest with a pull on the joint."""
        raise NotImplementedError


def carries_force(info: ParameterInfo) -> bool:
    """Check that an added force is in proportion to a parameter."""
    return info.dimension.startswith(("force", "inertia", "moment"))


def scaled(cls: type[Effect], values: dict[str, float], factor: float) -> dict[str, float]:
    """Return the values of the same effect, factor times as strong."""
    infos = parameters_of(cls)
    return {n: v * factor if carries_force(infos[n]) else v for n, v in values.items()}
