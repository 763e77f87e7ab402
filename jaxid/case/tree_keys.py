"""Keys of [plant] of a tree, which are checked before its file is read and without JAX."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxid.schema import (
    Key,
    Keys,
    Reader,
    Spot,
    anything,
    choice,
    either,
    flag,
    is_list,
    list_of,
    number,
    read_table,
    several,
    text,
)

# Kind of the plant whose keys these are.
TREE_KIND = "tree"
# Parameters of links that may be unknown, and further words for values that a file states of its joints.
LINKS_UNKNOWN = ("base", "all")
JOINTS_UNKNOWN = ("armature", "damping", "frictionloss", "stiffness")
# The same for values of its actuators.
DRIVES_UNKNOWN = ("kp", "kv", "forcerange", "delay")
UNKNOWN = ("none", *LINKS_UNKNOWN, *JOINTS_UNKNOWN, *DRIVES_UNKNOWN)


def _unknown_reader() -> Reader:
    one = choice(UNKNOWN)

    def read(value: Any, spot: Spot) -> tuple[str, ...]:
        words = several(one)(value, spot) if is_list(value) else (one(value, spot),)
        if "base" in words and "all" in words:
            raise spot.fault("has base and all", "keep one of them")
        return tuple(word for word in words if word != "none")

    return Reader(read, either(one.schema, list_of(one.schema)))


def _by_name(inner: Reader) -> Reader:
    """Return the reader of a table with an entry for some joints."""

    def read(value: Any, spot: Spot) -> dict[str, Any]:
        if not isinstance(value, Mapping):
            raise spot.refuse(value, "is not a table", f"write {{ <joint> = ... }}: {spot.key}")
        return {name: inner(entry, spot.inside(name)) for name, entry in value.items()}

    return Reader(read, {"type": "object", "additionalProperties": inner.schema})


def _ratios_reader() -> Reader:
    """Return the reader of one ratio for all joints, or of a table by joint."""
    table = _by_name(number("nonzero"))

    def read(value: Any, spot: Spot) -> float | dict[str, float]:
        return table(value, spot) if isinstance(value, Mapping) else number("nonzero")(value, spot)

    return Reader(read, either(number("nonzero").schema, table.schema))


# Keys of [plant] that only a tree has.
TREE: Keys = {
    "urdf": Key(text, "URDF file that describes the robot, relative to the case"),
    "mjcf": Key(text, "MJCF file that describes the robot, relative to the case"),
    "joints": Key(several(text), "names of the joints that move, in the order of the file", note="all"),
    "held": Key(_by_name(number()), "positions of joints that are held", unit="position", note="zero"),
    "unknown": Key(
        _unknown_reader(),
        "values of the file that are unknown: of its links (base, all), its joints, and its actuators",
        default=(),
        note="none",
    ),
    "gear_ratio": Key(
        _ratios_reader(),
        "turns of each motor for one of its joint; rotor_inertia is then that of the motor",
        note="rotor_inertia is seen at the joint",
    ),
    "actuated": Key(
        several(text), "names of the driven joints, in the order of the force columns", note="as in the file"
    ),
    "actuators": Key(
        flag, "whether gains, drag, limits and servos of an MJCF's actuators are taken over", default=True
    ),
    "shafts": Key(anything, "a table [[plant.shafts]] for each"),
    "gravity_vector": Key(
        several(number(), shortest=3, longest=3),
        "gravity in the frame of the base",
        unit="m/s^2",
        note="as in the file",
    ),
    "payload_at": Key(
        _by_name(several(number(), shortest=3, longest=3)),
        "point at which a link or body of the file carries a payload, in that link's frame",
        unit="m",
        note="no payload",
    ),
    "parameters": Key(anything, "values in place of the file's, by joint: mass = { elbow = 2.0 }"),
}


def read_tree_keys(table: dict[str, Any], keys: Keys, spot: Spot) -> dict[str, Any]:
    """Read the keys of [plant] of a tree; `keys` are those of every plant.

    Raises:
        InputError: If a key is unknown or its value impossible, or not one file is named.
    """
    general = {name: key for name, key in keys.items() if name not in ("orientation", "gravity")}
    given = read_table(table, {**general, **TREE}, spot)
    files = [name for name in ("urdf", "mjcf") if name in given]
    if len(files) != 1:
        what = "both urdf and mjcf are given" if files else "'urdf' or 'mjcf' is missing"
        raise spot.fault(what, "keep one of them" if files else 'add urdf = "<its file>", or mjcf')
    return given
