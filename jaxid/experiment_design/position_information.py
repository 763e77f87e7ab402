"""Compute the information of the positions of a loop whose force is not logged, and play its commands."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics, position_jacobian
from jaxid.experiment_design.in_loop import PRIOR, at_every_tick
from jaxid.experiment_design.limits import Peaks
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.plant import Plant
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.precision import assess_from_sums
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Replay, exact_numerics, from_rest, make_replay

# Part of a tick by which a delay is moved to either side.
_BESIDE = 0.01


@dataclass(frozen=True)
class PositionInformation:
    """Information of the positions of some logs.

    The position has a kink where an unknown delay is a whole number of ticks, and the two sides of it may
    tell much or little. Of all delays a little shorter, and all a little longer, those count that tell less.

    Args:
        matrices: J'J over the variance of a reading, by the unknowns of all logs, on each side of the delays,
            (2, p, p).
        signal: Squared norm of the positions over the deviation of a reading.
    """

    matrices: Float[np.ndarray, "2 p p"]
    signal: float

    @classmethod
    def of(cls, part: Part, noise: Float[np.ndarray, " n"], width: int) -> PositionInformation:
        """Compute the information of one log at the guesses of its machine, dry friction exact.

        Args:
            part: The log with its machine.
            noise: Standard deviation of a reading, (n,).
            width: Number of unknowns of all logs.
        """
        log, numerics = part.log, choose_numerics(part.machine, part.log)
        seen = np.flatnonzero(log.measured)
        matrices = []
        for machine in _beside_ticks(part.machine):
            jacobian = position_jacobian(machine, log, numerics)[:, seen]
            rows = part.widened(jacobian / noise[seen][:, None], width).reshape(-1, width)
            matrices.append(rows.T @ rows)
        moved = (log.filled - log.filled.mean(axis=0))[:, seen] / noise[seen]
        return cls(np.stack(matrices), float(np.sum(moved**2)))

    @classmethod
    def none(cls, width: int) -> PositionInformation:
        """Return that of no log."""
        return cls(np.zeros((2, width, width)), 0.0)

    def __add__(self, other: PositionInformation) -> PositionInformation:
        return PositionInformation(self.matrices + other.matrices, self.signal + other.signal)

    def least(self, machine: Machine, held: Collection[int]) -> Float[np.ndarray, "p p"]:
        """Return the matrix of the side that tells less, without some unknowns."""
        kept = [k for k in range(len(machine.parameters.free)) if k not in held]
        sides = [matrix[np.ix_(kept, kept)] for matrix in self.matrices]
        return min(sides, key=lambda matrix: gained(matrix, machine.parameters.guess[kept]))

    def std(self, machine: Machine, held: Collection[int]) -> Float[np.ndarray, " p"]:
        """Return the standard deviations if some unknowns are known; NaN for these and the unidentifiable."""
        unknown, own = machine.parameters, self.least(machine, held)
        kept = [k for k in range(len(unknown.free)) if k not in held]
        guess, names = unknown.guess[kept], [unknown.names[k] for k in kept]
        size = np.where(guess != 0, guess, 1.0)
        precision = assess_from_sums(names, own, own, float(np.sqrt(self.signal)), size)
        out = np.full(len(unknown.free), np.nan)
        out[kept] = np.where(precision.identifiable, precision.std, np.nan)
        return out


def log_at_rest(
    machine: Machine, signal: Float[np.ndarray, "rows m"], rate: float, start: Float[np.ndarray, " n"]
) -> Log:
    """Return a log of a reference, in which the machine rests at its start.

    Args:
        machine: The machine.
        signal: The reference, (rows, m) [m or rad].
        rate: Rows of the log [Hz].
        start: Positions at the start, (n,) [m or rad]; joints with a drive start at the reference.
    """
    start = np.array(start)
    start[np.asarray(machine.plant.driven(start.size))] = signal[0]
    rows = len(signal)
    time, force = np.arange(rows) / rate, np.zeros((rows, machine.gain.size))
    return Log(time, np.tile(start, (rows, 1)), force, reference=signal, source="the designed log")


def played(
    machine: Machine, signal: Float[np.ndarray, "rows m"], rate: float, start: Float[np.ndarray, " n"]
) -> Log:
    """Return the log without noise of a reference that is played, dry friction exact; see `log_at_rest`.

    Raises:
        InputError: If the loop diverges.
    """
    log = log_at_rest(machine, signal, rate, start)
    position = np.asarray(_run(_from_rest(machine, log), machine.plant).position)
    if not np.all(np.isfinite(position)):
        what = "the simulated loop diverges"
        raise InputError(what, where=log.source, hint="check the guesses of gains, delay and inertia")
    return replace(log, position=position)


def peaks_of(machine: Machine, log: Log) -> Peaks:
    """Return the extremes of a motion from rest, between the rows of its log too."""
    run = _run(at_every_tick(_from_rest(machine, log)), machine.plant)
    return Peaks.of(*(np.asarray(x) for x in (run.position, run.velocity, run.command)))


def _from_rest(machine: Machine, log: Log) -> Replay:
    """Return the run of a log from rest, dry friction exact."""
    return from_rest(make_replay(machine, log, exact_numerics(machine, log)))


@kept_jit
def _run(replay: Replay, plant: Plant) -> Trajectory:
    return replay(plant)


def _beside_ticks(machine: Machine) -> tuple[Machine, Machine]:
    """Return the machine with its unknown delays a little shorter, and a little longer."""
    controller, unknown = machine.controller, machine.parameters
    assert controller is not None, "only a loop is designed"
    delays = np.array([f.path[0] == CONTROLLER and f.path[1] == "delay" for f in unknown.free], dtype=bool)
    step = _BESIDE * float(controller.period) * delays
    shorter = np.where(delays, np.maximum(unknown.guess - step, 0.0), unknown.guess)
    return machine.with_estimate(shorter), machine.with_estimate(unknown.guess + step)


def gained(matrix: Float[np.ndarray, "p p"], guess: Float[np.ndarray, " p"]) -> float:
    """Return half the logarithm of the determinant of an information, by the prior's widths [nats]."""
    size = PRIOR * np.where(guess != 0, np.abs(guess), 1.0)
    return 0.5 * float(np.linalg.slogdet(np.eye(len(size)) + matrix * np.outer(size, size))[1])
