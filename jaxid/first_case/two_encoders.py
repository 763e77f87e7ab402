"""Motor and load behind a coupling with an encoder each: which column is which, and the gear between them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxid.first_case.words import FORCES, parts_of
from jaxid.logs.readers.dialect import split_unit
from jaxid.logs.rough_inertia import correlation
from jaxid.logs.units import parse_unit, size_of

if TYPE_CHECKING:
    from jaxid.first_case.columns import Column

# Words that name the encoder of a load by themselves, and beside a word that names that of its motor.
_OF_LOAD = frozenset("load link abtrieb secondary".split())
_BESIDE_MOTOR = frozenset("l joint gelenk arm output table tisch carriage schlitten slide scale".split())
_OF_MOTOR = frozenset("motor mot m rotor primary".split())
_MOTION = ("position", "velocity", "acceleration")
# Correlation of the two positions from which they have one course.
_SAME_COURSE = 0.95
# Travel of a load in a turn of its motor [m] that a screw, a belt or a rack may have.
_LEADS = (2e-4, 0.3)


class TwoEncoders(NamedTuple):
    """The columns of a log without those of a load behind a coupling.

    Args:
        columns: The other columns.
        load: Position of the load; None: there is none, and the columns are all of the log.
        left_out: Further columns of the load: other motion, and the torque behind the coupling.
    """

    columns: list[Column]
    load: Column | None
    left_out: tuple[Column, ...] = ()


def without_load(columns: Sequence[Column]) -> TwoEncoders:
    """Split off the columns of a load behind a coupling, of which motor and load have an encoder each.

    One of two positions of the same course, or of the turned one, is that of the load by a word that the
    other name lacks, such as q_load beside q_motor, or by a length beside an angle.

    Args:
        columns: The columns of a log.
    """
    measured = [c for c in columns if c.meaning.quantity == "position" and not c.meaning.reference]
    if len(measured) != 2:
        return TwoEncoders([*columns], None)
    for motor, load in (measured, measured[::-1]):
        of_motor, of_load = _words(motor) - _words(load), _words(load) - _words(motor)
        beside = of_load & _BESIDE_MOTOR if of_motor & _OF_MOTOR else frozenset()
        words = of_load & _OF_LOAD | beside
        named = bool(words) and not of_motor & _OF_LOAD
        if not (named or _of_screw(motor, load, columns)):
            continue
        if abs(correlation(motor.values, load.values)) <= _SAME_COURSE:
            continue
        others = [c for c in columns if c is not motor and c is not load]
        of_it = [c for c in others if _words(c) & words and not _words(c) & _OF_MOTOR]
        moving = [c for c in of_it if c.meaning.quantity in _MOTION]
        forces = [c for c in of_it if c.meaning.quantity in FORCES]
        if all(any(c is f for f in forces) for c in others if c.meaning.quantity in FORCES):
            forces = []  # it is the only one
        left_out = (*moving, *forces)
        kept = [c for c in columns if c is not load and not any(c is x for x in left_out)]
        return TwoEncoders(kept, load, left_out)
    return TwoEncoders([*columns], None)


def by_screw(motor: Column, load: Column) -> bool:
    """Check whether one position is stated as an angle and the other one as a length."""
    units = [parse_unit(column.unit) for column in (motor, load)]
    return [unit and unit.kind for unit in units] == ["angle", "length"]


def _of_screw(motor: Column, load: Column, columns: Sequence[Column]) -> bool:
    """Check whether an angle and a length are those of one drive by their sizes, and not of two joints."""
    forces = [c for c in columns if c.meaning.quantity in FORCES and not c.meaning.reference]
    if not by_screw(motor, load) or len(forces) > 1 or _numbers(motor) != _numbers(load):
        return False
    angle, length = (_stroke(column) for column in (motor, load))
    return angle > 0 and _LEADS[0] < 2 * np.pi * length / angle < _LEADS[1]


def _stroke(column: Column) -> float:
    """Return the stroke of a column with a unit, in SI units."""
    return float(np.ptp(column.values)) * size_of(column.unit)


def _numbers(column: Column) -> set[str]:
    """Return the numbers in the name of a column, without its unit."""
    return set(re.findall(r"\d+", split_unit(column.name)[0]))


def _words(column: Column) -> frozenset[str]:
    """Return the words of a column's name; the German Last in front of another word is a load."""
    parts = parts_of(column.name)
    german = {"load"} if any(part.startswith("last") and part != "last" for part in parts) else set()
    return frozenset({*parts, *german})
