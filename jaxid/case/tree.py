"""[plant] of a tree: the joints of a URDF or MJCF file, their bodies, friction, springs and drives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxid.arms.base_by_rules import base_parameters_by_rules
from jaxid.arms.base_parameters import base_parameters
from jaxid.case.declared import EffectEntry, PlantEntry
from jaxid.case.links import ANGLE, MOST_LINKS, read_shafts
from jaxid.case.mjcf import read_mjcf
from jaxid.case.robot import Robot, kept, projected
from jaxid.case.urdf import read_urdf_tree
from jaxid.case.values import Value, read_value
from jaxid.effects import EFFECTS
from jaxid.errors import InputError, suggest
from jaxid.model.parameter import ParameterInfo, parameters_of
from jaxid.model.units import Units
from jaxid.names import TEN
from jaxid.plants.link_tree import LinkTree
from jaxid.schema import Spot, is_list

# Guess of an unknown delay of which a file says nothing [s].
_DELAY = 0.005


@dataclass(frozen=True)
class Tree:
    """The robot of a case, with the joints that it keeps.

    Args:
        robot: Its joints that move.
        given: The checked keys of [plant].
        at: Place of [plant], for messages.
    """

    robot: Robot
    given: Mapping[str, Any]
    at: Spot

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free joints."""
        return tuple(joint.name for joint in self.robot.free)

    def unknown(self, word: str) -> bool:
        """Check that the case declares such values unknown."""
        return word in self.given.get("unknown", ())

    @property
    def taken(self) -> bool:
        """True if the file's actuators are taken over."""
        return bool(self.robot.drives) and self.given.get("actuators", True)


def read_tree(given: Mapping[str, Any], table: Mapping[str, Any], spot: Spot) -> PlantEntry:
    """Read the file of a tree, and return the plant.

    Args:
        given: The checked keys of [plant], as `jaxid.case.tree_keys.read_tree_keys` returns them.
        table: [plant] as it stands in the case.
        spot: Place of [plant], for messages.

    Raises:
        InputError: If a value is impossible, or the file cannot be read.
    """
    file = "urdf" if "urdf" in given else "mjcf"
    path = spot.folder / given[file]
    whole = read_urdf_tree(path) if file == "urdf" else read_mjcf(path)
    robot = kept(whole, given.get("joints"), given.get("held", {}))
    if len(robot.joints) > MOST_LINKS:
        hint = f"name those that move by joints; a plant has 1 to {MOST_LINKS}"
        raise spot.at(file).fault(f"has {len(robot.joints)} joints", hint)
    tree = Tree(robot, given, spot)
    _check_mass(tree)

    options: dict[str, Any] = {"geometry": robot.geometry, "parents": robot.parents}
    if robot.copies:
        options |= {"copies": robot.copies, "leading": robot.leading}
    gravity = given.get("gravity_vector", robot.gravity)
    if gravity is not None:
        options["gravity_vector"] = gravity
    points = _payload_points(tree)
    if points is not None:
        options["payload_position"] = points
    ratios = _gear_ratios(tree)
    if ratios is not None:
        options["gear_ratio"] = ratios
    if "shafts" in table:
        free = replace(robot, joints=tuple(replace(j, follows=None) for j in robot.free))
        options["shafts"] = read_shafts(table["shafts"], free.geometry, spot)
    servo, notes = _servo(tree)
    return PlantEntry(
        cls=LinkTree,
        parameters=_parameters(tree, options),
        units=Units(given.get("motion", LinkTree.usual_motion), **given.get("units", {})),
        vertical=False,
        gravity=None,
        joints=len(robot.free),
        actuated=_actuated(tree),
        options=options,
        names=tree.names,
        links=robot.names,
        effects=_effects(tree),
        defaults=_limits(tree) | _gains(tree) | servo,
        notes=(*robot.notes, *notes),
        bodies=robot.bodies,
        rotors=np.array([joint.armature for joint in projected(robot).values()]),
    )


def _check_mass(tree: Tree) -> None:
    """Refuse a joint that carries nothing that has mass."""
    joints = tree.robot.joints
    heavy = [joint.body[0] > 0 or joint.armature > 0 for joint in joints]
    for k in reversed(range(len(joints))):
        if heavy[k] and joints[k].parent >= 0:
            heavy[joints[k].parent] = True
    for joint, found in zip(joints, heavy, strict=True):
        if not found and joint.follows is None and not tree.unknown("armature"):
            hint = "give a link behind it <inertial>, or leave the joint out of joints"
            where = f"{tree.robot.file}, joint '{joint.name}'"
            raise InputError("it moves no mass", where=where, hint=hint)


def _gear_ratios(tree: Tree) -> list[float] | None:
    given = tree.given.get("gear_ratio")
    if given is None:
        return None
    if not isinstance(given, Mapping):
        return [float(given)] * len(tree.names)
    _check_names(given, tree.names, tree.at.at("gear_ratio"))
    return [float(given.get(name, 1.0)) for name in tree.names]


