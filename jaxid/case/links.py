"""The links of an arm, from the base to the tip: [[plant.links]] of a case, or a URDF file that it names."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from jaxid.case.kinds import Kinds
from jaxid.case.places import check_places
from jaxid.case.values import Value, read_values, value_reader, value_schema, values_schema
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.names import JOINTS, TEN
from jaxid.schema import (
    Key,
    Keys,
    Reader,
    Spot,
    anything,
    choice,
    either,
    is_list,
    list_of,
    number,
    read_table,
    several,
    text,
    whole,
)

if TYPE_CHECKING:
    from jaxid.case.urdf import Urdf
    from jaxid.model.plant import Plant
    from jaxid.plants.geometry import Geometry

# Chosen: more links than any arm has, and most robots.
MOST_LINKS = 50
# Entries of a list of the case, by the plant's parameters that they are.
_LISTS = {"first_moment": TEN[1:4], "inertia": TEN[4:]}
# Angles, which may be in degrees: a right angle in rad has no end.
_ANGLES = ("alpha", "theta")

# Keys of [[plant.shafts]].
SHAFT: Keys = {
    "joints": Key(several(whole(1), shortest=2), "joints that it turns with, from 1", True),
    "ratios": Key(several(number()), "turns of the shaft for one of each joint", note="1 each"),
}
# A sine of an angle of a URDF file below this counts as zero: such files state a right angle as 1.5708.
ANGLE = 1e-4
# Choices of the parameters of a URDF file that are unknown.
UNKNOWN = ("none", "base", "all")
# Keys of [plant] that only an arm has.
LINKED: Keys = {
    "links": Key(anything, "a table [[plant.links]] for each link"),
    "urdf": Key(text, "file that describes the arm, relative to the case"),
    "tip": Key(text, "name of its last link in that file"),
    "unknown": Key(choice(UNKNOWN), "which parameters of its links are unknown", default="none"),
    "shafts": Key(anything, "a table [[plant.shafts]] for each"),
    "gravity_vector": Key(
        several(number(), shortest=3, longest=3), "gravity in the frame of the base", unit="m/s^2"
    ),
}


def check_links(table: dict[str, Any], spot: Spot) -> None:
    """Refuse a [plant] without links.

    Raises:
        InputError: If there are no links, or one of them is not a table.
    """
    links = table.get("links")
    if links is None:
        hint = 'add a table [[plant.links]] for each, from the base to the tip, or urdf = "<its file>"'
        raise spot.fault("'links' is missing", hint)
    if not isinstance(links, list) or not all(isinstance(link, dict) for link in links):
        raise spot.at("links").fault("is not a list of tables", "write [[plant.links]], in double brackets")
    if not 1 <= len(links) <= MOST_LINKS:
        raise spot.at("links").fault(f"has {len(links)} entries", f"an arm has 1 to {MOST_LINKS}")


def read_links(
    links: list[dict[str, Any]], cls: type[Plant], root: Spot, kinds: Kinds
) -> tuple[dict[str, tuple[Value, ...]], Geometry]:
    """Read the inertial parameters of the links by name, one value a link, and their geometry.

    Raises:
        InputError: If a link has a key or value that it cannot have, or lacks one.
    """
    rows, parameters = [], {}
    for k, link in enumerate(links, start=1):
        spot = root.under(f"[[plant.links]] {k}")
        given = read_table(_in_rad(link, spot), link_keys(cls), spot)
        rows.append([given["joint"], *(given.get(name, 0.0) for name in ("alpha", "a", "d", "theta"))])
        for name, values in given.items():
            if name in _LISTS:
                for part, value in zip(_LISTS[name], values, strict=True):
                    parameters.setdefault(part, []).append(value)
            elif isinstance(values, Value):
                parameters.setdefault(name, []).append(values)
        if any("rotor_inertia" in other for other in links) and "rotor_inertia" not in given:
            parameters.setdefault("rotor_inertia", []).append(Value(0.0))
    return {name: tuple(values) for name, values in parameters.items()}, kinds.geometry(rows)


def read_links_of_urdf(
    given: dict[str, Any], cls: type[Plant], spot: Spot, kinds: Kinds
) -> tuple[dict[str, tuple[Value, ...]], Urdf]:
    """Read the parameters of the links from the URDF file that [plant] names.

    Returns:
        The parameters by name, one value a link, and the contents of the file.

    Raises:
        InputError: If [plant] describes the links as well, or the file does not describe an arm.
        NeedsClassesError: If the kinds are stand-ins.
    """
    if "links" in given:
        raise spot.fault("both urdf and [[plant.links]] are given", "keep one of them")
    kinds.need_classes()
    import numpy as np

    from jaxid.arms.base_by_rules import base_parameters_by_rules
    from jaxid.case.urdf import read_urdf
    from jaxid.plants.serial_arm import SerialArm

    arm = read_urdf(spot.folder / given["urdf"], given.get("tip"))
    if len(arm.names) > MOST_LINKS:
        raise spot.at("urdf").fault(f"has {len(arm.names)} joints", f"an arm has 1 to {MOST_LINKS}")
    unknown = given.get("unknown", "none")
    values = dict(zip(TEN, arm.bodies.T, strict=True))
    free = {name: np.full(len(arm.names), unknown == "all") for name in TEN}
    if unknown == "base":
        weight = {name: given[name] for name in ("gravity_vector",) if name in given}
        assert issubclass(cls, SerialArm), "no other plant has links"
        plant = cls(**values, geometry=arm.geometry, **weight)
        if not np.any(np.asarray(plant.gravity_vector)):
            hint = 'state a gravity_vector other than zero, or unknown = "all"'
            raise spot.at("unknown").refuse("base", "needs weight", hint)
        base = base_parameters_by_rules(plant, ANGLE)
        values = {name: np.zeros(len(arm.names)) for name in TEN}
        for (name, k), value in zip(base.places, base.of(plant), strict=True):
            values[name][k], free[name][k] = value, True
    return {
        name: tuple(Value(float(v), bool(f)) for v, f in zip(values[name], free[name], strict=True))
        for name in TEN
    }, arm


def read_shafts(shafts: Any, geometry: Geometry, spot: Spot) -> tuple[tuple[float, ...], ...]:
    """Read [[plant.shafts]]: the ratio of each shaft to every joint.

    Raises:
        InputError: If a shaft names joints that do not exist, or both revolute and prismatic ones.
    """
    if not isinstance(shafts, list) or not all(isinstance(shaft, dict) for shaft in shafts):
        raise spot.at("shafts").fault("is not a list of tables", "write [[plant.shafts]], in double brackets")
    joints, out = len(geometry.joints), []
    for k, shaft in enumerate(shafts, start=1):
        at = spot.under(f"[[plant.shafts]] {k}")
        given = read_table(shaft, SHAFT, at)
        named = given["joints"]
        check_places(shaft["joints"], named, joints, "joint", at.at("joints"))
        if len({geometry.joints[j - 1] for j in named}) > 1:
            raise at.at("joints").refuse(
                shaft["joints"],
                "names joints that turn and joints that slide",
                "a shaft goes with joints of one kind",
            )
        ratios = given.get("ratios", (1.0,) * len(named))
        if len(ratios) != len(named) or 0.0 in ratios:
            raise at.at("ratios").refuse(
                shaft["ratios"],
                f"does not go with {len(named)} joints",
                "give a ratio other than zero for each",
            )
        row = dict(zip(named, ratios, strict=True))
        out.append(tuple(float(row.get(j + 1, 0.0)) for j in range(joints)))
    return tuple(out)


def link_keys(cls: type[Plant]) -> Keys:
    """Return the keys of one of [[plant.links]]."""
    infos = parameters_of(cls)
    value = "a number, or { guess = ... }"
    keys = {
        "joint": Key(choice(JOINTS), '"revolute" or "prismatic"', True),
        "alpha": Key(number(), "twist from the previous axis to this one, or alpha_deg", True, "rad"),
        "a": Key(number(), "distance from the previous axis to this one", True, "m"),
        "d": Key(number(), "offset along the axis", unit="m"),
        "theta": Key(number(), "angle about the axis, or theta_deg", unit="rad"),
    }
    for name in ("mass", "first_moment", "inertia", "rotor_inertia"):
        parts = _LISTS.get(name, (name,))
        info = infos[parts[0]]
        if name in _LISTS:
            axes = ", ".join(part.rpartition("_")[2] for part in parts)
            read, doc = _listed(info, parts), f"the list {axes}; each {value}"
        else:
            read, doc = value_reader(info), f"{info.doc}; {value}"
        keys[name] = Key(read, doc, not info.optional)
    return keys


def _listed(info: ParameterInfo, parts: tuple[str, ...]) -> Reader:
    """Return the reader of a list with an entry for each axis, or pair of axes."""

    def read(value: Any, spot: Spot) -> tuple[Value, ...]:
        inner = isinstance(value, dict) and any(is_list(v) for v in value.values())
        if not is_list(value) and not inner:
            axes = ", ".join(part.rpartition("_")[2] for part in parts)
            raise spot.refuse(value, "is not a list", f"give {len(parts)} entries: {axes}")
        return read_values(value, info, len(parts), spot, "component")

    table = values_schema(info)["anyOf"][1]
    return Reader(read, either(list_of(value_schema(info), len(parts), len(parts)), table))


def _in_rad(link: dict[str, Any], spot: Spot) -> dict[str, Any]:
    """Return the table with its angles in rad."""
    out = dict(link)
    for name in _ANGLES:
        degrees = f"{name}_deg"
        if degrees in link:
            if name in link:
                raise spot.fault(f"both {name} and {degrees} are given", "keep one of them")
            out[name] = math.radians(number()(out.pop(degrees), spot.at(degrees)))
    return out
