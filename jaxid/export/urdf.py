"""Corrected URDF files: the user's text with the inertias, damping and friction of a result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element as XmlElement
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from jaxid.arms.bodies import Bodies, about_centre, are_bodies, bodies_of
from jaxid.case.robot import Robot, RobotJoint, body_in, kept, projected, towards
from jaxid.case.urdf import read_inertial, read_urdf_tree
from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile, JointLaws, need_joints, plant_of, shown
from jaxid.export.xml_text import Element, XmlText

# Relative change below which a value of the file stays as it is written.
_SAME = 1e-12
# Relative difference of a sum up to which bodies count as those of the result.
_CLOSE = 1e-6
# Effects that <dynamics> states, with their parameter.
_LAWS = {"viscous_friction": "coefficient", "coulomb_friction": "level"}
_ATTRIBUTES = {"viscous_friction": "damping", "coulomb_friction": "friction"}
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def export_urdf(model: Mapping[str, Any], path: Path) -> ExportedFile:
    """Put the machine of a result into the URDF that its case names: <inertial> and <dynamics>.

    Args:
        model: `model` of result.json or discovery.json.
        path: The URDF.

    Raises:
        InputError: If the file is not that of the case.
    """
    where = str(path)
    whole = read_urdf_tree(path)
    try:
        text = XmlText(path.read_bytes())
    except (OSError, expat.ExpatError) as error:
        raise InputError(str(error), where=where, hint="name the URDF of the case by --model") from error
    robot = kept(whole, model["joints"], model.get("held", {}))
    need_joints(robot, model, where)
    found = bodies_of(plant_of(robot, model), robot.bodies, np.zeros(len(robot.free)))
    work = _Work(text, robot, model)
    work.joints(found.rotors)
    work.bodies(found)
    return ExportedFile(text.text(), tuple(work.changed), tuple(work.notes), tuple(work.lost), work.real)


@dataclass
class _Work:
    """The export of one machine into one text."""

    text: XmlText
    robot: Robot
    model: Mapping[str, Any]
    notes: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    real: bool = True

    def _elements(self, tag: str) -> dict[str, Element]:
        return {e.attributes.get("name", ""): e for e in self.text.root.children if e.tag == tag}

    def joints(self, rotors: Float[np.ndarray, " n"]) -> None:
        """Write damping and friction of the free joints, and name what a URDF lacks."""
        laws, file, elements = (
            JointLaws.of(self.model, _LAWS, ()),
            projected(self.robot),
            self._elements("joint"),
        )
        for number in laws.lost:
            self.notes.append(f"{shown(self.model['effects'][number])} has no place in a URDF")
            self.lost.append(number)
        for joint, law, rotor in zip(self.robot.free, laws.values, rotors, strict=True):
            if rotor:
                self.notes.append(f"the rotor of joint '{joint.name}' ({rotor:.6g}) has no place in a URDF")
            values = self._dynamics(joint, file[joint.name], law)
            if not values:
                continue
            element = elements[joint.name]
            dynamics = element.find("dynamics")
            if dynamics is None:
                listed = " ".join(f'{name}="{value}"' for name, value in values.items())
                self.text.insert_into(element, f"<dynamics {listed}/>")
            else:
                self.text.set(dynamics, values)
            self.changed.append(f"joint '{joint.name}'")

    def _dynamics(
        self, own: RobotJoint, stated: RobotJoint, law: Mapping[str, float]
    ) -> dict[str, str | None]:
        """Return the attributes that change: a joint that others follow keeps their part."""
        values: dict[str, str | None] = {}
        for kind, before, at_joint in (
            ("viscous_friction", stated.damping[0], own.damping[0]),
            ("coulomb_friction", stated.friction, own.friction),
        ):
            more, name = law.get(kind, 0.0) - before, _ATTRIBUTES[kind]
            if abs(more) <= _SAME * max(abs(before), 1e-9):
                continue
            if at_joint + more < 0:
                self.notes.append(
                    f"{name} of joint '{own.name}' would be {at_joint + more:.3g}: written as 0"
                )
            values[name] = repr(max(at_joint + more, 0.0))
        return values

    def bodies(self, found: Bodies) -> None:
        """Write the inertias of the links that the kept joints move."""
        start, links = self.robot.bodies, self._elements("link")
        joints = self._elements("joint")
        if found.error > _CLOSE:
            what = f"no bodies have the inertias that were found: sums differ by {found.error:.2g}"
            self.notes.append(what)
            self.real = False
        for k, joint in enumerate(self.robot.joints):
            more = found.links[k] - start[k]
            if np.all(np.abs(more) <= _SAME * np.abs(start[k]).max()):
                continue
            element = joints[joint.name]
            child = element.find("child")
            assert child is not None, "a joint that was read has a child"
            self._write(links[child.attributes["link"]], _turn(element), joint, more)

    def _write(self, link: Element, turn: np.ndarray, joint: RobotJoint, more: np.ndarray) -> None:
        """Add to the inertia of a link of the file what was found of the body beside the file's."""
        name, inertial = link.attributes["name"], link.find("inertial")
        new = _ten_of(inertial) + body_in(more, turn)
        if not new[0] > 0 or not are_bodies(new[None]):
            what = f"less was found than the links weigh that are fixed to '{name}': not written"
            self.notes.append(f"joint '{joint.name}': {what}")
            self.real = False
            return
        mass, centre, tensor = about_centre(new)
        six = dict(zip(_TENSOR, tensor[np.triu_indices(3)].tolist(), strict=True))
        parts = {
            "origin": {"xyz": " ".join(repr(float(v)) for v in centre), "rpy": "0 0 0"},
            "mass": {"value": repr(mass)},
            "inertia": {n: repr(v) for n, v in six.items()},
        }
        listed = {t: " ".join(f'{n}="{v}"' for n, v in values.items()) for t, values in parts.items()}
        if inertial is None:
            whole = "".join(f"<{tag} {values}/>" for tag, values in listed.items())
            self.text.insert_into(link, f"<inertial>{whole}</inertial>")
        else:
            for tag, values in parts.items():
                element = inertial.find(tag)
                if element is None:
                    self.text.insert_into(inertial, f"<{tag} {listed[tag]}/>")
                else:
                    self.text.set(element, values)
        self.changed.append(f"link '{name}'")


def _turn(joint: Element) -> Float[np.ndarray, "4 4"]:
    """Return the frame of a joint, whose z is its axis, in that of the link that it moves."""
    axis, out = joint.find("axis"), np.eye(4)
    xyz = np.array([1.0, 0.0, 0.0]) if axis is None else _vector(axis.attributes["xyz"])
    out[:3, :3] = towards(xyz / np.linalg.norm(xyz))
    return out


def _ten_of(inertial: Element | None) -> Float[np.ndarray, " 10"]:
    """Return the ten parameters of a link about the origin of its frame."""
    if inertial is None:
        return np.zeros(10)
    plain = XmlElement("inertial")
    plain.extend(XmlElement(child.tag, child.attributes) for child in inertial.children)
    return read_inertial(plain, np.eye(4), "inertial")


def _vector(text: str) -> Float[np.ndarray, " 3"]:
    return np.array([float(word) for word in text.split()])
