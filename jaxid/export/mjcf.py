"""Corrected MJCF files: the user's text with the inertias, friction and springs of a result."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from jaxid.arms.bodies import Bodies, about_centre, are_bodies, bodies_of
from jaxid.case.mjcf import is_one_of, need_mujoco, robot_of_spec
from jaxid.case.robot import Robot, RobotJoint, body_in, kept, moved_by, projected
from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile, JointLaws, need_joints, plant_of, shown
from jaxid.export.mjcf_behind import BEHIND, BehindJoints
from jaxid.export.mjcf_drives import DRIVE_EFFECTS, DriveText
from jaxid.export.shaft_tendons import ShaftTendons, insert_tendons
from jaxid.export.soft_friction import Softness
from jaxid.export.xml_text import Element, XmlText

# Relative change below which a value of the file stays as it is written.
_SAME = 1e-12
# Relative difference of a sum up to which bodies count as those of the result.
_CLOSE = 1e-6
# Effects that a joint of an MJCF has, with their parameter.
JOINT_LAWS = {
    "viscous_friction": "coefficient",
    "quadratic_drag": "coefficient",
    "cubic_friction": "coefficient",
    "coulomb_friction": "level",
    "constant_force": "level",
    "linear_stiffness": "coefficient",
    "quadratic_stiffness": "coefficient",
    "cubic_stiffness": "coefficient",
    "added_mass": "mass",
}
DAMPING = ("viscous_friction", "quadratic_drag", "cubic_friction")
SPRING = ("constant_force", "linear_stiffness", "quadratic_stiffness", "cubic_stiffness")


def export_mjcf(model: Mapping[str, Any], path: Path) -> ExportedFile:
    """Put the machine of a result into the MJCF that its case names.

    Args:
        model: `model` of result.json or discovery.json.
        path: The MJCF.

    Raises:
        InputError: If MuJoCo is not installed, or the file is not that of the case.
    """
    mujoco, where = need_mujoco(str(path)), str(path)
    try:
        content = path.read_bytes()
        spec = mujoco.MjSpec.from_file(str(path))
        degrees, autolimits = bool(spec.compiler.degree), bool(spec.compiler.autolimits)
        whole, compiled = robot_of_spec(spec, where)
        text = XmlText(content)
    except (OSError, ValueError, expat.ExpatError) as error:
        what = " ".join(str(error).split())
        raise InputError(what, where=where, hint="name the MJCF of the case by --model") from error
    robot = kept(whole, model["joints"], model.get("held", {}))
    need_joints(robot, model, where)
    elements = _elements(text, compiled, mujoco, where)
    drives = DriveText(text, compiled, robot, model, elements.joints, autolimits)
    drives.write()
    shafts = ShaftTendons.of(model, float(compiled.opt.timestep), elements.names)
    work = _Work(mujoco, compiled, text, elements, robot, model, degrees, drives.damping, shafts)
    file = projected(robot)
    rotors = np.array([file[joint.name].armature for joint in robot.free])
    found = bodies_of(plant_of(robot, model), robot.bodies, rotors)
    work.joints(file, found.rotors)
    work.bodies(found)
    springs = BehindJoints(compiled, text, elements.joints, work.names, model)
    springs.write()
    insert_tendons(text, (*springs.tendons, *shafts.texts))
    work.notes.extend(springs.notes)
    work.changed.extend(springs.changed)
    changed, notes = (*work.changed, *drives.changed), (*work.notes, *drives.notes)
    lost, added = (*work.lost, *drives.lost), tuple(springs.added)
    return ExportedFile(text.text(), changed, notes, lost, work.real, added)


def spring_of(force: Float[np.ndarray, " 4"]) -> tuple[float, list[float]] | None:
    """Return rest and stiffness of a spring of an MJCF; None if it has no rest towards which it pulls.

    Args:
        force: Factors of 1, q, q^2 and q^3 in the force against the coordinate q.
    """
    own = np.polynomial.Polynomial(force)
    roots: Any = own.trim().roots() if own.trim().degree() > 0 else np.array([])
    real = roots[np.abs(roots.imag) < 1e-9].real
    if not real.size or own.deriv()(real[np.argmin(np.abs(real))]) < 0:
        return None
    rest = float(real[np.argmin(np.abs(real))])
    _, *slopes = [float(c) for c in own(np.polynomial.Polynomial([rest, 1.0])).coef]
    return rest, slopes if any(slopes[1:]) else slopes[:1]


@dataclass
class _Elements:
    """Elements of the text by the index of the joint or body of the compiled model."""

    joints: dict[int, Element]
    bodies: dict[int, Element]

    @property
    def names(self) -> list[str]:
        """Names of the joints that have one in the text."""
        return [e.attributes["name"] for e in self.joints.values() if "name" in e.attributes]


def _elements(text: XmlText, model: Any, mujoco: Any, where: str) -> _Elements:
    """Find the elements of joints and bodies, in MuJoCo's order: each body before those in it.

    Raises:
        InputError: If a body stands in another file, or is made by the compiler.
    """
    world = [e for e in text.root.children if e.tag == "worldbody"]
    bodies: dict[int, Element] = {}
    joints: dict[int, Element] = {}

    def inside(element: Element) -> Iterator[Element]:
        for child in element.children:
            if child.tag == "frame":
                yield from inside(child)
            else:
                yield child

    def visit(body: Element) -> None:
        bodies[len(bodies) + 1] = body
        for child in inside(body):
            if child.tag in ("joint", "freejoint"):
                joints[len(joints)] = child
        for child in inside(body):
            if child.tag == "body":
                visit(child)

    for element in world:
        for child in inside(element):
            if child.tag == "body":
                visit(child)
    fits = len(bodies) == model.nbody - 1 and len(joints) == model.njnt
    names = [(model.joint(k).name, joints[k].attributes.get("name", "")) for k in joints] if fits else []
    if not fits or any(ours != theirs for ours, theirs in names):
        hint = "write it as one file first: python -m mujoco.compile IN.xml OUT.xml, or MjSpec.to_file"
        raise InputError(
            "its bodies stand in other files, or are made by the compiler", where=where, hint=hint
        )
    return _Elements(joints, bodies)


@dataclass
class _Work:
    """The export of one machine into one text."""

    mujoco: Any
    compiled: Any
    text: XmlText
    elements: _Elements
    robot: Robot
    model: Mapping[str, Any]
    degrees: bool
    drag: Mapping[str, float]
    shafts: ShaftTendons
    notes: list[str] = field(default_factory=list)
    changed: list[str] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    real: bool = True

    @property
    def names(self) -> list[str]:
        """Names of all joints of the file."""
        return [self.compiled.joint(k).name or f"joint{k + 1}" for k in range(self.compiled.njnt)]

    def joints(self, file: Mapping[str, RobotJoint], rotors: Float[np.ndarray, " n"]) -> None:
        """Write armature, friction and springs of the free joints."""
        laws, names = self._laws(), self.names
        for port, joint in enumerate(self.robot.free):
            index = names.index(joint.name)
            values: dict[str, str | None] = {}
            law, stated = laws[port], file[joint.name]
            armature = rotors[port] + law.get("added_mass", 0.0) - stated.armature
            self._add(values, "armature", index, armature, stated.armature)
            level = law.get("coulomb_friction", 0.0) - stated.friction
            self._add(values, "frictionloss", index, level, stated.friction)
            self._harden(values, index)
            self._damping(values, joint, stated, law, index)
            self._spring(values, joint, stated, law, index)
            if values:
                self.text.set(self.elements.joints[index], values)
                self.changed.append(f"joint '{joint.name}'")

    def _laws(self) -> tuple[dict[str, float], ...]:
        """Return the effects that a joint of an MJCF has, by joint; name the others."""
        laws = JointLaws.of(self.model, JOINT_LAWS, (*DRIVE_EFFECTS, BEHIND), self.shafts.held)
        self._lose(laws.lost, "has no place in an MJCF")
        return laws.values

    def _lose(self, numbers: Iterable[int], why: str) -> None:
        """Name effects that the file cannot hold."""
        for number in numbers:
            self.notes.append(f"{shown(self.model['effects'][number])} {why}")
            self.lost.append(number)

    def _dof(self, joint: int) -> int:
        return int(self.compiled.jnt_dofadr[joint])

    def _add(
        self, values: dict[str, str | None], attribute: str, joint: int, more: float, size: float
    ) -> None:
        """Add to an attribute of a joint that must not be negative, unless it stays the same."""
        if abs(more) <= _SAME * max(abs(size), 1e-9):
            return
        new = float(getattr(self.compiled, f"dof_{attribute}")[self._dof(joint)]) + float(more)
        if new < 0:
            self.notes.append(f"{attribute} of joint '{self.names[joint]}' would be {new:.3g}: written as 0")
            new = 0.0
        values[attribute] = repr(new)

    def _harden(self, values: dict[str, str | None], joint: int) -> None:
        """Let a dry friction that is written hold its joint at rest, as jaxid's does."""
        if float(values.get("frictionloss") or 0.0) > 0:
            least = Softness.least(float(self.compiled.opt.timestep))
            if Softness.of(self.compiled, self._dof(joint)).softer(least):
                values |= least.attributes()

    def _damping(
        self, values: dict[str, str | None], joint: RobotJoint, stated: RobotJoint, law: dict, index: int
    ) -> None:
        more = [law.get(kind, 0.0) - old for kind, old in zip(DAMPING, stated.damping, strict=True)]
        more[0] += self.drag.get(joint.name, 0.0)
        if all(abs(m) <= _SAME * max(abs(s), 1e-9) for m, s in zip(more, stated.damping, strict=True)):
            return
        dof = self._dof(index)
        own = [float(self.compiled.dof_damping[dof]), *map(float, self.compiled.dof_dampingpoly[dof])]
        new = [a + float(b) for a, b in zip(own, more, strict=True)]
        if new[0] < 0:
            self.notes.append(f"damping of joint '{joint.name}' would be {new[0]:.3g}: written as 0")
            new[0] = 0.0
        values["damping"] = " ".join(map(repr, new if any(new[1:]) else new[:1]))

    def _spring(
        self, values: dict[str, str | None], joint: RobotJoint, stated: RobotJoint, law: dict, index: int
    ) -> None:
        found = np.array([law.get(kind, 0.0) for kind in SPRING]) * [-1.0, 1.0, 1.0, 1.0]
        more = found - np.array(stated.spring)
        if np.all(np.abs(more) <= _SAME * np.maximum(np.abs(found), 1e-9)):
            return
        spring = spring_of(np.array(joint.spring) + more)
        if spring is None:
            listed = ", ".join(f"{kind} = {law[kind]:.6g}" for kind in SPRING if kind in law)
            self.notes.append(
                f"{listed} at joint '{joint.name}': a spring of an MJCF has a rest, and pulls towards it"
            )
            self.lost += [
                number
                for number, effect in enumerate(self.model["effects"])
                if effect["kind"] in SPRING and effect.get("joint_name") == joint.name
            ]
            return
        rest, slopes = spring
        values["stiffness"] = " ".join(map(repr, slopes))
        turns = joint.motion == "revolute" and self.degrees
        values["springref"] = repr(float(np.degrees(rest)) if turns else rest)

    def bodies(self, found: Bodies) -> None:
        """Write the inertias of the bodies that the kept joints move."""
        start, links = self.robot.bodies, found.links
        if found.error > _CLOSE:
            what = f"no bodies have the inertias that were found: sums differ by {found.error:.2g}"
            self.notes.append(what)
            self.real = False
        frames = self._frames()
        for k, joint in enumerate(self.robot.joints):
            more = links[k] - start[k]
            if np.all(np.abs(more) <= _SAME * np.abs(start[k]).max()):
                continue
            body, place = frames[joint.name]
            if body is None:
                self.notes.append(f"joint '{joint.name}' has no body of its own: its inertia is not written")
                continue
            self._write(body, place, joint, more)

    def _frames(self) -> dict[str, tuple[int | None, Float[np.ndarray, "4 4"]]]:
        """Return the body of each kept joint, and the joint's frame in that of the body.

        All kept joints stand at zero, and the others where they are held.
        """
        mujoco, model = self.mujoco, self.compiled
        data = mujoco.MjData(model)
        names = self.names
        held, kept_names = self.model.get("held", {}), self.robot.names
        moving = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        for k, name in enumerate(names):
            if is_one_of(model.jnt_type[k], *moving):
                data.qpos[model.jnt_qposadr[k]] = 0.0 if name in kept_names else held.get(name, 0.0)
        for joint in self.robot.joints:
            if joint.follows is not None:
                data.qpos[model.jnt_qposadr[names.index(joint.name)]] = joint.follows.offset
        mujoco.mj_kinematics(model, data)

        out: dict[str, tuple[int | None, np.ndarray]] = {}
        placed: list[np.ndarray] = []
        for joint in self.robot.joints:
            at = np.eye(4) if joint.parent < 0 else placed[joint.parent]
            offset = moved_by(joint.motion, joint.follows.offset) if joint.follows else np.eye(4)
            placed.append(at @ joint.place @ offset)
            k = names.index(joint.name)
            body = int(model.jnt_bodyid[k])
            later = range(k + 1, int(model.body_jntadr[body] + model.body_jntnum[body]))
            frame = np.eye(4)
            frame[:3, :3], frame[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
            free = [n for n in later if names[n] in kept_names]
            out[joint.name] = (None if free else body, np.linalg.inv(frame) @ placed[-1])
        return out

    def _write(self, body: int, place: np.ndarray, joint: RobotJoint, more: np.ndarray) -> None:
        """Add to the inertia of a body of the file what was found of the link beside the file's."""
        mujoco, model = self.mujoco, self.compiled
        turn, inertial = np.zeros(9), np.eye(4)
        mujoco.mju_quat2Mat(turn, model.body_iquat[body])
        inertial[:3, :3], inertial[:3, 3] = turn.reshape(3, 3), model.body_ipos[body]
        xx, yy, zz = model.body_inertia[body]
        own = body_in(np.array([model.body_mass[body], 0, 0, 0, xx, 0, 0, yy, 0, zz]), inertial)
        new = own + body_in(more, place)
        name = self.compiled.body(body).name or f"body {body}"
        if not new[0] > 0 or not are_bodies(new[None]):
            what = f"less was found than the bodies weigh that are fixed to '{name}': not written"
            self.notes.append(f"joint '{joint.name}': {what}")
            self.real = False
            return
        mass, centre, tensor = about_centre(new)
        six = [tensor[i] for i in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        values: dict[str, str | None] = {
            "pos": " ".join(repr(float(v)) for v in centre),
            "mass": repr(mass),
            "fullinertia": " ".join(repr(float(v)) for v in six),
        }
        element = self.elements.bodies[body]
        found = element.find("inertial")
        if found is None:
            listed = " ".join(f'{n}="{v}"' for n, v in values.items())
            self.text.insert_into(element, f"<inertial {listed}/>")
        else:
            gone = dict.fromkeys(("diaginertia", "quat", "axisangle", "xyaxes", "zaxis", "euler"))
            self.text.set(found, {**values, **gone})
        self.changed.append(f"body '{name}'")
