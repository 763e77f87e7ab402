"""Units of the columns of a raw log, and the kind of motion: as stated, or as the values show."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from jaxid.first_case.columns import Chosen, Column
from jaxid.first_case.two_encoders import by_screw
from jaxid.logs.rough_inertia import correlation, smooth, windows
from jaxid.logs.units import fits, parse_unit
from jaxid.logs.units_check import time_unit_of
from jaxid.logs.wrap import find_wrap

# Stroke [m] and speed [m/s] beyond which a position without a unit is an angle.
_TURNS_BEYOND, _FAST = 20.0, 10.0
# Whole numbers over a wider span are counts.
_COUNTS = 100.0
# Counts after which a register starts anew, whatever a turn is.
_REGISTER = 2**16
_DEGREES = 180.0 / math.pi
# Units of position and velocity by the ratio of a velocity to the slope of its position, all without units.
_PAIRS = (
    (1.0, "", ""),
    (_DEGREES, "rad", "deg/s"),
    (1.0 / _DEGREES, "deg", "rad/s"),
    (30.0 / math.pi, "rad", "rpm"),
    (60.0, "rev", "rpm"),
    (1.0 / 6.0, "deg", "rpm"),
    (2.0 * math.pi, "rev", "rad/s"),
    (1.0 / (2.0 * math.pi), "rad", "rev/s"),
    (1e3, "m", "mm/s"),
    (1e-3, "mm", "m/s"),
)
# A ratio counts as one of these within so much.
_NEAR = 1.08
_SIMILAR = 0.9
# Unit of a position by the turn after which it starts anew.
_BY_TURN = {"2 pi": "rad", "pi": "rad", "360": "deg", "180": "deg"}
SI = {"": "", "linear": "m", "rotary": "rad"}
# Label of a drive's command by its kind, where its force is not known.
_LABELS = {"current": "A", "voltage": "V", "duty": "pwm", "command": "command", "load": "load", "": "command"}


@dataclass(frozen=True)
class Measures:
    """Units and motion of a log.

    Attributes:
        motion: "linear" or "rotary".
        units: `[log] units`, by quantity.
        labels: `[plant] units`, by quantity, where a quantity is not mechanical.
        unwrap: `[log] unwrap`; False: positions go on.
        counts: `[log] counts_per_revolution`; None: not known, or positions are in another unit.
        sign, offset: `[log] sign` and `[log] offset`, by quantity.
        said: Lines on everything that was assumed.
        questions: Doubts, by quantity.
    """

    motion: str
    units: dict[str, str]
    labels: dict[str, str]
    unwrap: bool | float
    said: tuple[str, ...]
    questions: dict[str, str]
    counts: int | None = None
    sign: Mapping[str, int] = field(default_factory=dict)
    offset: Mapping[str, float] = field(default_factory=dict)

    def size(self, quantity: str) -> float:
        """Return the size of one unit of a column, in the unit of results."""
        unit = parse_unit(self.units.get(quantity, ""))
        if unit is not None and unit.kind == "count" and self.counts is not None:
            return 2 * math.pi / self.counts
        return 1.0 if unit is None else unit.factor


def measures_of(chosen: Chosen, robot: str = "") -> Measures:
    """Return units and motion of the chosen columns, of joints of one kind.

    Args:
        chosen: The columns.
        robot: "linear" or "rotary", the motion of the first joint by a robot's file, whose other joints have
            theirs, and whose drives take commands; empty: there is no such file.
    """
    said: list[str] = []
    questions: dict[str, str] = {}
    units: dict[str, str] = {}
    labels: dict[str, str] = {}
    period = _time(chosen.time, units, said, questions)
    place = (chosen.position or chosen.velocity)[0]
    stated = _stated(place, "position" if chosen.position else "velocity")
    wrap = find_wrap(chosen.position[0].values) if chosen.position else None
    position = stated if chosen.position else ""
    velocity = _stated(chosen.velocity[0], "velocity") if chosen.velocity else ""

    if wrap is not None:
        turn = f"a turn ({wrap.name})" if wrap.name else f"{wrap.turn:.6g}"
        said.append(f"the position starts anew after {turn}: unwrap")
        if not position and wrap.name in _BY_TURN:
            position = _BY_TURN[wrap.name]
    counts = bool(chosen.position) and _counted(chosen.position[0], position)
    position = "" if counts else position
    per_turn = round(wrap.turn) if counts and wrap is not None and round(wrap.turn) < _REGISTER else None
    if chosen.position and chosen.velocity and not counts and wrap is None:
        position, velocity = _by_slope(chosen, period, position, velocity, said)
    screw = chosen.load is not None and by_screw(place, chosen.load)
    motion = "rotary"
    if robot:
        motion = robot
    elif screw:
        motion = "linear"
    elif not counts:
        motion = _motion(chosen, place, position or velocity, wrap is not None, said, questions)

    if per_turn is not None:
        units["position"] = "count"
        said.append(f"positions are encoder counts, {per_turn} a turn, after which they start anew")
        questions["position"] = f"is a turn of the joint {per_turn} counts? Else counts_per_revolution"
    elif counts:
        labels["position"] = "count"
        said.append("positions are whole numbers: encoder counts, which stay as they are")
        questions["position"] = (
            'how many counts are a turn? In [log], units.position = "count" and counts_per_revolution '
            "give rad in place of the label"
        )
    elif position:
        _state("position", position, units, said, place if chosen.position else None)
    elif chosen.position:
        unit = "rad, or m where a joint slides" if robot else SI[motion]
        said.append(f"the position is taken to be in {unit}: nothing states its unit")
    if chosen.velocity and velocity not in ("", _unknown()):
        units["velocity"] = velocity
    if robot and chosen.force and _of_robot(chosen.force[0]):
        said.append(_of_robot(chosen.force[0]))
    else:
        # The motor of a screw turns, but a force is that on its table.
        turns = screw and bool(chosen.force) and kind_of_force(chosen.force[0]) != "force"
        _force(chosen, "rotary" if turns else motion, units, labels, said, questions)
    if chosen.reference:
        own = _stated(chosen.reference[0], "position")
        own = "" if counts and per_turn is None else own or units.get("position", "")
        units |= {"reference": own} if own else {}
    if chosen.load is not None:
        of_load = _stated(chosen.load, "position") or units.get("position", "")
        units |= {"load_position": of_load} if of_load else {}
    plain = ("s", "m", "N", "N m") if motion == "linear" else ("s", "m", "rad", "N", "N m")
    return Measures(
        motion,
        {q: u for q, u in units.items() if u not in plain},
        labels,
        False if wrap is None else (True if wrap.name else wrap.turn),
        tuple(said),
        questions,
        per_turn,
    )


def _unknown() -> str:
    return "unknown"


def _stated(column: Column, quantity: str) -> str:
    """Return the unit that file or name states, if it is one of the quantity."""
    return column.unit if fits(parse_unit(column.unit), quantity) else ""


def _state(quantity: str, unit: str, units: dict[str, str], said: list[str], column: Column | None) -> None:
    units[quantity] = unit
    how = "as the column states" if column is not None and column.unit == unit else "by its values"
    said.append(f"the {quantity} is in {unit}, {how}")


def _time(time: Column | None, units: dict[str, str], said: list[str], questions: dict[str, str]) -> float:
    """Set the unit of the time, and return the sampling period [s]."""
    if time is None:
        return 1e-3
    steps = np.diff(time.values)
    steps = steps[steps > 0]
    period = float(np.median(steps)) if steps.size else 1.0
    stated = parse_unit(_stated(time, "time"))
    if stated is not None:
        units["time"] = time.unit
        said.append(f"the time is in {time.unit}, as the column states")
        return period * stated.factor
    unit = time_unit_of(period)
    if unit == "s":
        return period
    units["time"] = unit
    said.append(f"the time is in {unit}: from row to row it grows by {period:g}")
    questions["time"] = f"is the time in {unit}?"
    found = parse_unit(unit)
    assert found is not None, "a unit of time is known"
    return period * found.factor


def _counted(column: Column, unit: str) -> bool:
    """Check whether positions are counts, as their unit says, or whole numbers without a unit."""
    stated = parse_unit(unit) if unit else None
    if stated is not None:
        return stated.kind == "count"
    return bool(np.ptp(column.values) >= _COUNTS and np.all(column.values == np.round(column.values)))


def _by_slope(
    chosen: Chosen, period: float, position: str, velocity: str, said: list[str]
) -> tuple[str, str]:
    """Return the units of position and velocity after their ratio; the velocity's "unknown" if it is none."""
    q, v = chosen.position[0].values, chosen.velocity[0].values
    slope = (q[2:] - q[:-2]) / (2.0 * period)
    pairs = [(smooth(v[1:-1], w), smooth(slope, w)) for w in windows(q.size)]
    measured, derived = max(pairs, key=lambda pair: abs(correlation(*pair)))
    if correlation(measured, derived) < _SIMILAR:
        said.append(f"'{chosen.velocity[0].name}' is not the derivative of the position: it is passed over")
        return position, _unknown()
    ratio = float(measured.std() / derived.std())
    possible = [pair for pair in _PAIRS if position in ("", pair[1]) or pair[0] == 1.0]
    factor, of_position, of_velocity = min(possible, key=lambda pair: abs(math.log(ratio / pair[0])))
    near = 1 / _NEAR < ratio / factor < _NEAR
    if near and factor == 1.0:
        return position, f"{position}/s" if position and not velocity else velocity
    if near:
        said.append(
            f"velocity over the slope of the position is {ratio:.4g}: {of_position} and {of_velocity}"
        )
        return of_position, velocity or of_velocity
    if not velocity:
        said.append(
            f"'{chosen.velocity[0].name}' is {ratio:.4g} times the derivative of the position: passed over"
        )
        return position, _unknown()
    return position, velocity


