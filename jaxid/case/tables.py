"""Tables of a case whose keys depend on a kind: [plant] and [controller]; and the list of all tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from jaxid.case.kinds import Kinds
from jaxid.names import LAW_DERIVATIVES, MOTIONS, ORIENTATIONS
from jaxid.schema import (
    Key,
    Keys,
    Reader,
    anything,
    by_drive,
    choice,
    either_text,
    flag,
    inline,
    keys_of,
    number,
    several,
    table_of,
    text,
    whole,
)
from jaxid.settings import Disturbance, LogTable, Recursive

# Tables at the top of a case, in the order of the checks; True for those in [[ ]], which may recur.
TOP = {
    "plant": False,
    "effects": True,
    "actuator": False,
    "log": False,
    "preprocess": False,
    "identification": False,
    "algebraic": False,
    "output_error": False,
    "within_prior": False,
    "recursive": False,
    "controller": False,
    "sensor": False,
    "inertial_sensors": True,
    "limits": False,
    "validation": True,
    "discover": False,
    "design": False,
    "reference": False,
    "input": False,
    "simulation": False,
    "study": False,
}
DISTURBANCE = either_text(table_of(Disturbance))
_DISTURBANCE = Key(
    DISTURBANCE, "added to the command: a square wave, or the name of a column", note="nothing"
)

PLANT: Keys = {
    "motion": Key(choice(MOTIONS), "linear or rotary: sets the units", note="linear, or as the kind has it"),
    "orientation": Key(
        choice(ORIENTATIONS), "vertical if weight acts along the axis", default=ORIENTATIONS[0]
    ),
    "gravity": Key(number("nonnegative"), "acceleration of gravity", unit="m/s^2", note="9.81"),
    "units": Key(
        inline(
            {
                "position": Key(text, "label of the unit of positions"),
                "force": Key(text, "label of the unit of forces"),
            }
        ),
        "labels, if the quantities are not mechanical",
    ),
}

# Keys that an adaptive controller shares with [recursive].
ON_LINE = ("half_life", "gate_velocity", "gate_acceleration", "rows", "start", "instrument")
# Keys of the control laws, by the field of the controller; a key belongs to the kinds that have the field.
_LAW: dict[str, tuple[Reader, str]] = {
    "kp": (by_drive(number()), "gain of the position error"),
    "kv": (by_drive(number()), "gain of the velocity loop"),
    "ki": (by_drive(number()), "gain of the integral of the position error"),
    "kd": (by_drive(number()), "gain of the velocity error"),
    "derivative": (choice(LAW_DERIVATIVES), "signal that kd acts on: the error, or the velocity alone"),
    "coulomb": (by_drive(number()), "Coulomb friction fed forward, in units of the command"),
    "viscous": (by_drive(number()), "viscous friction fed forward, units of the command per velocity"),
    "inertia": (by_drive(number()), "inertia fed forward, units of the command per acceleration"),
    "derivative_filter": (by_drive(number("nonnegative")), "time constant of the derivative's low-pass [s]"),
    "anti_windup": (flag, "hold the integral while the command is at its limit"),
    "poles": (several(number("negative"), shortest=2, longest=3), "poles of the closed loop [1/s]"),
    "epsilon": (
        by_drive(number("positive")),
        "velocity within which the sign of dry friction is linear [m/s or rad/s]",
    ),
    "dynamics": (flag, "whether forces without friction are fed forward"),
    "gains": (flag, "whether the command is divided by the gains of the drives"),
    "friction": (flag, "whether friction is fed forward"),
    "regularization": (number("positive"), "number of samples that the start counts as"),
    "tolerance": (
        by_drive(number("positive")),
        "relative error of the force below which the estimate is fed forward",
    ),
    "reach": (whole(1), "ticks between the positions that are differenced; absent: velocity_average"),
}


@dataclass(frozen=True, kw_only=True)
class ControllerTable:
    """[controller]: a control law with its settings.

    Args:
        kind: One of `jaxid.controllers.CONTROLLERS`.
        period: Sampling time [s]; None: that of the log.
        disturbance: Signal that is added to the command: a square wave, or the name of a column.
        law: Further settings, by the fields of the controller's class.
    """

    kind: str
    period: float | None = None
    disturbance: Disturbance | str | None = None
    law: Mapping[str, Any] = field(default_factory=dict)

    @property
    def limit(self) -> float | tuple[float, ...] | None:
        """Bound of the command; None: no bound."""
        return self.law.get("limit")


def controller_table(given: Mapping[str, Any]) -> ControllerTable:
    """Return [controller] from its checked keys."""
    apart = ("kind", "period", "disturbance")
    law = {name: value for name, value in given.items() if name not in apart}
    return ControllerTable(**{name: given[name] for name in apart if name in given}, law=law)


def controller_keys(kind: str, kinds: Kinds) -> Keys:
    """Return the keys of [controller]: those of every controller, and the fields of this kind's class."""
    keys = {
        "period": Key(number("positive"), "sampling time", unit="s", note="the log's"),
        "velocity_average": Key(whole(1), "samples whose mean is differenced for the velocity", default=1),
        "limit": Key(by_drive(number("positive")), "bound of the command", note="no bound"),
        "disturbance": _DISTURBANCE,
    }
    cls = kinds.laws[kind]
    unstated = {*keys, *cls.of_machine}
    law = {}
    for f in fields(cls):
        if f.name not in unstated:
            required = f.default is MISSING and f.default_factory is MISSING
            plain = flag if f.type in (bool, "bool") else by_drive(number())
            read, doc = _LAW.get(f.name, (plain, "setting of the law"))
            law[f.name] = Key(read, f"{doc}; it belongs to kind = '{kind}'", required)
    if "estimator" in cls.of_machine:
        law |= {name: entry for name, entry in keys_of(Recursive).items() if name in ON_LINE}
    return {"kind": Key(anything), **law, **keys}


def validation_keys() -> Keys:
    """Return the keys of [[validation]]: its special keys, and any of [log] that differs."""
    of_log = {name: Key(k.read, k.doc, False, k.unit) for name, k in keys_of(LogTable).items()}
    return {
        "name": Key(text, "name in results", True),
        "log": Key(text, "file of the log, relative to the case", note="the fitted log"),
        "disturbance": _DISTURBANCE,
        **of_log,
    }
