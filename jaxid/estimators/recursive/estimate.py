"""Recursive least squares along a log, on the rows of a plant's balance.

Corrections to the paper: its regularisation pulls towards zero and fades (see
`jaxid.estimators.recursive.recursion`); its beta = 1 + T ln(0.5) / T_HL is the first-order expansion of
2^(-T / T_HL), which is used here; (49) lacks its root in our copy. The paper's gate and its sum of rows apply
to the whole sample. Here both apply to each row: if one joint slides and another sticks, the force that
holds the second is in no model. Samples that do not count do not forget either: the half-life is of motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.common.best_bodies import NEAREST, nearest_bodies
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.recursive.precision import details_of, precision_of, weights_together
from jaxid.estimators.recursive.recursion import (
    Recursion,
    RecursiveEstimate,
    RecursiveMemory,
    column_squares,
    instants,
    run,
)
from jaxid.estimators.recursive.rows import Rows, rows_steps
from jaxid.estimators.several.force import inverse_dynamics_steps
from jaxid.estimators.several.parts import Part
from jaxid.estimators.several.weights import disagreement
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import carries_force
from jaxid.model.parameter import parameters_of
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.rows import Rows as Residual
from jaxid.settings import Recursive

# Largest number of instants in the history of a log.
_MOST = 200
# A right-hand side below this fraction of the row's force is zero.
_NOTHING = 1e-9


def start_of(machine: Machine) -> Float[np.ndarray, " p"]:
    """Return the default start: one for gains, zero for friction and forces, and the plant's guesses."""
    out = machine.parameters.guess
    for k, f in enumerate(machine.parameters.free):
        if f.effect is not None:
            effect, name = type(machine.plant.effects[f.effect]), f.path[2]
            assert isinstance(name, str), "a parameter of an effect has a name"
            gain = effect.in_drive and not carries_force(parameters_of(effect)[name])
            out[k] = 1.0 if gain else 0.0
    return out


def gains_of(machine: Machine) -> tuple[int | None, ...]:
    """Return the index of the unknown that is the gain of each joint's drive; None if it is known."""
    out: list[int | None] = [None] * machine.plant.joints
    for k, f in enumerate(machine.parameters.free):
        effect = None if f.effect is None else machine.plant.effects[f.effect]
        if effect is not None and f.path[2] == effect.drive_gain:
            out[effect.port] = k
    return tuple(out)


@dataclass(frozen=True)
class _Run:
    """One log that the estimator runs along.

    Args:
        name: Name of the log in results.
        data: The filtered log.
        rows: All its rows, by the unknowns of all logs.
        used: The rows that the estimator uses, summed if the case says so.
        gains: Number of the unknown that is the gain of each joint's drive; None if it is known.
        scale: Factor of the rows, by which their noise is that of the first log.
    """

    name: str
    data: Prepared
    rows: Rows
    used: Rows
    gains: tuple[int | None, ...]
    scale: float = 1.0

    @property
    def period(self) -> float:
        """Time between rows [s]."""
        return self.data.period * self.data.recipe.decimation

    def residual(self, theta: np.ndarray) -> Residual:
        """Return the residual of the used rows at some values of the unknowns."""
        used = self.used
        return Residual(used.rows, used.rows @ theta - used.target, used.counts, used.size)

    def shown_residual(self, theta: np.ndarray) -> np.ndarray:
        """Return the residual of the used rows in its unit, NaN where a row does not count."""
        used = self.used
        return np.where(used.counts, used.rows @ theta - used.target, np.nan) / self.scale

    def scaled(self, factor: float) -> _Run:
        """Return the log with rows, target and force times a factor."""
        rows, used = self.rows.scaled(factor), self.used.scaled(factor)
        return replace(self, rows=rows, used=used, scale=factor)


