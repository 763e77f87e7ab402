"""The command `init`: from a raw log to a case that runs, with what it assumed and what it has to ask."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxid.case.case import Case, load_case
from jaxid.case.mjcf import read_mjcf
from jaxid.case.robot import Robot
from jaxid.case.urdf import read_urdf, read_urdf_tree
from jaxid.consistency.balance_fit import rough_gains
from jaxid.errors import InputError
from jaxid.estimators.apart.joint import mean_inertias
from jaxid.files import write_whole
from jaxid.first_case.columns import Chosen, choose, columns_of
from jaxid.first_case.drafting import Draft
from jaxid.first_case.flexible_draft import FlexibleDraft
from jaxid.first_case.gains import with_gains
from jaxid.first_case.joints import NO_FORCE_HINT, most_moved, need_forces, of_robot
from jaxid.first_case.raw import raw_log
from jaxid.first_case.reference import beside_reference
from jaxid.first_case.section import Section, case_text
from jaxid.first_case.servo import loop_of_servos, servos_of
from jaxid.first_case.units import measures_of
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.session import open_session

# Values of a robot's file that forces show, and those that a servo's motion along a known reference shows.
UNKNOWN_OF_FORCES = ("base", "armature", "damping", "frictionloss")
UNKNOWN_OF_SERVOS = ("damping", "frictionloss", "kp", "kv", "delay", "forcerange")
# Values of a file beside an unknown loop; a URDF has no rotors.
UNKNOWN_BESIDE_LOOP = ("armature", "damping", "frictionloss")
_TITLE = (
    "Lines that begin with `assumed` say what the log seemed to show.",
    "Lines that begin with `question` ask what only you know. Neither stops a command.",
)


@dataclass(frozen=True, repr=False)
class FirstCase:
    """A case written from a raw log.

    Args:
        text: The case as TOML, with comments.
        folder: Folder that file names in it start from.
        source: The log.
        assumed: Everything that was assumed, a line each.
        questions: Everything that only the user knows, a line each.
    """

    text: str
    folder: Path
    source: str
    assumed: tuple[str, ...]
    questions: tuple[str, ...]

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of the case, as `load_case` takes them."""
        return tomllib.loads(self.text)

    def case(self) -> Case:
        """Return the case, as `identify` and the other commands take it."""
        tables = self.tables
        for file in ("urdf", "mjcf"):
            if file in tables["plant"]:
                tables["plant"][file] = str(self.folder / tables["plant"][file])
        return load_case(tables)

    def save(self, path: str | Path, *, overwrite: bool = False) -> Path:
        """Write the case to a file.

        Raises:
            InputError: If the file exists and `overwrite` is not given, or it cannot be written.
        """
        path = check_target(Path(path), overwrite=overwrite)
        write_whole(path, self.text)
        return path

    def __str__(self) -> str:
        lines = [f"assumed: {line}" for line in self.assumed]
        return "\n".join([*lines, *(f"question: {line}" for line in self.questions)])

    def __repr__(self) -> str:
        return f"FirstCase of {self.source}: {len(self.assumed)} assumed, {len(self.questions)} question(s)"


def check_target(path: Path, *, overwrite: bool = False) -> Path:
    """Check that a case may be written to a file, before the work that makes it.

    Raises:
        InputError: If it exists and `overwrite` is false, is a folder, or its folder does not exist.
    """
    if path.is_dir():
        raise InputError("is a folder", where=str(path), hint="name a file: -o case.toml")
    if path.suffix.lower() != ".toml":
        raise InputError("a case is a .toml file", where=str(path), hint="end its name in .toml")
    if path.exists() and not overwrite:
        hint = "choose another -o, or overwrite with --force"
        raise InputError("exists already", where=str(path), hint=hint)
    if not path.parent.is_dir():
        raise InputError("has no such folder", where=str(path), hint="make the folder first")
    return path


