"""Commands that are given a robot's file in place of a case: the case that the file and a log imply."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxid.case.mjcf import read_mjcf
from jaxid.case.robot import Robot
from jaxid.case.urdf import read_urdf_tree
from jaxid.commands.init import FirstCase, init
from jaxid.errors import InputError
from jaxid.files import write_whole
from jaxid.names import FIRST_CASE, ROBOT_FILES

if TYPE_CHECKING:
    from jaxid.case.case import CaseLike
    from jaxid.commands.identify import Identification
    from jaxid.logs.in_memory import LogLike
    from jaxid.session import Logs

# Simulation of a robot that is let go: its length [s], and the most samples a second.
_SECONDS, _RATE = 5.0, 500.0


@dataclass(frozen=True)
class RobotCase:
    """A case that follows from a robot's file and a log.

    Args:
        robot: The file.
        log: The log.
        search: Whether effects are to be searched for, see `init`.
        first: The case, its file names from the current folder on.
    """

    robot: Path
    log: str
    search: bool
    first: FirstCase

    @classmethod
    def of(cls, robot: str, logs: Sequence[str], *, search: bool = False) -> RobotCase:
        """Make the case of a robot's file and its log.

        Args:
            robot: The file.
            logs: The logs of the command; the first one shows the columns.
            search: Whether effects are to be searched for, see `init`.

        Raises:
            InputError: If there is no log, or the file or the log is unsound.
        """
        path = Path(robot)
        if not logs:
            raise _no_log(path)
        return cls(path, logs[0], search, _first(path, logs[0], search, Path()))

    @property
    def tables(self) -> dict[str, Any]:
        """Tables of the case, as every command takes them."""
        return self.first.tables

    def save(self, folder: Path) -> Path:
        """Write the case beside a result, file names from there on."""
        path = folder / FIRST_CASE
        write_whole(path, _first(self.robot, self.log, self.search, folder).text)
        return path

    def save_servos(self, result: Identification, folder: Path) -> str:
        """Write the robot's MJCF with the servos of a fit without a force beside its result.

        Args:
            result: The fit, whose result.json is in the folder.
            folder: The folder.

        Returns:
            Lines on the file, on anything that it cannot hold, and on how MuJoCo follows the logs with it. A
            URDF has no servos, and is not written.
        """
        if self.robot.suffix.lower() == ".urdf":
            return ""
        from jaxid.commands.export import export, machine_of
        from jaxid.export.mjcf_drives import servo_words
        from jaxid.export.servo_replay import replay_servos

        stored = folder / "result.json"
        exported, path = export(stored, "mjcf", self.robot), folder / found_file(str(self.robot))
        write_whole(path, exported.content)
        lines = [f"not exported: {note}" for note in exported.notes]
        if "controller" in self.tables:
            lines += [f"not exported: {line}" for line in servo_words(machine_of(stored)[0])]
        lines.append(f"changed {', '.join(exported.changed) or 'nothing'} in {path}")
        if b"file=" in exported.content:
            lines.append(f"it looks for its meshes beside it: copy it to {self.robot.parent}")
        replayed = replay_servos(result, machine_of(stored)[0], exported, self.robot)
        return "\n".join([*lines, "", str(replayed)])


def implied_case(case: CaseLike, log: Logs, *, search: bool = False) -> CaseLike:
    """Return the case that a robot's file and a log imply; any other case as it is.

    Args:
        case: The case, or a robot's file in MJCF or URDF in its place.
        log: The log, or a list of several, of which the first one shows the columns.
        search: Whether effects are to be searched for, see `init`.

    Raises:
        InputError: If there is no log for a robot's file, or one of the two is unsound.
    """
    if not isinstance(case, (str, Path)) or Path(case).suffix.lower() not in ROBOT_FILES:
        return case
    first = log[0] if isinstance(log, (list, tuple)) and log else log
    if first is None or isinstance(first, (list, tuple)):
        raise _no_log(Path(case))
    return _first(Path(case), first, search, Path()).tables


def _no_log(robot: Path) -> InputError:
    hint = "name the log behind the robot's file, or give a case"
    return InputError("a robot's file alone has no log", where=str(robot), hint=hint)


def found_file(robot: str) -> str:
    """Return the name of a robot's file with a result in it."""
    path = Path(robot)
    return f"{path.stem}_found{path.suffix}"


def let_go(robot: str) -> dict[str, Any]:
    """Return the tables of a simulation in which a robot is let go at its zero position, drives off.

    Raises:
        InputError: If the file is unsound.
    """
    path = Path(robot)
    found = _read(path)
    period = found.period or 1.0 / _RATE
    every = max(1, round(1.0 / _RATE / period))
    key = "urdf" if path.suffix.lower() == ".urdf" else "mjcf"
    still = {"kind": "multisine", "amplitude": 1e-12, "band_hz": [0.5, 5.0]}
    return {
        "plant": {"kind": "tree", key: robot, "actuators": False},
        "input": still,
        "simulation": {"duration": _SECONDS, "sample_rate": 1.0 / (every * period)},
    }


def _read(path: Path) -> Robot:
    return read_urdf_tree(path) if path.suffix.lower() == ".urdf" else read_mjcf(path)


def _first(path: Path, log: LogLike, search: bool, folder: Path) -> FirstCase:
    if path.suffix.lower() == ".urdf":
        return init(log, urdf=path, search=search, folder=folder)
    return init(log, mjcf=path, search=search, folder=folder)
