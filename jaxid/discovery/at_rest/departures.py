"""Starts from rest, cut out of a log: when, from where, and under what command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.controllers import Controller, Tick
from jaxid.dynamics.residuals import integrate_internal_states
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics import filters as signals
from jaxid.session import OpenedLog
from jaxid.simulation.disturbance import disturbance_at
from jaxid.simulation.force_balance import ForceData

# Readings that agree within this range, in standard deviations of their noise, are a rest: noise
# alone does otherwise once in a thousand times. There must be as many of them as a reversal
# without sticking could not keep together, and at least so many.
_RANGE = 5.0
_STILL = 3
# ... and at most about so many: where readings hardly move, no number of them would do.
_LONGEST = 60
# Samples that follow a start, at least.
_AFTER = 12
# Most that are kept, of all logs and joints together.
_MOST = 192
# A controller's law is taken for the one that made a log where it gives the logged command back to
# within this many deviations of its noise, or this part of its RMS.
_SAME = 1.5
_NEARLY = 0.02


class Starts(eqx.Module):
    """Moments in which a joint starts from rest, cut out of a log.

    Args:
        past: Logged command before each start, as far back as a delay reaches, (start, earlier, m).
        command: Logged command, (start, time, m).
        position: Measured, (start, time, n).
        rest: Position at the first sample, (start, n): of the joint that rests its mean reading, of the
            others, which may move, the filtered one.
        velocity: There, (start, n); zero of the joint that rests.
        time: Of the first sample [s], (start,).
        own: Own states of the plant's effects at the first sample.
        still: How many of the samples are at rest.
        log: Which log each is from, (start,).
    """

    past: Array
    command: Array
    position: Array
    rest: Array
    velocity: Array
    time: Array
    own: tuple
    still: Array
    log: Array

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.time)

    def padded(self, count: int) -> Starts:
        """With the last start repeated, so that one compiled shape serves any number."""
        more = count - len(self.time)
        spread = eqx.tree_at(lambda s: s.still, self, jnp.full(len(self.time), self.still))
        return jax.tree.map(lambda a: jnp.concatenate([a, jnp.repeat(a[-1:], more, axis=0)]), spread)


def starts_from_rest(
    machine: Machine, runs: Sequence[OpenedLog], noise: Float[np.ndarray, " n"], joints: Sequence[int]
) -> tuple[list[list[Starts]], list[int]]:
    """Find where joints leave a rest, by a lax and by a strict notion of one.

    Args:
        machine: The machine.
        runs: Logs of one sampling time.
        noise: Standard deviation of a reading, by joint.
        joints: 0-based.

    Returns:
        By joint one or two cuts, the starts of all logs in each, all of one length so that compiled
        code serves them; and how many samples of that each joint asks for.
    """
    first = runs[0]
    stills = [sorted(set(_stills(float(noise[j]), first.log, first.data, j))) for j in joints]
    lengths = [of_joint[-1] + max(_AFTER, 2 * of_joint[-1]) for of_joint in stills]
    length = max(lengths)
    delays = machine.plant.command_delays(runs[0].log.force.shape[1])
    most = max(1, _MOST // (len(joints) * len(runs)))
    lead = int(np.ceil(float(delays.max()) / runs[0].log.period)) + 1
    ready = [
        (
            _own_states(machine.plant, ForceData.of(r.data)),
            replace(r.log, force=_acted(r.machine(machine), r.log)),
            r.data,
        )
        for r in runs
    ]
    cuts = [
        [
            _joined([_cut(*each, float(noise[j]), still, length, lead, j, most) for each in ready])
            for still in of_joint
        ]
        for j, of_joint in zip(joints, stills, strict=True)
    ]
    return cuts, lengths


def _joined(cuts: list[Starts]) -> Starts:
    """The starts of several logs as one."""
    still = cuts[0].still
    own = jax.tree.map(lambda *a: jnp.concatenate(a), *[c.own for c in cuts])
    names = ("past", "command", "position", "rest", "velocity", "time")
    parts = [[getattr(c, n) for c in cuts] for n in names]
    which = jnp.repeat(jnp.arange(len(cuts)), jnp.asarray([c.count for c in cuts]))
    return Starts(*[jnp.concatenate(p) for p in parts], own, still, which)


def _cut(
    own: tuple,
    log: Log,
    data: Prepared,
    noise: float,
    still: int,
    length: int,
    lead: int,
    joint: int,
    most: int,
) -> Starts:
    after = length - still
    ends = _departures(log.position[:, joint], noise, still, after)
    ends = ends[np.unique(np.linspace(0, len(ends) - 1, min(len(ends), most)).astype(int))]
    rows = ends[:, None] + np.arange(1 - still, after + 1)
    earlier = np.maximum(rows[:, :1] + np.arange(-lead, 0), 0)
    rest, velocity = data.q[rows[:, 0]].copy(), data.qd[rows[:, 0]].copy()
    rest[:, joint] = log.position[rows[:, :still], joint].mean(axis=1)
    velocity[:, joint] = 0.0
    return Starts(
        jnp.asarray(log.force[earlier]),
        jnp.asarray(log.force[rows]),
        jnp.asarray(log.position[rows]),
        jnp.asarray(rest),
        jnp.asarray(velocity),
        jnp.asarray(log.time[rows[:, 0]] - log.time[0]),
        jax.tree.map(lambda a: a[rows[:, 0]], own),
        jnp.asarray(still),
        jnp.zeros(len(rows), int),
    )


def _stills(noise: float, log: Log, data: Prepared, joint: int) -> list[int]:
    """Samples that must agree for a rest, if reversals are as quick as is usual, or as slow as any.

    Few find the short rests of a stiff loop, many are needed where motion is slow against noise.
    """
    v, a = data.qd[:, joint], np.abs(data.qdd[:, joint])
    turns = np.flatnonzero(v[1:] * v[:-1] <= 0)
    usual = float(np.sqrt(np.mean(a**2)))
    slow = float(np.quantile(a[turns], 0.25)) if len(turns) else usual
    halves = [np.sqrt(2 * _RANGE * noise / max(x, 1e-300)) / log.period for x in (usual, slow)]
    return [max(_STILL, 1 + 2 * int(np.ceil(min(h, _LONGEST / 2)))) for h in halves]


def _departures(q: Float[np.ndarray, " time"], noise: float, still: int, after: int) -> np.ndarray:
    """Last samples of rests that are followed by motion."""
    if len(q) <= still + after:
        return np.zeros(0, int)
    windows = np.lib.stride_tricks.sliding_window_view(q, still)
    agree = np.ptp(windows, axis=1) <= _RANGE * noise
    ends = np.flatnonzero(agree[:-1] & ~agree[1:]) + still - 1
    ends = ends[ends + after < len(q)]
    # Where it has not gone far soon after, it was noise that ended the rest.
    moved = np.abs(q[ends + after] - q[ends]) > 2 * _RANGE * noise
    return ends[moved]


@eqx.filter_jit
def _own_states(plant: Plant, data: ForceData) -> tuple:
    """Own states of the effects along a log, under the command as it acts."""
    delays = plant.command_delays(data.force.shape[1])
    u = signals.delayed(data.force, delays, data.period, hold=data.hold)
    return integrate_internal_states(plant, data.q, data.qd, data.qdd, u, data.period, data.start)


def _acted(machine: Machine, log: Log) -> np.ndarray:
    """The command as it acted: what the controller makes of the readings, noise of the log left out.

    At a start a single noisy sample above the level would set the simulation moving. The logged
    command stands where there is no controller, or one that does not give it back.
    """
    if machine.controller is None or log.reference is None:
        return log.force
    extra = disturbance_at(machine.disturbance, log.time, log)
    arrays = (log.position, log.reference, np.broadcast_to(extra, log.force.shape))
    driven = machine.plant.driven(log.position.shape[1])
    made = np.asarray(_commands(machine.controller, driven, *(jnp.asarray(a) for a in arrays)))
    size = np.sqrt(np.mean(log.force**2, axis=0))
    stated = machine.sensor.force_noise
    noise = 0.0 if stated is None else np.asarray(stated)
    off = np.sqrt(np.mean((made - log.force) ** 2, axis=0))
    return np.where(off <= np.maximum(_SAME * noise, _NEARLY * size), made, log.force)


@eqx.filter_jit
def _commands(
    controller: Controller,
    driven: tuple[int, ...],
    position: Array,
    reference: Array,
    disturbance: Array,
) -> Array:
    def tick(memory: tuple, now: tuple) -> tuple[tuple, Array]:
        position, path, disturbance = now
        u, memory = controller.command(Tick(position, path, driven), memory, disturbance)
        return memory, u

    path = controller.path(reference)
    first = Tick(position[0], jax.tree.map(lambda x: x[0], path), driven)
    start = controller.start(first, jnp.zeros_like(position[0]))
    return jax.lax.scan(tick, start, (position, path, disturbance))[1]
