"""Motor and load behind a coupling with an encoder each: which column is which, and the gear between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxid.first_case.words import FORCES, parts_of
from jaxid.logs.rough_inertia import Signal, correlation, smooth, windows

if TYPE_CHECKING:
    from jaxid.first_case.columns import Column

# Words that name the encoder of a load by themselves, and beside a word that names that of its motor.
_OF_LOAD = frozenset("load link abtrieb secondary".split())
_BESIDE_MOTOR = frozenset("l joint gelenk arm output".split())
_OF_MOTOR = frozenset("motor mot m rotor primary".split())
_MOTION = ("position", "velocity", "acceleration")
# Correlation of the two positions from which they have one course.
_SAME_COURSE = 0.95
# Velocity below which a sample counts as at rest, over the largest one.
_REST = 0.02
# Fewest samples of a fit.
_ENOUGH = 20


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

    One of two positions of the same course is that of the load by a word that the other name lacks, such as
    q_load beside q_motor.

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
        if not words or of_motor & _OF_LOAD or correlation(motor.values, load.values) <= _SAME_COURSE:
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


def _words(column: Column) -> frozenset[str]:
    """Return the words of a column's name; the German Last in front of another word is a load."""
    parts = parts_of(column.name)
    german = {"load"} if any(part.startswith("last") and part != "last" for part in parts) else set()
    return frozenset({*parts, *german})


def ratio_of_strokes(motor: Signal, load: Signal) -> float:
    """Estimate how many times a motor moves as far as its load behind a coupling.

    The coupling gives with the load's acceleration and friction, which follow beside its position. Of all
    running means the one that leaves least of the motor's position decides.
    """
    best, ratio = np.inf, 0.0
    for window in windows(load.size - 2):
        signals = (
            motor[1:-1],
            load[1:-1],
            (load[2:] - load[:-2]) / 2.0,
            load[2:] - 2 * load[1:-1] + load[:-2],
        )
        q, x, v, a = (smooth(s, window) for s in signals)
        if q.size <= _ENOUGH or q.std() == 0:
            continue
        moves = np.where(np.abs(v) < _REST * np.abs(v).max(), 0.0, np.sign(v))
        columns = np.stack([x, a, v, moves, np.ones_like(x)], axis=1)
        size = np.sqrt(np.mean(columns**2, axis=0))
        scaled = columns / np.where(size > 0, size, 1.0)
        theta = np.linalg.lstsq(scaled, q, rcond=1e-8)[0]
        left = float(np.var(q - scaled @ theta)) / float(np.var(q))
        if left < best and size[0] > 0:
            best, ratio = left, float(theta[0] / size[0])
    return ratio
