"""Drives by their torque constant, gear, screw and winding: force for a command, and damping by back-EMF."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxid.errors import InputError
from jaxid.logs.units import command_kind
from jaxid.settings import Actuator, LogTable

if TYPE_CHECKING:
    from jaxtyping import Float

# Keys that only a drive with a torque constant uses for its force.
_OF_MOTOR = ("resistance", "back_emf", "efficiency")


@dataclass(frozen=True)
class Drives:
    """The drives of a machine.

    Attributes:
        gain: Force at the joint per unit of the command, by drive.
        damping: Force per velocity that the back-EMF takes off, by drive; zero for a drive of known current.
        command: Unit of the command, "A" or "V"; empty: as it is logged.
    """

    gain: Float[np.ndarray, " drives"]
    damping: Float[np.ndarray, " drives"]
    command: str


def drives_of(actuator: Actuator, log: LogTable | None, motions: Sequence[str], where: str) -> Drives:
    """Return the drives of a case.

    A motor of torque constant k_t behind a gear of N turns gives N eta k_t i at a joint that turns, and
    2 pi / lead times that at one that slides. With the voltage v logged, i = (v - k_e w) / R, and w is the
    speed of the motor.

    Args:
        actuator: Table [actuator].
        log: Table [log], for the unit of the force; None: the command is the current.
        motions: "linear" or "rotary", by drive.
        where: The case, for messages.

    Raises:
        InputError: If a value that the force depends on is missing.

    Source:
        The equations of a permanent-magnet DC motor without inductance.
    """
    count = len(motions)

    def value(name: str, default: float) -> np.ndarray:
        given = getattr(actuator, name)
        return np.broadcast_to(np.asarray(default if given is None else given, dtype=np.float64), (count,))

    where = f"{where}, [actuator]"
    if actuator.torque_constant is None:
        unused = [name for name in _OF_MOTOR if getattr(actuator, name) is not None]
        if unused:
            hint = "add torque_constant, or leave it out and state gain"
            raise InputError(f"{unused[0]} goes with torque_constant", where=where, hint=hint)
        return Drives(value("gain", 1.0).copy(), np.zeros(count), "")
    kind = command_kind(None if log is None else log.units, actuator) or "current"
    if kind not in ("current", "voltage"):
        hint = "leave torque_constant out, and state gain"
        raise InputError(
            "torque_constant goes with a current, a voltage or a duty cycle", where=where, hint=hint
        )
    turns = value("gear_ratio", 1.0).copy()
    for k, motion in enumerate(motions):
        if motion != "linear":
            continue
        if actuator.lead is None:
            hint = "add lead [m/rev], 2 pi times the radius of a pinion or pulley"
            raise InputError("a drive of a sliding joint needs lead", where=where, hint=hint)
        turns[k] *= 2 * math.pi / value("lead", 1.0)[k]
    gain = value("torque_constant", 1.0) * turns * value("efficiency", 1.0)
    if kind == "current":
        return Drives(gain, np.zeros(count), "A")
    if actuator.resistance is None:
        hint = "add resistance [ohm], or log the current"
        raise InputError("a drive whose voltage is logged needs resistance", where=where, hint=hint)
    gain = gain / value("resistance", 1.0)
    constant = actuator.torque_constant if actuator.back_emf is None else actuator.back_emf
    return Drives(gain, gain * np.asarray(constant) * turns, "V")
