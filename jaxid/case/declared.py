"""A plant and effects as a case declares them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaxid.case.values import Value
from jaxid.model.effect import Effect
from jaxid.model.plant import Plant
from jaxid.model.units import Units


@dataclass(frozen=True)
class PlantEntry:
    """[plant] of a case.

    Args:
        cls: Its class.
        parameters: One value, or a list, by name.
        units: Labels.
        vertical: Whether weight acts along the axis.
        gravity: Its acceleration [m/s^2]; None: the class's own.
        joints: How many there are.
        actuated: Joints that are driven, 0-based, in the order of their drives; None: all.
        options: What else its class takes, by field: the geometry and the shafts of an arm.
        names: Of its joints, where these have any: in a URDF file.
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

    @property
    def drives(self) -> int:
        """How many drives there are."""
        return self.joints if self.actuated is None else len(self.actuated)


@dataclass(frozen=True)
class EffectEntry:
    """One of [[effects]].

    Args:
        cls: Its class.
        parameters: By name, one value for each of `ports`.
        ports: Where it acts: joints from 0 on, and behind them springs, shafts, passive angles or tools.
    """

    cls: type[Effect]
    parameters: dict[str, tuple[Value, ...]]
    ports: tuple[int, ...]
