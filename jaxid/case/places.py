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
    driven_only = cls.in_drive or cls.needs_drive
    if len(places) > 1:
        raise spot.fault(f"{' and '.join(places)} exclude each other", f"keep one: {places[0]}")
    parts, springs = plant.cls.bodies(plant.joints), plant.cls.springs(plant.joints)
    if cls.with_springs not in (None, springs > 0):
        has, hint = (
            ("no springs", "chain or flexible_axis")
            if cls.with_springs
            else (
                "springs",
                "axis, or state the spring there",
            )
        )
        raise spot.fault(f"{cls.kind} does not go with a plant that has {has}", f"use a {hint}")
    shafts = len(plant.options.get("shafts", ()))
    passives, tools = plant.cls.passives, plant.cls.tools
    there = {"spring": springs, "shaft": shafts, "passive": passives, "tool": tools}
    for name in (name for name in places if name in there):
        if not there[name]:
            hint = f"leave {name} out: the effect then acts on the joint"
            if name == "shaft" and plant.cls.linked:
                hint = "add [[plant.shafts]] with the joints that it turns with, or name joints"
            what = f"does not exist on kind = '{plant.cls.kind}'"
            raise spot.at(name).refuse(table[name], what, hint)
    if "spring" in table:
        if not cls.of_spring:
            hint = "name a joint; on springs act the stiffness effects"
            raise spot.at("spring").refuse(table["spring"], f"does not go with {cls.kind}", hint)
        chosen = _places(table, "spring", springs, spot)
        return tuple(parts + k for k in chosen), "spring"
    for name, before in (("shaft", parts), ("passive", parts), ("tool", parts + passives)):
        if name not in table:
            continue
        if driven_only:
            what, hint = f"has no command for {cls.kind} to act on", "name the joint of the drive"
            raise spot.at(name).refuse(table[name], what, hint)
        if name == "tool" and not cls.any_direction:
            uniform = "effects that are the same in all directions (added_mass, viscous_friction)"
            hint = f"name a joint; on a tool act {uniform}"
            raise spot.at(name).refuse(table[name], f"does not go with {cls.kind}", hint)
        return tuple(before + k for k in _places(table, name, there[name], spot)), name
    if "joint" in table:
        chosen = _places(_numbered(table, plant.names, spot), "joint", parts, spot)
        actuated = range(plant.joints) if plant.actuated is None else plant.actuated
        undriven = plant.actuated is not None and not set(chosen) <= set(actuated)
        if driven_only and undriven:
            driven = ", ".join(str(k + 1) for k in actuated)
            what = f"has no drive for {cls.kind} to sit in"
            raise spot.at("joint").refuse(table["joint"], what, f"driven is: {driven}")
        return chosen, "joint"
    if cls.of_spring and springs:
        return tuple(range(parts, parts + springs)), "spring"
    if driven_only and plant.actuated is not None:
        return plant.actuated, "joint"
    return tuple(range(parts)), "joint"


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
