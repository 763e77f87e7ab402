"""Second joints of a corrected MJCF: elastic transmissions and backlash between a motor and its link."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxid.export.exported import shown
from jaxid.export.xml_text import Element, XmlText

# Effect that puts a part of the inertia behind a spring, with or without a clearance.
BEHIND = "joint_flexibility"
# Least rotor before a second joint, as a part of the inertia behind it: with none the matrix is singular.
_LEAST = 0.01
# Attributes that say where a joint is, and those by which it has nothing of its class.
_PLACE = ("class", "type", "axis", "pos")
_BARE = {
    "limited": "false",
    "ref": "0",
    "springref": "0",
    "armature": "0",
    "frictionloss": "0",
    "actuatorfrclimited": "false",
}


@dataclass
class BehindJoints:
    """Second joints of one text.

    The usual construction: the body of a joint gets a second one about its axis. The actuator and the
    rotor stay at the first, which is what an encoder at the motor shows; the body and all that it carries
    move with both. A spring is the second joint's stiffness. With a clearance it is that of a tendon over
    this joint alone, whose spring has a dead band.

    Args:
        compiled: Its compiled model of the text.
        text: The text.
        joints: Elements of all joints, by their index in the compiled model.
        names: Names of all joints.
        model: `model` of the result.
        notes: Sentences on what differs; changed: names of joints; added: names of the second ones.
        tendons: Elements of the springs with a clearance.
    """

    compiled: Any
    text: XmlText
    joints: Mapping[int, Element]
    names: Sequence[str]
    model: Mapping[str, Any]
    notes: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    tendons: list[str] = field(default_factory=list)

    def write(self) -> None:
        """Write a second joint for each such effect."""
        for effect in self.model["effects"]:
            if effect["kind"] == BEHIND:
                self._write(effect)

    def _write(self, effect: Mapping[str, Any]) -> None:
        """Write the second joint of one effect."""
        values, first = effect["parameters"], effect["joint_name"]
        index, gap = self.names.index(first), values.get("gap")
        element = self.joints[index]
        name = self._free_name(f"{first}_{'spring' if gap is None else 'backlash'}")
        stiffness, damping = (repr(float(values[key])) for key in ("stiffness", "damping"))
        # Place and axis as they are written, whatever class they come from; nothing else of the first joint.
        place = {key: element.attributes[key] for key in _PLACE if key in element.attributes}
        own = {"name": name, **place, **_BARE, "damping": damping}
        own["stiffness"] = stiffness if gap is None else "0"
        self.text.insert_behind(element, _tag("joint", own))
        if gap is not None:
            # Damping cannot be left to the ends of a clearance. Without any the motion is further off.
            half = 0.5 * float(gap)
            band = {"name": name, "springlength": f"{-half!r} {half!r}", "stiffness": stiffness}
            only = _tag("joint", {"joint": name, "coef": "1"})
            self.tendons.append(f"<fixed {_listed(band)}>{only}</fixed>")
            self.notes.append(
                f"{shown(effect)}: joint '{name}' has its damping inside the clearance too, and jaxid none"
            )
        self._rotor(effect, index, first)
        self.notes.append(
            f"{shown(effect)}: behind joint '{name}' is all that the body of '{first}' carries, with its "
            "inertia and weight in the place of load_inertia"
        )
        self.added.append(name)
        self.changed.append(f"joint '{name}'")

    def _rotor(self, effect: Mapping[str, Any], index: int, first: str) -> None:
        """Give the first joint a rotor if it has none."""
        load = float(effect["parameters"]["load_inertia"])
        written = self.text.attribute(self.joints[index], "armature")
        armature = float(self.compiled.dof_armature[self.compiled.jnt_dofadr[index]])
        armature = armature if written is None else float(written)
        if armature < _LEAST * load:
            self.text.set(self.joints[index], {"armature": repr(_LEAST * load)})
            self.notes.append(
                f"armature of joint '{first}' was {armature:.3g}, and a motor before a spring needs one: "
                f"written as {_LEAST * load:.3g}"
            )

    def _free_name(self, wanted: str) -> str:
        """Return a name that no joint has."""
        names, number = {*self.names, *self.added}, 2
        name = wanted
        while name in names:
            name, number = f"{wanted}{number}", number + 1
        return name


def _listed(values: Mapping[str, str]) -> str:
    return " ".join(f'{name}="{value}"' for name, value in values.items())


def _tag(name: str, values: Mapping[str, str]) -> str:
    return f"<{name} {_listed(values)}/>"
