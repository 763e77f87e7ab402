"""The plant and the effects of a case, read against the classes that they name."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxid.effects import EFFECTS
from jaxid.errors import InputError
from jaxid.io.case_tables import PLANNED_EFFECTS, PLANNED_PLANTS, PLANT
from jaxid.io.case_values import Value, read_value, read_values
from jaxid.io.schema import (
    Key,
    Spot,
    choice,
    count,
    flag,
    nearest,
    read_table,
    several,
    text,
    whole,
)
from jaxid.io.user_effect import user_effect
from jaxid.model import Effect, Plant, parameters_of
from jaxid.plants import PLANTS
from jaxid.units import Units


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
    """

    cls: type[Plant]
    parameters: dict[str, Value | tuple[Value, ...]]
    units: Units
    vertical: bool
    gravity: float | None
    joints: int


@dataclass(frozen=True)
class EffectEntry:
    """One of [[effects]].

    Args:
        cls: Its class.
        parameters: By name, one value for each of `joints`.
        joints: On which joints it acts, 1-based.
    """

    cls: type[Effect]
    parameters: dict[str, tuple[Value, ...]]
    joints: tuple[int, ...]


def read_kind(table: dict[str, Any], known: Any, planned: tuple[str, ...], spot: Spot) -> str:
    """The kind that a table names.

    Raises:
        InputError: If it is missing, unknown or not available yet.
    """
    if "kind" not in table:
        raise spot.fault("'kind' is missing", f'add kind = "..."; there is: {", ".join(known)}')
    return choice(known, planned)(table["kind"], spot.at("kind"))


def read_plant(table: dict[str, Any], file: str) -> PlantEntry:
    """Read [plant].

    Raises:
        InputError: If it states what the plant cannot have, or not what it must.
    """
    spot = Spot(file, "[plant]")
    cls = PLANTS[read_kind(table, PLANTS, PLANNED_PLANTS, spot)]
    # Only plants of several joints say how many they have.
    joints = getattr(cls, "joints", 1)
    keys = {"kind": Key(lambda value, spot: value), **PLANT}
    keys["parameters"] = Key(lambda v, s: _plant_parameters(v, cls, joints, file))
    given = read_table(table, keys, spot)
    if "parameters" not in given:
        needed = ", ".join(f"{name} = {{ guess = ... }}" for name in parameters_of(cls))
        raise spot.fault("'parameters' is missing", f"add [plant.parameters] with {needed}")
    motion = given.get("motion", "linear")
    vertical = given.get("orientation") == "vertical"
    if vertical and motion == "rotary":
        mend = 'leave orientation out, or set motion = "linear"; an unbalanced load is an effect'
        raise spot.at("orientation").refuse("vertical", "does not go with a rotary plant", mend)
    units = Units(motion, **given.get("units", {}))
    return PlantEntry(cls, given["parameters"], units, vertical, given.get("gravity"), joints)


def _plant_parameters(
    table: Any, cls: type[Plant], joints: int, file: str
) -> dict[str, Value | tuple[Value, ...]]:
    def reader(info: Any) -> Any:
        def read(value: Any, spot: Spot) -> Value | tuple[Value, ...]:
            if isinstance(value, list) and joints > 1:
                return read_values(value, info, joints, spot)
            return read_value(value, info, spot)

        return read

    keys = {
        name: Key(reader(info), f"{info.doc}; a number, or {{ guess = ... }}", not info.optional)
        for name, info in parameters_of(cls).items()
    }
    return read_table(table, keys, Spot(file, "[plant.parameters]"))


def read_effects(tables: list, plant: PlantEntry, path: Path) -> tuple[EffectEntry, ...]:
    """Read [[effects]], in the order of the drive.

    Raises:
        InputError: If one is unknown, or states what it cannot have, or not what it must.
    """
    return tuple(_effect(table, k, plant, path) for k, table in enumerate(tables, start=1))


