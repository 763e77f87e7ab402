"""The servos of a robot's file, before and after a fit, on all its logs in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.export.exported import ExportedFile
from jaxid.export.followed import Followed, lacks_table, rms
from jaxid.export.mujoco_run import FINER
from jaxid.export.replayed import mujoco_robot
from jaxid.results.aligned import aligned

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification


@dataclass(frozen=True)
class ServoReplay:
    """Logs that MuJoCo has followed from their references alone; all values are RMS by joint [m or rad].

    Args:
        joints: Names of the joints.
        units: Unit of each joint's position.
        logs: Names of the logs.
        before: Measured less simulated position of the user's file, (logs, n).
        after: That of the exported file.
        difference: Exported file in MuJoCo less jaxid's simulation, (logs, n).
        without_creep: The same at a short time step, dry friction as stiff as it can be, (logs, n).
        lacks: Things that the file cannot hold: a sentence, and what each moves, (logs, n).
    """

    joints: tuple[str, ...]
    units: tuple[str, ...]
    logs: tuple[str, ...]
    before: Float[np.ndarray, "logs n"]
    after: Float[np.ndarray, "logs n"]
    difference: Float[np.ndarray, "logs n"]
    without_creep: Float[np.ndarray, "logs n"]
    lacks: Mapping[str, Float[np.ndarray, "logs n"]]

    def __str__(self) -> str:
        changed = [
            [f"{b:.3g} -> {a:.3g}" for b, a in zip(before, after, strict=True)]
            for before, after in zip(1e3 * self.before, 1e3 * self.after, strict=True)
        ]
        apart, stiff = (
            [[f"{x:.2g}" for x in row] for row in 1e3 * sizes]
            for sizes in (self.difference, self.without_creep)
        )
        lines = [
            "replay by MuJoCo: RMS from the log, your file -> exported",
            self._table(changed),
            "",
            "exported file in MuJoCo less jaxid's simulation, RMS",
            self._table(apart),
            "",
            f"the same at a {FINER}th of the time step, which leaves dry friction a {FINER}th of its creep",
            self._table(stiff),
        ]
        if self.lacks:
            worst = ((what, np.nanmax(sizes, axis=0)) for what, sizes in self.lacks.items())
            table = lacks_table("single causes", self.joints, self.units, worst)
            lines += ["", "what single causes move, on the log where each moves a joint most, RMS", table]
        return "\n".join(lines)

    def _table(self, rows: Sequence[Sequence[str]]) -> str:
        """Return rows of text, one a log, with their heads."""
        heads = ["log", *(f"{name} [m{unit}]" for name, unit in zip(self.joints, self.units, strict=True))]
        return aligned([heads, *([name, *row] for name, row in zip(self.logs, rows, strict=True))])


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
    users = mujoco_robot(path.read_bytes(), *shared)
    ours = mujoco_robot(exported.content, *shared, exported.added)
    every = [Followed.of(run.machine(fitted), run.log, users, ours) for run in session.runs]
    lacks = [dict(followed.lacks(model, exported)) for followed in every]
    # An effect without which one of the logs cannot be simulated has no size there.
    none = np.full(len(model["joints"]), np.nan)
    names = dict.fromkeys(what for one in lacks for what in one)
    return ServoReplay(
        joints=tuple(model["joints"]),
        units=tuple(fitted.unit("position", k) for k in range(len(model["joints"]))),
        logs=tuple(run.name for run in session.runs),
        before=np.array([rms(f.log.position - f.before) for f in every]),
        after=np.array([rms(f.log.position - f.after) for f in every]),
        difference=np.array([rms(f.after - f.own) for f in every]),
        without_creep=np.array([rms(f.without_creep() - f.own) for f in every]),
        lacks={what: np.array([one.get(what, none) for one in lacks]) for what in names},
    )
