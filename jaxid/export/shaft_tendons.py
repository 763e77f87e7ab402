"""Shafts that turn with several joints, as fixed tendons of an MJCF."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from jaxid.export.soft_friction import Softness
from jaxid.export.xml_text import XmlText, listed

# Attributes of a tendon, with the effect and parameter that each is.
_ATTRIBUTES = {
    "viscous_friction": ("coefficient", "damping"),
    "coulomb_friction": ("level", "frictionloss"),
    "added_mass": ("mass", "armature"),
    "linear_stiffness": ("coefficient", "stiffness"),
}


@dataclass(frozen=True)
class ShaftTendons:
    """Tendons with the inertia, friction and stiffness of the shafts of a result.

    A fixed tendon is as long as the sum of its joints' coordinates times its coefficients, which is the
    turn of the shaft. MuJoCo's inverse and forward dynamics have its inertia.

    Args:
        texts: An element each.
        held: Numbers of the effects that they hold.
    """

    texts: tuple[str, ...]
    held: frozenset[int]

    @classmethod
    def of(cls, model: Mapping[str, Any], step: float, named: Collection[str]) -> ShaftTendons:
        """Read the effects on shafts of a result.

        Args:
            model: `model` of result.json.
            step: Time step of the file [s], which says how stiff its dry friction can be.
            named: Names of the joints that a tendon can refer to.
        """
        texts, held = [], set[int]()
        for number, ratios in enumerate(model.get("shafts") or (), start=1):
            turning = [j for j, ratio in zip(model["joints"], ratios, strict=True) if ratio]
            if not set(turning) <= set(named):
                continue
            values: dict[str, float] = {}
            for k, effect in enumerate(model["effects"]):
                parameter, attribute = _ATTRIBUTES.get(effect["kind"], ("", ""))
                if effect.get("shaft") != number or not attribute:
                    continue
                value = float(effect["parameters"][parameter])
                # No attribute of a tendon may be negative.
                if value < 0:
                    continue
                held.add(k)
                if value > 0:
                    values[attribute] = values.get(attribute, 0.0) + value
            if values:
                texts.append(_tendon(model["joints"], ratios, values, f"shaft_{number}", step))
        return cls(tuple(texts), frozenset(held))


def _tendon(joints: list[str], ratios: list[float], values: dict[str, float], name: str, step: float) -> str:
    head = {"name": name, **{attribute: repr(value) for attribute, value in values.items()}}
    if "frictionloss" in values:
        head |= {key: value for key, value in Softness.least(step).attributes().items() if value is not None}
    if "stiffness" in values:
        head["springlength"] = "0"
    turning = [(joint, ratio) for joint, ratio in zip(joints, ratios, strict=True) if ratio]
    parts = "".join(f"<joint {listed({'joint': joint, 'coef': repr(ratio)})}/>" for joint, ratio in turning)
    return f"<fixed {listed(head)}>{parts}</fixed>"


def insert_tendons(text: XmlText, tendons: tuple[str, ...]) -> None:
    """Write tendons into a file, in its section of tendons or in a new one."""
    if not tendons:
        return
    section = next((e for e in text.root.children if e.tag == "tendon"), None)
    if section is None:
        worldbody = next(e for e in text.root.children if e.tag == "worldbody")
        text.insert_before(worldbody, f"<tendon>{''.join(tendons)}</tendon>")
        return
    for one in tendons:
        text.insert_into(section, one)