def _effect(table: dict[str, Any], index: int, plant: PlantEntry, path: Path) -> EffectEntry:
    spot = Spot(str(path), f"[[effects]] {index}")
    if ":" in str(table.get("kind", "")) or str(table.get("kind", "")).endswith(".py"):
        cls = user_effect(str(table["kind"]), path.parent, spot.at("kind"))
    else:
        cls = EFFECTS[read_kind(table, EFFECTS, PLANNED_EFFECTS, spot)]
    spot = Spot(str(path), f"[[effects]] {index} ({cls.kind})")
    infos = parameters_of(cls)
    _check_keys(table, list(infos), spot)
    joints = _joints(table, plant, spot)
    if "shared" in table and flag(table["shared"], spot.at("shared")) and len(joints) > 1:
        mend = "leave it out: each joint then has a value of its own"
        raise spot.at("shared").refuse(True, "is not available in this version", mend)
    for name, info in infos.items():
        if not info.optional and name not in table:
            raise spot.fault(f"'{name}' is missing", f"add {name}: {info.doc}; {_takes(cls)}")
    parameters = {
        name: read_values(table[name], info, len(joints), spot.at(name))
        for name, info in infos.items()
        if name in table
    }
    _check_together(cls, parameters, spot)
    return EffectEntry(cls, parameters, joints)


def read_candidates(table: Any, path: Path) -> tuple[type[Effect], ...]:
    """Read [discover]: the user's own effects that a search may name.

    Raises:
        InputError: If one is no class of a file.
    """
    def own(value: Any, spot: Spot) -> type[Effect]:
        kind = text(value, spot)
        if kind in EFFECTS:
            raise spot.refuse(kind, "takes part in every search", "leave it out")
        return user_effect(kind, path.parent, spot)

    keys = {"candidates": Key(several(own), 'a list such as ["my_effects.py:MyEffect"]')}
    return read_table(table, keys, Spot(str(path), "[discover]")).get("candidates", ())


def check_kinds(classes: Iterable[type[Effect]], file: str) -> None:
    """Refuse two own effects of one kind: results go by kind.

    Raises:
        InputError: If there are.
    """
    known: dict[str, type[Effect]] = {}
    for cls in classes:
        if known.setdefault(cls.kind, cls) is not cls:
            mend = "give one of them another kind"
            raise Spot(file).fault(f"two effects of your own are of kind '{cls.kind}'", mend)


def _check_keys(table: dict[str, Any], names: list[str], spot: Spot) -> None:
    known = [*names, "kind", "joint", "spring", "passive", "shared"]
    for name in table:
        if name not in known:
            raise spot.fault(f"unknown key '{name}'", nearest(name, known, table))


def _takes(cls: type[Effect]) -> str:
    names = [n + (" (optional)" if i.optional else "") for n, i in parameters_of(cls).items()]
    return f"it takes {', '.join(names)}"


def _joints(table: dict[str, Any], plant: PlantEntry, spot: Spot) -> tuple[int, ...]:
    """Joints on which an effect acts, 1-based: all where none is named."""
    places = [name for name in ("joint", "spring", "passive") if name in table]
    if len(places) > 1:
        raise spot.fault(f"{' and '.join(places)} exclude each other", f"keep one: {places[0]}")
    for name in ("spring", "passive"):
        if name in table:
            mend = f"leave {name} out: the effect then acts on the joint"
            what = f"does not exist on kind = '{plant.cls.kind}'"
            raise spot.at(name).refuse(table[name], what, mend)
    if "joint" not in table:
        return tuple(range(1, plant.joints + 1))
    given, place = table["joint"], spot.at("joint")
    several_joints = isinstance(given, list)
    joints = several(whole(1))(given, place) if several_joints else (whole(1)(given, place),)
    if max(joints) > plant.joints:
        what = f"is out of range: the plant has {count(plant.joints, 'joint')}"
        mend = f"joints count from 1 to {plant.joints}" if plant.joints > 1 else "leave joint out"
        raise place.refuse(given, what, mend)
    if len(set(joints)) < len(joints):
        raise place.refuse(given, "names a joint twice", "name each joint once")
    return joints


def _check_together(
    cls: type[Effect], parameters: dict[str, tuple[Value, ...]], spot: Spot
) -> None:
    """Let the class judge which optional parameters go together."""
    try:
        cls(**{name: values[0].guess for name, values in parameters.items()})
    except (ValueError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise spot.fault(str(error).rstrip("."), _takes(cls)) from error
