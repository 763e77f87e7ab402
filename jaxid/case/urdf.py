"""Arms and trees from URDF files: the joints that such a file describes, and the bodies that they move."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np
from jaxtyping import Float

from jaxid.case.robot import Follows, Robot, RobotJoint, towards
from jaxid.errors import InputError, suggest
from jaxid.plants.geometry import JointFrames

# Motion of a joint of each type; None: it is fixed.
_TYPES = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "fixed": None}
# Joints of other types, which a tree holds.
_HELD = ("floating", "planar")
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class Urdf:
    """An open chain of joints.

    Args:
        names: Names of the joints that move, from the base to the tip.
        geometry: Frames of the joints: those of the file, turned such that z is the joint's axis. The base
            frame is that of the file's first link.
        bodies: Mass, first moments x y z, and inertia tensor xx xy xz yy yz zz about the frame's origin, of
            the body between each joint and the next, (n, 10) [kg, kg m, kg m^2].
    """

    names: tuple[str, ...]
    geometry: JointFrames
    bodies: Float[np.ndarray, "n 10"]


@dataclass(frozen=True)
class _Joint:
    """A joint of the file: its motion (None: it is fixed), and its place in the parent link."""

    name: str
    motion: str | None
    parent: str
    child: str
    place: np.ndarray
    axis: np.ndarray
    mimics: str | None
    element: Element


def read_urdf(path: str | Path, tip: str | None = None) -> Urdf:
    """Read an arm from a URDF file.

    Links behind fixed joints are one body. Joints outside the chain from the first link to the tip are held
    at zero, and the links that they carry are part of the body that they stand on. Shapes, limits,
    transmissions and <dynamics> (declare friction as effects) are passed over.

    Args:
        path: The file.
        tip: Name of the last link; None: there is only one way to go.

    Raises:
        InputError: If the file cannot be read, is no URDF, describes anything but an open chain, or a body
            that moves has no mass.

    Source:
        The URDF's XML specification of ROS; rpy turns about the fixed axes x, y, z in this order.
    """
    file = str(path)
    robot = _tree(Path(path))
    links = {name: link for name, link in _named(robot, "link", file)}
    joints = [_joint(name, joint, links, file) for name, joint in _named(robot, "joint", file)]
    root = _root(links, joints, file)
    moving = _chain(root, links, joints, tip, file)

    names, places, bodies, carriers = [], [], [np.zeros(10)], [root]
    weighed = [False]
    # Links that remain to be visited, each with the body that contains it, and its frame in the body's.
    ahead = [(root, 0, np.eye(4))]
    while ahead:
        link, body, frame = ahead.pop()
        inertial = links[link].find("inertial")
        if inertial is not None:
            bodies[body] += read_inertial(inertial, frame, f"{file}, link '{link}'")
            weighed[body] = True
        for joint in (j for j in joints if j.parent == link):
            if joint.name not in moving:
                ahead.append((joint.child, body, frame @ joint.place))
                continue
            turn = np.eye(4)
            turn[:3, :3] = towards(joint.axis)
            names.append(joint.name)
            places.append((joint.motion, frame @ joint.place @ turn))
            bodies.append(np.zeros(10))
            carriers.append(joint.child)
            weighed.append(False)
            ahead.append((joint.child, len(names), turn.T))

    for k, (body, carrier) in enumerate(zip(bodies, carriers, strict=True)):
        if k and not body[0] > 0:
            what = "has no mass" if weighed[k] else "has no <inertial>"
            hint = "give it, or a link fixed to it, <inertial> with <mass> and <inertia>"
            where = f"{file}, link '{carrier}'"
            raise InputError(f"{what}, and joint '{names[k - 1]}' moves it", where=where, hint=hint)

    geometry = JointFrames(
        tuple(m for m, _ in places),
        np.array([p[:3, :3] for _, p in places]),
        np.array([p[:3, 3] for _, p in places]),
    )
    return Urdf(tuple(names), geometry, np.array(bodies[1:]))


def read_urdf_tree(path: str | Path) -> Robot:
    """Read a tree of joints from a URDF file, with friction, limits and joints that follow others.

    Links behind fixed joints are one body. Joints stand in the order of a walk from the first link, branches
    in the order of the file. Joints of other types (floating, planar) are held.

    Args:
        path: The file.

    Raises:
        InputError: If the file cannot be read, is no URDF, or describes no tree.

    Source:
        The URDF's XML specification of ROS.
    """
    file = str(path)
    robot = _tree(Path(path))
    links = {name: link for name, link in _named(robot, "link", file)}
    elements = dict(_named(robot, "joint", file))
    notes = []
    for name, element in elements.items():
        if element.get("type") in _HELD:
            notes.append(f"joint '{name}' is {element.get('type')}: it is held at zero")
            element.set("type", "fixed")
    joints = [_joint(name, element, links, file) for name, element in elements.items()]
    root = _root(links, joints, file)

    out: list[RobotJoint] = []
    bodies: list[np.ndarray] = []
    places: dict[str, tuple[int, np.ndarray]] = {}

    def visit(link: str, body: int, frame: np.ndarray) -> None:
        places[link] = body, frame
        inertial = links[link].find("inertial")
        if inertial is not None and body >= 0:
            bodies[body] += read_inertial(inertial, frame, f"{file}, link '{link}'")
        for joint in (j for j in joints if j.parent == link):
            if joint.motion is None:
                visit(joint.child, body, frame @ joint.place)
                continue
            turn = np.eye(4)
            turn[:3, :3] = towards(joint.axis)
            out.append(_tree_joint(joint, body, frame @ joint.place @ turn, file))
            bodies.append(np.zeros(10))
            visit(joint.child, len(out) - 1, turn.T)

    visit(root, -1, np.eye(4))
    leaders = _leaders(joints, file)
    whole = tuple(
        replace(joint, body=body, follows=leaders.get(joint.name))
        for joint, body in zip(out, bodies, strict=True)
    )
    return Robot(file, whole, notes=tuple(notes), places=places)


def _tree_joint(joint: _Joint, parent: int, place: np.ndarray, file: str) -> RobotJoint:
    """Return a joint with its friction and limits; its body is still empty."""
    where, known = f"{file}, joint '{joint.name}'", {}
    assert joint.motion is not None, "fixed joints are merged before"
    dynamics, limit = joint.element.find("dynamics"), joint.element.find("limit")
    for key, name in (("damping", "damping"), ("friction", "friction")):
        if dynamics is not None and dynamics.get(name) is not None:
            known[key] = float(_numbers(dynamics, name, 1, where)[0])
    for name, value in known.items():
        if value < 0:
            what = f"<dynamics> has a negative {name}: {value:g}"
            raise InputError(what, where=where, hint="give it without its sign")
    if "damping" in known:
        known["damping"] = (known["damping"], 0.0, 0.0)
    if limit is not None and joint.element.get("type") != "continuous":
        ends = [0.0 if limit.get(k) is None else _numbers(limit, k, 1, where)[0] for k in ("lower", "upper")]
        if ends[0] < ends[1]:
            known["range"] = (float(ends[0]), float(ends[1]))
    if limit is not None:
        known["effort"] = _effort(limit)
    return RobotJoint(joint.name, joint.motion, parent, place, np.zeros(10), **known)


def _effort(limit: Element) -> float | None:
    """Return the largest force of a joint's drive; None if it is no number, which nothing else needs."""
    try:
        value = float(limit.get("effort", "nan"))
    except ValueError:
        return None
    return None if np.isnan(value) else value


