"""A URDF of a robot of which no file exists: frames, bodies, damping and friction."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.export.exported import ExportedFile, JointLaws, notes_of_case, shown
from jaxid.export.new_robot import NewRobot, comment, leader_of, leading_of
from jaxid.export.xml_text import escaped, listed, numbers

# Effects that <dynamics> states, with their parameter, and its attributes.
_LAWS = {"viscous_friction": "coefficient", "coulomb_friction": "level"}
_ATTRIBUTES = {"viscous_friction": "damping", "coulomb_friction": "friction"}
# Range [m], speed [m/s] and force [N] of a sliding joint: the format asks for them, and no log has them.
_FAR = 1000.0
_USUAL = (0.0, 0.0, -9.81)
_TENSOR = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")

_URDF = """\
<?xml version="1.0"?>
{comment}
<robot name="{name}">
{lines}</robot>
"""


def new_urdf(model: Mapping[str, Any], stem: str, version: str, where: str) -> ExportedFile:
    """Write a URDF of a robot of which no file exists.

    Joints that turn are continuous, since a result states no limits.

    Args:
        model: `model` of result.json.
        stem: Name of the file without its suffix.
        version: That of jaxid.
        where: The result, for messages.

    Raises:
        InputError: If the result has no frames, because an older jaxid wrote it.
    """
    robot, leading = NewRobot.of(model, where), leading_of(model)
    laws = JointLaws.of(model, _LAWS, ())
    notes = [*robot.notes, *(f"{shown(model['effects'][k])} has no place in a URDF" for k in laws.lost)]
    joints = dict(zip(robot.plain.names, laws.values, strict=True))
    lines = ['<link name="base"/>']
    for link in range(len(robot.plain.links)):
        lines += [*_link(robot, link), *_joint(robot, link, joints, leading, notes)]
    for name, rotor in zip(robot.plain.names, robot.rotors, strict=True):
        if rotor:
            notes.append(f"the rotor of joint '{name}' ({rotor:.6g}) has no place in a URDF")
    gravity = tuple(map(float, model["gravity_vector"]))
    if gravity != _USUAL:
        notes.append(f"gravity {list(gravity)} m/s^2 has no place in a URDF: set it in the simulation")
    notes += notes_of_case(model)
    text = _URDF.format(
        comment=comment(stem, version, notes),
        name=escaped(stem),
        lines="".join(f"  {line}\n" for line in lines),
    )
    names = tuple(f"joint '{name}'" for name in model["joints"])
    return ExportedFile(text.encode(), names, tuple(notes), laws.lost, robot.real, new=True)


def _link(robot: NewRobot, link: int) -> Iterator[str]:
    """Yield the lines of a link."""
    mass, centre, tensor = robot.inertial(link)
    six: dict[str, str] = dict(zip(_TENSOR, map(repr, tensor[np.triu_indices(3)].tolist()), strict=True))
    yield f'<link name="{escaped(robot.plain.links[link])}_link">'
    yield f'  <inertial><origin xyz="{numbers(centre)}" rpy="0 0 0"/><mass value="{mass!r}"/>'
    yield f"    <inertia {listed(six)}/></inertial>"
    yield "</link>"


def _joint(
    robot: NewRobot,
    link: int,
    joints: Mapping[str, Mapping[str, float]],
    leading: tuple[int, ...],
    notes: list[str],
) -> Iterator[str]:
    """Yield the lines of the joint that moves a link."""
    plain = robot.plain
    name, parent = plain.links[link], plain.parents[link]
    turns, leader = plain.revolute[link], leader_of(plain, link, leading)
    head = {"name": name, "type": "continuous" if turns else "prismatic"}
    yield f"<joint {listed(head)}>"
    carrier = "base" if parent < 0 else f"{plain.links[parent]}_link"
    yield f'  <parent link="{escaped(carrier)}"/><child link="{escaped(name)}_link"/>'
    place = {"xyz": numbers(plain.origins[link]), "rpy": numbers(_rpy(plain.axes[link]))}
    yield f'  <origin {listed(place)}/><axis xyz="0 0 1"/>'
    if leader is not None:
        yield f'  <mimic joint="{escaped(leader[0])}" multiplier="{leader[1]!r}"/>'
    if not turns:
        limit = {"lower": -_FAR, "upper": _FAR, "effort": _FAR, "velocity": _FAR}
        yield f"  <limit {listed({key: repr(value) for key, value in limit.items()})}/>"
        notes.append(f"limits of joint '{name}', which the format asks for, are unknown: set {_FAR:g}")
    law = joints.get(name, {})
    for kind, value in law.items():
        if value < 0:
            notes.append(f"{_ATTRIBUTES[kind]} of joint '{name}' would be {value:.3g}: written as 0")
    values = {_ATTRIBUTES[kind]: repr(max(value, 0.0)) for kind, value in law.items()}
    if values:
        yield f"  <dynamics {listed(values)}/>"
    yield "</joint>"


def _rpy(turn: Float[np.ndarray, "3 3"]) -> tuple[float, float, float]:
    """Return a rotation as turns about the fixed axes x, y, z in this order [rad].

    About y it is from -90 to 90 degrees; at these the turn about z is zero.
    """
    level = float(np.hypot(turn[0, 0], turn[1, 0]))
    pitch = float(np.arctan2(-turn[2, 0], level))
    if level < 1e-12:
        return float(np.arctan2(-turn[1, 2], turn[1, 1])), pitch, 0.0
    return float(np.arctan2(turn[2, 1], turn[2, 2])), pitch, float(np.arctan2(turn[1, 0], turn[0, 0]))
