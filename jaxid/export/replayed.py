"""A replay of an exported file by MuJoCo, compared with jaxid's simulation and with the log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.effects.actuator import ActuatorGain
from jaxid.export.exported import ExportedFile
from jaxid.export.followed import STRETCH, Followed, lacks_table, rms
from jaxid.export.found_machine import case_of, found_machine
from jaxid.export.mujoco_run import MujocoRobot, load
from jaxid.logs.in_memory import LogLike
from jaxid.machine import Machine
from jaxid.results.aligned import aligned
from jaxid.session import open_session


@dataclass(frozen=True)
class Replayed:
    """An exported file in MuJoCo on one log; all values are RMS by joint [m or rad].

    Args:
        joints: Names of the joints.
        units: Unit of each joint's position.
        before: Measured less simulated position, of the user's file in MuJoCo; None: there is none.
        after: The same of the exported file.
        own: The same of the result in jaxid's simulation.
        difference: Exported file in MuJoCo less jaxid's simulation.
        costs: Changes by single differences between both on this log: a sentence, and the RMS by joint.
        closed: Whether the loop was closed; if not, both start anew from the log after each `stretch` [s].
        stretch: Length of such a stretch [s].
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    before: Float[np.ndarray, " n"] | None
    after: Float[np.ndarray, " n"]
    own: Float[np.ndarray, " n"]
    difference: Float[np.ndarray, " n"]
    costs: tuple[tuple[str, Float[np.ndarray, " n"]], ...]
    closed: bool
    stretch: float

    @property
    def share(self) -> Float[np.ndarray, " n"]:
        """Difference as a part of the gap that was closed, by joint; NaN where none was.

        Where there was no file before, nothing is known of the gap, and all are NaN.
        """
        if self.before is None:
            return np.full(self.own.shape, np.nan)
        closed = self.before - self.own
        return np.divide(self.difference, closed, out=np.full(closed.shape, np.nan), where=closed > 0)

    def __str__(self) -> str:
        how = "in the loop" if self.closed else f"open loop, anew from the log every {self.stretch:g} s"
        heads = ["joint", "exported", "jaxid", "exported - jaxid"]
        columns = [self.after, self.own, self.difference]
        if self.before is not None:
            heads, columns = [heads[0], "your file", *heads[1:], "of the gap closed"], [self.before, *columns]
        rows = [heads]
        for k, name in enumerate(self.joints):
            row = [f"{name} [{self.units[k]}]", *(f"{x[k]:.3g}" for x in columns)]
            if self.before is not None:
                row.append("-" if np.isnan(self.share[k]) else f"{100 * self.share[k]:.2g} %")
            rows.append(row)
        lines = [f"replay by MuJoCo, {how}: RMS from the log, by joint", aligned(rows), ""]
        return "\n".join([*lines, lacks_table("single causes", self.joints, self.units, self.costs)])


def replay_export(
    model: Mapping[str, Any],
    exported: ExportedFile,
    path: Path | None,
    log: LogLike,
    where: str = "result",
    to: str = "mjcf",
) -> Replayed:
    """Replay a log by the exported file in MuJoCo, and by the result in jaxid.

    Contacts are off. Commands of the log drive the file's actuators if the case takes these over, otherwise
    forces act on the joints. A loop is closed by the file's position servos if these are the case's,
    otherwise by the case's law.

    Args:
        model: `model` of result.json.
        exported: The file with the result in it.
        path: The user's file; None: there is none.
        log: The log, with the columns of the case.
        where: The result, for messages.
        to: Target of the file: "mjcf" or "urdf".

    Raises:
        InputError: If the result holds no case, the log is unsound, or a simulation cannot run.
    """
    case = _alone(case_of(model, where))
    session = open_session(case, log)
    machine = found_machine(model, case, session.machine)
    with TemporaryDirectory(prefix="jaxid-") as folder:
        at = path if path is not None else Path(folder) / f"exported.{'urdf' if to == 'urdf' else 'xml'}"
        users = None if path is None else mujoco_robot(path.read_bytes(), path, model, case, machine)
        ours = mujoco_robot(exported.content, at, model, case, machine, exported.added)
    followed = Followed.of(machine, session.fit.log, users, ours)
    measured = followed.log.position
    return Replayed(
        joints=tuple(model["joints"]),
        units=tuple(session.machine.unit("position", k) for k in range(len(model["joints"]))),
        before=None if followed.before is None else rms(measured - followed.before),
        after=rms(measured - followed.after),
        own=rms(measured - followed.own),
        difference=rms(followed.after - followed.own),
        costs=(*followed.lacks(model, exported), followed.time_step()),
        closed=followed.replay.controller is not None,
        stretch=STRETCH,
    )


def _alone(case: Case) -> Case:
    """Return a case of one log, without those that it was fitted or validated with."""
    identification = replace(case.identification, per_log=())
    tables = {k: v for k, v in case.tables.items() if k not in ("fit", "validation")}
    return replace(case, fits=(), validations=(), identification=identification, tables=tables)


def mujoco_robot(
    content: bytes,
    path: Path,
    model: Mapping[str, Any],
    case: Case,
    machine: Machine,
    added: tuple[str, ...] = (),
) -> MujocoRobot:
    """Compile a file, and decide how the drives of a case act on it."""
    held = {name: float(value) for name, value in model["held"].items()}
    compiled, robot = load(content, path, model["joints"], held, model["gravity_vector"], added)
    drives = machine.plant.driven(machine.plant.joints)
    by_joint = {drive.joint: drive for drive in robot.drives}
    of_file = [by_joint.get(model["joints"][joint]) for joint in drives]
    taken = case.tables["plant"].get("actuators", True) and all(of_file)
    servo = taken and machine.controller is not None and "controller" not in case.tables
    servo = servo and all(drive is not None and drive.kp is not None for drive in of_file)
    gains = np.array([np.nan if d is None or d.kp is not None else d.gain for d in of_file])
    # A file may have the gain of a drive that was found in the gear of its motor.
    wanted = (np.asarray(machine.gain), np.asarray(machine.gain) * _found_gains(machine, drives))
    driven = taken and not servo and any(np.allclose(gains, one, rtol=1e-9) for one in wanted)
    return MujocoRobot(compiled, robot, held, bool(servo), bool(driven), np.asarray(machine.gain), drives)


def _found_gains(machine: Machine, drives: tuple[int, ...]) -> Float[np.ndarray, " m"]:
    """Return the factor of each drive by which its force differs from the declared one."""
    out = np.ones(len(drives))
    for effect in machine.plant.effects:
        if isinstance(effect, ActuatorGain) and effect.port in drives:
            out[drives.index(effect.port)] *= float(effect.gain)
    return out
