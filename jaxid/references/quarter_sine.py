"""A quarter of a sine up, a hold, and a Bezier polynomial on: the profile of flatness-based control."""

from typing import Any

import numpy as np

from jaxid.references.bezier import bezier_curve, rest_to_rest
from jaxid.references.family import Family, Grid
from jaxid.schema import Key, number


def _sample(values: dict[str, Any], grid: Grid) -> np.ndarray:
    rise, hold = values["rise_time"], values["hold_until"]
    end = values["return_until"]
    if not rise <= hold < end:
        what = f"rise_time = {rise:g} s, hold_until = {hold:g} s and return_until = {end:g} s do not follow"
        raise grid.fault(what, "let each be later than the one before")
    up = values["level"] * np.sin(0.5 * np.pi * np.minimum(grid.time / rise, 1.0))
    z = np.clip((grid.time - hold) / (end - hold), 0.0, 1.0)
    back = bezier_curve(rest_to_rest(0.0, 1.0), z)
    return up + (values["end"] - values["level"]) * back


QUARTER_SINE = Family(
    kind="quarter_sine",
    doc="a quarter sine to a level, a hold, and a Bezier polynomial from rest to rest",
    keys={
        "level": Key(number(), "position that it holds", True, "position"),
        "rise_time": Key(
            number("positive"), "duration of the quarter sine, which starts at full speed", True, "s"
        ),
        "hold_until": Key(number("positive"), "time at which the polynomial begins", True, "s"),
        "return_until": Key(number("positive"), "time at which it ends", True, "s"),
        "end": Key(number(), "position at its end", unit="position", default=0.0),
    },
    sample=_sample,
)