def _leaders(joints: list[_Joint], file: str) -> dict[str, Follows]:
    """Return the free joint that each <mimic> follows, through those that follow others themselves."""
    moving = {j.name: j for j in joints if j.motion is not None}
    out = {}
    for name, joint in moving.items():
        ratio, offset, at, seen = 1.0, 0.0, joint, [name]
        while at.mimics is not None:
            where = f"{file}, joint '{at.name}'"
            element = at.element.find("mimic")
            assert element is not None, "it has a <mimic>"
            more = [
                default if element.get(k) is None else float(_numbers(element, k, 1, where)[0])
                for k, default in (("multiplier", 1.0), ("offset", 0.0))
            ]
            ratio, offset = ratio * more[0], ratio * more[1] + offset
            if at.mimics not in moving or at.mimics in seen:
                what = f"<mimic> names '{at.mimics}', which is no joint that moves freely"
                raise InputError(what, where=where, hint=suggest(at.mimics, [n for n in moving if n != name]))
            seen.append(at.mimics)
            at = moving[at.mimics]
        if at is not joint:
            out[name] = Follows(at.name, ratio, offset)
    return out


def _tree(path: Path) -> Element:
    """Parse the file and return its root element.

    Documents that declare entities are refused: these can fill all memory.
    """
    where = str(path)

    def refuse(*args: object) -> None:
        hint = "take the line <!DOCTYPE ...> out"
        raise InputError("has a document type declaration", where=where, hint=hint)

    tree, parser = TreeBuilder(), expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    parser.StartElementHandler, parser.EndElementHandler = tree.start, tree.end
    try:
        parser.Parse(path.read_bytes(), True)
    except FileNotFoundError as error:
        beside = ", ".join(sorted(p.name for p in path.parent.glob("*.urdf"))[:8]) or "none"
        hint = f"check the path, which starts at the case; URDF files in that folder: {beside}"
        raise InputError("no such file", where=where, hint=hint) from error
    except OSError as error:
        hint = "name a URDF file that may be read"
        raise InputError(f"cannot be read ({error.strerror})", where=where, hint=hint) from error
    except (expat.ExpatError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"is not XML: {error}", where=where, hint="correct that line") from error
    root = tree.close()
    if root.tag != "robot":
        hint = "name a URDF file, whose first element is <robot>"
        raise InputError(f"is no URDF: its first element is <{root.tag}>", where=where, hint=hint)
    expand = [e.tag for e in root.iter() if "xacro" in e.tag]
    if expand:
        hint = "expand it first: xacro arm.urdf.xacro > arm.urdf"
        raise InputError(f"holds <{expand[0]}>, a macro", where=where, hint=hint)
    return root