def _motion(
    chosen: Chosen, place: Column, unit: str, wraps: bool, said: list[str], questions: dict[str, str]
) -> str:
    """Return the kind of motion: by unit, by words, by the force, or by the size of the motion."""
    found = parse_unit(unit.partition("/")[0]) if unit else None
    found = parse_unit("rev") if unit == "rpm" else found
    if found is not None:
        return "linear" if found.kind == "length" else "rotary"
    if wraps:
        return "rotary"

    if place.meaning.motion:
        said.append(f"the motion is {place.meaning.motion}, by the name '{place.name}'")
        return place.meaning.motion
    force = chosen.force[0] if chosen.force else None
    of_force = parse_unit(force.unit) if force is not None and force.unit else None
    kind = "" if force is None else of_force.kind if of_force is not None else force.meaning.quantity
    if force is not None and kind in ("torque", "force"):
        motion = "rotary" if kind == "torque" else "linear"
        said.append(f"the motion is {motion}, because '{force.name}' is a {kind}")
        return motion

    span = float(np.ptp(place.values)) if chosen.position else 0.0
    speed = max((float(np.abs(v.values).max()) for v in chosen.velocity), default=0.0)
    if span > _TURNS_BEYOND or speed > _FAST:
        size = f"a way of {span:.4g} m" if span > _TURNS_BEYOND else f"a speed of {speed:.4g} m/s"
        said.append(f"the motion is rotary: no axis has {size}")
        questions["motion"] = (
            'is the position in rad? Else say units = { position = "deg" } in [log], or "mm" with '
            'motion = "linear" in [plant]'
        )
        return "rotary"
    said.append("the motion is taken to be linear: nothing says whether it turns or slides")
    questions["motion"] = 'does it turn? Then motion = "rotary": units are rad, N m and kg m^2'
    return "linear"