def _payload_points(tree: Tree) -> np.ndarray | None:
    """Return the point of each link at which it may carry a payload; None if the case names none."""
    given, robot, spot = tree.given.get("payload_at"), tree.robot, tree.at.at("payload_at")
    if given is None:
        return None
    out, loaded = np.zeros((len(robot.joints), 3)), dict[int, str]()
    for link, point in given.items():
        if link not in robot.places:
            raise spot.fault(f"names '{link}', which is no link of the file", suggest(link, robot.places))
        carrier, frame = robot.places[link]
        if carrier < 0:
            raise spot.fault(f"names '{link}', which no joint moves", "name a link behind a joint")
        if carrier in loaded:
            what = f"names '{loaded[carrier]}' and '{link}', which move as one"
            raise spot.fault(what, "keep one of them")
        loaded[carrier] = link
        out[carrier] = frame[:3, :3] @ np.array(point) + frame[:3, 3]
    return out


def _check_names(given: Any, names: tuple[str, ...], spot: Spot) -> None:
    for name in given:
        if name not in names:
            raise spot.fault(f"names '{name}', which is no joint that moves", suggest(name, names))


def _actuated(tree: Tree) -> tuple[int, ...] | None:
    """Return the driven joints: those that the case names, or those of the file's actuators; None: all."""
    names, given = tree.names, tree.given.get("actuated")
    if given is not None:
        spot = tree.at.at("actuated")
        _check_names(given, names, spot)
        if len(set(given)) < len(given):
            raise spot.fault("names a joint twice", "name each joint once")
    elif tree.taken:
        driven = {drive.joint for drive in tree.robot.drives}
        given = [name for name in names if name in driven]
    if given is None or list(given) == list(names):
        return None
    return tuple(names.index(name) for name in given)


def _driven(tree: Tree) -> list[str]:
    """Return the names of the driven joints, by drive."""
    actuated = _actuated(tree)
    return [*tree.names] if actuated is None else [tree.names[k] for k in actuated]


def _parameters(tree: Tree, options: dict[str, Any]) -> dict[str, tuple[Value, ...]]:
    """Return the ten parameters of each link, and the rotors; those that the case states come last."""
    robot, infos = tree.robot, parameters_of(LinkTree)
    links = dict(zip(TEN, robot.bodies.T.copy(), strict=True))
    free = {name: np.full(len(robot.joints), tree.unknown("all")) for name in TEN}
    stated = tree.given.get("parameters", {})
    spot = tree.at.under("[plant.parameters]")
    if not isinstance(stated, Mapping):
        raise spot.fault("is not a table", "write [plant.parameters] with the values by joint")
    for name in stated:
        if name not in infos:
            raise spot.fault(f"unknown key '{name}'", suggest(name, infos))

    rotors = np.array([joint.armature for joint in projected(robot).values()])
    rotors = rotors / np.asarray(options.get("gear_ratio", 1.0)) ** 2
    turns = np.any(rotors) or tree.unknown("armature") or "rotor_inertia" in stated
    free["rotor_inertia"] = np.full(len(rotors), tree.unknown("armature"))
    if tree.unknown("base"):
        # Known rotors stand for themselves; unknown ones are part of the sums.
        unknown = {"rotor_inertia": rotors} if tree.unknown("armature") else {}
        places, values = _base(LinkTree(**links, **unknown, **_fixed(options)), tree.at.at("unknown"))
        for name, one in (links | unknown).items():
            one[:], free[name][:] = 0.0, False
        for (name, k), value in zip(places, values, strict=True):
            (links | unknown)[name][k], free[name][k] = value, True
    out = {
        name: tuple(Value(float(v), bool(f)) for v, f in zip(links[name], free[name], strict=True))
        for name in TEN
    }
    if turns:
        out["rotor_inertia"] = tuple(
            Value(float(v), bool(f)) for v, f in zip(rotors, free["rotor_inertia"], strict=True)
        )
    if "payload_at" in tree.given:
        out["payload"] = (Value(0.0),) * len(robot.joints)
    elif "payload" in stated:
        hint = 'state payload_at = { "<link>" = [x, y, z] } in [plant]'
        raise spot.at("payload").fault("has no place", hint)
    for name, value in stated.items():
        of_links = name in (*TEN, "payload")
        places = robot.names if of_links else tree.names
        out[name] = _stated(value, infos[name], out[name], places, spot.at(name))
    return out


def _fixed(options: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if name != "shafts"}


def _base(plant: LinkTree, spot: Spot) -> tuple[tuple, np.ndarray]:
    """Return the places of the base parameters, and their values."""
    if np.any(np.asarray(plant.gravity_vector)) and not plant.copies:
        base = base_parameters_by_rules(plant, ANGLE)
    else:
        try:
            base = base_parameters(plant)
        except ValueError as error:
            raise spot.refuse("base", f"cannot be found: {error}", 'state unknown = "all"') from error
    return base.places, base.of(plant)


