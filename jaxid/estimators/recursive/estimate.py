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
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.recursive.precision import details_of, precision_of, weights_together
from jaxid.estimators.recursive.recursion import Recursion, RecursiveMemory, column_squares, instants, run
from jaxid.estimators.recursive.rows import Rows, rows_steps
from jaxid.estimators.several.force import inverse_dynamics_steps
from jaxid.estimators.several.parts import Part
from jaxid.estimators.several.weights import disagreement
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import carries_force
from jaxid.model.parameter import parameters_of
from jaxid.numerics.lanes import SolveRequest, Steps
from jaxid.numerics.precision import Rows as Residual
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
        The estimate at the end. Standard deviations include the residual's colour, the weights and the
        remaining pull of the start. `details` has the history and the memory.

    Raises:
        InputError: If the balance is not linear in the unknowns, a gain has no known term to scale it, an
            instrument has no gain, or rows of different units are to be summed.
    """
    noisy = settings.instrument == "model"
    _check(machine, settings, gains_of(machine), saved)
    parts, logs = [] if isinstance(log, Prepared) else list(log), []
    if isinstance(log, Prepared):
        members = [("fit", machine, log, np.arange(len(machine.parameters.free)))]
    else:
        members = [(part.name, part.machine, part.data, part.index) for part in parts]
    for name, own, data, index in members:
        gains = tuple(None if g is None else int(index[g]) for g in gains_of(own))
        rows = yield from rows_steps(own, data, _gates(data, settings))
        rows = rows.widened(index, len(machine.parameters.free))
        logs.append(_Run(name, data, rows, rows.summed if settings.rows == "summed" else rows, gains))
    _check_rows(machine, logs)
    if len(parts) > 1:
        logs = yield from _of_equal_noise(machine, parts, logs)

    used = Rows.joined([each.used for each in logs])
    recursion, memory = _recursion(machine, logs[0], used, settings)
    if saved is not None:
        recursion = replace(recursion, start=saved["start"], information=saved["information"])
        memory = RecursiveMemory(**{k: jnp.asarray(v) for k, v in saved["memory"].items()})

    every, samples = max(1, -(-len(used.rows) // _MOST)), [len(each.rows.rows) for each in logs]
    factors, histories, instruments, times, began = [], [], [], [], 0.0
    for each in logs:
        recursion = replace(recursion, gains=each.gains, forgetting=_forgetting(each, settings))
        rows = each.rows
        memory, history, z = yield SolveRequest(
            run, (recursion, memory, rows.rows, rows.target, rows.counts, every)
        )
        factors.append(float(recursion.forgetting))
        histories.append(jax.tree.map(np.asarray, history))
        instruments.append(each.used.rows if z is None else np.asarray(z))
        # The logs stand one behind the other in time.
        times.append(began + each.data.times[instants(len(rows.rows), every)])
        began = float(times[-1][-1]) + each.period
    history = jax.tree.map(lambda *x: np.concatenate(x), *histories)
    theta = history.theta[-1]
    weight = weights_together([each.used for each in logs], factors)
    precision, inflation = precision_of(
        machine,
        used,
        np.concatenate(instruments),
        recursion,
        history,
        every,
        saved is None,
        weight,
        _blocks(samples, every),
        samples,
    )

    converged = bool(np.all(np.isfinite(theta)))
    residual = [
        np.where(own.counts, own.rows @ theta - own.target, np.nan) / each.scale
        for each, own in ((each, each.used) for each in logs)
    ]
    details: dict[str, Any] = {
        "recursive": details_of(
            machine, recursion, memory, history, np.concatenate(times), inflation, settings
        )
    }
    contrary: list[str] = []
    if len(logs) > 1:
        if settings.half_life is None:
            contrary = disagreement(
                [each.residual(theta) for each in logs], int(precision.identifiable.sum())
            )
        entries = [
            {"samples": int(each.used.counts.sum()), "noise": float(history.noise[-1]) / each.scale}
            for each in logs
        ]
        details["fits"] = dict(zip([each.name for each in logs], entries, strict=True))
    return Estimate(
        method="recursive",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else "the estimate is not finite",
        residual=np.concatenate(residual),
        samples=int(used.counts.sum()),
        notes=(*_notes(machine, theta, settings, noisy, len(logs)), *contrary),
        details=details,
    )


def _of_equal_noise(machine: Machine, parts: Sequence[Part], logs: Sequence[_Run]) -> Steps[list[_Run]]:
    """Return the logs with rows scaled so that the noise of each is that of the first one.

    Least squares on all logs shows the noise. The rows alone do not: where a gain is unknown, zeros
    may fit those of a log without any residual.
    """
    first = yield from inverse_dynamics_steps(machine, parts)
    noises = [first.details["fits"][part.name]["noise"] for part in parts]
    return [each.scaled(noises[0] / noise) for each, noise in zip(logs, noises, strict=True)]


def _blocks(samples: Sequence[int], every: int) -> np.ndarray:
    """Return for each sample of all logs the number of the estimate after it in the history."""
    out, first = [], 0
    for count in samples:
        out.append(first + np.arange(count) // every)
        first += -(-count // every)
    return np.concatenate(out)


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


def _notes(
    machine: Machine, theta: np.ndarray, settings: Recursive, instrument: bool, logs: int
) -> tuple[str, ...]:
    """Return the notes about forgetting, bounds and instruments."""
    lower, upper = machine.parameters.bounds
    out = [n for n, o in zip(machine.parameters.names, (theta < lower) | (theta > upper), strict=True) if o]
    notes = (
        [f"outside the bounds of sign or case, which this method ignores: {', '.join(out)}"] if out else []
    )
    if instrument:
        notes.append("instruments: the drive's force that the model fitted by least squares predicts")
    if logs > 1:
        notes.append(f"the {logs} logs were run one after the other, as they are named")
    half = settings.half_life
    if not half:
        return ("nothing is forgotten", *notes)
    return (f"the weight of a sample halves every {half:g} s of motion", *notes)
