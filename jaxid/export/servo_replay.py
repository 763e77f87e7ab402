"""The servos of a robot's file, before and after a fit, on all its logs in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile
from jaxid.export.replayed import mujoco_robot, rms
from jaxid.results.aligned import aligned
from jaxid.simulation.replay import exact_numerics, make_replay

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification


@dataclass(frozen=True)
class ServoReplay:
    """Logs that MuJoCo has followed from their references alone.

    Args:
        joints: Names of the joints.
        units: Unit of each joint's position.
        logs: Names of the logs.
        before: RMS of measured less simulated position of the user's file, (logs, n) [m or rad].
        after: RMS of that of the exported file.
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    logs: tuple[str, ...]
    before: Float[np.ndarray, "logs n"]
    after: Float[np.ndarray, "logs n"]

    def __str__(self) -> str:
        heads = ["log", *(f"{name} [m{unit}]" for name, unit in zip(self.joints, self.units, strict=True))]
        rows = [heads]
        for name, before, after in zip(self.logs, 1e3 * self.before, 1e3 * self.after, strict=True):
            rows.append([name, *(f"{b:.3g} -> {a:.3g}" for b, a in zip(before, after, strict=True))])
        return "replay by MuJoCo: RMS from the log, your file -> exported\n" + aligned(rows)


def replay_servos(
    result: Identification, model: Mapping[str, Any], exported: ExportedFile, path: Path
) -> ServoReplay:
    """Follow all logs of a fit by the user's file and by the exported one in MuJoCo.

    Args:
        result: The fit of a loop without a force.
        model: `model` of its result.json.
        exported: The file with the result in it.
        path: The user's file.

    Raises:
        InputError: If a simulation diverges.
    """
    session, fitted = result.session, result.estimate.machine
    shared = (path, model, session.declared, fitted)
    robots = mujoco_robot(path.read_bytes(), *shared), mujoco_robot(exported.content, *shared, exported.added)
    off = []
    for run in session.runs:
        machine = run.machine(fitted)
        replay = make_replay(machine, run.log, exact_numerics(machine, run.log))
        motions = [robot.motion(replay) for robot in robots]
        if not np.all(np.isfinite(motions)):
            raise InputError(f"MuJoCo's simulation diverges on {run.log.source}", where=str(path))
        off.append([rms(run.log.position - motion) for motion in motions])
    before, after = np.moveaxis(np.array(off), 1, 0)
    joints = tuple(model["joints"])
    units = tuple(fitted.unit("position", k) for k in range(len(joints)))
    return ServoReplay(joints, units, tuple(run.name for run in session.runs), before, after)