def _force(
    chosen: Chosen,
    motion: str,
    units: dict[str, str],
    labels: dict[str, str],
    said: list[str],
    questions: dict[str, str],
) -> None:
    """Set unit and label of the force."""
    if not chosen.force:
        return
    column = chosen.force[0]
    stated, kind = parse_unit(_stated(column, "force")), kind_of_force(column)
    mechanical = {"linear": "force", "rotary": "torque"}[motion]
    if kind == mechanical:
        if stated is not None:
            units["force"] = column.unit
            said.append(f"the force is in {column.unit}, as the column states")
        else:
            unit = "N" if motion == "linear" else "N m"
            said.append(f"'{column.name}' is taken to be in {unit}: nothing states its unit")
        return

    label = _LABELS.get(kind, "%" if kind == "percent" else "command")
    if kind in ("torque", "force"):
        label = "N m" if kind == "torque" else "N"
    if label == "command" and column.name.isidentifier() and parse_unit(column.name) is None:
        label = column.name
    if stated is not None and kind in ("current", "voltage") and stated.factor != 1.0:
        units["force"] = column.unit

    labels["force"] = label
    of = "" if label == column.name else f" of '{column.name}'"
    force = "N" if motion == "linear" else "N m"
    said.append(f"results are per {label}: the {force} for one {label}{of} are not known")
    questions["force"] = questions_of_drive(kind, motion, label)


def kind_of_force(column: Column) -> str:
    """Return the kind of a force by its unit, or else by its name."""
    unit = parse_unit(_stated(column, "force"))
    return column.meaning.quantity if unit is None else unit.kind


def _of_robot(column: Column) -> str:
    """Return how a force without a unit goes with a robot's file; empty if the file does not say."""
    if _stated(column, "force"):
        return ""
    kind = column.meaning.quantity
    if kind in ("torque", "force"):
        return f"'{column.name}' is taken to be in N m, or N where a joint slides: nothing states its unit"
    if kind in ("command", ""):
        return (
            f"'{column.name}' is taken for a command of the robot file's actuators, or a force without these"
        )
    return ""


def questions_of_drive(kind: str, motion: str, label: str) -> str:
    """Return the question whose answer turns results per unit of the command into mechanical ones."""
    lead = ", lead [m/rev]" if motion == "linear" else ""
    if kind == "current":
        return f"torque_constant [N m/A], gear_ratio{lead} of the drive? In [actuator], without this label"
    if kind == "voltage":
        return (
            f"torque_constant [N m/A], resistance [ohm], gear_ratio{lead}? In [actuator], without this label"
        )
    force = "N" if motion == "linear" else "N m"
    return f"how many {force} are one {label}? State gain in [actuator], and take this label out"
