"""[[inertial_sensors]] of a case: gyroscopes and accelerometers on links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from jaxid.names import AXES
from jaxid.schema import Counts, Spot, is_list, read_settings
from jaxid.settings import InertialSensor


def read_inertial_sensors(tables: Mapping[str, Any], links: int, root: Spot) -> tuple[InertialSensor, ...]:
    """Read [[inertial_sensors]].

    Args:
        tables: Tables of the case.
        links: Number of links of the plant.
        root: Position of the case.

    Raises:
        InputError: If the plant has no links, a sensor has a key or value that it cannot have, or there
            are accelerometers and no gyroscope.
    """
    out: list[InertialSensor] = []
    for k, table in enumerate(tables.get("inertial_sensors", []), start=1):
        spot = root.under(f"[[inertial_sensors]] {k}")
        if not links:
            raise spot.fault("the plant has no links", "leave it out, or take a serial_arm or five_bar")

        # Lists of scale and bias have one entry for each axis that the sensor reads.
        axes = table.get("axes", AXES)
        counts = Counts(len(axes) if is_list(axes) else len(AXES))
        sensor = read_settings(InertialSensor, table, replace(spot, counts=counts))
        if sensor.link > links:
            raise spot.at("link").refuse(sensor.link, "does not exist", f"the plant has {links} links")
        if len(set(sensor.axes)) < len(sensor.axes):
            raise spot.at("axes").refuse(sensor.axes, "names an axis twice", "name each once")
        if sensor.position is not None and sensor.kind == "gyroscope":
            hint = "leave it out: the angular velocity is that of the whole link"
            raise spot.at("position").fault("is a key of accelerometers", hint)
        out.append(sensor)
    if {s.kind for s in out} == {"accelerometer"}:
        hint = "add gyroscopes: a rotating link also accelerates towards its axis"
        raise root.under("[[inertial_sensors]]").fault("there are accelerometers only", hint)
    return tuple(out)
