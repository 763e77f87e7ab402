"""Search commands for an arm by trials: draw them, keep the best, and vary it joint by joint.

Derivatives by the command would take a simulation for each of its numbers and each unknown. A trial takes one
for each unknown, and varies all joints at once: the information on the unknowns of a joint hardly depends on
the commands of the others.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.apart.joint import joint_of
from jaxid.estimators.several.parts import Part
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.experiment_design.limits import Limits, Peaks, kept_within
from jaxid.experiment_design.position_information import (
    PositionInformation,
    gained,
    peaks_of,
    played,
)
from jaxid.experiment_design.present import Present
from jaxid.experiment_design.shapes import Shapes
from jaxid.logs.log import Log

# Work of all trials, steps of integration times unknowns, since a trial simulates the arm for each unknown;
# least number of trials; and the share of trials that are drawn before the best is varied.
_WORK, _LEAST, _DRAWN = 6e6, 20, 0.2
# Part of the largest speed that a command uses: with a payload the arm goes a little faster.
_PART_OF_SPEED = 0.95
# Seed of the draws: the same case gives the same command.
_SEED = 17
# Share of variations that draw a joint's command anew, and share of a command's weights that others change.
_ANEW, _CHANGED = 0.15, 0.5


@dataclass(frozen=True)
class Trial:
    """Hold a command that keeps within the limits, and the information of its log.

    Args:
        numbers: Numbers of the command in its family.
        signal: The command, (rows, m).
        information: Information of its log and the present ones.
        nats: Information over the guesses [nats].
        by_joint: The same for the unknowns of each joint alone, (n,).
    """

    numbers: Float[np.ndarray, " k"]
    signal: Float[np.ndarray, "rows m"]
    information: PositionInformation
    nats: float
    by_joint: Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Trials:
    """Hold the machine, the limits and the family of commands of all trials.

    Args:
        present: The machine, the noise and the present logs.
        known: Information of the present logs.
        held: Unknowns that are held because nothing gives a scale.
        limits: Limits of the experiment.
        shapes: Family of commands.
        rate: Rows of the log [Hz].
    """

    present: Present
    known: PositionInformation
    held: Collection[int]
    limits: Limits
    shapes: Shapes
    rate: float

    def trial(self, numbers: Float[np.ndarray, " k"]) -> Trial | None:
        """Play a command at the largest amplitude within the limits; None if there is none."""
        machine = self.present.machine

        def peaks(signal: Float[np.ndarray, "rows m"]) -> Peaks:
            return peaks_of(machine, self.log(signal))

        limits = replace(self.limits, speed=_PART_OF_SPEED * self.limits.speed)
        try:
            kept = kept_within(limits, self.shapes, numbers, peaks)
        except InputError:
            # The loop diverges.
            return None
        if kept is None:
            return None
        numbers, signal, _ = kept
        part = Part.alone(machine, self.log(signal))
        width = len(machine.parameters.free)
        information = self.known + PositionInformation.of(part, self.present.noise, width)
        guess = np.delete(machine.parameters.guess, list(self.held))
        nats = gained(information.least(machine, self.held), guess)
        if not np.isfinite(nats):
            return None
        return Trial(numbers, signal, information, nats, self._by_joint(information))

    def log(self, signal: Float[np.ndarray, "rows m"]) -> Log:
        """Return the log without noise of a command."""
        return played(self.present.machine, signal, self.rate, self.present.start)

    def work(self, trial: Trial) -> float:
        """Return the work of a trial: steps of integration times unknowns."""
        machine = self.present.machine
        assert machine.controller is not None, "without a controller there is no loop"
        log = self.log(trial.signal)
        ticks = len(trial.signal) / (self.rate * float(machine.controller.period))
        return ticks * choose_numerics(machine, log).substeps * len(machine.parameters.free)

    def _by_joint(self, information: PositionInformation) -> Float[np.ndarray, " n"]:
        """Return the information on the unknowns of each joint, if all others were known [nats]."""
        machine = self.present.machine
        joints = [joint_of(f, machine) for f in machine.parameters.free]
        guess, out = machine.parameters.guess, []
        for joint in range(machine.plant.joints):
            ours = [k for k, j in enumerate(joints) if j == joint and k not in self.held]
            block = np.ix_(ours, ours)
            out.append(min(gained(matrix[block], guess[ours]) for matrix in information.matrices))
        return np.array(out)

    def mixed(self, best: Trial, other: Trial) -> Float[np.ndarray, " k"] | None:
        """Return the best command with those joints of another that show their unknowns better.

        Returns:
            Its numbers; None if all joints are those of one of the two.
        """
        better = [bool(b) for b in other.by_joint > best.by_joint]
        drives = [better[joint] for joint in self.present.machine.plant.driven(len(better))]
        if all(drives) or not any(drives):
            return None
        n, k = self._sizes()
        joints = np.repeat(drives, k)
        chosen = np.concatenate([joints, drives, [False]])
        return np.where(chosen, other.numbers, best.numbers)

    def drawn(self, rng: np.random.Generator) -> Float[np.ndarray, " k"]:
        """Draw the numbers of a command: of each joint sines of all speeds, slow ones or fast ones."""
        n, k = self._sizes()
        sines = (k - 1) // 2
        slope = rng.uniform(-1.5, 1.0, size=(n, 1))
        size = np.geomspace(1.0, 100.0, sines) ** slope
        weights = rng.standard_normal((n, 2, sines)) * size[:, None]
        tour = rng.choice([0.0, 1.0], size=(n, 1)) * np.abs(weights).sum(axis=(1, 2))[:, None] * 0.3
        centre = rng.normal(0.0, 0.3, size=n)
        return np.concatenate([np.hstack([weights.reshape(n, -1), tour]).ravel(), centre, [4.0]])

    def varied(self, numbers: Float[np.ndarray, " k"], rng: np.random.Generator) -> Float[np.ndarray, " k"]:
        """Return the numbers of a command near another one, some of its joints drawn anew."""
        n, k = self._sizes()
        weights = numbers[: n * k].reshape(n, k)
        typical = np.abs(weights).max(axis=1, keepdims=True)
        width = 10 ** rng.uniform(-1.5, 0.0, size=(n, 1))
        change = width * rng.standard_normal((2, n, k)) * (rng.random((n, k)) < _CHANGED)
        near = weights * (1 + change[0]) + 0.3 * typical * change[1]
        centre = numbers[n * k : n * k + n] + width[:, 0] * rng.standard_normal(n)
        fresh = self.drawn(rng)
        anew = rng.random(n) < _ANEW
        whole = np.where(anew[:, None], fresh[: n * k].reshape(n, k), near)
        return np.concatenate([whole.ravel(), np.where(anew, fresh[n * k : n * k + n], centre), [4.0]])

    def _sizes(self) -> tuple[int, int]:
        """Return the number of drives, and that of basis functions."""
        return self.shapes.low.size, self.shapes.basis.shape[1]


def informative_commands(
    trials: Trials, starts: list[np.ndarray], where: str, progress: Callable[[str], None]
) -> tuple[Trial | None, Trial]:
    """Return the tour, None if it breaks the limits, and the most informative of all commands tried.

    Args:
        trials: Machine, limits and family of commands.
        starts: Numbers of commands to begin with, the tour first.
        where: The case, for messages.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If no command keeps within the limits.
    """
    rng = np.random.default_rng(_SEED)
    progress("evaluating sines and tours")
    tour, *others = map(trials.trial, starts)
    found = [trial for trial in (tour, *others) if trial is not None]
    for _ in range(_LEAST):
        # The centre of the stroke may be no place for an arm that sags.
        if not found and (drawn := trials.trial(trials.drawn(rng))) is not None:
            found.append(drawn)
    if not found:
        raise InputError(
            "no experiment within the limits was found",
            where=f"{where}, [limits]",
            hint="widen them, or check the loop's gains: every trial exceeded them, whatever its amplitude",
        )
    best = max(found, key=lambda t: t.nats)
    most = max(_LEAST, int(_WORK / trials.work(best)))
    for count in range(most):
        progress(f"trial {count + 1} of {most}")
        is_drawn = count < _DRAWN * most
        numbers = trials.drawn(rng) if is_drawn else trials.varied(best.numbers, rng)
        for other in _with_mixed(trials, best, numbers):
            best = max(best, other, key=lambda t: t.nats)
    return tour, best


def _with_mixed(trials: Trials, best: Trial, numbers: np.ndarray) -> Iterator[Trial]:
    """Try a command, and the best one with those joints of it that show their unknowns better."""
    other = trials.trial(numbers)
    if other is None:
        return
    yield other
    mixed = trials.mixed(best, other)
    if mixed is not None and (both := trials.trial(mixed)) is not None:
        yield both