def init(
    log: LogLike,
    *,
    urdf: str | Path | None = None,
    tip: str | None = None,
    mjcf: str | Path | None = None,
    folder: str | Path = ".",
    unknown: Sequence[str] | None = None,
    search: bool = False,
) -> FirstCase:
    """Write a first case from a raw log: columns, units, sensors, and rough guesses of the unknowns.

    Args:
        log: The file, or a table in memory (DataFrame, Dataset, dict).
        urdf: File that describes the robot of the log.
        tip: Name of its last link whose joints the log has; None: all joints, or those that the log names.
        mjcf: MuJoCo model of the robot of the log.
        folder: Folder in which the case will stand, for the path of the robot's file in it.
        unknown: Words of `[plant] unknown` for a robot's file; None: all that a log of its kind shows.
        search: Whether effects are to be searched for. Friction and springs are then unknown only if the
            robot's file has any, because the search finds what the file lacks. Rotors are too, except in an
            unknown loop. Not used if `unknown` is given.

    Raises:
        InputError: If no column is the position or velocity of a joint, there is no force, or nothing else
            from which one could be concluded.
    """
    if mjcf is not None and urdf is not None:
        raise InputError("--mjcf and --urdf are both given", hint="name one file")
    if tip is not None and urdf is None:
        raise InputError("--tip goes with --urdf", hint="add --urdf FILE, or leave --tip out")
    if isinstance(log, Log):
        hint = "give the file, or a table with the columns by name"
        raise InputError("a Log has its columns already", where=log.source, hint=hint)

    raw = raw_log(log)
    robot = _robot(mjcf, urdf)
    names = () if robot is None else _joints_of(robot, urdf, tip)
    columns = columns_of(raw.data, raw.units, raw.contents.time, names)
    chosen = choose(columns, raw.source, of_robot=robot is not None)
    if robot is not None:
        chosen = of_robot(chosen, names, _actuated(robot), robot.file, raw.source, to_tip=tip is not None)
    elif len(chosen.joints) > 1:
        need_forces(chosen, raw.source)
        chosen = most_moved(chosen)

    motion = "" if robot is None else _motion_of(robot, next(iter(chosen.joints)))
    kind = Draft if chosen.load is None else FlexibleDraft
    measures = measures_of(chosen, motion)
    if robot is None:
        measures = beside_reference(chosen, measures)
    draft = kind(log, raw, chosen, measures, Path(folder))
    if robot is not None:
        key = "urdf" if mjcf is None else "mjcf"
        own_loop = not chosen.force and not servos_of(robot, chosen.joints)
        if unknown is None:
            unknown = _unknown(robot, force=bool(chosen.force), own_loop=own_loop, search=search)
        sections = draft.tree(robot, Path(robot.file), key, chosen.joints, unknown)
        if own_loop:
            sections = _with_loop(sections, len(chosen.joints), raw.source, log, Path(folder))
        if (unit := draft.unit_of_force) and {"base", "all"} & {*unknown}:
            known, *others = draft.driven
            tried = with_gains(sections, dict.fromkeys(others, 1.0), known, unit)
            shown = _shown_gains(_first_case(raw.source, Path(folder), tried), log, others)
            sections = with_gains(sections, shown, known, unit, [j for j in others if j not in shown])
    elif not chosen.force:
        sections = draft.without_force()
    else:
        sections = draft.axis()
    first = _first_case(raw.source, Path(folder), sections)
    _need_loadable(first, chosen)
    return first


def _first_case(source: str, folder: Path, sections: Sequence[Section]) -> FirstCase:
    """Join the sections of a case, with what they assume and ask."""
    title = [f"Case of {Path(source).name}, written by `jaxid init`.", *_TITLE]
    return FirstCase(
        case_text(title, sections),
        folder,
        source,
        tuple(line for section in sections for line in section.assumed),
        tuple(line for section in sections for line in section.questions),
    )