def _named(robot: Element, tag: str, file: str) -> Iterator[tuple[str, Element]]:
    """Return the links or joints with their names.

    Raises:
        InputError: If one has no name, or two have one.
    """
    taken = set()
    for k, element in enumerate(robot.findall(tag), start=1):
        name = element.get("name", "")
        if not name or name in taken:
            what = f"<{tag}> {k} has no name" if not name else f"two <{tag}> are named '{name}'"
            raise InputError(what, where=file, hint="give each a name of its own")
        taken.add(name)
        yield name, element


def _joint(name: str, joint: Element, links: dict[str, Element], file: str) -> _Joint:
    """Read one joint of the file.

    Raises:
        InputError: If its type is not one of an arm, or it joins links that do not exist.
    """
    where = f"{file}, joint '{name}'"
    kind = joint.get("type", "")
    if kind not in _TYPES:
        raise InputError(f"type '{kind}' is none of an arm's joints", where=where, hint=suggest(kind, _TYPES))

    ends = []
    for end in ("parent", "child"):
        element = joint.find(end)
        link = "" if element is None else element.get("link", "")
        if link not in links:
            what = f"<{end}> names no link" if not link else f"there is no link '{link}', its {end}"
            raise InputError(what, where=where, hint=suggest(link, links))
        ends.append(link)

    given = joint.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if given is None else _numbers(given, "xyz", 3, where)
    length = np.linalg.norm(axis)
    if _TYPES[kind] and not length > 0:
        raise InputError("<axis> has no length", where=where, hint='write a direction such as xyz="0 0 1"')

    copied = joint.find("mimic")
    parent, child = ends
    return _Joint(
        name=name,
        motion=_TYPES[kind],
        parent=parent,
        child=child,
        place=_place(joint.find("origin"), where),
        axis=axis / (length or 1.0),
        mimics=None if copied is None else copied.get("joint", ""),
        element=joint,
    )


def _root(links: dict[str, Element], joints: list[_Joint], file: str) -> str:
    """Return the link that no joint moves, from which all others can be reached.

    Raises:
        InputError: If there is none, or more than one, or a loop.
    """
    if not links:
        raise InputError("has no <link>", where=file, hint="name a file that describes an arm")
    into: dict[str, str] = {}
    for joint in joints:
        if joint.child in into:
            both = f"joints '{into[joint.child]}' and '{joint.name}' both carry it"
            hint = "take one of them out; an arm is an open chain"
            where = f"{file}, link '{joint.child}'"
            raise InputError(f"{both}: the chain closes to a loop", where=where, hint=hint)
        into[joint.child] = joint.name

    roots = [name for name in links if name not in into]
    if len(roots) > 1:
        raise InputError(
            f"no joint joins '{roots[0]}' and '{roots[1]}'",
            where=file,
            hint="join them, or take out links that are not part of the arm",
        )

    reached, ahead = set(), list(roots)
    while ahead:
        link = ahead.pop()
        reached.add(link)
        ahead += [j.child for j in joints if j.parent == link]
    lost = [name for name in links if name not in reached]
    if lost:
        what = f"the joints from link '{lost[0]}' on lead back to it: a loop"
        raise InputError(what, where=file, hint="take one of them out; an arm is an open chain")
    return roots[0]


