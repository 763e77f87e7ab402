"""Robots as a URDF or MJCF file describes them: a tree of joints, and the bodies that these move."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError, suggest
from jaxid.plants.geometry import JointFrames


@dataclass(frozen=True)
class Follows:
    """A joint's motion as that of another one: ratio times its coordinate, plus offset."""

    joint: str
    ratio: float
    offset: float


@dataclass(frozen=True)
class RobotJoint:
    """A joint of a file, and the body that it moves.

    Args:
        name: Name in the file.
        motion: "revolute" or "prismatic".
        parent: Index of the joint whose body carries it; -1: the base.
        place: Its frame in that of the parent joint, itself at zero; z is its axis, (4, 4).
        body: Mass, first moments x y z, and inertia xx xy xz yy yz zz about the frame's origin, of all that
            is fixed to it, (10,) [kg, kg m, kg m^2].
        follows: The joint that it follows, if it is not free.
        armature: Inertia of its rotor, seen at the joint [kg m^2 or kg].
        damping: Factors of v, v |v| and v^3 in the force against the velocity v.
        friction: Level of its dry friction [N m or N].
        spring: Factors of 1, q, q^2 and q^3 in the force against a displacement to the coordinate q.
        range: Lowest and highest coordinate, if it is limited.
        effort: Largest force of its drive by a URDF's <limit>; None: not stated.
    """

    name: str
    motion: str
    parent: int
    place: Float[np.ndarray, "4 4"]
    body: Float[np.ndarray, " 10"]
    follows: Follows | None = None
    armature: float = 0.0
    damping: tuple[float, float, float] = (0.0, 0.0, 0.0)
    friction: float = 0.0
    spring: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    range: tuple[float, float] | None = None
    effort: float | None = None


@dataclass(frozen=True)
class RobotDrive:
    """An actuator of a file, on one joint.

    Args:
        name: Name in the file.
        joint: Name of its joint.
        gain: Force of the joint per unit of the command.
        kp, kd: Gains of a position servo, per unit of the joint; None: the command is a force.
        limit: Largest force at the joint; None: none, or one that differs by direction.
        drag: Force against the velocity, per velocity, that belongs to the command: of a back-EMF, or of
            a servo that follows a velocity.
        lag: Time constant between command and force [s]; 0: none.
        delay: Delay of the command [s].
    """

    name: str
    joint: str
    gain: float
    kp: float | None = None
    kd: float | None = None
    limit: float | None = None
    drag: float = 0.0
    lag: float = 0.0
    delay: float = 0.0