def _unknown(robot: Robot, *, force: bool, own_loop: bool, search: bool) -> list[str]:
    """Return the words for the values of a robot's file that are unknown.

    Args:
        robot: The robot.
        force: Whether the log has forces.
        own_loop: Whether the loop of its servos is one of the case, and not of the file.
        search: See `init`.
    """
    words = UNKNOWN_BESIDE_LOOP if own_loop else UNKNOWN_OF_SERVOS
    words = UNKNOWN_OF_FORCES if force else words
    if not search:
        return [*words]
    joints = robot.joints
    stated = {
        # No URDF has rotors, without which an unknown loop cannot be fitted.
        "armature": own_loop or any(joint.armature for joint in joints),
        "damping": any(any(joint.damping) for joint in joints),
        "frictionloss": any(joint.friction for joint in joints),
        "stiffness": any(any(joint.spring) for joint in joints),
    }
    return [word for word in (*words, "stiffness") if stated.get(word, True)]


def _with_loop(
    sections: Sequence[Section], joints: int, source: str, log: LogLike, folder: Path
) -> list[Section]:
    """Return the sections of a robot's case with the unknown loop of its servos.

    The guesses of its gains are those of a loop about the mean inertia of each joint along the log.

    Args:
        sections: Sections of the case, without a loop.
        joints: Number of its joints.
        source: The log, for messages.
        log: The log.
        folder: Folder in which the case will stand.
    """
    tried = [*sections, loop_of_servos([1.0] * joints, math.inf)]
    try:
        session = open_session(_first_case(source, folder, tried).case(), log)
    except InputError:
        return tried  # the next command says what is wrong
    inertias = mean_inertias(session.machine, session.fit.data)
    return [*sections, loop_of_servos(inertias.tolist(), session.fit.log.period)]


def _shown_gains(first: FirstCase, log: LogLike, joints: Sequence[int]) -> dict[int, float]:
    """Return the rough gains of the drives of which a log shows the gain, by joint.

    Joints of an arm push each other, which shows the ratios of their gains.

    Args:
        first: Case in which the gains of these joints are unknown.
        log: The log.
        joints: Joints whose gain is unknown, 0-based.
    """
    try:
        session = open_session(first.case(), log)
    except InputError:
        return {}  # the command that follows says what is wrong
    rough = rough_gains(session.machine, session.fit.data)
    if rough is None:
        return {}
    found = zip(joints, rough.gains.tolist(), rough.shown, strict=True)
    return {joint: gain for joint, gain, shown in found if shown}


def _robot(mjcf: str | Path | None, urdf: str | Path | None) -> Robot | None:
    """Read the robot's file, if there is one."""
    if mjcf is not None:
        return read_mjcf(mjcf)
    return None if urdf is None else read_urdf_tree(urdf)


def _joints_of(robot: Robot, urdf: str | Path | None, tip: str | None) -> tuple[str, ...]:
    """Return the names of a robot's free joints, or of those up to a tip of its URDF file."""
    names = tuple(joint.name for joint in robot.free)
    if urdf is None or tip is None:
        return names
    to_tip = read_urdf(urdf, tip).names
    return tuple(name for name in names if name in to_tip)


def _actuated(robot: Robot) -> tuple[str, ...]:
    """Return the names of the joints that a file's actuators drive, or else those with a limit of effort."""
    driven = tuple(drive.joint for drive in robot.drives)
    return driven or tuple(joint.name for joint in robot.free if joint.effort)


def _motion_of(robot: Robot, name: str) -> str:
    """Return "linear" or "rotary" for a joint of a robot."""
    joint = next(joint for joint in robot.joints if joint.name == name)
    return "rotary" if joint.motion == "revolute" else "linear"


def _need_loadable(first: FirstCase, chosen: Chosen) -> None:
    """Refuse a log whose case this version cannot load, with the reason."""
    try:
        first.case()
    except InputError as error:
        if chosen.position and (chosen.force or chosen.reference):
            raise
        what, hint = (
            "the log has no position, and velocities alone are not fitted yet",
            "log the position too",
        )
        if not chosen.force:
            what, hint = "the log has no force, and a free swing is not fitted yet", NO_FORCE_HINT
        elif chosen.time is None:
            what = "the log is a table of steady speeds, which is not fitted yet"
        raise InputError(what, where=first.source, hint=hint) from error
