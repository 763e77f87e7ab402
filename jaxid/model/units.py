"""Units of parameters, written once as dimensions and labelled for the machine at hand."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_LABELS = {
    "linear": {
        "force": "N",
        "position": "m",
        "time": "s",
        "inertia": "kg",
        "gravity": "m/s^2",
        "moment": "kg m",
    },
    "rotary": {"force": "N m", "position": "rad", "time": "s", "inertia": "kg m^2"},
}


@dataclass(frozen=True)
class Units:
    """Labels of one joint's quantities.

    Args:
        motion: "linear" (kg, m, N) or "rotary" (kg m^2, rad, N m).
        position: Label in place of m or rad, if the quantity is not mechanical.
        force: Label in place of N or N m.
    """

    motion: str = "linear"
    position: str | None = None
    force: str | None = None

    def label(self, dimension: str, motion: str | None = None) -> str:
        """Turn a dimension such as "force*time/position" into a label such as "N s/m".

        Args:
            dimension: Product of force, position, time and inertia; "1", "angle" for a phase, or "moment"
                for a mass times its distance from an axis.
            motion: Motion of a joint that differs from the others; None: that of the machine.
        """
        labels = dict(_LABELS[motion or self.motion]) | {"angle": "rad", "moment": "kg m"}
        if self.position is not None or self.force is not None:
            labels["position"] = self.position or labels["position"]
            labels["force"] = self.force or labels["force"]
            labels["inertia"] = f"{labels['force']} s^2/{labels['position']}"
        if self.force is not None:
            # Times the acceleration of gravity it is a force.
            labels["moment"] = f"{self.force} s^2/m"
        if dimension in labels:
            return labels[dimension]
        over, _, under = dimension.partition("/")
        over = "1" if over == "1" else " ".join(_power(w, labels) for w in over.split("*"))
        # A compound label below the line keeps its brackets: N m/(N m) is not N m/N m.
        below = " ".join(_power(w, labels) for w in under.split("*") if w)
        if not below:
            return over
        return f"{over}/({below})" if " " in below else f"{over}/{below}"


def joined(unit: str | Sequence[str]) -> str:
    """Return one label as it is, and labels by joint as text."""
    return unit if isinstance(unit, str) else ", ".join(unit)


def _power(word: str, labels: dict[str, str]) -> str:
    match = re.fullmatch(r"([a-z]+)(\d?)", word)
    if match is None:
        raise ValueError(f"{word!r} is not a dimension; use force, position, time, inertia.")
    name, exponent = match.groups()
    label = labels[name]
    if not exponent:
        return label
    return f"{label}^{exponent}" if " " not in label else f"({label})^{exponent}"
