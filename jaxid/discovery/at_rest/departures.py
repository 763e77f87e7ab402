"""Starts from rest, cut out of a log: their times, positions and commands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.consistency.law import noise_free_command
from jaxid.dynamics.residuals import integrate_internal_states
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics import filters as signals
from jaxid.numerics.kept import kept_jit
from jaxid.session import OpenedLog
from jaxid.simulation.force_balance import ForceData

# Readings that agree within this range, in standard deviations of their noise, count as a rest: noise alone
# exceeds it once in a thousand times. A rest needs more agreeing readings than a reversal without sticking
# could give, and at least this many.
_RANGE = 5.0
_STILL = 3
# At most about this many readings are asked for: if they hardly move, no number of them would suffice.
_LONGEST = 60
# Least number of samples after a start.
_AFTER = 12
# Largest number of starts, of all logs and joints together.
_MOST = 192
# Median of the square of a standard normal variable.
_MEDIAN_OF_SQUARE = 0.4549


class Starts(eqx.Module):
    """Moments in which a joint starts from rest, cut out of a log.

    Args:
        past: Logged command before each start, as far back as a delay reaches, (start, earlier, m).
        command: Logged command, (start, time, m).
        position: Measured position, (start, time, n).
        rest: Position at the first sample, (start, n): the mean reading for the joint at rest, the filtered
            position for the others, which may move.
        velocity: Velocity at the first sample, (start, n); zero for the joint at rest.
        time: Time of the first sample [s], (start,).
        internal_states: Internal states of the plant's effects at the first sample.
        still: Number of samples at rest.
        log: Index of the log of each start, (start,).
    """

    past: Array
    command: Array
    position: Array
    rest: Array
    velocity: Array
    time: Array
    internal_states: tuple
    still: Array
    log: Array

    @property
    def count(self) -> int:
        """Number of starts."""
        return len(self.time)

    def padded(self, count: int) -> Starts:
        """Repeat the last start up to a number, so that one compiled shape serves any number."""
        more = count - len(self.time)
        spread = eqx.tree_at(lambda s: s.still, self, np.full(len(self.time), self.still))
        return jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[-1:], more, axis=0)]), spread)


def starts_from_rest(
    machine: Machine, runs: Sequence[OpenedLog], noise: Float[np.ndarray, " n"], joints: Sequence[int]
) -> tuple[list[list[Starts]], list[int]]:
    """Find the starts from rest of some joints, by a loose and by a strict definition of a rest.

    Args:
        machine: The machine with the values of its estimate.
        runs: Logs with one sampling time.
        noise: Standard deviation of a reading, by joint.
        joints: Indices of the joints, from 0.

    Returns:
        By joint one or two cuts, each with the starts of all logs, all of one length so that compiled code
        serves them; and the number of samples of that length that each joint needs.
    """
    first = runs[0]
    still_counts = [sorted(set(_still_counts(float(noise[j]), first.log, first.data, j))) for j in joints]
    lengths = [of_joint[-1] + max(_AFTER, 2 * of_joint[-1]) for of_joint in still_counts]
    length = max(lengths)
    delays = machine.plant.command_delays(runs[0].log.force.shape[1])
    most = max(1, _MOST // (len(joints) * len(runs)))
    lead = int(np.ceil(float(delays.max()) / runs[0].log.period)) + 1
    logs = [
        (
            _internal_states(machine.plant, ForceData.of(r.data)),
            replace(r.log, force=_applied_command(r.machine(machine), r.log)),
            r.data,
        )
        for r in runs
    ]
    cuts = [
        [
            _concatenated([_cut(*each, float(noise[j]), still, length, lead, j, most) for each in logs])
            for still in of_joint
        ]
        for j, of_joint in zip(joints, still_counts, strict=True)
    ]
    return cuts, lengths


def _concatenated(cuts: list[Starts]) -> Starts:
    """Concatenate the starts of several logs."""

    def together(name: str) -> Array:
        return np.concatenate([getattr(c, name) for c in cuts])

    return Starts(
        past=together("past"),
        command=together("command"),
        position=together("position"),
        rest=together("rest"),
        velocity=together("velocity"),
        time=together("time"),
        internal_states=jax.tree.map(lambda *a: np.concatenate(a), *[c.internal_states for c in cuts]),
        still=cuts[0].still,
        log=np.repeat(np.arange(len(cuts)), [c.count for c in cuts]),
    )


def _cut(
    internal_states: tuple,
    log: Log,
    data: Prepared,
    noise: float,
    still: int,
    length: int,
    lead: int,
    joint: int,
    most: int,
) -> Starts:
    """Cut the starts of one joint out of one log, at most so many, spread evenly over it."""
    after = length - still
    ends = _departures(log.position[:, joint], noise, still, after)
    ends = ends[np.unique(np.linspace(0, len(ends) - 1, min(len(ends), most)).astype(int))]
    rows = ends[:, None] + np.arange(1 - still, after + 1)
    earlier = np.maximum(rows[:, :1] + np.arange(-lead, 0), 0)

    rest, velocity = data.q[rows[:, 0]].copy(), data.qd[rows[:, 0]].copy()
    rest[:, joint] = log.position[rows[:, :still], joint].mean(axis=1)
    velocity[:, joint] = 0.0
    return Starts(
        past=log.force[earlier],
        command=log.force[rows],
        position=log.position[rows],
        rest=rest,
        velocity=velocity,
        time=log.time[rows[:, 0]] - log.time[0],
        internal_states=jax.tree.map(lambda a: np.asarray(a)[rows[:, 0]], internal_states),
        still=np.asarray(still),
        log=np.zeros(len(rows), int),
    )


def _still_counts(noise: float, log: Log, data: Prepared, joint: int) -> list[int]:
    """Return the numbers of samples that must agree for a rest, for typical and for slow reversals.

    A small number finds the short rests of a stiff loop; a large one is needed for slow motion in noise.
    """
    v, a = data.qd[:, joint], np.abs(data.qdd[:, joint])
    turns = np.flatnonzero(v[1:] * v[:-1] <= 0)
    usual = float(np.sqrt(np.mean(a**2)))
    slow = float(np.quantile(a[turns], 0.25)) if len(turns) else usual
    halves = [np.sqrt(2 * _RANGE * noise / max(x, 1e-300)) / log.period for x in (usual, slow)]
    return [max(_STILL, 1 + 2 * int(np.ceil(min(h, _LONGEST / 2)))) for h in halves]


def _departures(q: Float[np.ndarray, " time"], noise: float, still: int, after: int) -> np.ndarray:
    """Find the last samples of rests that are followed by motion."""
    if len(q) <= still + after:
        return np.zeros(0, int)
    windows = np.lib.stride_tricks.sliding_window_view(q, still)
    agree = np.ptp(windows, axis=1) <= _RANGE * noise
    ends = np.flatnonzero(agree[:-1] & ~agree[1:]) + still - 1
    ends = ends[ends + after < len(q)]
    # If the joint has not moved far soon after, noise ended the rest.
    moved = np.abs(q[ends + after] - q[ends]) > 2 * _RANGE * noise
    return ends[moved]


@kept_jit
def _internal_states(plant: Plant, data: ForceData) -> tuple:
    """Integrate the internal states of the effects along a log, under the delayed command."""
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    return integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)


def force_noise_at_rest(machine: Machine, log: Log, starts: Starts, joint: int) -> float:
    """Return the standard deviation of the noise of the force under which a joint starts [N or N m].

    It is that of second differences of the readings at rest, in which friction holds and the force changes
    slowly. A command that the declared law computes has none.

    Args:
        machine: The machine.
        log: A log of the starts.
        starts: The starts, whose commands are in units of the log.
        joint: Index of the joint that starts.
    """
    driven = machine.plant.driven(log.position.shape[1])
    drives = np.flatnonzero(np.asarray(driven) == joint)
    if not drives.size or noise_free_command(machine, log) is not None:
        return 0.0
    readings = np.asarray(starts.command)[:, : int(starts.still), drives[0]]
    curved = np.diff(readings, n=2, axis=1)
    # Of white noise a second difference has six times the variance.
    variance = np.median(curved**2) / _MEDIAN_OF_SQUARE / 6
    return float(np.sqrt(variance) * abs(np.asarray(machine.gain)[drives[0]]))


def _applied_command(machine: Machine, log: Log) -> np.ndarray:
    """Return the command without the noise of the log, if the declared law explains it, else the logged one.

    A single noisy sample above the level at a start would set the simulation in motion.
    """
    law = noise_free_command(machine, log)
    return log.force if law is None else law.command
