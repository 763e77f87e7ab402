"""A log that jaxid and MuJoCo have followed, and what single differences between both move."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.export.exported import ExportedFile, shown
from jaxid.export.found_machine import without_effects
from jaxid.export.mujoco_run import FINER, MujocoRobot, Setting
from jaxid.export.soft_friction import Softness
from jaxid.gap import simulation_gap
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.results.aligned import aligned
from jaxid.simulation.replay import Replay, exact_numerics, make_replay, with_fitted_start
from jaxid.simulation.step_size import TooStiffError

# Length of the stretches after which an open loop starts anew from the log [s]: errors of the start of an arm
# that stands upright grow with a time constant of about 0.15 s.
STRETCH = 0.25


@dataclass(frozen=True)
class Followed:
    """A log, followed by a result in jaxid and by two files in MuJoCo.

    Args:
        machine: Machine of the result.
        log: The log.
        replay: Its inputs.
        own: Position that jaxid simulates, (time, n) [m or rad].
        users: The user's file in MuJoCo; None: there is none.
        robot: The exported file in MuJoCo.
        before: Position of the user's file, (time, n); None without it.
        after: Position of the exported file, (time, n).
    """

    machine: Machine
    log: Log
    replay: Replay
    own: Float[np.ndarray, "time n"]
    users: MujocoRobot | None
    robot: MujocoRobot
    before: Float[np.ndarray, "time n"] | None
    after: Float[np.ndarray, "time n"]

    @classmethod
    def of(cls, machine: Machine, log: Log, users: MujocoRobot | None, robot: MujocoRobot) -> Followed:
        """Follow a log.

        Args:
            machine: Machine of the result.
            log: The log.
            users: The user's file in MuJoCo; None: there is none.
            robot: The exported file in MuJoCo.

        Raises:
            InputError: If a simulation cannot run, or diverges.
        """
        replay, own = _simulated(machine, log)
        before, after = None if users is None else users.motion(replay), robot.motion(replay)
        for what, values in (("the exported file", after), ("your file", before)):
            if values is not None and not np.all(np.isfinite(values)):
                what = f"MuJoCo's simulation of {what} diverges on {log.source}"
                raise InputError(what, where=robot.robot.file)
        return cls(machine, log, replay, own, users, robot, before, after)

    def lacks(self, model: Mapping[str, Any], exported: ExportedFile) -> Iterator[tuple[str, np.ndarray]]:
        """Return what a file cannot hold of a result, and what each thing moves: a sentence and RMS by joint.

        Effects of one kind are taken out together.

        Args:
            model: `model` of result.json.
            exported: The file.
        """
        effects = model["effects"]
        for kind in dict.fromkeys(effects[number]["kind"] for number in exported.lost):
            alike = [number for number in exported.lost if effects[number]["kind"] == kind]
            try:
                changed = _simulated(without_effects(self.machine, set(alike)), self.log)[1]
            except InputError:
                continue
            several = f"{kind} of {len(alike)} joints"
            what = shown(effects[alike[0]]) if len(alike) == 1 else several
            yield f"without {what}", rms(changed - self.own)
        for name in exported.added:
            stiff = self.robot.motion(self.replay, Setting(locked=(name,)))
            yield f"without the second joint '{name}'", rms(stiff - self.after)
        yield from self._creep()

    def _creep(self) -> Iterator[tuple[str, np.ndarray]]:
        """Return what creep of MuJoCo's dry friction moves: that of the user's softness, and what is left."""
        ours = self.robot.softness
        if not ours:
            return
        kept, whose = dict.fromkeys(ours, Softness.usual()), "MuJoCo's usual dry friction"
        if self.users is not None:
            theirs, whose = self.users.model, "your file's dry friction"
            kept = {name: Softness.of(theirs, int(theirs.joint(name).dofadr[0])) for name in ours}
        if any(kept[name].softer(softness) for name, softness in ours.items()):
            moved = self.robot.motion(self.replay, Setting(softness=kept))
            yield f"creep of {whose} (solreffriction)", rms(moved - self.after)
        # None can be stiffer; what a little creep moves is in proportion to it.
        least = Softness.least(float(self.robot.model.opt.timestep))
        soft = any(softness.softer(least) for softness in ours.values())
        other = {name: least if soft else softness.doubled for name, softness in ours.items()}
        moved = self.robot.motion(self.replay, Setting(softness=other))
        yield "creep that the exported file's dry friction leaves", rms(moved - self.after)

    def without_creep(self) -> Float[np.ndarray, "time n"]:
        """Return the position of the exported file at a short time step, dry friction as stiff as it can be.

        Creep is in proportion to the time step: a tenth of it is left.
        """
        least = Softness.least(float(self.robot.model.opt.timestep) / FINER)
        stiff = dict.fromkeys(self.robot.softness, least)
        return self.robot.motion(self.replay, Setting(finer=FINER, softness=stiff))

    def time_step(self) -> tuple[str, np.ndarray]:
        """Return what the file's time step moves, as `lacks` does."""
        fine = self.robot.motion(self.replay, Setting(finer=FINER))
        step = self.robot.model.opt.timestep
        return f"time step of {step:g} s, against a {FINER}th", rms(fine - self.after)


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
        numerics = replace(numerics, segment=max(2, round(STRETCH / log.period)))
    replay = with_fitted_start(make_replay(machine, log, numerics), machine.plant, log)
    position = simulation_gap(machine, replay, log).position
    if not np.all(np.isfinite(position)):
        raise InputError("jaxid's simulation of this log diverges", where=log.source)
    return replay, position


def rms(off: np.ndarray) -> Float[np.ndarray, " n"]:
    """Return the root mean square of each column, (n,); a missing reading is NaN."""
    return np.sqrt(np.nanmean(off**2, axis=0))


def lacks_table(
    heading: str, joints: Sequence[str], units: Sequence[str], lacks: Iterable[tuple[str, np.ndarray]]
) -> str:
    """Return what single things move as text, a row each, by joint in thousandths of its unit."""
    heads = [heading, *(f"{name} [m{unit}]" for name, unit in zip(joints, units, strict=True))]
    return aligned([heads, *([what, *(f"{1e3 * x:.2g}" for x in sizes)] for what, sizes in lacks)])
