"""Mean readings of a loop whose controller reads a coarse, noisy encoder.

The noise of the readings goes round the loop. It shakes a joint loose where dry friction would hold it, and
the counts of the encoder stand still while the joint does. Both move the mean of the readings away from the
motion of a loop without noise, by an amount that follows the motion as a missing effect would.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.arrays import Array
from jaxid.logs.log import Log
from jaxid.logs.soundness import position_levels
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.numerics.filters import high_band_std
from jaxid.numerics.kept import kept_jit
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Replay, from_rest

# Pairs of opposite noise in the mean that a fit follows, and in the mean readings at one point that its shift
# gives; fewer in a long log: the ticks of all runs together are limited.
_PAIRS, _MANY_PAIRS, _FEWEST_PAIRS, _TICKS = 8, 128, 4, 2_000_000
# Pairs by which levels of noise are compared, all under the same draws, and that are run together.
_FEW_PAIRS = 32
# Draws that are run together, for memory.
_TOGETHER = 50
# Noise before rounding that is tried if the case does not state it, as parts of a count, or of the noise that
# the high band of a log shows if it has no counts.
_PARTS = (0.02, 0.04, 0.08, 0.12, 0.16, 0.24, 0.35, 0.5)
# Steps of Gauss-Newton for the start of a run.
_STEPS = 4


class NoisyReplay(Replay):
    """A loop that is run once with each draw of noise, and whose positions are the mean readings.

    Args:
        draws: Standard normal numbers for the noise of the readings, (draws, ticks, n).
        shift: Change of the mean readings, (time, n).
    """

    draws: Float[Array, "draws ticks n"]
    shift: Float[Array, "time n"]

    def __call__(
        self, plant: Plant, nudge: Array | None = None, noise: Float[Array, "ticks n"] | None = None
    ) -> Trajectory:
        """Return the mean trajectory at the samples of the log; for the arguments see `Replay`."""
        runs = self.runs(plant, nudge)
        runs = replace(runs, position=self.sensor.expected(runs.position))
        mean = jax.tree.map(lambda a: jnp.mean(a, axis=0), runs)
        return replace(mean, position=mean.position + self.shift)

    def runs(self, plant: Plant, nudge: Array | None = None) -> Trajectory:
        """Return the trajectories of all draws, (draws, time, k)."""
        one = lambda noise: Replay.__call__(self, plant, nudge, noise)
        if len(self.draws) == 1:
            # A run that is mapped over computes both branches of every condition.
            return jax.tree.map(lambda a: a[None], one(self.draws[0]))
        return jax.vmap(one)(jnp.asarray(self.draws))


@dataclass(frozen=True)
class ReadingNoise:
    """The noise of an encoder that a controller reads, and the start of the run that is read.

    Args:
        count: Size of one count of each joint, (n,) [m or rad]; zero without counts.
        std: Standard deviation of the noise before rounding, (n,) [m or rad].
        nudge: Change of position and velocity at the start, (2 n,).
        rest: Whether the run begins at rest before that change.
        shift: Mean readings with counts less those of the runs that a fit follows, (time, n).
        follows: Whether a fit follows runs with white noise of as much power, or one run without noise.
    """

    count: Float[np.ndarray, " n"]
    std: Float[np.ndarray, " n"]
    nudge: Float[np.ndarray, " 2n"]
    rest: bool = False
    shift: Float[np.ndarray, "time n"] | None = None
    follows: bool = True

    def on(self, replay: Replay) -> NoisyReplay:
        """Return a replay for fits, shifted by what it leaves out of the mean readings.

        Rounding in the loop is a staircase of the unknowns, which no gradient follows. Fixed draws of white
        noise give a mean that is as smooth as the loop; one run without noise takes a fraction of the time.
        """
        loud = np.hypot(self.std, self.count / np.sqrt(12))
        sensor = replace(replay.sensor, position_resolution=None, position_noise=loud)
        shift = 0.0 if self.shift is None else self.shift
        return self._with(replay, sensor, _opposite(replay, _PAIRS if self.follows else 0), shift)

    def rounded(self, replay: Replay, draws: Float[np.ndarray, "draws ticks n"]) -> NoisyReplay:
        """Return a replay whose loop reads counts with some draws of noise."""
        # Joints without counts get ones far below their noise, so that one compiled function serves all.
        count = np.where(self.count > 0, self.count, 1e-3 * np.where(self.std > 0, self.std, 1e-9))
        sensor = replace(replay.sensor, position_resolution=count, position_noise=self.std)
        return self._with(replay, sensor, draws, 0.0)

    def _with(
        self,
        replay: Replay,
        sensor: Sensor,
        draws: Float[np.ndarray, "draws ticks n"],
        shift: Float[np.ndarray, "time n"] | float,
    ) -> NoisyReplay:
        """Return a replay with a sensor and draws, from the start of this noise."""
        n = len(self.std)
        began = from_rest(replay) if self.rest else replay
        began = replace(
            began, position=began.position + self.nudge[:n], velocity=began.velocity + self.nudge[n:]
        )
        values: dict[str, Any] = {f.name: getattr(began, f.name) for f in fields(began)}
        values["sensor"] = sensor
        rows = -(-draws.shape[1] // replay.every)
        return NoisyReplay(**values, draws=draws, shift=np.broadcast_to(shift, (rows, n)).astype(float))


def _opposite(replay: Replay, most: int) -> Float[np.ndarray, "draws ticks n"]:
    """Draw pairs of opposite noise, at most so many, for the ticks of a replay; without any, one of zeros."""
    assert replay.disturbance is not None, "only a loop reads its encoder"
    ticks, n = len(replay.disturbance), replay.position.size
    if most == 0:
        return np.zeros((1, ticks, n))
    pairs = int(np.clip(_TICKS // (2 * ticks), _FEWEST_PAIRS, most))
    half = np.random.default_rng(39).standard_normal((pairs, ticks, n))
    return np.concatenate([half, -half])


def estimated_noise(
    machine: Machine,
    log: Log,
    replay: Replay,
    *,
    follows: bool = True,
    before: ReadingNoise | None = None,
) -> ReadingNoise | None:
    """Estimate the noise of the encoder in a loop, and the start of its run, at a machine's values.

    The size of a count is that of the case, or else of the log. The noise before rounding is that of the
    case, or else the one with which the mean readings are nearest to the log.

    Args:
        machine: The machine, at the values of a fit.
        log: The log of positions.
        replay: The loop without noise.
        follows: See `ReadingNoise`.
        before: Noise at values nearby, next to which levels are tried; None: all are.

    Returns:
        The noise; None if the log has velocities in place of positions, or no reading has any noise.
    """
    found = _noise_in_loop(machine, log, replay, follows, before)
    if found is None:
        return None
    noise, loop = found
    smooth = np.asarray(mean_readings(noise.on(loop.replay), machine.plant))
    return replace(noise, shift=loop.mean(noise) - smooth)


def _noise_in_loop(
    machine: Machine, log: Log, replay: Replay, follows: bool, before: ReadingNoise | None = None
) -> tuple[ReadingNoise, _Loop] | None:
    """Return the noise of `estimated_noise` without its shift, and the loop at the machine's values."""
    if log.integrated or replay.controller is None:
        return None
    n, sensor = log.position.shape[1], machine.sensor
    measured = np.array(log.measured)
    stated = sensor.position_resolution
    count = np.array([position_levels(q)[1] for q in log.filled.T]) if stated is None else np.asarray(stated)
    count = np.broadcast_to(count, n) * measured
    unit = np.where(count > 0, count, high_band_std(log.filled)) * measured
    if not np.any(unit > 0):
        return None

    known = sensor.position_noise
    levels = [part * unit for part in _PARTS]
    if known is not None:
        levels = [np.broadcast_to(np.asarray(known), n) * measured]
    replay = replay.following(machine.parameters.places, jnp.asarray(machine.parameters.guess))
    loop = _Loop.of(machine.plant, log, replay)
    if before is not None:
        near = loop.started(replace(before, shift=None))
        return loop.at_best_level(near, _levels_beside(before.std, levels)), loop

    begun = loop.at_best_level(ReadingNoise(count, levels[0], np.zeros(2 * n), follows=follows), levels)
    noises = [loop.started(replace(begun, rest=rest)) for rest in (False, True)]
    noise = min(noises, key=lambda noise: float(np.sum(loop.squares(noise))))
    return loop.at_best_level(noise, levels), loop


