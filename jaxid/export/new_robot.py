"""A robot of which no file exists, as its result describes it: what new MJCF and URDF files share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.arms.bodies import about_centre
from jaxid.arms.likely_bodies import likely_bodies
from jaxid.export.exported import rotors_of
from jaxid.export.plain import PlainTree
from jaxid.names import TEN
from jaxid.plants.geometry import JointFrames
from jaxid.plants.link_tree import LinkTree

# Relative difference of a sum up to which bodies count as those of the result.
_CLOSE = 1e-6
# Shortest distance between joints, over the reach of the robot, at which a rod is drawn.
_NEAR = 0.01
# Reach of a robot whose joints meet in a point [m].
_POINT = 0.3


@dataclass(frozen=True)
class NewRobot:
    """A robot by its frames and bodies.

    Args:
        plain: Its frames and names.
        links: Ten parameters of a body behind each joint, (links, 10).
        rotors: Inertia of each rotor, seen at its joint, (n,).
        real: Whether the bodies have the sums of the result.
        notes: Sentences on what differs.
    """

    plain: PlainTree
    links: Float[np.ndarray, "links 10"]
    rotors: Float[np.ndarray, " n"]
    real: bool
    notes: tuple[str, ...]

    @classmethod
    def of(cls, model: Mapping[str, Any], where: str) -> NewRobot:
        """Read `model` of result.json, and find bodies that have its sums.

        Raises:
            InputError: If it has no frames, because an older jaxid wrote it.
        """
        plain = PlainTree.of(model, where)
        motions = tuple("revolute" if turns else "prismatic" for turns in plain.revolute)
        copies = {}
        if len(plain.links) > len(plain.names):
            copies["copies"] = tuple(zip(plain.leaders, plain.ratios, strict=True))
            copies["leading"] = tuple(model["tree"]["leading"])
        plant = LinkTree(
            **dict(zip(TEN, plain.bodies.T, strict=True)),
            rotor_inertia=rotors_of(model),
            geometry=JointFrames(motions, plain.axes, plain.origins),
            parents=plain.parents,
            gravity_vector=plain.gravity,
            **copies,
        )
        found, notes = likely_bodies(plant), []
        if found.error > _CLOSE:
            notes.append(f"no bodies have the inertias that were found: sums differ by {found.error:.2g}")
        return cls(plain, found.links, found.rotors, found.error <= _CLOSE, tuple(notes))

    def inertial(self, link: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass [kg], centre [m] and inertia about it [kg m^2] of the body behind a joint."""
        return about_centre(self.links[link])

    def children(self, link: int) -> list[int]:
        """Return the links that hang on one of them; -1: on the base."""
        return [k for k, parent in enumerate(self.plain.parents) if parent == link]

    @property
    def reach(self) -> float:
        """Length of the way through all joints [m]."""
        return float(np.linalg.norm(self.plain.origins, axis=1).sum()) or _POINT

    def rods(self, link: int) -> list[np.ndarray]:
        """Return the origins of the links on one of them that are far enough to draw a rod to [m]."""
        ends = [self.plain.origins[k] for k in self.children(link)]
        return [end for end in ends if np.linalg.norm(end) > _NEAR * self.reach]


def leader_of(plain: PlainTree, link: int, leading: Sequence[int]) -> tuple[str, float] | None:
    """Return the joint that a link's joint follows, and by how much; None if it is free."""
    if link in leading:
        return None
    return plain.names[plain.leaders[link]], plain.ratios[link]


def leading_of(model: Mapping[str, Any]) -> tuple[int, ...]:
    """Return the link that each free joint of a result moves itself."""
    return tuple(model["tree"]["leading"] or range(len(model["joints"])))


def comment(stem: str, version: str, notes: Sequence[str]) -> str:
    """Return an XML comment that says who wrote a file, and what it does not hold."""
    lines = [
        f"{stem}, written by jaxid {version} from a result.",
        "Each body's frame has its origin on its joint, and z along it. Rods are drawn between joints.",
        *(f"Not in it: {note}." for note in notes),
    ]
    text = "\n  ".join(lines)
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!--\n  {text}\n-->"
