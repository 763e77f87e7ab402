"""An MJCF of a robot of which no file exists: bodies, rotors, friction, springs, shafts and motors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxid.export.exported import ExportedFile, JointLaws, notes_of_case, shown
from jaxid.export.mjcf import DAMPING, JOINT_LAWS, SPRING, spring_of
from jaxid.export.new_robot import NewRobot, comment, leader_of, leading_of
from jaxid.export.shaft_tendons import ShaftTendons
from jaxid.export.soft_friction import Softness
from jaxid.export.xml_text import escaped, listed, numbers

# Time step of the file [s].
_STEP = 0.001
# Effects of drives that a motor can have.
_OF_DRIVES = (
    "actuator_gain",
    "actuator_offset",
    "saturation",
    "actuator_lag",
    "input_delay",
    "back_emf_damping",
)
# Radii of what is drawn, over the reach of the robot.
_ROD, _JOINT = 0.02, 0.035

_MJCF = """\
{comment}
<mujoco model="{name}">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{step!r}" integrator="implicitfast" gravity="{gravity}"/>
  <worldbody>
{bodies}  </worldbody>
{sections}</mujoco>
"""


def new_mjcf(model: Mapping[str, Any], stem: str, version: str, where: str) -> ExportedFile:
    """Write an MJCF of a robot of which no file exists.

    A constant force is a part of the joint's actuator, so that MuJoCo's inverse dynamics do not have it.
    Shafts are fixed tendons with their inertia, damping and dry friction. Joints have no limits.

    Args:
        model: `model` of result.json.
        stem: Name of the file without its suffix.
        version: That of jaxid.
        where: The result, for messages.

    Raises:
        InputError: If the result has no frames, because an older jaxid wrote it.
    """
    work = _Work(NewRobot.of(model, where), model, leading_of(model))
    bodies = "".join(f"    {line}\n" for link in work.robot.children(-1) for line in work.body(link))
    sections = "".join(work.sections())
    notes = (*work.robot.notes, *work.notes, *notes_of_case(model))
    text = _MJCF.format(
        comment=comment(stem, version, notes),
        name=escaped(stem),
        step=_STEP,
        gravity=numbers(model["gravity_vector"]),
        bodies=bodies,
        sections=sections,
    )
    names = tuple(f"joint '{name}'" for name in model["joints"])
    return ExportedFile(text.encode(), names, notes, tuple(work.lost), work.robot.real, new=True)


@dataclass
class _Motor:
    """An actuator of one joint, from its effects in the order in which they act.

    Args:
        gain: Force per unit of the command.
        bias: Constant force.
        limit: Largest force; None: there is none.
        lag, delay: Time constant behind the command, and its delay [s].
    """

    gain: float
    bias: float = 0.0
    limit: float | None = None
    lag: float = 0.0
    delay: float = 0.0

    def takes(self, kind: str, values: Mapping[str, Any]) -> bool:
        """Take over an effect; return False if an actuator of MuJoCo cannot have it in this place."""
        if kind == "saturation":
            limit = float(values["limit"])
            self.limit = limit if self.limit is None else min(limit, self.limit)
        elif kind == "input_delay":
            self.delay += float(values["delay"])
        elif self.limit is not None or (kind == "actuator_lag" and self.lag):
            # The range is the last part of an actuator.
            return False
        elif kind == "actuator_gain":
            self.gain, self.bias = (float(values["gain"]) * x for x in (self.gain, self.bias))
        elif kind == "actuator_offset":
            self.bias += float(values["level"])
        elif kind == "actuator_lag":
            self.lag = float(values["time_constant"])
        return True

    def attributes(self) -> dict[str, str]:
        """Return the attributes of a general actuator."""
        out = {"gainprm": repr(self.gain)}
        if self.bias:
            out |= {"biastype": "affine", "biasprm": repr(self.bias)}
        if self.limit is not None:
            out["forcerange"] = numbers((-self.limit, self.limit))
        if self.lag:
            out |= {"dyntype": "filterexact", "dynprm": repr(self.lag)}
        if self.delay:
            samples = int(np.ceil(self.delay / _STEP)) + 2
            out |= {"delay": repr(self.delay), "nsample": str(samples), "interp": "linear"}
        return out


@dataclass
class _Work:
    """The writing of one file."""

    robot: NewRobot
    model: Mapping[str, Any]
    leading: tuple[int, ...]
    notes: list[str] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    motors: dict[str, _Motor] = field(default_factory=dict)
    joints: dict[str, dict[str, str]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        plain, effects = self.robot.plain, self.model["effects"]
        self.shafts = ShaftTendons.of(self.model, _STEP, plain.names)
        for drive, gain in zip(plain.drives, plain.gains, strict=True):
            self.motors[plain.names[drive]] = _Motor(gain)
        drag = self._drives()
        laws = JointLaws.of(self.model, JOINT_LAWS, _OF_DRIVES, self.shafts.held)
        for number in laws.lost:
            self._lose(number, "has no place in an MJCF")
        for k, (name, law) in enumerate(zip(plain.names, laws.values, strict=True)):
            values: dict[str, str] = {}
            self._add(values, "armature", name, self.robot.rotors[k] + law.get("added_mass", 0.0))
            self._add(values, "frictionloss", name, law.get("coulomb_friction", 0.0))
            if "frictionloss" in values:
                hard = Softness.least(_STEP).attributes()
                values |= {key: value for key, value in hard.items() if value is not None}
            damping = [law.get(kind, 0.0) for kind in DAMPING]
            damping[0] += drag.get(name, 0.0)
            self._add(values, "damping", name, damping[0])
            if any(damping[1:]):
                values["damping"] = numbers((max(damping[0], 0.0), *damping[1:]))
            self._spring(values, name, law, effects)
            self.joints[name] = values

    def _lose(self, number: int, why: str) -> None:
        self.notes.append(f"{shown(self.model['effects'][number])} {why}")
        self.lost.append(number)

    def _drives(self) -> dict[str, float]:
        """Take over the effects of drives; return the damping of joints that belongs to them."""
        drag: dict[str, float] = {}
        for number, effect in enumerate(self.model["effects"]):
            kind, name = effect["kind"], effect.get("joint_name", "")
            if kind not in _OF_DRIVES:
                continue
            if kind == "back_emf_damping":
                drag[name] = drag.get(name, 0.0) + float(effect["parameters"]["coefficient"])
            elif name not in self.motors:
                self._lose(number, "has no place: nothing drives that joint")
            elif not self.motors[name].takes(kind, effect["parameters"]):
                self._lose(number, "has no place in an actuator of an MJCF, whose range comes last")
        return drag

    def _add(self, values: dict[str, str], attribute: str, joint: str, value: float) -> None:
        """Write an attribute of a joint that must not be negative, unless it is zero."""
        if value < 0:
            self.notes.append(f"{attribute} of joint '{joint}' would be {value:.3g}: written as 0")
        elif value > 0:
            values[attribute] = repr(float(value))

    def _spring(self, values: dict[str, str], name: str, law: Mapping[str, float], effects: Any) -> None:
        """Write a spring; a force that is constant, or no spring, is a bias of the actuator or lost."""
        force = np.array([law.get(kind, 0.0) for kind in SPRING]) * [-1.0, 1.0, 1.0, 1.0]
        if not np.any(force):
            return
        spring, motor = spring_of(force), self.motors.get(name)
        if spring is not None:
            rest, slopes = spring
            values["stiffness"] = numbers(slopes)
            values["springref"] = repr(rest)
            return
        if not np.any(force[1:]) and motor is not None and motor.limit is None:
            motor.bias -= float(force[0])
            return
        for number, effect in enumerate(effects):
            if effect["kind"] in SPRING and effect.get("joint_name") == name:
                self._lose(number, "has no place: a spring of an MJCF has a rest, and pulls towards it")

    def body(self, link: int) -> Iterator[str]:
        """Yield the lines of a body, and of those that hang on it."""
        robot, plain = self.robot, self.robot.plain
        name, turn = plain.links[link], _quaternion(plain.axes[link])
        place = {"name": f"{name}_link", "pos": numbers(plain.origins[link]), "quat": numbers(turn)}
        yield f"<body {listed(place)}>"
        mass, centre, tensor = robot.inertial(link)
        six = [tensor[i] for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        inertial = {"pos": numbers(centre), "mass": repr(mass), "fullinertia": numbers(six)}
        yield f"  <inertial {listed(inertial)}/>"
        kind = "hinge" if plain.revolute[link] else "slide"
        joint = {"name": name, "type": kind, "axis": "0 0 1", **self.joints.get(name, {})}
        yield f"  <joint {listed(joint)}/>"
        size, only = robot.reach, {"contype": "0", "conaffinity": "0"}
        ends = numbers((0, 0, -_JOINT * size, 0, 0, _JOINT * size))
        drawn = {"type": "cylinder", "fromto": ends, "size": repr(_JOINT * size), **only}
        yield f"  <geom {listed(drawn)}/>"
        for end in robot.rods(link):
            rod = {"type": "capsule", "fromto": f"0 0 0 {numbers(end)}", "size": repr(_ROD * size), **only}
            yield f"  <geom {listed(rod)}/>"
        for child in robot.children(link):
            for line in self.body(child):
                yield f"  {line}"
        yield "</body>"

    def sections(self) -> Iterator[str]:
        """Yield shafts, joints that follow others, and motors, a section each."""
        if self.shafts.texts:
            yield _section("tendon", self.shafts.texts)
        follows = []
        for link, name in enumerate(self.robot.plain.links):
            leader = leader_of(self.robot.plain, link, self.leading)
            if leader is not None:
                row = {"joint1": name, "joint2": leader[0], "polycoef": numbers((0, leader[1], 0, 0, 0))}
                follows.append(f"<joint {listed(row)}/>")
        if follows:
            yield _section("equality", follows)
        motors = []
        for name, motor in self.motors.items():
            values = {"name": name, "joint": name, **motor.attributes()}
            motors.append(f"<general {listed(values)}/>")
        if motors:
            yield _section("actuator", motors)


def _section(tag: str, lines: Any) -> str:
    inside = "".join(f"    {line}\n" for line in lines)
    return f"  <{tag}>\n{inside}  </{tag}>\n"


def _quaternion(turn: np.ndarray) -> np.ndarray:
    """Return a rotation matrix as w x y z.

    Source:
        Bar-Itzhack (2000), J. Guidance, Control, and Dynamics 23(6): eigenvector of the largest eigenvalue.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = turn
    upper = [
        [xx - yy - zz, 0.0, 0.0, 0.0],
        [yx + xy, yy - xx - zz, 0.0, 0.0],
        [zx + xz, zy + yz, zz - xx - yy, 0.0],
        [zy - yz, xz - zx, yx - xy, xx + yy + zz],
    ]
    vector = np.linalg.eigh(np.array(upper) / 3.0)[1][:, -1]
    w = np.array([vector[3], *vector[:3]])
    return w if w[0] >= 0 else -w
