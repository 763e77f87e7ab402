"""Actuators of a corrected MJCF: gains of position servos, force ranges, delays and gears."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxid.case.robot import Robot, RobotDrive
from jaxid.export.exported import shown
from jaxid.export.xml_text import Element, XmlText

# Relative change below which a value of the file stays as it is written.
_SAME = 1e-12
_SLOPE_OF_ERROR = "kd acts on the slope of the error, and kv of a position servo on the velocity alone"
# Effects of drives that are written here.
DRIVE_EFFECTS = ("back_emf_damping", "saturation", "actuator_lag", "input_delay", "actuator_gain")


@dataclass
class DriveText:
    """The actuators of one text.

    Args:
        text: The text.
        compiled: Its compiled model.
        robot: Its kept joints and their drives.
        model: `model` of the result.
        joints: Elements of all joints, by their index in the compiled model.
        autolimits: Whether a range by itself limits.
        notes: Sentences on what it cannot hold; lost: numbers of such effects; changed: names of actuators.
        damping: What belongs to the damping of each joint besides, by name.
    """

    text: XmlText
    compiled: Any
    robot: Robot
    model: Mapping[str, Any]
    joints: Mapping[int, Element]
    autolimits: bool
    notes: list[str] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    damping: dict[str, float] = field(default_factory=dict)

    def write(self) -> None:
        """Write all that differs from the file."""
        elements = self._elements()
        drives = {drive.joint: drive for drive in self.robot.drives}
        limits, delays, factors = {}, {}, {}
        for number, effect in enumerate(self.model["effects"]):
            kind, values = effect["kind"], effect["parameters"]
            if kind not in DRIVE_EFFECTS:
                continue
            name = effect.get("joint_name", "")
            drive = drives.get(name)
            if kind == "back_emf_damping":
                own = 0.0 if drive is None else drive.drag
                self.damping[name] = self.damping.get(name, -own) + float(values["coefficient"])
            elif drive is None or name not in elements:
                self._lose(number, "has no place: the file has no actuator for that joint")
            elif kind == "actuator_lag":
                if not _same(float(values["time_constant"]), drive.lag):
                    self._lose(number, "has no place in an actuator of an MJCF that is none of filter")
            elif kind == "saturation":
                limits[name] = float(values["limit"])
            elif kind == "input_delay":
                delays[name] = delays.get(name, 0.0) + float(values["delay"])
            elif not self._scale(elements[name], drive, float(values["gain"]), factors):
                self._lose(number, "has no place in an actuator that is no motor")
        self._servos(drives, elements, limits, delays)
        for name, limit in limits.items():
            self._limit(elements[name], drives[name], limit, factors.get(name, 1.0))
        for name, delay in delays.items():
            self._delay(elements[name], delay)

    def _elements(self) -> dict[str, tuple[int, Element]]:
        """Return index and element of the actuator of each driven joint; empty if the text has other ones."""
        listed = [e for part in self.text.root.children if part.tag == "actuator" for e in part.children]
        count = len(self.compiled.actuator_trntype)
        names = [self.compiled.actuator(k).name for k in range(count)]
        if [e.attributes.get("name", "") for e in listed] != names:
            return {}
        index = {name or f"actuator{k + 1}": k for k, name in enumerate(names)}
        return {drive.joint: (index[drive.name], listed[index[drive.name]]) for drive in self.robot.drives}

    def _lose(self, number: int, why: str) -> None:
        self.notes.append(f"{shown(self.model['effects'][number])} {why}")
        self.lost.append(number)

    def _set(self, place: tuple[int, Element], values: Mapping[str, str | None]) -> None:
        index, element = place
        self.text.set(element, values)
        name = f"actuator '{self.compiled.actuator(index).name or index + 1}'"
        if name not in self.changed:
            self.changed.append(name)

    def _scale(
        self, place: tuple[int, Element], drive: RobotDrive, gain: float, factors: dict[str, float]
    ) -> bool:
        """Multiply the gear of a plain motor; return whether the actuator is one."""
        index, element = place
        compiled = self.compiled
        beside = compiled.actuator_armature[index] or np.any(compiled.actuator_damping[index])
        if element.tag != "motor" or beside or drive.lag:
            return _same(gain, 1.0)
        if not _same(gain, 1.0):
            factors[drive.joint] = gain
            gear = compiled.actuator_gear[index] * [gain, 1, 1, 1, 1, 1]
            shortest = gear if np.any(gear[1:]) else gear[:1]
            self._set(place, {"gear": " ".join(repr(float(g)) for g in shortest)})
        return True

    def _servos(
        self,
        drives: Mapping[str, RobotDrive],
        elements: Mapping[str, tuple[int, Element]],
        limits: dict[str, float],
        delays: dict[str, float],
    ) -> None:
        """Write the gains of position servos, and take over limit and delay of their law."""
        given = self.model.get("drives") or {}
        law = given.get("controller")
        if law is None or law["kind"] not in ("pd", "cascade_pd"):
            return
        names = [self.model["joints"][joint - 1] for joint in given["joints"]]
        servos = [name for name in names if name in drives and drives[name].kp is not None]
        if len(servos) < len(names) or not set(names) <= set(elements):
            return
        gain, count = np.array(given["gain"]), len(names)

        def of_law(key: str) -> np.ndarray:
            return np.broadcast_to(np.asarray(law[key], dtype=float), (count,))

        kp, kd = _servo_gains(given)
        if _of_the_error(law) and np.any(kd):
            self.notes.append(f"controller: {_SLOPE_OF_ERROR}")
        for name, stiffness, damping in zip(names, kp.tolist(), kd.tolist(), strict=True):
            self._gains(elements[name], drives[name], stiffness, damping)
        if law.get("limit") is not None:
            limits |= dict(zip(names, (np.abs(gain) * of_law("limit")).tolist(), strict=True))
        if law.get("delay") is not None:
            delays |= dict(zip(names, of_law("delay").tolist(), strict=True))

    def _gains(self, place: tuple[int, Element], drive: RobotDrive, kp: float, kd: float) -> None:
        index, element = place
        if _same(kp, drive.kp or 0.0) and _same(kd, drive.kd or 0.0):
            return
        if element.tag == "position":
            self._set(place, {"kp": repr(kp), "kv": repr(kd), "dampratio": None})
            return
        more = [float(x) for x in np.trim_zeros(self.compiled.actuator_biasprm[index][3:], "b")]
        bias = [float(self.compiled.actuator_biasprm[index][0]), -kp, -kd, *more]
        self._set(place, {"gainprm": repr(kp), "biasprm": " ".join(map(repr, bias))})

    def _limit(self, place: tuple[int, Element], drive: RobotDrive, limit: float, factor: float) -> None:
        """Write a force range, and widen that of the joint if it is narrower."""
        index, compiled = place[0], self.compiled
        if drive.limit is not None and _same(limit, drive.limit):
            return
        at_actuator = limit / abs(float(compiled.actuator_gear[index][0]) * factor)
        limited = (
            {} if self.autolimits and "forcelimited" not in place[1].attributes else {"forcelimited": "true"}
        )
        self._set(place, {"forcerange": f"{-at_actuator!r} {at_actuator!r}", **limited})
        joint = int(compiled.actuator_trnid[index, 0])
        if compiled.jnt_actfrclimited[joint] and compiled.jnt_actfrcrange[joint, 1] < limit:
            self.text.set(self.joints[joint], {"actuatorfrcrange": f"{-limit!r} {limit!r}"})

    def _delay(self, place: tuple[int, Element], delay: float) -> None:
        """Write a delay, with a memory that is long enough for it, and lines between its samples."""
        index, compiled = place[0], self.compiled
        if _same(delay, float(compiled.actuator_delay[index])):
            return
        needed = math.ceil(delay / float(compiled.opt.timestep)) + 2
        values = {"delay": repr(delay)}
        if int(compiled.actuator_history[index, 0]) < needed:
            values["nsample"] = str(needed)
        if delay > 0 and int(compiled.actuator_history[index, 1]) == 0:
            values["interp"] = "linear"
        self._set(place, values)


def servo_words(model: Mapping[str, Any]) -> list[str]:
    """Return sentences on the position servos that stand for the loop of a result.

    Args:
        model: `model` of result.json.

    Returns:
        The servos as elements of an MJCF, with all that these do not hold; empty if its law is no such servo.
    """
    given = model.get("drives") or {}
    law = given.get("controller")
    if law is None or law["kind"] not in ("pd", "cascade_pd"):
        return []
    names = [model["joints"][joint - 1] for joint in given["joints"]]
    kp, kd = _servo_gains(given)
    elements = [
        f'<position joint="{name}" kp="{stiffness:.6g}" kv="{damping:.6g}"/>'
        for name, stiffness, damping in zip(names, kp.tolist(), kd.tolist(), strict=True)
    ]
    lines = [f"the loop, for which the file has no position servos; add {' '.join(elements)}"]
    if law.get("delay") is not None:
        delays = np.broadcast_to(np.asarray(law["delay"], dtype=float), kp.shape)
        listed = ", ".join(f"{1e3 * delay:.3g} ms" for delay in delays.tolist())
        lines.append(f"the delay of the command of each servo: {listed}")
    if _of_the_error(law) and np.any(kd):
        lines.append(_SLOPE_OF_ERROR)
    return lines


def _of_the_error(law: Mapping[str, Any]) -> bool:
    """Check whether a law differentiates the error of the position."""
    return law["kind"] == "pd" and law.get("derivative", "error") == "error"


def _servo_gains(given: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness and damping of each servo of the drives of a result."""
    law, gain = given["controller"], np.array(given["gain"])

    def of_law(key: str) -> np.ndarray:
        return np.broadcast_to(np.asarray(law[key], dtype=float), gain.shape)

    if law["kind"] == "cascade_pd":
        return gain * of_law("kp") * of_law("kv"), gain * of_law("kv")
    return gain * of_law("kp"), gain * of_law("kd")


def _same(one: float, other: float) -> bool:
    return abs(one - other) <= _SAME * max(abs(one), abs(other), 1e-9)