def _stated(
    value: Any, info: ParameterInfo, before: tuple[Value, ...], names: tuple[str, ...], spot: Spot
) -> tuple[Value, ...]:
    """Return values of the case in place of the file's: a list, or a table by joint."""
    if is_list(value):
        if len(value) != len(names):
            raise spot.fault(f"has {len(value)} entries", f"give {len(names)}: {', '.join(names)}")
        return tuple(read_value(v, info, spot.entry(k)) for k, v in enumerate(value, start=1))
    if not isinstance(value, Mapping):
        raise spot.refuse(value, "is no table by joint", f"write {{ {names[0]} = ... }}, or a list")
    _check_names(value, names, spot)
    return tuple(
        read_value(value[name], info, spot.inside(name)) if name in value else old
        for name, old in zip(names, before, strict=True)
    )


def _effects(tree: Tree) -> tuple[EffectEntry, ...]:
    """Return friction, springs and drives of the file as effects, one for each kind."""
    names, joints = tree.names, projected(tree.robot)
    values: dict[tuple[str, str], dict[int, Value]] = {}

    def put(kind: str, parameter: str, port: int, value: float, word: str = "") -> None:
        unknown = bool(word) and tree.unknown(word)
        if value or unknown:
            guess = value or (_DELAY if word == "delay" else 0.0)
            values.setdefault((kind, parameter), {})[port] = Value(guess, unknown)

    for port, name in enumerate(names):
        joint = joints[name]
        put("viscous_friction", "coefficient", port, joint.damping[0], "damping")
        put("quadratic_drag", "coefficient", port, joint.damping[1])
        put("cubic_friction", "coefficient", port, joint.damping[2])
        put("coulomb_friction", "level", port, joint.friction, "frictionloss")
        constant, *slopes = joint.spring
        # A spring's rest is unknown with its stiffness.
        put("constant_force", "level", port, -constant, "stiffness")
        put("linear_stiffness", "coefficient", port, slopes[0], "stiffness")
        put("quadratic_stiffness", "coefficient", port, slopes[1])
        put("cubic_stiffness", "coefficient", port, slopes[2])
    driven = _driven(tree)
    for drive in tree.robot.drives if tree.taken else ():
        if drive.joint not in driven:
            continue
        port = names.index(drive.joint)
        put("back_emf_damping", "coefficient", port, drive.drag)
        put("actuator_lag", "time_constant", port, drive.lag)
        # Of a servo both are part of [controller].
        if drive.kp is None:
            put("input_delay", "delay", port, drive.delay, "delay")
            if drive.limit is not None:
                put("saturation", "limit", port, drive.limit, "forcerange")
    return tuple(
        EffectEntry(EFFECTS[kind], {parameter: tuple(of_ports.values())}, tuple(of_ports))
        for (kind, parameter), of_ports in values.items()
    )


def _limits(tree: Tree) -> dict[str, Any]:
    ranges = [joint.range for joint in tree.robot.free]
    if None in ranges:
        return {}
    return {"limits": {"stroke": [list(ends) for ends in ranges if ends is not None]}}


def _gains(tree: Tree) -> dict[str, Any]:
    """Return [actuator] with the gains of the file's actuators, if any is not one."""
    by_joint = {drive.joint: drive.gain for drive in tree.robot.drives} if tree.taken else {}
    gains = [by_joint.get(name, 1.0) for name in _driven(tree)]
    return {} if set(gains) <= {1.0} else {"actuator": {"gain": gains}}


def _servo(tree: Tree) -> tuple[dict[str, Any], list[str]]:
    """Return [controller] with the servos of the file, if every drive is one; and sentences on the rest."""
    drives = {drive.joint: drive for drive in tree.robot.drives} if tree.taken else {}
    servos = [drives[name] for name in _driven(tree) if name in drives and drives[name].kp is not None]
    if not servos:
        return {}, []
    if len(servos) < len(_driven(tree)):
        return {}, ["not every drive is a position servo: state [controller]"]

    def values(word: str, of_file: list[float | None]) -> list[Any]:
        return [{"guess": value} for value in of_file] if tree.unknown(word) else of_file

    law: dict[str, Any] = {
        "kind": "pd",
        "derivative": "velocity",
        "kp": values("kp", [drive.kp for drive in servos]),
        "kd": values("kv", [drive.kd for drive in servos]),
        "period": tree.robot.period,
    }
    limits, notes = [drive.limit for drive in servos], []
    if None not in limits:
        law["limit"] = values("forcerange", limits)
    elif any(limits):
        notes.append("some servos have a force range, others none: state limit in [controller]")
    if tree.unknown("delay"):
        law["delay"] = [{"guess": drive.delay or _DELAY} for drive in servos]
    elif any(drive.delay for drive in servos):
        law["delay"] = [drive.delay for drive in servos]
    return {"controller": law}, notes
