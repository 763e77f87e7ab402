"""Motor and load behind a coupling with an encoder each: which column is which, and the gear between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from jaxid.first_case.words import parts_of
from jaxid.logs.rough_inertia import Signal, correlation, smooth, windows

if TYPE_CHECKING:
    from jaxid.first_case.columns import Column

# Words that name the encoder of a load, those that do so alone, and those that name the encoder of its motor.
_SURELY_LOAD = frozenset("load last link output abtrieb secondary".split())
_OF_LOAD = _SURELY_LOAD | frozenset("l joint gelenk arm".split())
_OF_MOTOR = frozenset("motor mot m rotor input primary".split())
# Correlation of the two positions from which they have one course.
_SAME_COURSE = 0.95
# Velocity below which a sample counts as at rest, over the largest one.
_REST = 0.02
# Fewest samples of a fit.
_ENOUGH = 20


def without_load(columns: Sequence[Column]) -> tuple[list[Column], Column | None]:
    """Split off the motion of a load behind a coupling, of which motor and load have an encoder each.

    One of two positions of the same course is that of the load by its name, such as q_load beside q_motor.

    Args:
        columns: The columns of a log.

    Returns:
        The columns without velocity and position of the load, and its position; None if there is none.
    """
    words_of = lambda column: {*parts_of(column.name), *column.meaning.joint}
    measured = [c for c in columns if c.meaning.quantity == "position" and not c.meaning.reference]
    if len(measured) != 2:
        return [*columns], None
    for motor, load in (measured, measured[::-1]):
        of_motor, of_load = words_of(motor) & _OF_MOTOR, words_of(load) & _OF_LOAD
        named = of_load & _SURELY_LOAD or (of_load and of_motor)
        named = named and not words_of(motor) & _SURELY_LOAD
        if named and correlation(motor.values, load.values) > _SAME_COURSE:
            moving = ("position", "velocity", "acceleration")
            beside = [c for c in columns if words_of(c) & of_load and c.meaning.quantity in moving]
            return [c for c in columns if not any(c is b for b in beside)], load
    return [*columns], None


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
