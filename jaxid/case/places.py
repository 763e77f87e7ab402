"""Places on which the effects of a case act: joints, springs, shafts, passive angles, tools; from 1."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from jaxid.errors import suggest
from jaxid.names import PLACES
from jaxid.schema import Spot, count, several, whole

if TYPE_CHECKING:
    from jaxid.case.declared import PlantEntry
    from jaxid.model.effect import Effect


# Nouns of places that differ from their keys.
_NOUNS = {"passive": "passive angle"}


def read_ports(
    table: dict[str, Any], cls: type[Effect], plant: PlantEntry, spot: Spot
) -> tuple[tuple[int, ...], str]:
    """Read the ports on which an effect acts, 0-based, and their noun; all that suit, if none is named.

    Raises:
        InputError: If a place does not exist on the plant, or does not go with the effect.
    """
    places = [name for name in PLACES if name in table]
    if len(places) > 1:
        raise spot.fault(f"{' and '.join(places)} exclude each other", f"keep one: {places[0]}")
    _need_suitable_plant(cls, plant, spot)
    joints, springs = plant.cls.bodies(plant.joints), plant.cls.springs(plant.joints)
    if not places:
        return _default_ports(cls, plant)
    [place] = places
    if place == "joint":
        return _joints(table, cls, plant, spot), place

    passives = plant.cls.passives
    number = {
        "spring": springs,
        "shaft": len(plant.options.get("shafts", ())),
        "passive": passives,
        "tool": plant.cls.tools,
    }[place]
    _need_places(table, place, number, plant, spot)
    _need_suitable_effect(table, place, cls, spot)
    # Other ports are numbered from the joints on; tools follow the passive angles.
    before = joints + passives if place == "tool" else joints
    return tuple(before + k for k in _places(table, place, number, spot)), place


def _need_suitable_plant(cls: type[Effect], plant: PlantEntry, spot: Spot) -> None:
    """Refuse an effect that needs springs on a plant without them, or the reverse."""
    springs = plant.cls.springs(plant.joints) > 0
    if cls.with_springs in (None, springs):
        return
    has, hint = (
        ("no springs", "chain or flexible_axis")
        if cls.with_springs
        else ("springs", "axis, or state the spring there")
    )
    raise spot.fault(f"{cls.kind} does not go with a plant that has {has}", f"use a {hint}")


def _need_places(table: dict[str, Any], place: str, number: int, plant: PlantEntry, spot: Spot) -> None:
    """Refuse a kind of place that the plant does not have."""
    if number:
        return
    hint = f"leave {place} out: the effect then acts on the joint"
    if place == "shaft" and plant.cls.linked:
        hint = "add [[plant.shafts]] with the joints that it turns with, or name joints"
    raise spot.at(place).refuse(table[place], f"does not exist on kind = '{plant.cls.kind}'", hint)


def _need_suitable_effect(table: dict[str, Any], place: str, cls: type[Effect], spot: Spot) -> None:
    """Refuse an effect that cannot act on a kind of place other than a joint."""
    given, at = table[place], spot.at(place)
    if place == "spring":
        if not cls.of_spring:
            hint = "name a joint; on springs act the stiffness effects"
            raise at.refuse(given, f"does not go with {cls.kind}", hint)
        return
    if _only_on_drives(cls):
        hint = "name the joint of the drive"
        raise at.refuse(given, f"has no command for {cls.kind} to act on", hint)
    if place == "tool" and not cls.any_direction:
        uniform = "effects that are the same in all directions (added_mass, viscous_friction)"
        hint = f"name a joint; on a tool act {uniform}"
        raise at.refuse(given, f"does not go with {cls.kind}", hint)


def _only_on_drives(cls: type[Effect]) -> bool:
    return cls.in_drive or cls.needs_drive


def _joints(table: dict[str, Any], cls: type[Effect], plant: PlantEntry, spot: Spot) -> tuple[int, ...]:
    """Read the joints on which an effect acts, 0-based, and refuse those without the drive that it needs."""
    joints = plant.cls.bodies(plant.joints)
    chosen = _places(_numbered(table, plant.names, spot), "joint", joints, spot)
    if _only_on_drives(cls) and plant.actuated is not None and not set(chosen) <= set(plant.actuated):
        driven = ", ".join(str(k + 1) for k in plant.actuated)
        what = f"has no drive for {cls.kind} to sit in"
        raise spot.at("joint").refuse(table["joint"], what, f"driven is: {driven}")
    return chosen


def _default_ports(cls: type[Effect], plant: PlantEntry) -> tuple[tuple[int, ...], str]:
    """Return all ports that suit an effect, 0-based, and their noun."""
    joints, springs = plant.cls.bodies(plant.joints), plant.cls.springs(plant.joints)
    if cls.of_spring and springs:
        return tuple(range(joints, joints + springs)), "spring"
    if _only_on_drives(cls) and plant.actuated is not None:
        return plant.actuated, "joint"
    return tuple(range(joints)), "joint"


def _numbered(table: dict[str, Any], names: tuple[str, ...], spot: Spot) -> dict[str, Any]:
    """Return the table with numbers in place of the names that a URDF file gives to the joints.

    Raises:
        InputError: If it names an unknown joint.
    """
    given = table["joint"]
    listed = given if isinstance(given, list) else [given]
    for name in listed:
        if names and isinstance(name, str) and name not in names:
            raise spot.at("joint").refuse(name, "is no joint of the arm", suggest(name, names))
    numbers = [names.index(j) + 1 if names and isinstance(j, str) else j for j in listed]
    return table | {"joint": numbers if isinstance(given, list) else numbers[0] if numbers else given}


def _places(table: dict[str, Any], what: str, there: int, spot: Spot) -> tuple[int, ...]:
    """Read the joints or springs that a table names; return them 0-based."""
    given, place = table[what], spot.at(what)
    several_places = isinstance(given, list)
    named = several(whole(1))(given, place) if several_places else (whole(1)(given, place),)
    check_places(given, named, there, what, place)
    return tuple(k - 1 for k in named)


def check_places(given: Any, named: tuple[int, ...], there: int, what: str, spot: Spot) -> None:
    """Refuse places that do not exist, or are named twice.

    Raises:
        InputError: If a place does not exist or is named twice.
    """
    noun = _NOUNS.get(what, what)
    if max(named) > there:
        fault = f"is out of range: the plant has {count(there, noun)}"
        # Without its place an effect is on the joints, not on the only shaft.
        alone = f"leave {what} out" if what in ("joint", "spring") else f"name {what} 1"
        hint = f"{noun}s count from 1 to {there}" if there > 1 else alone
        raise spot.refuse(given, fault, hint)
    if len(set(named)) < len(named):
        raise spot.refuse(given, f"names a {noun} twice", f"name each {noun} once")
