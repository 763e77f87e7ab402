"""Design experiments for a loop whose force is not logged, by the position of the simulated loop.

The information of such a log is that of its position. It never tells a scale that nothing known gives: the
design then says what would, a gain that is stated or a payload that is known in a second log.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.build import build_machine
from jaxid.case.case import Case
from jaxid.effects.inertia import AddedMass
from jaxid.errors import InputError
from jaxid.estimators.several.parts import Part, parts_of
from jaxid.estimators.simulated_output import choose_numerics, position_jacobian
from jaxid.estimators.ticks import std_of_ticks
from jaxid.estimators.unforced import base_of, common_scale_group, stated_gains, without
from jaxid.estimators.within_prior.prior import Prior
from jaxid.experiment_design.in_loop import (
    PRIOR,
    SHARPNESS,
    LoopDesign,
    at_every_tick,
    empty_replay,
    family,
    informative_signals,
    limits_of,
    no_noise,
)
from jaxid.experiment_design.limits import Limits, Peaks
from jaxid.files import signal_csv, write_whole
from jaxid.logs.log import Log
from jaxid.machine import Machine
from jaxid.model.parameter import parameters_of
from jaxid.model.plant import Plant
from jaxid.model.unknowns import CONTROLLER
from jaxid.numerics.kept import kept_jit
from jaxid.numerics.precision import assess_from_sums
from jaxid.scene import refuse_impossible, sampling_of
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Replay, exact_numerics, from_rest, make_replay

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification

# Payloads that are tried, as parts of the inertia, and changes of a known gain.
_PAYLOADS, _GAINS = (0.25, 1.0), (0.5, 2.0)
# Number of most informative starts that are improved, and evaluations for each.
_IMPROVED, _EVALUATIONS = 3, 100
# Part of a tick by which a delay is moved to either side.
_BESIDE = 0.01
# Part by which the rate of the log may differ from a whole part of the loop's.
_WHOLE = 1e-3


@dataclass(frozen=True)
class SecondLog:
    """A second log of the designed motion, in which something known differs.

    Args:
        what: What differs, in words.
        values: Known values in that log by name, for `set` in [[fit]].
        std: Expected standard deviations of the unknowns by both logs, (p,); NaN: not identifiable.
    """

    what: str
    values: Mapping[str, float]
    std: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class UnforcedDesign:
    """A reference for a loop whose force is not logged, and the expected precision of its unknowns.

    Deviations are those of white noise on the readings, by the Fisher information of the position; the
    derivative by a delay is that on the side of its tick that tells less. Without a scale, they are those of
    the ratios to one of the unknowns, which is held.

    Args:
        case: The case.
        machine: The machine at the guesses, or at the fit of the present logs.
        time: Time of each row [s].
        values: The reference, (rows, m) [m or rad].
        group: Unknowns that may all be multiplied by one factor, whatever the motion.
        base: The one of them that is held; None: something known gives the scale.
        std: Expected standard deviations by this log and the present ones, (p,); NaN: not identifiable.
        plain: The same for a tour from end to end at several speeds in place of the design, (p,).
        before: The same by the present logs alone, (p,); None: there are none.
        stating: Expected standard deviations if one unknown of the group were stated, by its name, (p,) each.
        second: Second logs that tell more; the first one is that of `case_text`.
        noise: Standard deviation of a reading that was counted with, (n,) [m or rad].
        peaks: Extremes of the motion.
        result: The fit of the present logs; None: there are none.
    """

    case: Case
    machine: Machine
    time: Float[np.ndarray, " rows"]
    values: Float[np.ndarray, "rows m"]
    group: tuple[int, ...]
    base: int | None
    std: Float[np.ndarray, " p"]
    plain: Float[np.ndarray, " p"]
    before: Float[np.ndarray, " p"] | None
    stating: Mapping[str, Float[np.ndarray, " p"]]
    second: tuple[SecondLog, ...]
    noise: Float[np.ndarray, " n"]
    peaks: Peaks
    result: Identification | None

    signal = "reference"

    def csv(self) -> str:
        """Return time and reference as CSV for `[reference] kind = "csv"`, with every digit."""
        return signal_csv(self.signal, self.time, self.values)

    def save(self, path: str | Path) -> Path:
        """Write the reference as CSV, whole or not at all."""
        write_whole(Path(path), self.csv())
        return Path(path)

    def case_text(self, path: str | Path) -> str:
        """Return the case that fits the log of this experiment with the present ones, as TOML.

        Args:
            path: File of the reference, beside which the case and the new logs stand.
        """
        from jaxid.experiment_design.next_case import next_case

        return next_case(self, Path(path))

    def save_case(self, path: str | Path) -> Path:
        """Write the case of `case_text` beside the file of the reference, with the suffix .toml."""
        out = Path(path).with_suffix(".toml")
        write_whole(out, self.case_text(path))
        return out

    def __str__(self) -> str:
        return "\n".join([*self._table(), *self._scale(), *self._second(), self._extremes()])

    def _table(self) -> list[str]:
        """Return a line for each unknown: its expected deviation over its value."""
        columns = {"before": self.before, "expected": self.std, "tour": self.plain}
        shown = {name: std for name, std in columns.items() if std is not None}
        labels = [self._label(k) for k in range(len(self.std))]
        width = max(len("parameter"), *map(len, labels))
        head = "  ".join(f"{name:<8}" for name in shown)
        lines = [f"{'parameter':<{width}}  {head}  (standard deviation over the value)"]
        for k, label in enumerate(labels):
            if k != self.base:
                cells = "  ".join(f"{self._part(std, k):<8}" for std in shown.values())
                lines.append(f"{label:<{width}}  {cells}".rstrip())
        return lines

    def _label(self, k: int) -> str:
        """Return the name of an unknown; of one without a scale, that of its ratio."""
        names = self.machine.parameters.names
        if self.base is None or k not in self.group:
            return names[k]
        return f"{names[k]} / {names[self.base]}"

    def _part(self, std: np.ndarray, k: int) -> str:
        """Return a deviation over the value, or with its unit if the value is zero."""
        unknown = self.machine.parameters.free[k]
        if not np.isfinite(std[k]):
            return "not identifiable"
        if unknown.guess == 0:
            return f"{std[k]:.2g} {unknown.unit}"
        return f"{std[k] / abs(unknown.guess):.2%}"

    def _scale(self) -> list[str]:
        """Return the lines on a missing scale, and on what would give it."""
        if self.base is None:
            return []
        names = self.machine.parameters.names
        group = ", ".join(names[k] for k in self.group)
        lines = [
            f"no motion tells the scale: {group} may all be multiplied by one factor. It is known",
            *(f"  if {name} is stated as a number: {self._all(std)}" for name, std in self.stating.items()),
        ]
        return [*lines, *(f"  by a second log with {s.what}: {self._all(s.std)}" for s in self.second)]

    def _second(self) -> list[str]:
        """Return the lines on second logs, if the scale is known without."""
        if self.base is not None or not self.second:
            return []
        return ["a second log of this motion", *(f"  with {s.what}: {self._all(s.std)}" for s in self.second)]

    def _all(self, std: np.ndarray) -> str:
        """Return the deviations of all unknowns that are not stated, in a line."""
        known = [k for k in range(len(std)) if np.isfinite(std[k])]
        return ", ".join(f"{self.machine.parameters.names[k]} {self._part(std, k)}" for k in known)

    def _extremes(self) -> str:
        """Return the line on the extremes of the motion."""

        def shown(values: np.ndarray) -> str:
            return ", ".join(f"{v:.3g}" for v in np.ravel(values))

        return (
            f"{self.time[-1]:.3g} s from rest at {shown(self.values[0])}, positions from "
            f"{shown(self.peaks.low)} to {shown(self.peaks.high)}, speed up to {shown(self.peaks.speed)}, "
            f"command up to {shown(self.peaks.force)}; noise of a reading {shown(self.noise)}"
        )


@dataclass(frozen=True)
class _Information:
    """Information of the positions of some logs.

    The position has a kink where an unknown delay is a whole number of ticks, and the two sides of it may
    tell much or little. The side that tells less counts.

    Args:
        matrices: J'J over the variance of a reading, by the unknowns of all logs, on each side of the delays,
            (2, p, p).
        signal: Squared norm of the positions over the deviation of a reading.
    """

    matrices: Float[np.ndarray, "2 p p"]
    signal: float

    @classmethod
    def of(cls, part: Part, noise: Float[np.ndarray, " n"], width: int) -> _Information:
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
    def none(cls, width: int) -> _Information:
        """Return that of no log."""
        return cls(np.zeros((2, width, width)), 0.0)

    def __add__(self, other: _Information) -> _Information:
        return _Information(self.matrices + other.matrices, self.signal + other.signal)

    def least(self, machine: Machine, held: Collection[int]) -> Float[np.ndarray, "p p"]:
        """Return the matrix of the side that tells less, without some unknowns."""
        kept = [k for k in range(len(machine.parameters.free)) if k not in held]
        sides = [matrix[np.ix_(kept, kept)] for matrix in self.matrices]
        return min(sides, key=lambda matrix: _gained(matrix, machine.parameters.guess[kept]))

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


@dataclass(frozen=True)
class _Present:
    """Hold what is there before an experiment: a machine and logs, or guesses alone.

    Args:
        machine: The machine at its values.
        parts: The logs that there are.
        noise: Standard deviation of a reading, (n,): that of the sensor, or as much as a fit leaves.
        result: The fit of the logs.
        least: Least standard deviation of each unknown, (p,): that of one tick for a delay of a loop whose
            period is stated; NaN: none.
    """

    machine: Machine
    parts: tuple[Part, ...]
    noise: Float[np.ndarray, " n"]
    result: Identification | None
    least: Float[np.ndarray, " p"]

    def std(self, information: _Information, held: Collection[int]) -> Float[np.ndarray, " p"]:
        """Return the standard deviations by an information; see `_Information.std`."""
        std = information.std(self.machine, held)
        return np.where(np.isfinite(std), np.fmax(std, self.least), std)


def designed_unforced(
    case: Case, result: Identification | None, progress: Callable[[str], None]
) -> UnforcedDesign:
    """Find the reference whose log, without a force, would tell the unknowns best beside the present logs.

    Gradients through the smoothed loop maximise the determinant of the information of the position. The
    deviations of the result are those of the loop with exact dry friction.

    Args:
        case: The case, with the tables that `jaxid.design` requires.
        result: A fit of the present logs; None: there are none, and the guesses count.
        progress: Called with a line of text at every stage.

    Raises:
        InputError: If the joints of the machine are linked, the noise of the encoder is not known, the rate
            of the log does not go with that of the loop, or no experiment keeps within the limits.
    """
    _refuse(case)
    rate, duration = sampling_of(case)
    present = _present(case, result, rate)
    machine, width = present.machine, len(present.machine.parameters.free)
    limits = _limits(case, machine)

    before = [_Information.of(part, present.noise, width) for part in present.parts]
    known = _Information.none(width)
    for one in before:
        known = known + one
    rows = round(duration * rate)
    stroke = np.linspace(limits.low, limits.high, rows)
    blank = Part.alone(machine, replace(_at_rest(machine, np.zeros((rows, 1)), rate), position=stroke))
    group = common_scale_group(machine, [*present.parts, blank])
    base = base_of(machine, group) if group else None
    held = () if base is None else (base,)
    problem = _problem(case, present, limits, base, known)
    signals = informative_signals(problem, case.where, progress, _IMPROVED, _EVALUATIONS)

    progress("computing the expected precision of each")
    parts = [Part.alone(machine, _played(machine, signal, rate)) for signal in signals]
    informed = [known + _Information.of(part, present.noise, width) for part in parts]
    guess = np.delete(machine.parameters.guess, held)
    gained = [_gained(one.least(machine, held), guess) for one in informed]
    best = int(np.argmax(gained))

    progress("trying second logs")
    signal, whole = signals[best], informed[best]
    second = _second_logs(case, present, limits, signal, rate, whole, held)
    gains = [k for k in group if machine.parameters.free[k].path[0] == CONTROLLER or k == base]
    return UnforcedDesign(
        case=case,
        machine=machine,
        time=np.arange(rows) / rate,
        values=signal,
        group=group,
        base=base,
        std=present.std(whole, held),
        plain=present.std(informed[0], held),
        before=present.std(known, held) if before else None,
        stating={machine.parameters.names[k]: present.std(whole, (k,)) for k in gains},
        second=second,
        noise=present.noise,
        peaks=problem.peaks(signal),
        result=result,
    )


def _refuse(case: Case) -> None:
    """Refuse a machine, or settings, for which no such experiment is designed."""
    if case.plant.cls.linked:
        what = "no experiment is designed for an arm whose log has no force"
        hint = "design one joint after the other as plant.kind = 'axis', or log the force"
        raise InputError(what, where=case.where, hint=hint)
    if case.identification.per_log:
        what = "no experiment is designed for unknowns with a value in each log"
        hint = "leave per_log out, and state what is known to differ by set in [[fit]]"
        raise InputError(what, where=f"{case.where}, [identification]", hint=hint)
    others = [] if case.design is None else [k for k in case.tables.get("design", {}) if k != "acceleration"]
    if others:
        what = f"{others[0]} is of an experiment along a reference, and a log without a force has none"
        raise InputError(what, where=f"{case.where}, [design]", hint=f"leave {others[0]} out")


def _present(case: Case, result: Identification | None, rate: float) -> _Present:
    """Return the machine, the logs and the noise from which an experiment starts."""
    if result is None:
        machine = build_machine(case, period=1 / rate)
        if case.log is None or case.log.reference_hold is None:
            # A command that is played row by row is held in between.
            machine = replace(machine, reference_hold="zero_order")
        std = machine.sensor.position_std
        if std is None:
            raise no_noise(case, "position", "position_noise or position_resolution, or name a log")
        noise = np.broadcast_to(np.asarray(std, float), case.plant.joints)
        return _Present(_with_noise(machine, noise), (), noise, None, _least_std(case, machine))

    if not result.estimate.converged:
        what = "the fit of the present log did not converge"
        raise InputError(what, where=case.where, hint="fit it by `jaxid identify`, or leave the log out")
    session = result.session
    values = np.where(
        np.isfinite(result.estimate.theta), result.estimate.theta, session.machine.parameters.guess
    )
    run = session.fit.machine(session.machine)
    hold = replace(session.machine, reference_hold=run.reference_hold)
    machine = hold.with_estimate(values)
    left = _left(result, case.plant.joints)
    std = machine.sensor.position_std
    noise = left if std is None else np.maximum(left, np.asarray(std, float))
    machine = _with_noise(machine, noise)
    parts = tuple(parts_of(session.with_machine(machine)))
    return _Present(machine, parts, noise, result, _least_std(case, machine))


def _least_std(case: Case, machine: Machine) -> Float[np.ndarray, " p"]:
    """Return the least standard deviation of each unknown, as a fit of its log prints it, (p,)."""
    stated = case.controller is not None and case.controller.period is not None
    return std_of_ticks(machine) if stated else np.full(len(machine.parameters.free), np.nan)


def _with_noise(machine: Machine, noise: Float[np.ndarray, " n"]) -> Machine:
    """Return the machine with white noise of its readings in place of counts.

    The steps of a simulation depend on it, and counts would make the motion rough.
    """
    sensor = replace(machine.sensor, position_noise=jnp.asarray(noise), position_resolution=None)
    return replace(machine, sensor=sensor)


def _left(result: Identification, joints: int) -> Float[np.ndarray, " n"]:
    """Return the RMS of the position that a fit leaves of the log that it follows worst, (n,)."""
    runs = [gap.simulation for gap in result.gaps[: len(result.session.fits)]]
    return np.max([run.rms for run in runs if run is not None], axis=0) * np.ones(joints)


def _limits(case: Case, machine: Machine) -> Limits:
    """Take the limits of a case; a command may saturate if the saturation is an unknown."""
    limits = limits_of(case, machine)
    unknown = [f.path[1] for f in machine.parameters.free if f.path[0] == CONTROLLER]
    if "limit" in unknown and case.limits.force is None:
        return replace(limits, force=np.full(limits.force.shape, np.inf))
    return limits


def _problem(
    case: Case, present: _Present, limits: Limits, base: int | None, known: _Information
) -> LoopDesign:
    """Set up the search for a reference, one value a row of the log, with the base of a scale held."""
    rate, duration = sampling_of(case)
    machine = present.machine if base is None else without(present.machine, base)
    assert machine.controller is not None, "without a controller there is no loop"
    period = float(machine.controller.period)
    every = max(1, round(1 / (rate * period)))
    if abs(1 / (rate * period * every) - 1) > _WHOLE:
        raise InputError(
            f"a loop of {1 / period:g} Hz cannot be logged at sample_rate = {rate:g}",
            where=case.where,
            hint="take the loop's rate, or a whole part of it",
        )
    rows = round(duration * rate)
    start = np.broadcast_to(np.asarray(case.simulation.initial_position, float), case.plant.joints)
    refuse_impossible(machine.plant, start[None], f"{case.where}, [simulation] initial_position")
    speed = float(limits.speed.max())
    plant = machine.plant.smoothed(np.asarray(SHARPNESS), np.asarray(speed))
    machine = machine.with_plant(plant, machine.parameters)
    stated_limit = None if case.design is None else case.design.acceleration
    acceleration = None if stated_limit is None else np.broadcast_to(stated_limit, machine.gain.shape)
    shapes, starts = family(machine, limits, rows, 1 / rate, acceleration)

    memory = choose_numerics(machine, _at_rest(machine, np.zeros((rows, 1)), rate))
    prior = Prior.of(machine, PRIOR, np.zeros(0))
    slope = prior.slope(machine.parameters.guess)
    matrix = known.least(present.machine, () if base is None else (base,)) * np.outer(slope, slope)
    return LoopDesign(
        machine=machine,
        replay=empty_replay(machine, start, (rows - 1) * every + 1, period, every, memory.longest_delay),
        weight=np.tile(1.0 / present.noise, (rows, 1)),
        direct_share=np.ones(len(present.noise)),
        prior=prior,
        on="position",
        limits=limits,
        shapes=shapes,
        starts=starts,
        known=np.eye(len(matrix)) + matrix,
    )


def _at_rest(machine: Machine, signal: Float[np.ndarray, "rows m"], rate: float) -> Log:
    """Return a log of a reference, in which the machine rests at its start."""
    n = machine.plant.joints
    start = np.zeros(n)
    start[np.asarray(machine.plant.driven(n))] = signal[0]
    rows = len(signal)
    time, force = np.arange(rows) / rate, np.zeros((rows, machine.gain.size))
    return Log(time, np.tile(start, (rows, 1)), force, reference=signal, source="the designed log")


def _played(machine: Machine, signal: Float[np.ndarray, "rows m"], rate: float) -> Log:
    """Return the log without noise of a reference that is played, dry friction exact.

    Raises:
        InputError: If the loop diverges.
    """
    log = _at_rest(machine, signal, rate)
    position = np.asarray(_run(_from_rest(machine, log), machine.plant).position)
    if not np.all(np.isfinite(position)):
        what = "the simulated loop diverges"
        raise InputError(what, where=log.source, hint="check the guesses of gains, delay and inertia")
    return replace(log, position=position)


def _peaks(machine: Machine, log: Log) -> Peaks:
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


def _gained(matrix: Float[np.ndarray, "p p"], guess: Float[np.ndarray, " p"]) -> float:
    """Return half the logarithm of the determinant of an information, by the prior's widths [nats]."""
    size = PRIOR * np.where(guess != 0, np.abs(guess), 1.0)
    return 0.5 * float(np.linalg.slogdet(np.eye(len(size)) + matrix * np.outer(size, size))[1])


