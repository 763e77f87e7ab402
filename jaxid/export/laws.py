"""Formulas of effects in one joint's motion, as expressions that C and Python share but for names."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxid.export.exported import is_nothing, notes_of_case, shown

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

    def formula(self, template: str, values: Mapping[str, float], place: Mapping[int, float]) -> str:
        """Return a formula with its numbers, in the motion of a joint or of a shaft.

        Args:
            template: The formula.
            values: Its numbers.
            place: How much the joint or shaft turns with each joint, from 0.
        """
        text = _MOTION.sub(lambda match: self._turn(match[1], place), template)
        text = text.format_map({name: self.number(value) for name, value in values.items()})
        return _WORD.sub(lambda match: f"{self.functions[match[1]]}(", text)

    def _turn(self, motion: str, place: Mapping[int, float]) -> str:
        """Return the motion of a joint or a shaft."""
        parts = [self.share(ratio, f"{motion}[{joint}]") for joint, ratio in place.items()]
        return parts[0] if len(parts) == 1 else f"({' + '.join(parts)})"

    def share(self, ratio: float, text: str) -> str:
        """Return a multiple of a term."""
        return text if ratio == 1.0 else f"{self.number(ratio)} * {text}"


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
    notes, lost = list(notes_of_case(model)), []
    for number, effect in enumerate(model["effects"]):
        if is_nothing(effect):
            continue
        kind, place = effect["kind"], _place(model, effect)
        values = {"g": field, **{n: v for n, v in effect["parameters"].items() if v is not None}}
        if "period" in values:
            values["wave"] = 2 * 3.141592653589793 / values["period"]
        template = _FORMULAS.get(kind, _DRIVES.get(kind))
        remark = _REMARKS.get(kind, "is left out" if template is None else "")
        fits = template is not None and bool(place) and _names(template) <= set(values)
        # A drive is one of a joint.
        fits = fits and (kind in _FORMULAS or len(place) == 1)
        if fits:
            assert template is not None, "it fits"
            term = language.formula(template, values, place)
            for joint, ratio in place.items():
                if kind in _FORMULAS:
                    forces[joint].append(term if ratio == 1.0 else language.share(ratio, f"({term})"))
                else:
                    commands[joint].append(term)
        if remark or not fits:
            notes.append(f"{shown(effect)} {remark or 'is left out'}")
            lost.append(number)
    # Effects of a drive act one after the other: the last one is undone first.
    return Written(_rows(forces), _rows([steps[::-1] for steps in commands]), tuple(notes), tuple(lost))


def _place(model: Mapping[str, Any], effect: Mapping[str, Any]) -> dict[int, float]:
    """Return how much the place of an effect turns with each joint, from 0; nothing in another place."""
    if "shaft" in effect:
        ratios = model["shafts"][effect["shaft"] - 1]
        return {joint: float(ratio) for joint, ratio in enumerate(ratios) if ratio}
    return {effect["joint"] - 1: 1.0} if "joint" in effect else {}


def _names(template: str) -> set[str]:
    return set(re.findall(r"{(\w+)}", template))


def _rows(lists: Sequence[Sequence[str]]) -> tuple[tuple[str, ...], ...]:
    return tuple(tuple(row) for row in lists)