def _levels_beside(std: Float[np.ndarray, " n"], levels: list[np.ndarray]) -> list[np.ndarray]:
    """Return the level of each joint, the one below and the one above, among those that are tried."""
    tried, last = np.stack(levels), len(levels) - 1
    own = np.argmin(np.abs(tried - std), axis=0)
    places = [np.clip(own + step, 0, last) for step in (-1, 0, 1)] if last else [own]
    return [tried[place, np.arange(std.size)] for place in places]


@dataclass(frozen=True)
class _Loop:
    """A loop whose mean readings are compared with a log.

    Args:
        plant: The plant.
        log: The log.
        replay: The loop without noise.
        draws: Sets of standard normal numbers, (draws, ticks, n) each.
    """

    plant: Plant
    log: Log
    replay: Replay
    draws: tuple[Float[np.ndarray, "draws ticks n"], ...]

    @classmethod
    def of(cls, plant: Plant, log: Log, replay: Replay) -> _Loop:
        """Return a loop with draws of noise, the first set for comparisons and all for the mean readings."""
        draws = _opposite(replay, _MANY_PAIRS)
        half = draws[: len(draws) // 2]
        few = min(_FEW_PAIRS, len(half))
        sets = (half[k : k + few] for k in range(0, len(half) - few + 1, few))
        return cls(plant, log, replay, tuple(np.concatenate([one, -one]) for one in sets))

    def mean(self, noise: ReadingNoise) -> Float[np.ndarray, "time n"]:
        """Return the mean readings with a noise."""
        return np.mean([self._mean(noise, draws) for draws in self.draws], axis=0)

    def _mean(self, noise: ReadingNoise, draws: np.ndarray) -> Float[np.ndarray, "time n"]:
        return np.asarray(mean_readings(noise.rounded(self.replay, draws), self.plant))

    def squares(self, noise: ReadingNoise) -> Float[np.ndarray, " n"]:
        """Return the sum of squares that mean readings of the first draws leave of the log, by joint."""
        off = self.log.filled - self._mean(noise, self.draws[0])
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that diverges
            return np.nan_to_num(np.sum(np.where(self.log.measured, off, 0.0) ** 2, axis=0), nan=np.inf)

    def at_best_level(self, noise: ReadingNoise, levels: list[np.ndarray]) -> ReadingNoise:
        """Return the noise with the level of each joint at which its mean readings are nearest to the log."""
        best = np.argmin([self.squares(replace(noise, std=level)) for level in levels], axis=0)
        return replace(noise, std=np.array([levels[k][joint] for joint, k in enumerate(best)]))

    def started(self, noise: ReadingNoise) -> ReadingNoise:
        """Return the noise with a start fitted by Gauss-Newton, while a step helps."""
        measured = np.array(self.log.measured, float)

        def rows(nudge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            at = replace(noise, nudge=nudge).on(self.replay)
            mean, columns = _start_columns(at, self.plant, np.zeros_like(nudge))
            off = (self.log.filled - np.asarray(mean)) * measured
            return off.ravel(), (np.asarray(columns) * measured[:, None]).reshape(off.size, -1)

        nudge = noise.nudge
        off, columns = rows(nudge)
        for _ in range(_STEPS):
            if not (np.all(np.isfinite(off)) and np.all(np.isfinite(columns))):
                break  # the loop diverges at these values
            size = np.linalg.norm(columns, axis=0) + 1e-300
            new = nudge + np.linalg.lstsq(columns / size, off, rcond=1e-6)[0] / size
            after, slope = rows(new)
            if not np.sum(after**2) < np.sum(off**2):
                break
            nudge, off, columns = new, after, slope
        return replace(noise, nudge=nudge)


def drawn_readings(
    noise: ReadingNoise, replay: Replay, plant: Plant, runs: int
) -> Float[np.ndarray, "runs time n"]:
    """Draw readings of a loop about their mean.

    Args:
        noise: Noise of the encoder.
        replay: The loop without noise, at the values of its unknowns.
        plant: The plant at these values.
        runs: Number of draws.
    """
    assert replay.disturbance is not None, "only a loop reads its encoder"
    together = min(runs, _TOGETHER)
    shape, rng = (together, len(replay.disturbance), replay.position.size), np.random.default_rng(40)
    parts = [
        np.asarray(_readings(noise.rounded(replay, rng.standard_normal(shape)), plant))
        for _ in range(0, runs, together)
    ]
    readings = np.concatenate(parts)[:runs]
    return readings - readings.mean(axis=0)


@kept_jit
def mean_readings(replay: Replay, plant: Plant) -> Array:
    """Return the positions of a loop, or the mean readings of one with noise, (time, n)."""
    return replay(plant).position


@kept_jit
def _readings(replay: NoisyReplay, plant: Plant) -> Array:
    return replay.runs(plant).reading


@kept_jit
def _start_columns(replay: NoisyReplay, plant: Plant, nudge: Array) -> tuple[Array, Array]:
    """Return the mean readings, (time, n), and their derivatives by the start, (time, n, 2 n)."""

    def both(nudge: Array) -> tuple[Array, Array]:
        mean = replay(plant, nudge).position
        return mean, mean

    columns, mean = jax.jacfwd(both, has_aux=True)(nudge)
    return mean, columns


def noisy_readings(
    machine: Machine, log: Log, replay: Replay
) -> tuple[Float[np.ndarray, "time n"], Float[np.ndarray, "runs time n"]] | None:
    """Return the mean readings of a log by a machine at its values, and draws of readings about their mean.

    Nothing is returned if nothing is known of the noise. A long log gets fewer draws.

    Args:
        machine: The machine, at the values of a fit.
        log: The log of positions.
        replay: The loop without noise.
    """
    found = _noise_in_loop(machine, log, replay, follows=True)
    if found is None:
        return None
    noise, loop = found
    assert replay.disturbance is not None, "only a loop reads its encoder"
    runs = int(np.clip(_TICKS // len(replay.disturbance), 2 * _FEWEST_PAIRS, _TOGETHER))
    return loop.mean(noise), drawn_readings(noise, loop.replay, machine.plant, runs)
