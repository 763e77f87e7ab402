"""Tables of a case whose keys depend on a kind: [plant] and [controller]; and the list of all tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields
from typing import Any

from jaxid.case.kinds import Kinds
from jaxid.case.values import Value, read_value, value_keys
from jaxid.model.parameter import ParameterInfo
from jaxid.names import LAW_DERIVATIVES, MOTIONS, ORIENTATIONS
from jaxid.schema import (
    Key,
    Keys,
    Reader,
    Spot,
    anything,
    by_drive,
    choice,
    either,
    either_text,
    flag,
    inline,
    keys_of,
    number,
    numbers_by_name,
    schema_of,
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
    "fit": True,
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
# Keys that may be unknown: the dimension of their value, in units of the command, and its sign.
UNKNOWN_OF_CONTROLLER = {
    "kp": ("force/position", "positive"),
    "kv": ("force*time/position", "positive"),
    "ki": ("force/position", "nonnegative"),
    "kd": ("force*time/position", "nonnegative"),
    "derivative_filter": ("time", "nonnegative"),
    "limit": ("force", "positive"),
    "delay": ("time", "nonnegative"),
    "dead_band": ("position", "nonnegative"),
    "coulomb": ("force", "nonnegative"),
    "viscous": ("force*time/position", "nonnegative"),
    "inertia": ("inertia", "nonnegative"),
}
# Fields of every controller that the columns of a log, or an effect, decide.
_OF_LOG = ("own_velocity", "lag", "speed")
# Laws whose values may be unknown. An adaptive law fits its model itself.
_WITH_UNKNOWNS = ("cascade_pd", "pd", "pid", "friction_compensation", "computed_torque", "flatness")
# Laws whose gains act on a velocity that is itself a gain times the position error.
_CASCADES = ("cascade_pd",)


def unknown_info(kind: str, name: str) -> ParameterInfo:
    """Return the declaration of a value of [controller] that may be unknown."""
    dimension, sign = UNKNOWN_OF_CONTROLLER[name]
    if kind in _CASCADES and name == "kp":
        dimension = "1/time"
    return ParameterInfo(dimension, sign, "")


def _maybe_unknown(read: Reader, kind: str, name: str) -> Reader:
    """Return the reader of a known value, or of one with a guess."""
    if kind not in _WITH_UNKNOWNS:
        return read
    info = unknown_info(kind, name)
    table = schema_of(value_keys(info))

    def read_either(value: Any, spot: Spot) -> Any:
        return read_value(value, info, spot) if isinstance(value, dict) else read(value, spot)

    return Reader(read_either, either(read.schema, table))


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
        law: Further settings, by the fields of the controller's class; unknown ones at their guess.
        unknown: Unknown values by name, one for all drives or one each; known ones among them are not free.
    """

    kind: str
    period: float | None = None
    disturbance: Disturbance | str | None = None
    law: Mapping[str, Any] = field(default_factory=dict)
    unknown: Mapping[str, Value | tuple[Value | float, ...]] = field(default_factory=dict)

    @property
    def limit(self) -> float | tuple[float, ...] | None:
        """Bound of the command; None: no bound."""
        return self.law.get("limit")


def controller_table(given: Mapping[str, Any]) -> ControllerTable:
    """Return [controller] from its checked keys."""
    apart = ("kind", "period", "disturbance")
    law = {name: value for name, value in given.items() if name not in apart}
    unknown = {
        name: value for name, value in law.items() if name in UNKNOWN_OF_CONTROLLER and _any_free(value)
    }
    law |= {name: at_start(value) for name, value in unknown.items()}
    return ControllerTable(**{name: given[name] for name in apart if name in given}, law=law, unknown=unknown)


def _any_free(value: Any) -> bool:
    return any(isinstance(v, Value) for v in (value if isinstance(value, tuple) else (value,)))


def at_start(value: Any, at_truth: bool = False) -> Any:
    """Return the guesses of a value of [controller] that may be unknown, or its true values."""
    if isinstance(value, tuple):
        return tuple(at_start(v, at_truth) for v in value)
    return value.start(at_truth) if isinstance(value, Value) else value


def controller_keys(kind: str, kinds: Kinds) -> Keys:
    """Return the keys of [controller]: those of every controller, and the fields of this kind's class."""
    keys = {
        "period": Key(number("positive"), "sampling time", unit="s", note="the log's"),
        "velocity_average": Key(whole(1), "samples whose mean is differenced for the velocity", default=1),
        "limit": Key(
            by_drive(_maybe_unknown(number("positive"), kind, "limit")),
            "bound of the command",
            note="no bound",
        ),
        "delay": Key(
            by_drive(_maybe_unknown(number("nonnegative"), kind, "delay")),
            "transport delay of the reference",
            unit="s",
            note="none",
        ),
        "disturbance": _DISTURBANCE,
    }

    cls = kinds.laws[kind]
    if cls.sees_error:
        keys["dead_band"] = Key(
            by_drive(_maybe_unknown(number("nonnegative"), kind, "dead_band")),
            "position error that counts as zero, with all smaller ones",
            note="none",
        )
    unstated = {*keys, *_OF_LOG, "dead_band", *cls.of_machine}
    law = {}
    for f in fields(cls):
        if f.name not in unstated:
            required = f.default is MISSING and f.default_factory is MISSING
            plain = flag if f.type in (bool, "bool") else by_drive(number())
            read, doc = _LAW.get(f.name, (plain, "setting of the law"))
            if f.name in UNKNOWN_OF_CONTROLLER:
                known = number("nonnegative") if f.name == "derivative_filter" else number()
                read = by_drive(_maybe_unknown(known, kind, f.name))
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
        "set": Key(numbers_by_name, "values of parameters that are known in this log", note="as in the case"),
        **of_log,
    }


def fit_keys() -> Keys:
    """Return the keys of [[fit]]: those of [[validation]], of which `name` may be absent beside `log`."""
    return {
        **validation_keys(),
        "name": Key(text, "name in results", note="that of the file, without its suffix"),
        "log": Key(text, "file of the log, relative to the case", note="the first LOG"),
    }