@dataclass(frozen=True)
class Robot:
    """The contents of a URDF or MJCF file.

    Args:
        file: The file, for messages.
        joints: Its joints that can move, each behind the one that carries it.
        gravity: Acceleration of gravity in the base's frame [m/s^2]; None: the file does not state it.
        drives: Its actuators.
        period: Time step of its simulation [s], with which its servos run; None: not stated.
        notes: Parts of the file that this does not hold, a sentence each.
        places: Index of the joint that carries each link of the file (-1: the base), and the link's frame in
            that of the joint, itself at zero, (4, 4).
    """

    file: str
    joints: tuple[RobotJoint, ...]
    gravity: tuple[float, float, float] | None = None
    drives: tuple[RobotDrive, ...] = ()
    period: float | None = None
    notes: tuple[str, ...] = ()
    places: Mapping[str, tuple[int, Float[np.ndarray, "4 4"]]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def free(self) -> tuple[RobotJoint, ...]:
        """The joints that do not follow another one."""
        return tuple(joint for joint in self.joints if joint.follows is None)

    @property
    def parents(self) -> tuple[int, ...]:
        """Index of the joint that carries each joint; -1 for the base."""
        return tuple(joint.parent for joint in self.joints)

    @property
    def geometry(self) -> JointFrames:
        """Frames of the joints, each in that of its parent, with offsets of joints that follow."""
        places = [
            joint.place @ moved_by(joint.motion, joint.follows.offset) if joint.follows else joint.place
            for joint in self.joints
        ]
        return JointFrames(
            tuple(joint.motion for joint in self.joints),
            np.array([place[:3, :3] for place in places]),
            np.array([place[:3, 3] for place in places]),
        )

    @property
    def bodies(self) -> Float[np.ndarray, "links 10"]:
        """Ten inertial parameters of the body behind each joint."""
        return np.array([joint.body for joint in self.joints])

    @property
    def copies(self) -> tuple[tuple[int, float], ...]:
        """The free joint by which each joint moves, and how much of it; empty if all are free."""
        names = [joint.name for joint in self.free]
        if len(names) == len(self.joints):
            return ()
        return tuple(
            (names.index(joint.name), 1.0)
            if joint.follows is None
            else (names.index(joint.follows.joint), joint.follows.ratio)
            for joint in self.joints
        )

    @property
    def leading(self) -> tuple[int, ...]:
        """Index of each free joint among all."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.follows is None)


def moved_by(motion: str, by: float) -> Float[np.ndarray, "4 4"]:
    """Return the transform of a turn about z, or of a slide along it."""
    out = np.eye(4)
    if motion == "revolute":
        c, s = math.cos(by), math.sin(by)
        out[:2, :2] = [[c, -s], [s, c]]
    else:
        out[2, 3] = by
    return out


def body_in(ten: Float[np.ndarray, " 10"], place: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 10"]:
    """Return a body's ten parameters about the origin of another frame, in which its own one has a place."""
    turn, p = place[:3, :3], place[:3, 3]
    mass, moment = ten[0], turn @ ten[1:4]
    xx, xy, xz, yy, yz, zz = ten[4:]
    tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    tensor += (2 * p @ moment + mass * p @ p) * np.eye(3)
    tensor -= np.outer(p, moment) + np.outer(moment, p) + mass * np.outer(p, p)
    return np.array([mass, *(moment + mass * p), *tensor[np.triu_indices(3)]])


def towards(axis: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Turn the axes of a link such that z is the joint's; keep them if it is already."""
    # Half a turn about x first, if z would turn by more than a right angle: the divisor stays above zero.
    half = np.diag([1.0, -1.0, -1.0]) if axis[2] < 0 else np.eye(3)
    x, y, z = half @ axis
    # About the cross product of both, by Rodrigues' formula.
    return half @ np.array(
        [
            [1 - x * x / (1 + z), -x * y / (1 + z), x],
            [-x * y / (1 + z), 1 - y * y / (1 + z), y],
            [-x, -y, z],
        ]
    )


def kept(robot: Robot, names: Sequence[str] | None, held: Mapping[str, float]) -> Robot:
    """Return the robot with some joints held, and what they carry as part of the body before them.

    A joint that follows one that is kept stays; one that follows a joint that is held is held with it.

    Args:
        robot: The robot.
        names: Joints that stay, in the order of the file; None: all that are not among `held`.
        held: Positions of held joints [rad or m]; of others it is zero.

    Raises:
        InputError: If a joint does not exist, follows another one, is kept and held, or stands out of order.
    """
    free = [joint.name for joint in robot.free]
    for name in (*(names or ()), *held):
        joint = next((j for j in robot.joints if j.name == name), None)
        if joint is None:
            raise InputError(f"there is no joint '{name}'", where=robot.file, hint=suggest(name, free))
        if joint.follows is not None:
            what = f"joint '{name}' follows '{joint.follows.joint}'"
            raise InputError(what, where=robot.file, hint=f"name '{joint.follows.joint}' in its place")
    names = [name for name in free if name not in held] if names is None else list(names)
    both = [name for name in names if name in held]
    if both:
        raise InputError(f"joint '{both[0]}' is in joints and in held", where=robot.file, hint="keep one")
    order = [name for name in free if name in names]
    if names != order:
        what = f"joints = [{', '.join(names)}] is not in the order of the file"
        raise InputError(what, where=robot.file, hint=f"write {', '.join(order)}")
    if not names:
        hint = "name one that is revolute, continuous or prismatic"
        raise InputError("no joint can move", where=robot.file, hint=hint)

    joints: list[RobotJoint] = []
    # Joint that carries the frame of each joint of the file now, and its place in that one's frame.
    carrier: list[tuple[int, np.ndarray]] = []
    for joint in robot.joints:
        before, frame = (-1, np.eye(4)) if joint.parent < 0 else carrier[joint.parent]
        place = frame @ joint.place
        leader = joint.name if joint.follows is None else joint.follows.joint
        if leader in names:
            joints.append(replace(joint, parent=before, place=place))
            carrier.append((len(joints) - 1, np.eye(4)))
            continue
        at = held.get(leader, 0.0)
        if joint.follows is not None:
            at = joint.follows.ratio * at + joint.follows.offset
        place = place @ moved_by(joint.motion, at)
        carrier.append((before, place))
        if before >= 0:
            body = joints[before].body + body_in(joint.body, place)
            joints[before] = replace(joints[before], body=body)
    drives = tuple(drive for drive in robot.drives if drive.joint in names)
    places = dict(robot.places)
    for link, (joint, frame) in robot.places.items():
        if joint >= 0:
            now, before = carrier[joint]
            places[link] = now, before @ frame
    return replace(robot, joints=tuple(joints), drives=drives, places=places)


def spring(stiffness: Sequence[float], rest: float) -> tuple[float, float, float, float]:
    """Return the factors of 1, q, q^2 and q^3 of a spring, from those of x, x^2 and x^3 with x = q - rest."""
    return _four(np.polynomial.Polynomial([0.0, *stiffness])(np.polynomial.Polynomial([-rest, 1.0])))


def _four(law: np.polynomial.Polynomial) -> tuple[float, float, float, float]:
    a, b, c, d = (float(x) for x in np.append(law.coef, np.zeros(4))[:4])
    return a, b, c, d


def projected(robot: Robot) -> dict[str, RobotJoint]:
    """Return each free joint with armature, friction, damping and springs of those that follow it.

    Motions of a joint that follows by a ratio r are r times as large, and its forces count r times: its
    armature adds r^2 times, and its dry friction |r| times.
    """
    out = {joint.name: joint for joint in robot.free}
    for joint in robot.joints:
        if joint.follows is None:
            continue
        r, offset, to = joint.follows.ratio, joint.follows.offset, out[joint.follows.joint]
        law = r * np.polynomial.Polynomial(joint.spring)(np.polynomial.Polynomial([offset, r]))
        sizes = r**2, abs(r) ** 3, r**4
        a, b, c = (x + s * y for x, s, y in zip(to.damping, sizes, joint.damping, strict=True))
        out[to.name] = replace(
            to,
            armature=to.armature + r**2 * joint.armature,
            friction=to.friction + abs(r) * joint.friction,
            damping=(a, b, c),
            spring=_four(np.polynomial.Polynomial(to.spring) + law),
        )
    return out
