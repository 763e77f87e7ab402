"""[[inertial_sensors]] of a case: gyroscopes and accelerometers on links."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from jaxid.case.schema import (
    Key,
    Keys,
    Reader,
    Spot,
    by_joint,
    choice,
    flag,
    number,
    read_table,
    several,
    whole,
)
from jaxid.sensors.inertial import AXES, KINDS


def _vector(value: Any, spot: Spot) -> tuple[float, ...]:
    out = several(number(), shortest=3, longest=3)(value, spot)
    return tuple(out)


def inertial_keys(axes: int) -> Keys:
    """Keys of [[inertial_sensors]], of a sensor that reads so many axes."""
    each: Reader = by_joint(number(), axes, "axis")
    return {
        "kind": Key(choice(KINDS), f"one of {', '.join(KINDS)}", True),
        "link": Key(whole(1), "which it is on, counted from 1", True),
        "noise": Key(number("positive"), "standard deviation of a reading [rad/s or m/s^2]", True),
        "axes": Key(several(choice(AXES), longest=3), "which of its own it reads; default all"),
        "position": Key(_vector, "in the link's frame [m]"),
        "rotation": Key(_vector, "from the link's axes to its own, a rotation vector [rad]"),
        "scale": Key(by_joint(number("positive"), axes, "axis"), "reading over quantity"),
        "bias": Key(each, "reading at nothing"),
        "range": Key(number("positive"), "largest absolute reading"),
        "rate": Key(number("positive"), "readings per second; absent: one a tick"),
        "calibrated": Key(flag, "whether rotation, scale and bias are known to the loop; default true"),
    }


def read_inertial_sensors(tables: Mapping[str, Any], links: int, file: str) -> tuple[dict[str, Any], ...]:
    """Read [[inertial_sensors]], each with the defaults that are not the sensor's own.

    Raises:
        InputError: If the plant has no links, or one states what it cannot have; if there are
            accelerometers and no gyroscope.
    """
    out = []
    for k, table in enumerate(tables.get("inertial_sensors", []), start=1):
        spot = Spot(file, f"[[inertial_sensors]] {k}")
        if not links:
            raise spot.fault("the plant has no links", "leave it out, or take a serial_arm or five_bar")
        axes = table.get("axes", AXES)
        given = read_table(table, inertial_keys(len(axes) if isinstance(axes, list) else 3), spot)
        if given["link"] > links:
            raise spot.at("link").refuse(given["link"], "is not there", f"the plant has {links} links")
        names = given.get("axes", AXES)
        if len(set(names)) < len(names):
            raise spot.at("axes").refuse(list(names), "names an axis twice", "name each once")
        if "position" in given and given["kind"] == "gyroscope":
            hint = "leave it out: a link turns alike everywhere"
            raise spot.at("position").fault("is of an accelerometer", hint)
        out.append({**given, "axes": tuple(AXES.index(a) for a in names)})
    kinds = {s["kind"] for s in out}
    if kinds == {"accelerometer"}:
        hint = "add gyroscopes: what turns also accelerates towards its axis"
        raise Spot(file, "[[inertial_sensors]]").fault("there are accelerometers only", hint)
    return tuple(out)