def recursive_steps(
    machine: Machine,
    log: Prepared | Sequence[Part],
    settings: Recursive,
    saved: Mapping[str, Any] | None = None,
) -> Steps[Estimate]:
    """Estimate the unknowns sample by sample.

    Several logs are run one after the other: each begins with its filters, and with the memory at the end of
    the one before. Their rows count over the variance of their noise, which a fit of each log shows.

    Args:
        machine: The machine. The guesses of the plant's parameters are their start, and those of the effects
            too if `start` is "guess".
        log: The filtered log, or the parts of several.
        settings: Table [recursive] of the case.
        saved: Memory of an earlier run to continue, as `jaxid.estimators.recursive.memory` reads it.

    Returns:
        The estimate at the end; links that must be physically consistent are the nearest real bodies, and
        the history is without this. Standard deviations include the residual's colour, the weights and the
        remaining pull of the start. `details` has the history and the memory.

    Raises:
        InputError: If the balance is not linear in the unknowns, a gain has no known term to scale it, an
            instrument has no gain, or rows of different units are to be summed.
    """
    _check(machine, settings, gains_of(machine), saved)
    logs = yield from _logs_of(machine, log, settings)
    _check_rows(machine, logs)
    if not isinstance(log, Prepared) and len(log) > 1:
        logs = yield from _of_equal_noise(machine, log, logs)

    used = Rows.joined([each.used for each in logs])
    recursion, memory = _recursion(machine, logs[0], used, settings)
    if saved is not None:
        recursion, memory = _continued(recursion, saved)
    course = yield from _run_along(recursion, memory, logs, settings)

    theta = np.asarray(course.history.theta[-1])
    precision, inflation = precision_of(
        machine,
        used,
        course.instruments,
        course.recursion,
        course.history,
        course.every,
        whole=saved is None,
        weight=weights_together([each.used for each in logs], course.forgetting),
        block=course.blocks,
        logs=course.samples,
    )
    shown = details_of(
        machine, course.recursion, course.memory, course.history, course.times, inflation, settings
    )
    details: dict[str, Any] = {"recursive": shown}
    notes = list(_notes(machine, theta, settings, len(logs)))
    if len(logs) > 1:
        details["fits"] = _facts_by_log(logs, float(course.history.noise[-1]))
        if settings.half_life is None:
            residuals = [each.residual(theta) for each in logs]
            notes += disagreement(residuals, int(precision.identifiable.sum()))

    if machine.parameters.bodies:
        columns = np.linalg.solve(np.asarray(course.memory.root), np.eye(len(theta)))
        theta, _ = nearest_bodies(machine.parameters, columns, theta)
        notes.append(f"{NEAREST}; the course over time is without it")
    converged = bool(np.all(np.isfinite(theta)))
    return Estimate(
        method="recursive",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else "the estimate is not finite",
        residual=np.concatenate([each.shown_residual(theta) for each in logs]),
        samples=int(used.counts.sum()),
        notes=tuple(notes),
        details=details,
    )


def _logs_of(machine: Machine, log: Prepared | Sequence[Part], settings: Recursive) -> Steps[list[_Run]]:
    """Compute the rows of each log, by the unknowns of all."""
    unknowns = len(machine.parameters.free)
    if isinstance(log, Prepared):
        members = [("fit", machine, log, np.arange(unknowns))]
    else:
        members = [(part.name, part.machine, part.data, part.index) for part in log]
    logs = []
    for name, on_log, data, index in members:
        gains = tuple(None if g is None else int(index[g]) for g in gains_of(on_log))
        rows = yield from rows_steps(on_log, data, _gates(data, settings))
        rows = rows.widened(index, unknowns)
        logs.append(_Run(name, data, rows, rows.summed if settings.rows == "summed" else rows, gains))
    return logs


def _continued(recursion: Recursion, saved: Mapping[str, Any]) -> tuple[Recursion, RecursiveMemory]:
    """Return the estimator and the memory of an earlier run."""
    recursion = replace(recursion, start=saved["start"], information=saved["information"])
    return recursion, RecursiveMemory(**{k: jnp.asarray(v) for k, v in saved["memory"].items()})


