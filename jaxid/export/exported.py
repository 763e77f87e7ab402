"""Files with a result in them, and the part of a result that a robot's file can hold."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxid.case.robot import Robot
from jaxid.errors import InputError
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree

# Parameter below which an effect counts as none [its SI unit].
_ROUNDING = 1e-14


@dataclass(frozen=True)
class ExportedFile:
    """A file with a result in it.

    Args:
        content: Its bytes.
        changed: Names of the joints and bodies that were changed, or of the joints that it describes.
        notes: Parts of the result that it cannot hold, a sentence each.
        lost: Effects among them, by their numbers in `model.effects` of the result, from 0.
        real: Whether every body that was found can exist, and was written.
        added: Names of joints that the user's file does not have.
        new: Whether it is a robot's file of its own, where the case names none to change.
    """

    content: bytes
    changed: tuple[str, ...]
    notes: tuple[str, ...]
    lost: tuple[int, ...] = ()
    real: bool = True
    added: tuple[str, ...] = ()
    new: bool = False


def shown(effect: Mapping[str, Any]) -> str:
    """Return an effect of a result in words: kind, joint and values."""
    values = ", ".join(f"{n} = {v:.6g}" for n, v in effect["parameters"].items() if v is not None)
    place = f"[{effect['joint_name']}]" if "joint_name" in effect else ""
    place = f"[shaft {effect['shaft']}]" if "shaft" in effect else place
    return f"{effect['kind']}{place} ({values})"


def is_nothing(effect: Mapping[str, Any]) -> bool:
    """Check that an effect with one parameter is zero but for rounding, as of a spring's expansion."""
    values = [v for v in effect["parameters"].values() if v is not None]
    return len(values) == 1 and abs(values[0]) < _ROUNDING


@dataclass(frozen=True)
class JointLaws:
    """Effects of a result, sorted by the joints of a file.

    Args:
        values: Value of each kind of effect that the file can hold, by joint.
        lost: Numbers of the effects that it cannot hold.
    """

    values: tuple[dict[str, float], ...]
    lost: tuple[int, ...]

    @classmethod
    def of(
        cls,
        model: Mapping[str, Any],
        placed: Mapping[str, str],
        stay: Collection[str],
        held: Collection[int] = (),
    ) -> JointLaws:
        """Sort the effects of a result.

        Args:
            model: `model` of result.json.
            placed: Kinds that the file can hold at a joint, with their parameter.
            stay: Kinds that are dealt with elsewhere.
            held: Numbers of effects that are.
        """
        values: list[dict[str, float]] = [{} for _ in model["joints"]]
        lost = []
        for number, effect in enumerate(model["effects"]):
            kind, joint = effect["kind"], effect.get("joint", 0) - 1
            value = effect["parameters"].get(placed.get(kind, ""))
            if value is not None and joint >= 0:
                values[joint][kind] = values[joint].get(kind, 0.0) + float(value)
            elif kind not in stay and number not in held and not is_nothing(effect):
                lost.append(number)
        return cls(tuple(values), tuple(lost))


def need_joints(robot: Robot, model: Mapping[str, Any], where: str) -> None:
    """Refuse a file whose joints are not those of the result.

    Raises:
        InputError: If they are not.
    """
    if robot.names != tuple(model["links"]):
        what = f"its joints are {', '.join(robot.names)}, and those of the result {', '.join(model['links'])}"
        raise InputError(what, where=where, hint="name the file of the case by --model")


def plant_of(robot: Robot, model: Mapping[str, Any]) -> LinkTree:
    """Return the plant of a result in the geometry of a file, without effects; rotors as at the joints."""
    parameters = model["parameters"]
    copies = {"copies": robot.copies, "leading": robot.leading} if robot.copies else {}
    return LinkTree(
        **{name: np.asarray(parameters[name]) for name in TEN},
        rotor_inertia=rotors_of(model),
        geometry=robot.geometry,
        parents=robot.parents,
        gravity_vector=np.asarray(model["gravity_vector"]),
        **copies,
    )


def rotors_of(model: Mapping[str, Any]) -> np.ndarray | None:
    """Return the inertias of a result's rotors as seen at the joints, (n,); None if it has none."""
    rotors, ratios = model["parameters"].get("rotor_inertia"), model.get("gear_ratio")
    if rotors is None:
        return None
    return np.asarray(rotors) * (1.0 if ratios is None else np.asarray(ratios) ** 2)


def notes_of_case(model: Mapping[str, Any]) -> tuple[str, ...]:
    """Return sentences on gears between motors and joints, and on payloads, which no target holds."""
    notes = []
    if (model.get("drives") or {}).get("transmission"):
        notes.append(
            "the transmission of the case: commands are forces of the joints, and the log's are of the motors"
        )
    for link, mass in zip(model["links"], model["parameters"].get("payload") or (), strict=False):
        if mass:
            notes.append(f"the payload of joint '{link}' ({mass:.6g} kg) is no part of the robot")
    return tuple(notes)
