"""The machine of a result as plain numbers, for files that compute its forces without jaxid."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.export.exported import rotors_of
from jaxid.names import TEN


@dataclass(frozen=True)
class PlainTree:
    """A tree of links by numbers.

    Args:
        names: Names of the free joints.
        links: Names of the joints that move the links.
        parents: Index of the link on which each link hangs; -1: the base.
        revolute: Whether each link's joint turns.
        axes, origins: Frame of each link in that of its parent, joints at zero.
        leaders, ratios: Free joint by which each link's joint moves, from 0, and how much of it.
        bodies: Ten parameters of each link, (links, 10).
        rotors: Inertia of each rotor as seen at its joint, (n,).
        gravity: Acceleration of gravity in the base's frame, (3,).
        drives: Driven joints, from 0.
        gains: Force at each driven joint per unit of its command.
    """

    names: tuple[str, ...]
    links: tuple[str, ...]
    parents: tuple[int, ...]
    revolute: tuple[bool, ...]
    axes: Float[np.ndarray, "links 3 3"]
    origins: Float[np.ndarray, "links 3"]
    leaders: tuple[int, ...]
    ratios: tuple[float, ...]
    bodies: Float[np.ndarray, "links 10"]
    rotors: Float[np.ndarray, " n"]
    gravity: Float[np.ndarray, " 3"]
    drives: tuple[int, ...]
    gains: tuple[float, ...]

    @classmethod
    def of(cls, model: Mapping[str, Any], where: str) -> PlainTree:
        """Read `model` of result.json.

        Raises:
            InputError: If it has no frames, because an older jaxid wrote it.
        """
        if "tree" not in model:
            hint = "run identify or discover again"
            raise InputError("holds no frames of the links: an older jaxid wrote it", where=where, hint=hint)
        tree, count = model["tree"], len(model["joints"])
        copies = tree["copies"] or [[k, 1.0] for k in range(count)]
        rotors = rotors_of(model)
        drives = model.get("drives") or {"joints": [*range(1, count + 1)], "gain": [1.0] * count}
        return cls(
            names=tuple(model["joints"]),
            links=tuple(model["links"]),
            parents=tuple(tree["parents"]),
            revolute=tuple(motion == "revolute" for motion in tree["motions"]),
            axes=np.array(tree["axes"]),
            origins=np.array(tree["origins"]),
            leaders=tuple(int(joint) for joint, _ in copies),
            ratios=tuple(float(ratio) for _, ratio in copies),
            bodies=np.stack([np.array(model["parameters"][name]) for name in TEN], axis=-1),
            rotors=np.zeros(count) if rotors is None else rotors,
            gravity=np.array(model["gravity_vector"]),
            drives=tuple(joint - 1 for joint in drives["joints"]),
            gains=tuple(float(gain) for gain in drives["gain"]),
        )

    @property
    def field(self) -> float:
        """Size of the acceleration of gravity [m/s^2]."""
        return float(np.linalg.norm(self.gravity))


def identifier(text: str) -> str:
    """Return a name that C and Python accept."""
    name = re.sub(r"\W", "_", text, flags=re.ASCII) or "robot"
    return f"_{name}" if name[0].isdigit() else name