@dataclass(frozen=True)
class _Course:
    """Course of the estimates along all logs, of n samples in all and h instants in the history.

    Args:
        recursion: The estimator, as it ran along the last log.
        memory: Its memory at the end.
        history: The estimates, by instant.
        times: Time of each instant, with the logs one behind the other [s], (h,).
        instruments: Instruments, or the rows themselves if there are none, (n, m, p).
        every: Number of samples between two instants.
        samples: Number of samples of each log.
        forgetting: Factor of a sample's weight at the next sample, by log.
    """

    recursion: Recursion
    memory: RecursiveMemory
    history: RecursiveEstimate
    times: np.ndarray
    instruments: np.ndarray
    every: int
    samples: list[int]
    forgetting: list[float]

    @property
    def blocks(self) -> np.ndarray:
        """Number of the estimate after each sample in the history, (n,)."""
        out, first = [], 0
        for count in self.samples:
            out.append(first + np.arange(count) // self.every)
            first += -(-count // self.every)
        return np.concatenate(out)


def _run_along(
    recursion: Recursion, memory: RecursiveMemory, logs: Sequence[_Run], settings: Recursive
) -> Steps[_Course]:
    """Run the estimator along the logs, one after the other."""
    samples = [len(each.rows.rows) for each in logs]
    every = max(1, -(-sum(samples) // _MOST))
    histories, times, instruments, forgetting, began = [], [], [], [], 0.0

    for each in logs:
        recursion = replace(recursion, gains=each.gains, forgetting=_forgetting(each, settings))
        rows = each.rows
        memory, history, z = yield SolveRequest(
            run, (recursion, memory, rows.rows, rows.target, rows.counts, every)
        )
        histories.append(jax.tree.map(np.asarray, history))
        instruments.append(each.used.rows if z is None else np.asarray(z))
        forgetting.append(float(recursion.forgetting))
        # The logs stand one behind the other in time.
        times.append(began + each.data.times[instants(len(rows.rows), every)])
        began = float(times[-1][-1]) + each.period

    return _Course(
        recursion=recursion,
        memory=memory,
        history=jax.tree.map(lambda *x: np.concatenate(x), *histories),
        times=np.concatenate(times),
        instruments=np.concatenate(instruments),
        every=every,
        samples=samples,
        forgetting=forgetting,
    )


def _facts_by_log(logs: Sequence[_Run], noise: float) -> dict[str, dict[str, Any]]:
    """Return the number of samples and the noise of each log; `noise` is that of the first."""
    return {each.name: {"samples": int(each.used.counts.sum()), "noise": noise / each.scale} for each in logs}


def _of_equal_noise(machine: Machine, parts: Sequence[Part], logs: Sequence[_Run]) -> Steps[list[_Run]]:
    """Return the logs with rows scaled so that the noise of each is that of the first one.

    Least squares on all logs shows the noise. The rows alone do not: where a gain is unknown, zeros
    may fit those of a log without any residual.
    """
    first = yield from inverse_dynamics_steps(machine, parts)
    noises = [first.details["fits"][part.name]["noise"] for part in parts]
    return [each.scaled(noises[0] / noise) for each, noise in zip(logs, noises, strict=True)]


def _forgetting(log: _Run, settings: Recursive) -> np.ndarray:
    """Return the factor of a sample's weight when the next one of this log comes."""
    half_life = np.inf if settings.half_life is None else settings.half_life
    return np.asarray(2.0 ** (-log.period / half_life))


def _recursion(
    machine: Machine, first: _Run, used: Rows, settings: Recursive
) -> tuple[Recursion, RecursiveMemory]:
    """Build the estimator that the case states, and its memory before the first sample."""
    recursion = Recursion(
        start=machine.parameters.guess if settings.start == "guess" else start_of(machine),
        information=settings.regularization * _sizes(machine, used),
        forgetting=_forgetting(first, settings),
        summed=settings.rows == "summed",
        gains=first.gains,
        instrument=settings.instrument == "model",
    )
    return recursion, recursion.memory()


def _sizes(machine: Machine, used: Rows) -> Float[np.ndarray, " p"]:
    """Return the mean square of each column over the samples that count, with a floor from the force."""
    natural = np.where(machine.parameters.guess == 0, 1.0, machine.parameters.guess)
    return np.asarray(column_squares(used.rows, used.counts, used.force, natural)[0])


def _gates(data: Prepared, settings: Recursive) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the stated gates by joint; the velocity gate defaults to the recipe's rest velocity."""
    if settings.gate_velocity is None and settings.gate_acceleration is None:
        return None
    joints = data.q.shape[1]
    velocity = data.recipe.rest_velocity if settings.gate_velocity is None else settings.gate_velocity
    acceleration = np.inf if settings.gate_acceleration is None else settings.gate_acceleration
    return _by_joint(velocity, joints), _by_joint(acceleration, joints)


def _by_joint(value: Any, joints: int) -> np.ndarray:
    return np.broadcast_to(np.asarray(value, float), (joints,))


def _check(machine: Machine, settings: Recursive, gains: tuple, saved: Mapping[str, Any] | None) -> None:
    """Check the settings, independently of the log.

    Raises:
        InputError: If settings contradict one another, the machine or the saved memory.
    """
    rows, instrument = settings.rows, settings.instrument
    if instrument == "model" and not any(g is not None for g in gains):
        raise InputError(
            'instrument = "model" needs an unknown gain of a drive',
            where="recursive",
            hint="leave it out, or add an effect actuator_gain with gain = { guess = 1.0 }",
        )
    if rows == "summed" and len({machine.plant.motion(i) for i in range(machine.plant.joints)}) > 1:
        raise InputError(
            'rows = "summed" would add forces to torques', where="recursive", hint='take rows = "full"'
        )
    wanted = {"summed": rows == "summed", "instrument": instrument == "model"}
    if saved and any(saved[k] != v for k, v in wanted.items()):
        raise InputError(
            "the run to restart from had other rows or another instrument",
            where="recursive",
            hint="take the rows and instrument of that run",
        )


def _check_rows(machine: Machine, logs: Sequence[_Run]) -> None:
    """Check that there are enough rows, and that each gain is beside a known term.

    If all terms of a balance are unknown, unknowns of zero fit any log.

    Raises:
        InputError: If there are too few rows, or a gain has no known term to scale it.
    """
    names = machine.parameters.names
    passed = sum(int(each.rows.counts.sum()) for each in logs)
    if passed <= len(names):
        raise InputError(
            f"{passed} samples pass the gate, for {len(names)} unknowns",
            where="recursive",
            hint="lower gate_velocity or gate_acceleration, or take a log with more motion",
        )
    scaled: dict[int, bool] = {}
    for each in logs:
        for k, g in enumerate(each.gains):
            known = np.abs(np.where(each.rows.counts, each.rows.target, 0.0)[:, k]).max()
            if g is not None:
                scaled[g] = scaled.get(g, False) or known > _NOTHING * np.abs(each.rows.force[:, k]).max()
    for g, there in scaled.items():
        if not there:
            raise InputError(
                f"{names[g]} is not identifiable: its balance has no known term, and any multiple of all "
                "unknowns fits as well",
                where="recursive",
                hint="declare the inertia or the gain known",
            )


def _notes(machine: Machine, theta: np.ndarray, settings: Recursive, logs: int) -> tuple[str, ...]:
    """Return the notes about forgetting, bounds and instruments."""
    lower, upper = machine.parameters.bounds
    out = [n for n, o in zip(machine.parameters.names, (theta < lower) | (theta > upper), strict=True) if o]
    notes = (
        [f"outside the bounds of sign or case, which this method ignores: {', '.join(out)}"] if out else []
    )
    if settings.instrument == "model":
        notes.append("instruments: the drive's force that the model fitted by least squares predicts")
    if logs > 1:
        notes.append(f"the {logs} logs were run one after the other, as they are named")
    half = settings.half_life
    if not half:
        return ("nothing is forgotten", *notes)
    return (f"the weight of a sample halves every {half:g} s of motion", *notes)