def _chain(
    root: str, links: dict[str, Element], joints: list[_Joint], tip: str | None, file: str
) -> set[str]:
    """Return the names of the joints that move: those on the path from the first link to the tip.

    Raises:
        InputError: If there are several paths and no tip selects one, or none of the joints can move.
    """
    of_child = {j.child: j for j in joints}
    if tip is not None and tip not in links:
        raise InputError(f"there is no link '{tip}', the tip", where=file, hint=suggest(tip, links))

    ways = []
    for end in [tip] if tip is not None else links:
        way, link = [], end
        while link != root:
            way.append(of_child[link])
            link = of_child[link].parent
        ways.append([j for j in reversed(way) if j.motion])

    longest = max(ways, key=len)
    for way in ways:
        for one, other in zip(way, longest, strict=False):
            if one is not other:
                what = f"joints '{other.name}' and '{one.name}' branch: an arm is one chain"
                hint = 'say which by tip = "<name of its last link>"; branches are then held at zero'
                raise InputError(what, where=file, hint=hint)
    if not longest:
        raise InputError(
            "no joint can move" + (f" up to link '{tip}'" if tip else ""),
            where=file,
            hint="give it a revolute, continuous or prismatic one, or name another tip",
        )

    for joint in longest:
        if joint.mimics is not None:
            what = f"it copies joint '{joint.mimics}' (<mimic>), and would not be free"
            raise InputError(
                what, where=f"{file}, joint '{joint.name}'", hint="take <mimic> out, or name a tip before it"
            )
    return {j.name for j in longest}


def _numbers(element: Element, name: str, count: int, where: str) -> np.ndarray:
    """Read the numbers of an attribute.

    Raises:
        InputError: If these are not so many finite numbers.
    """
    text = element.get(name)
    try:
        values = [float(word) for word in (text or "").split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        shown = f"has no {name}" if text is None else f'has {name}="{text[:40]}"'
        hint = f"give {'a number' if count == 1 else f'{count} numbers'}"
        raise InputError(f"<{element.tag}> {shown}", where=where, hint=hint)
    return np.array(values)


def _place(origin: Element | None, where: str) -> Float[np.ndarray, "4 4"]:
    """Return the homogeneous transform of an <origin>; missing parts are zero."""
    out = np.eye(4)
    if origin is None:
        return out
    if origin.get("xyz") is not None:
        out[:3, 3] = _numbers(origin, "xyz", 3, where)
    if origin.get("rpy") is not None:
        roll, pitch, yaw = _numbers(origin, "rpy", 3, where)
        (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
        out[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    return out


def read_inertial(inertial: Element, frame: np.ndarray, where: str) -> Float[np.ndarray, " 10"]:
    """Return the ten parameters of a link about the origin of its body's frame.

    Raises:
        InputError: If mass or inertia is missing, or no number.
    """
    parts = {}
    for tag in ("mass", "inertia"):
        parts[tag] = inertial.find(tag)
        if parts[tag] is None:
            raise InputError(f"<inertial> has no <{tag}>", where=where, hint=f"add <{tag} .../>")
    (mass,) = _numbers(parts["mass"], "value", 1, where)
    if mass < 0:
        raise InputError(f"<mass> is negative: {mass:g} kg", where=where, hint="give the mass of a body")
    xx, xy, xz, yy, yz, zz = (float(_numbers(parts["inertia"], name, 1, where)[0]) for name in _TENSOR)
    place = frame @ _place(inertial.find("origin"), where)
    turn, c = place[:3, :3], place[:3, 3]
    tensor = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    tensor += mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.array([mass, *(mass * c), *tensor[np.triu_indices(3)]])