def _second_logs(
    case: Case,
    present: _Present,
    limits: Limits,
    signal: Float[np.ndarray, "rows m"],
    rate: float,
    whole: _Information,
    held: Sequence[int],
) -> tuple[SecondLog, ...]:
    """Return second logs of a motion that keep within the limits: payloads that are known, then other gains.

    Args:
        case: The case.
        present: The machine and the noise.
        limits: Limits of the experiment.
        signal: The reference.
        rate: Rows of the log [Hz].
        whole: Information of the first log and the present ones.
        held: Unknowns that are held because nothing gives a scale.
    """
    width, out = len(present.machine.parameters.free), []
    for what, values, machine in (*_loaded(case, present.machine), *_other_gains(present.machine)):
        log = _played(machine, signal, rate)
        if limits.broken(_peaks(machine, log)):
            continue
        part = Part.alone(machine, log)
        of_both = whole + _Information.of(part, present.noise, width)
        scaled = not common_scale_group(machine, [part])
        out.append(SecondLog(what, values, present.std(of_both, () if scaled else held)))
    return tuple(out)


def _loaded(case: Case, machine: Machine) -> list[tuple[str, dict[str, float], Machine]]:
    """Return the machine with payloads that are known; none if an added mass is an unknown."""
    inertia = machine.plant.own_inertia()
    declared = [e for e in case.effects if e.cls is AddedMass]
    unknown = [f for f in machine.parameters.free if f.name.startswith(AddedMass.kind)]
    if inertia is None or machine.plant.joints > 1 or unknown or len(declared) > 1:
        return []
    info = parameters_of(AddedMass)["mass"]
    unit = machine.units.label(info.dimension, machine.plant.motion(0))
    there = sum(float(np.sum(np.asarray(e.mass))) for e in machine.plant.effects if isinstance(e, AddedMass))
    out = []
    for part in sorted(_PAYLOADS, reverse=True):
        mass = float(f"{part * float(np.max(np.asarray(inertia))):.2g}")
        plant = machine.plant.with_effect(AddedMass(mass=jnp.asarray(mass)))
        values = {f"{AddedMass.kind}.mass": there + mass}
        loaded = machine.with_plant(plant, machine.parameters)
        out.append((f"a payload of {mass:g} {unit} that is known", values, loaded))
    return out


def _other_gains(machine: Machine) -> list[tuple[str, dict[str, float], Machine]]:
    """Return the machine with its first stated gain halved and doubled; none if no gain is stated."""
    law, names = machine.controller, stated_gains(machine)
    if law is None or not names:
        return []
    out = []
    for factor in _GAINS:
        value = factor * np.asarray(getattr(law, names[0]), float)
        if value.size == 1:
            changed = replace(machine, controller=replace(law, **{names[0]: jnp.asarray(value)}))
            number = float(value.ravel()[0])
            out.append((f"{names[0]} = {number:g}", {f"{CONTROLLER}.{names[0]}": number}, changed))
    return out
