"""A replay of an exported file by MuJoCo, compared with jaxid's simulation and with the log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.case.case import Case
from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile, shown
from jaxid.export.found_machine import case_of, found_machine, without_effects
from jaxid.export.mujoco_run import MujocoRobot, Setting, load
from jaxid.gap import simulation_gap
from jaxid.logs.in_memory import LogLike
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.results.aligned import aligned
from jaxid.session import open_session
from jaxid.simulation.replay import Replay, exact_numerics, make_replay, with_fitted_start
from jaxid.simulation.step_size import TooStiffError

# Length of the stretches after which an open loop starts anew from the log [s]: errors of the start of an arm
# that stands upright grow with a time constant of about 0.15 s.
_STRETCH = 0.25
# Factor by which the time step of the file is shortened to see what it costs.
_FINER = 10


@dataclass(frozen=True)
class Replayed:
    """An exported file in MuJoCo on one log; all values are RMS by joint [m or rad].

    Args:
        joints: Names of the joints.
        units: Unit of each joint's position.
        before: Measured less simulated position, of the user's file in MuJoCo.
        after: The same of the exported file.
        own: The same of the result in jaxid's simulation.
        difference: Exported file in MuJoCo less jaxid's simulation.
        costs: Changes by single differences between both on this log: a sentence, and the RMS by joint.
        closed: Whether the loop was closed; if not, both start anew from the log after each `stretch` [s].
        stretch: Length of such a stretch [s].
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    before: Float[np.ndarray, " n"]
    after: Float[np.ndarray, " n"]
    own: Float[np.ndarray, " n"]
    difference: Float[np.ndarray, " n"]
    costs: tuple[tuple[str, Float[np.ndarray, " n"]], ...]
    closed: bool
    stretch: float

    @property
    def share(self) -> Float[np.ndarray, " n"]:
        """Difference as a part of the gap that was closed, by joint; NaN where none was."""
        closed = self.before - self.own
        return np.divide(self.difference, closed, out=np.full(closed.shape, np.nan), where=closed > 0)

    def __str__(self) -> str:
        how = "in the loop" if self.closed else f"open loop, anew from the log every {self.stretch:g} s"
        heads = ["joint", "your file", "exported", "jaxid", "exported - jaxid", "of the gap closed"]
        rows = [heads]
        for k, name in enumerate(self.joints):
            share = "-" if np.isnan(self.share[k]) else f"{100 * self.share[k]:.2g} %"
            sizes = (x[k] for x in (self.before, self.after, self.own, self.difference))
            rows.append([f"{name} [{self.units[k]}]", *(f"{x:.3g}" for x in sizes), share])
        lines = [f"replay by MuJoCo, {how}: RMS from the log, by joint", aligned(rows)]
        for text, sizes in self.costs:
            listed = ", ".join(
                f"{n} {x:.2g} {u}" for n, x, u in zip(self.joints, sizes, self.units, strict=True)
            )
            lines.append(f"{text}: {listed}")
        return "\n".join(lines)


def replay_export(
    model: Mapping[str, Any], exported: ExportedFile, path: Path, log: LogLike, where: str = "result"
) -> Replayed:
    """Replay a log by the exported file in MuJoCo, and by the result in jaxid.

    Contacts are off. Commands of the log drive the file's actuators if the case takes these over, otherwise
    forces act on the joints. A loop is closed by the file's position servos if these are the case's,
    otherwise by the case's law.

    Args:
        model: `model` of result.json.
        exported: The file with the result in it.
        path: The user's file.
        log: The log, with the columns of the case.
        where: The result, for messages.

    Raises:
        InputError: If the result holds no case, the log is unsound, or a simulation cannot run.
    """
    case = _alone(case_of(model, where))
    session = open_session(case, log)
    machine, measured = session.machine, session.fit.log
    found = found_machine(model, case, machine)
    replay, position = _simulated(found, measured)

    def robot(content: bytes, added: tuple[str, ...] = ()) -> MujocoRobot:
        return mujoco_robot(content, path, model, case, found, added)

    ours, theirs = robot(exported.content, exported.added), robot(path.read_bytes())
    motion, before = ours.motion(replay), theirs.motion(replay)
    for what, values in (("the exported file", motion), ("your file", before)):
        if not np.all(np.isfinite(values)):
            raise InputError(f"MuJoCo's simulation of {what} diverges on {measured.source}", where=str(path))
    return Replayed(
        joints=tuple(model["joints"]),
        units=tuple(machine.unit("position", k) for k in range(len(model["joints"]))),
        before=rms(measured.position - before),
        after=rms(measured.position - motion),
        own=rms(measured.position - position),
        difference=rms(motion - position),
        costs=tuple(_costs(model, exported, found, measured, position, ours, replay, motion)),
        closed=replay.controller is not None,
        stretch=_STRETCH,
    )


def _alone(case: Case) -> Case:
    """Return a case of one log, without those that it was fitted or validated with."""
    identification = replace(case.identification, per_log=())
    tables = {k: v for k, v in case.tables.items() if k not in ("fit", "validation")}
    return replace(case, fits=(), validations=(), identification=identification, tables=tables)


def _simulated(machine: Machine, log: Log) -> tuple[Replay, np.ndarray]:
    """Return the replay of a log, and the positions that jaxid simulates.

    Raises:
        InputError: If the simulation cannot run, or diverges.
    """
    try:
        numerics = exact_numerics(machine, log)
    except TooStiffError as error:
        raise InputError(f"jaxid cannot simulate this log: {error}", where=log.source) from error
    if machine.controller is None:
        numerics = replace(numerics, segment=max(2, round(_STRETCH / log.period)))
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    position = simulation_gap(machine, replay, log).position
    if not np.all(np.isfinite(position)):
        raise InputError("jaxid's simulation of this log diverges", where=log.source)
    return replay, position


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
    driven = bool(taken and not servo and np.allclose(gains, machine.gain, rtol=1e-9))
    return MujocoRobot(compiled, robot, held, bool(servo), driven, np.asarray(machine.gain), drives)


def _costs(
    model: Mapping[str, Any],
    exported: ExportedFile,
    machine: Machine,
    log: Log,
    position: np.ndarray,
    robot: MujocoRobot,
    replay: Replay,
    motion: np.ndarray,
) -> Iterator[tuple[str, np.ndarray]]:
    """Return the changes by each effect that the file lacks, by MuJoCo's step, and by its soft friction."""
    for number in exported.lost:
        less = without_effects(machine, {number})
        try:
            changed = _simulated(less, log)[1]
        except InputError:
            continue
        yield f"without {shown(model['effects'][number])}", rms(changed - position)
    for name in exported.added:
        stiff = robot.motion(replay, Setting(locked=(name,)))
        yield f"without the second joint '{name}'", rms(stiff - motion)
    fine = robot.motion(replay, Setting(finer=_FINER))
    yield f"time step of {robot.model.opt.timestep:g} s, against a {_FINER}th", rms(fine - motion)
    if np.any(robot.model.dof_frictionloss > 0):
        stiff = robot.motion(replay, Setting(finer=_FINER, stiff=True))
        yield "soft dry friction (solreffriction), against stiff", rms(stiff - fine)


def rms(off: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the root mean square of each column, (n,); a missing reading is NaN."""
    return np.sqrt(np.nanmean(off**2, axis=0))
