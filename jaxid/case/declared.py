"""A plant and effects as a case declares them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.case.values import Value
from jaxid.model.units import Units

if TYPE_CHECKING:
    from jaxid.model.effect import Effect
    from jaxid.model.plant import Plant


@dataclass(frozen=True)
class PlantEntry:
    """[plant] of a case.

    Args:
        cls: Its class.
        parameters: One value, or a list, by name.
        units: Labels.
        vertical: Whether weight acts along the axis.
        gravity: Acceleration of gravity [m/s^2]; None: the default of the class.
        joints: Number of joints.
        actuated: Joints that are driven, 0-based, in the order of their drives; None: all.
        options: Further fields of its class: the geometry and the shafts of an arm.
        names: Names of the joints, if a URDF or MJCF file gives them.
        links: Names of the joints that move each link, if a tree's file gives them.
        effects: Effects that such a file states.
        defaults: Tables of the case that such a file states, by name.
        notes: Parts of such a file that the plant does not hold, a sentence each.
        bodies: Ten inertial parameters of each link by such a file; None: there is none.
        rotors: Inertia of each rotor by such a file, as seen at its joint.
    """

    cls: type[Plant]
    parameters: Mapping[str, Value | tuple[Value | tuple[Value, ...], ...]]
    units: Units
    vertical: bool
    gravity: float | None
    joints: int
    actuated: tuple[int, ...] | None = None
    options: dict[str, Any] = field(default_factory=dict)
    names: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    effects: tuple[EffectEntry, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    bodies: np.ndarray | None = field(default=None, compare=False, repr=False)
    rotors: np.ndarray | None = field(default=None, compare=False, repr=False)

    @property
    def drives(self) -> int:
        """Number of drives."""
        return self.joints if self.actuated is None else len(self.actuated)


@dataclass(frozen=True)
class EffectEntry:
    """One of [[effects]].

    Args:
        cls: Its class.
        parameters: By name, one value for each of `ports`.
        ports: Ports that it acts on: joints from 0 on, then springs, shafts, passive angles or tools.
    """

    cls: type[Effect]
    parameters: dict[str, tuple[Value, ...]]
    ports: tuple[int, ...]


def own_effects(
    effects: tuple[EffectEntry, ...], of_file: tuple[EffectEntry, ...]
) -> tuple[EffectEntry, ...]:
    """Return the effects of a file that the case does not declare itself, at the joints where it does not."""
    declared = {(entry.cls.kind, port) for entry in effects for port in entry.ports}
    out = []
    for entry in of_file:
        stay = [k for k, port in enumerate(entry.ports) if (entry.cls.kind, port) not in declared]
        if stay:
            parameters = {n: tuple(values[k] for k in stay) for n, values in entry.parameters.items()}
            out.append(EffectEntry(entry.cls, parameters, tuple(entry.ports[k] for k in stay)))
    return tuple(out)
