"""Formulas of effects in one joint's motion, as expressions that C and Python share but for names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxid.export.exported import is_nothing, shown

# Force that a drive needs to overcome an effect: position q, velocity v, acceleration a, gravity g.
_FORMULAS = {
    "viscous_friction": "{coefficient} * v",
    "back_emf_damping": "{coefficient} * v",
    "coulomb_friction": "{level} * sign(v)",
    "stribeck_friction": "{level} * exp(-(v / {velocity}) * (v / {velocity})) * sign(v)",
    "hysteresis": "{level} * sign(v)",
    "asymmetric_viscous": "{coefficient} * fabs(v)",
    "quadratic_drag": "{coefficient} * v * fabs(v)",
    "cubic_friction": "{coefficient} * v * v * v",
    "quartic_friction": "{coefficient} * v * v * v * fabs(v)",
    "constant_force": "-{level}",
    "linear_stiffness": "{coefficient} * q",
    "quadratic_stiffness": "{coefficient} * q * q",
    "cubic_stiffness": "{coefficient} * q * q * q",
    "cogging": "{amplitude} * cos({wave} * q + {phase})",
    "unbalance": "{moment} * {g} * cos(q + {phase})",
    "added_mass": "{mass} * a",
}
# Command of a drive from the force f that it is to deliver, in the order from the joint to the command.
_DRIVES = {
    "actuator_gain": "f / {gain}",
    "actuator_offset": "f - {level}",
    "saturation": "clip(f, {limit})",
}
# Remarks on effects of which a formula holds a part, or none.
_REMARKS = {
    "hysteresis": "counts as dry friction at its level",
    "static_friction": "acts at rest only, and is left out",
    "actuator_lag": "is left out: the force follows the command late",
    "input_delay": "is left out: give the command earlier by it",
}
_WORD = re.compile(r"\b(sign|exp|fabs|cos|clip)\(")
_MOTION = re.compile(r"\b([qva])\b")


@dataclass(frozen=True)
class Language:
    """Names and numbers of a programming language.

    Args:
        functions: Name of each function of the formulas.
        suffix: Text behind each number.
    """

    functions: Mapping[str, str]
    suffix: str = ""

    def number(self, value: float) -> str:
        """Return a number, negative ones in brackets."""
        text = repr(float(value)) if not self.suffix else f"{float(value):.9g}"
        text = text if any(c in text for c in ".en") else f"{text}.0"
        text += self.suffix
        return f"({text})" if value < 0 else text

    def formula(self, template: str, values: Mapping[str, float], joint: int) -> str:
        """Return a formula with its numbers, in the motion of a joint."""
        text = _MOTION.sub(rf"\1[{joint}]", template)
        text = text.format_map({name: self.number(value) for name, value in values.items()})
        return _WORD.sub(lambda match: f"{self.functions[match[1]]}(", text)


@dataclass(frozen=True)
class Written:
    """Effects of a result as formulas.

    Args:
        forces: Sums of force against the effects, by joint; empty: nothing.
        commands: Steps from force to command of each drive, by joint.
        notes: Sentences on what is left out.
        lost: Numbers of the effects that are left out.
    """

    forces: tuple[tuple[str, ...], ...]
    commands: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...]
    lost: tuple[int, ...]


def written(model: Mapping[str, Any], language: Language, field: float) -> Written:
    """Write the effects of a result as formulas.

    Args:
        model: `model` of result.json.
        language: The language.
        field: Size of the acceleration of gravity [m/s^2].
    """
    count = len(model["joints"])
    forces: list[list[str]] = [[] for _ in range(count)]
    commands: list[list[str]] = [[] for _ in range(count)]
    notes, lost = [], []
    for number, effect in enumerate(model["effects"]):
        if is_nothing(effect):
            continue
        kind, joint = effect["kind"], effect.get("joint", 0) - 1
        values = {"g": field, **{n: v for n, v in effect["parameters"].items() if v is not None}}
        if "period" in values:
            values["wave"] = 2 * 3.141592653589793 / values["period"]
        into = forces if kind in _FORMULAS else commands
        template = _FORMULAS.get(kind, _DRIVES.get(kind))
        remark = _REMARKS.get(kind, "is left out" if template is None else "")
        fits = template is not None and joint >= 0 and _names(template) <= set(values)
        if fits:
            assert template is not None, "it fits"
            into[joint].append(language.formula(template, values, joint))
        if remark or not fits:
            notes.append(f"{shown(effect)} {remark or 'is left out'}")
            lost.append(number)
    # Effects of a drive act one after the other: the last one is undone first.
    return Written(_rows(forces), _rows([steps[::-1] for steps in commands]), tuple(notes), tuple(lost))


def _names(template: str) -> set[str]:
    return set(re.findall(r"{(\w+)}", template))


def _rows(lists: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(row) for row in lists)
