"""Units of columns, and their conversion to SI units by a table, and by the stated drive and encoder."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.readers.table import Assumed
from jaxid.logs.unit_endings import unit_ending
from jaxid.settings import Actuator, LogTable

_TURN, _PERCENT = 2.0 * math.pi, 1e-2
_TIMES = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254, "inch": 0.0254}
_DEGREE = _TURN / 360.0
_ANGLES = {
    "rad": 1.0,
    "mrad": 1e-3,
    "urad": 1e-6,
    "deg": _DEGREE,
    "grad": _TURN / 400.0,
    "arcmin": _DEGREE / 60.0,
    "arcsec": _DEGREE / 3600.0,
    "rev": _TURN,
}
_POUND, _OUNCE, _KILOPOND, _INCH = 4.4482216152605, 4.4482216152605 / 16, 9.80665, 0.0254
_FORCES = {"N": 1.0, "kN": 1e3, "mN": 1e-3, "uN": 1e-6, "lbf": _POUND, "kgf": _KILOPOND}
_TORQUES = {"N m": 1.0, "kN m": 1e3, "N cm": 1e-2, "N mm": 1e-3, "mN m": 1e-3, "uN m": 1e-6}
_TORQUES |= {"lbf in": _POUND * _INCH, "lbf ft": _POUND * 12 * _INCH, "ozf in": _OUNCE * _INCH}
_TORQUES |= {"kgf cm": _KILOPOND * 1e-2, "kgf m": _KILOPOND}
_CURRENTS = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "kA": 1e3}
_VOLTAGES = {"V": 1.0, "mV": 1e-3, "kV": 1e3}
_KINDS: dict[str, dict[str, float]] = {
    "time": _TIMES,
    "length": _LENGTHS,
    "angle": _ANGLES,
    "count": {"count": 1.0},
    "force": _FORCES,
    "torque": _TORQUES,
    "current": _CURRENTS,
    "voltage": _VOLTAGES,
    "percent": {"%": _PERCENT},
}
# Units of the kinds without a conversion.
_SI = {"time": "s", "length": "m", "angle": "rad", "force": "N", "torque": "N m"}
# Other spellings, after blanks, products and special letters are made alike.
_SPELT = {
    "degree": "deg",
    "degrees": "deg",
    "grd": "deg",
    "gon": "grad",
    "turn": "rev",
    "turns": "rev",
    "revs": "rev",
    "revolutions": "rev",
    "U": "rev",
    "r": "rev",
    "counts": "count",
    "cnt": "count",
    "cnts": "count",
    "inc": "count",
    "incs": "count",
    "increments": "count",
    "ticks": "count",
    "pulses": "count",
    "seconds": "s",
    "second": "s",
    "milliseconds": "ms",
    "msec": "ms",
    "usec": "us",
    "minutes": "min",
    "volt": "V",
    "volts": "V",
    "Volt": "V",
    "amp": "A",
    "amps": "A",
    "percent": "%",
    "Nm": "N m",
    "mNm": "mN m",
    "lbf-in": "lbf in",
    "lbf-ft": "lbf ft",
    "ozf-in": "ozf in",
    "lb-in": "lbf in",
    "in-lb": "lbf in",
    "lb-ft": "lbf ft",
    "ft-lb": "lbf ft",
    "oz-in": "ozf in",
    "kg-cm": "kgf cm",
    "kgf-cm": "kgf cm",
    "kNm": "kN m",
    "Ncm": "N cm",
    "Nmm": "N mm",
    "rpm": "rev/min",
    "RPM": "rev/min",
    "1/min": "rev/min",
    "min-1": "rev/min",
    "rps": "rev/s",
    "Hz": "rev/s",
    "dps": "deg/s",
    "A rms": "A",
    "Arms": "A",
}
# Dimensions of each quantity: the kinds that it may have, and the power of time below them.
_OF_PLACE = ("length", "angle", "count")
_QUANTITIES: dict[str, tuple[tuple[str, ...], int]] = {
    "time": (("time",), 0),
    "position": (_OF_PLACE, 0),
    "reference": (_OF_PLACE, 0),
    "load_position": (_OF_PLACE, 0),
    "velocity": (_OF_PLACE, 1),
    "acceleration": (_OF_PLACE, 2),
    "load_acceleration": (_OF_PLACE, 2),
    "force": (("force", "torque", "current", "voltage", "percent"), 0),
}


@dataclass(frozen=True)
class Unit:
    """A unit of a column.

    Attributes:
        text: The unit as it was written.
        kind: One of "time", "length", "angle", "count", "force", "torque", "current", "voltage", "percent".
        factor: Size of one unit, in the SI unit of its kind; of a rate per power of a second.
        per: Power of time that it is divided by.
    """

    text: str
    kind: str
    factor: float
    per: int = 0


def parse_unit(text: str) -> Unit | None:
    """Return a unit from its text, as "mm", "deg/s", "rpm" or "0.5 um"; None if it is not known.

    A number before the unit is its size: a count of "0.5 um", 255 steps of "0.047 V".
    """
    plain = text.strip().replace("\u00b5", "u").replace("\u03bc", "u").replace("\u00b0", "deg")
    plain = (
        plain.replace("\u00b2", "^2").replace("\u207b\u00b9", "-1").replace("**", "^").replace("\u00b7", " ")
    )
    match = re.match(r"([+]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?)\s+(?=\D)|", plain)
    size = float(match[1]) if match and match[1] else 1.0
    rest = plain[match.end() :] if match and match[1] else plain
    rest = re.sub(r"[ *]+", " ", rest).strip()
    rest = _SPELT.get(rest, rest)
    over, divided, under = rest.partition("/")
    over = _SPELT.get(over.strip(), over.strip())
    per, below = 0, 1.0
    if divided:
        found = re.fullmatch(r"([a-z]+?)\s*(?:\^?([12]))?", under.strip())
        if found is None or found[1] not in _TIMES:
            return None
        per = int(found[2] or 1)
        below = _TIMES[found[1]] ** per
    for kind, known in _KINDS.items():
        if over in known and size > 0:
            return Unit(text, kind, size * known[over] / below, per)
    return None


def size_of(text: str) -> float:
    """Return a unit in SI units, or in counts; 1 if it is not known."""
    unit = parse_unit(text)
    return 1.0 if unit is None else unit.factor


def need_unit(text: str, quantity: str, where: str) -> Unit:
    """Return the unit that a user states for a quantity.

    Raises:
        InputError: If it is not known, or not one of this quantity.
    """
    unit = parse_unit(text)
    kinds, per = _QUANTITIES[quantity]
    if unit is None or unit.kind not in kinds or unit.per != per:
        what = "is not a known unit" if unit is None else f"is no unit of a {quantity}"
        raise InputError(
            f'units.{quantity} = "{text}" {what}', where=where, hint=f"take {_examples(quantity)}"
        )
    return unit


def fits(unit: Unit | None, quantity: str) -> bool:
    """Check whether a unit is one of a quantity."""
    kinds, per = _QUANTITIES.get(quantity, ((), 0))
    return unit is not None and unit.kind in kinds and unit.per == per


def _examples(quantity: str) -> str:
    kinds, per = _QUANTITIES[quantity]
    if quantity == "time":
        return "s, ms, us, ns or min"
    if quantity == "force":
        return "N, kN, mN, N m, mN m, A, mA, V or %"
    listed = {0: "mm, um, in, deg, rev, count", 1: "mm/s, mm/min, deg/s, rpm, count/s"}
    return f"{listed.get(per, 'mm/s^2, deg/s^2')}, with a number before it for steps of that size ('0.5 um')"


@dataclass(frozen=True)
class Frame:
    """The machine behind the columns of a log, as far as their units depend on it.

    Attributes:
        motions: "linear" or "rotary" by joint; empty: not known.
        driven: Joint of each drive, from 0; empty: all in order.
        actuator: The drives.
        labels: Labels of [plant] units, by quantity; their columns are not converted by a header.
    """

    motions: tuple[str, ...] = ()
    driven: tuple[int, ...] = ()
    actuator: Actuator = field(default_factory=Actuator)
    labels: Mapping[str, str] = field(default_factory=dict)

    def motion(self, joint: int) -> str:
        """Return the motion of a joint; empty if it is not known."""
        return self.motions[joint] if joint < len(self.motions) else ""

    def joint(self, quantity: str, column: int) -> int:
        """Return the joint of a column."""
        if quantity in ("force", "reference"):
            return self.driven[column] if column < len(self.driven) else column
        if quantity in ("load_position", "load_acceleration"):
            return max(len(self.motions) - 1, 0)
        return column

    def drive(self, name: str, column: int) -> float | None:
        """Return a value of the drives, for one of them."""
        value = getattr(self.actuator, name)
        return value[column] if isinstance(value, tuple) else value


def converted(
    groups: dict[str, np.ndarray],
    names: Mapping[str, Sequence[str]],
    of_file: Mapping[str, str],
    table: LogTable,
    frame: Frame,
    path: str,
) -> tuple[dict[str, np.ndarray], list[Assumed]]:
    """Convert the columns of a log to SI units, turn the signs and move the zeros that the case states.

    Args:
        groups: Columns by quantity, (samples, width).
        names: Names of the columns by quantity.
        of_file: Units that the file states, by the name of the column.
        table: The `[log]` table.
        frame: The machine.
        path: The file, for messages.

    Returns:
        The converted columns, and the units that the file decided.

    Raises:
        InputError: If a unit does not go with the machine, or a statement converts nothing.
    """
    stated = dict(table.units or {})
    signs, offsets = dict(table.sign or {}), dict(table.offset or {})
    for key, given in (("units", stated), ("sign", signs), ("offset", offsets)):
        for quantity in given:
            if quantity not in groups:
                hint = f"add the column, or leave out {key}.{quantity}"
                raise InputError(
                    f"{key}.{quantity} converts nothing: [log] names no {quantity}", where=path, hint=hint
                )
    out, assumed = {}, []
    for quantity, values in groups.items():
        units, said = _units_of(quantity, values.shape[1], names[quantity], of_file, stated, frame, path)
        if quantity == "force":
            said += _of_motor(units, names[quantity], stated, frame, path)
        width = values.shape[1]
        factors = np.array([_factor(u, quantity, k, table, frame, path) for k, u in enumerate(units)])
        factors = factors * _by_column("sign", quantity, signs.get(quantity, 1.0), width, path)
        out[quantity] = values if np.all(factors == 1.0) else values * factors
        if quantity in offsets:
            out[quantity] = out[quantity] + _by_column("offset", quantity, offsets[quantity], width, path)
        assumed += said
    return out, assumed


def _by_column(key: str, quantity: str, value: Any, width: int, path: str) -> np.ndarray:
    """Return the numbers that a key states for a quantity, one a column."""
    numbers = np.atleast_1d(np.asarray(value, float))
    if numbers.size not in (1, width):
        what = f"{key}.{quantity} has {numbers.size} entries, and there are {width} columns"
        raise InputError(what, where=path, hint="give one number for all, or one a column")
    return np.broadcast_to(numbers, width)


def _units_of(
    quantity: str,
    width: int,
    names: Sequence[str],
    of_file: Mapping[str, str],
    stated: Mapping[str, Any],
    frame: Frame,
    path: str,
) -> tuple[list[Unit | None], list[Assumed]]:
    """Return the unit of each column of a quantity: stated, of the file, or of the position; None: SI."""
    if quantity not in _QUANTITIES:
        return [None] * width, []
    if quantity in stated:
        given = stated[quantity]
        texts = [given] * width if isinstance(given, str) else list(given)
        if len(texts) != width:
            what = f"units.{quantity} has {len(texts)} entries, and there are {width} columns"
            raise InputError(what, where=path, hint="give one unit for all, or one a column")
        return [need_unit(text, quantity, path) for text in texts], []
    if frame.labels.get("force" if quantity == "force" else "position"):
        return [None] * width, []

    texts = [of_file.get(name, "") for name in names]
    texts = texts * width if len(texts) == 1 else texts
    units: list[Unit | None] = []
    said: list[Assumed] = []
    for text in dict.fromkeys(text for text in texts if text):
        unit = parse_unit(text)
        setting = f"units.{quantity}"
        if not fits(unit, quantity):
            if text not in ("-", "1"):
                said.append(
                    Assumed(setting, text, f"the file's, not known as a unit of a {quantity}: not converted")
                )
        else:
            said.append(Assumed(setting, text, "the file states it"))
    for text in texts:
        unit = parse_unit(text) if text else None
        units.append(unit if fits(unit, quantity) else None)
    # A reference is recorded as the position is, unless its column says otherwise.
    if (
        quantity == "reference"
        and not any(texts)
        and "position" in stated
        and isinstance(stated["position"], str)
    ):
        unit = need_unit(stated["position"], "position", path)
        said.append(Assumed("units.reference", stated["position"], "that of the position"))
        units = [unit] * width
    elif not any(texts):
        said += _of_names(quantity, names)
    return units, said


def _of_names(quantity: str, names: Sequence[str]) -> list[Assumed]:
    """Return the SI unit that is taken for a column whose name ends in another unit."""
    for name in names:
        unit = parse_unit(unit_ending(name)[1])
        if unit is None or not fits(unit, quantity) or unit.factor == 1.0 or unit.kind not in _SI:
            continue
        taken = _SI[unit.kind] + {0: "", 1: "/s", 2: "/s^2"}[unit.per]
        ends = f"the name '{name}' ends in {unit.text}, and no unit is stated"
        return [Assumed(f"units.{quantity}", taken, f"{ends}; state {unit.text} if that is right")]
    return []


def time_factor(table: LogTable, of_file: str) -> float:
    """Return the factor from the time column to seconds: stated, or of the file."""
    stated = (table.units or {}).get("time")
    unit = parse_unit(stated if isinstance(stated, str) else of_file)
    return unit.factor if unit is not None and fits(unit, "time") else 1.0


def _of_motor(
    units: Sequence[Unit | None],
    names: Sequence[str],
    stated: Mapping[str, Any],
    frame: Frame,
    path: str,
) -> list[Assumed]:
    """Check the command of a drive with a torque constant against the unit that file or name states."""
    if frame.actuator.torque_constant is None or "force" in stated:
        return []
    unit = units[0]
    named = parse_unit(unit_ending(names[0])[1])
    if unit is None and named is not None and named.kind == "current" and named.factor != 1.0:
        hint = f'state units.force = "{named.text}" in [log], or "A"'
        what = f"the name '{names[0]}' ends in {named.text}, and [log] states no unit"
        raise InputError(what, where=path, hint=hint)
    if unit is None:
        reason = "torque_constant goes with a current; state units.force for a voltage or a duty cycle"
        return [Assumed("units.force", "A", reason)]
    if unit.kind != "current":
        hint = f'state units.force = "{unit.text}" in [log]'
        raise InputError(
            f"the file gives the force in {unit.text}, and [log] states no unit", where=path, hint=hint
        )
    return []


def _factor(unit: Unit | None, quantity: str, column: int, table: LogTable, frame: Frame, path: str) -> float:
    """Return the factor from a column to the SI unit of its joint."""
    if quantity == "force":
        return _of_command(unit, column, frame, path)
    if quantity not in _QUANTITIES or quantity == "time":
        return 1.0 if unit is None else unit.factor

    at_motor = table.position_at == "motor" and quantity in (
        "position",
        "reference",
        "velocity",
        "acceleration",
    )
    motion = frame.motion(frame.joint(quantity, column))
    if unit is None:
        # SI: of the joint, or of the motor, which turns.
        if not at_motor:
            return 1.0
        unit = Unit("rad", "angle", 1.0)

    factor, kind = unit.factor, unit.kind
    if kind == "count":
        counts = table.counts_per_revolution
        if counts is None:
            hint = "state counts_per_revolution, or the size of a count: '0.5 um'"
            raise InputError(f"units.{quantity} is in counts of no known size", where=path, hint=hint)
        factor, kind = factor * _TURN / np.broadcast_to(counts, column + 1)[column], "angle"

    if kind == "angle" and at_motor:
        ratio = frame.drive("gear_ratio", column)
        if ratio is None:
            hint = "state gear_ratio in [actuator], or leave position_at out"
            raise InputError('position_at = "motor" needs the gear\'s ratio', where=path, hint=hint)
        factor /= ratio

    if kind == "angle" and motion == "linear":
        lead = frame.drive("lead", column)
        if lead is None:
            hint = 'state lead [m/rev] in [actuator], or motion = "rotary" in [plant]'
            raise InputError(
                f"{quantity} is in {unit.text}, and joint {column + 1} slides", where=path, hint=hint
            )
        factor *= lead / _TURN
    if kind == "length" and motion == "rotary":
        hint = "correct units, or motion in [plant]"
        raise InputError(f"{quantity} is in {unit.text}, and joint {column + 1} turns", where=path, hint=hint)
    return factor


def _of_command(unit: Unit | None, drive: int, frame: Frame, path: str) -> float:
    """Return the factor from a command to N, N m, A or V."""
    if unit is None:
        return 1.0
    motion = frame.motion(frame.joint("force", drive))
    wrong = {"force": "rotary", "torque": "linear"}.get(unit.kind)
    by_gain = wrong == "linear" and frame.drive("gain", drive) != 1.0  # of a screw or a rack
    if motion == wrong and frame.drive("torque_constant", drive) is None and not by_gain:
        moves = "turns" if wrong == "rotary" else "slides"
        hint = "correct units, or motion in [plant]"
        if wrong == "linear":
            hint = "state the force for one N m as gain in [actuator]"
        raise InputError(f"the force is in {unit.text}, and joint {drive + 1} {moves}", where=path, hint=hint)

    if unit.kind != "percent":
        return unit.factor
    rated, supply = frame.drive("rated", drive), frame.drive("supply", drive)
    if rated is None and supply is None and frame.drive("gain", drive) != 1.0:
        # The gain is the force for one per cent, such as a hundredth of the rated torque.
        return unit.factor / _PERCENT
    if (rated is None) == (supply is None):
        what = (
            "the force is in %, of nothing that is stated" if rated is None else "% is of rated or of supply"
        )
        hint = (
            "state in [actuator] either rated [A] (a current) or supply [V] (a duty cycle), or gain, "
            "the force for one %"
        )
        raise InputError(what, where=path, hint=hint)
    full = rated if rated is not None else supply
    assert full is not None, "one of the two is given"
    return unit.factor * full


def command_kind(units: Any, actuator: Actuator) -> str | None:
    """Return the kind of the stated unit of the force after conversion; None if none is stated."""
    text = (units or {}).get("force")
    text = text if isinstance(text, str) or text is None else text[0]
    unit = None if text is None else parse_unit(text)
    if unit is None:
        return None
    if unit.kind == "percent":
        return "current" if actuator.rated is not None else "voltage"
    return unit.kind
