"""Loads of an arm's joints from the simulated motion of the whole arm.

The encoders show a motion only as far as their rows and their noise let it be differentiated: jerks of a
servo between two rows, as at every change of a command that is held, push the other joints unseen. Here the
loop of the arm is simulated from its commands, and the load at every tick is that of the simulated motion.
What the measured motion has beside it, through the same filter, is added, unless noise explains it.

At values that are several percent off these loads may be worse than the measured ones: a fit decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from jaxid.estimators.apart.joint import JointAlone, inertias_of_links, links_of, load_of, of_links
from jaxid.estimators.several.parts import Part
from jaxid.logs.prepare import motion
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.kept import kept_jit
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.reference_course import reference_at
from jaxid.simulation.replay import Replay, make_replay
from jaxid.simulation.sensor_noise import position_noise

# Squares that a simulation leaves, over those of the encoder's noise, up to which its motion is taken whole.
_EXPLAINED = 1.5


def with_simulated_loads(
    joints: Sequence[JointAlone], theta: Float[np.ndarray, " p"], parts: Sequence[Part]
) -> list[JointAlone]:
    """Return joints whose loads are those of the simulated arm; along a log that diverges they stay.

    Args:
        joints: The joints, each with any of the logs.
        theta: Unknowns of the arm at which it is simulated.
        parts: All logs, with the machines of the arm.
    """
    motions = {part.name: _Motions.of(part.at(theta), part) for part in parts}

    def renewed(alone: JointAlone, part: Part) -> Part:
        found = motions[part.name]
        if found is None:
            return part
        load = found.load(alone.joint, alone.links, alone.at_zero)
        return replace(part, machine=replace(part.machine, held_load=load))

    return [
        replace(
            alone,
            parts=tuple(renewed(alone, part) for part in alone.parts),
            others=tuple(renewed(alone, part) for part in alone.others),
        )
        for alone in joints
    ]


class _Motions:
    """Acceleration of the joints, and force and inertia of the links, along the motions of a log.

    Args:
        inside: Mean acceleration of the links over every tick of the simulation, and their force, (ticks, n)
            each.
        beside: What the measured motion has more of both, by row and joint; the same at every tick.
        inertia: Inertia of the links about each joint, (ticks, n).
        ahead: Acceleration of the joints less that of the links, which springs may drive apart, (ticks, n).
    """

    def __init__(
        self,
        inside: tuple[np.ndarray, np.ndarray],
        beside: tuple[np.ndarray, np.ndarray],
        inertia: np.ndarray,
        ahead: np.ndarray,
    ) -> None:
        self.inertia, self.acceleration = inertia, inside[0] + beside[0] + ahead
        # That which links at the acceleration of their joint would take.
        self.force = inside[1] + beside[1] + inertia * ahead

    def load(self, joint: int, links: float, at_zero: float) -> Float[np.ndarray, "ticks 3"]:
        """Return the load of a joint alone; see `load_of`."""
        acceleration, force, inertia = (x[:, joint] for x in (self.acceleration, self.force, self.inertia))
        return load_of(acceleration, force, inertia, mean=links, at_zero=at_zero)

    @classmethod
    def of(cls, machine: Machine, part: Part) -> _Motions | None:
        """Return the motions of an arm along a log; None if its simulation diverges."""
        log, law = part.log, machine.controller
        assert law is not None, "checked by stands_apart"
        replay = make_replay(machine, log)
        run = _run(replace(replay, every=1), machine.plant)
        q, v = np.asarray(run.position), np.asarray(run.velocity)
        if not np.all(np.isfinite(q)) or not np.all(np.isfinite(v)):
            return None
        links = links_of(machine)
        apart = (q, v) if run.links is None else tuple(np.asarray(x) for x in run.links)
        middle, speed = (np.concatenate([0.5 * (x[1:] + x[:-1]), x[-1:]]) for x in apart)
        of_joints, a = (np.diff(x, axis=0, append=x[-1:]) / law.period for x in (v, apart[1]))
        force = np.asarray(of_links(links, middle, speed, a))
        inertia = np.asarray(inertias_of_links(links, middle))

        recipe, rows = part.data.recipe, q[:: replay.every]
        seen = motion(
            replace(log, position=rows), recipe.cutoff_hz, recipe.order, recipe.derivatives, recipe.reach
        )
        unexplained = _EXPLAINED * np.square(position_noise(machine, log)) < np.mean(
            np.square(log.filled - rows), axis=0
        )
        measured = [
            np.where(unexplained, x, y)
            for x, y in zip((part.data.q, part.data.qd, part.data.qdd), seen, strict=True)
        ]
        more = measured[2] - seen[2], np.asarray(of_links(links, *measured) - of_links(links, *seen))
        times = log.time[0] + law.period * (np.arange(len(q)) + 0.5)
        at_ticks = (reference_at(log.time, x, times, "linear") for x in more)
        return cls((a, force), (next(at_ticks), next(at_ticks)), inertia, of_joints - a)


@kept_jit
def _run(replay: Replay, plant: Plant) -> Trajectory:
    return replay(plant)
