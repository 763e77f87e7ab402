"""Recursive least squares along a log, on the rows of a plant's balance.

Corrections to the paper: its regularisation pulls towards zero and fades (see
`jaxid.estimators.recursive.recursion`); its beta = 1 + T ln(0.5) / T_HL is the first-order expansion of
2^(-T / T_HL), which is used here; (49) lacks its root in our copy. The paper's gate and its sum of rows apply
to the whole sample. Here both apply to each row: if one joint slides and another sticks, the force that
holds the second is in no model. Samples that do not count do not forget either: the half-life is of motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxid.errors import InputError
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.recursive.precision import details_of, precision_of
from jaxid.estimators.recursive.recursion import Recursion, RecursiveMemory, column_squares, instants, run
from jaxid.estimators.recursive.rows import Rows, rows_steps
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine
from jaxid.model.effect import carries_force
from jaxid.model.parameter import parameters_of
from jaxid.numerics.lanes import SolveRequest, Steps
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


def recursive_steps(
    machine: Machine, data: Prepared, settings: Recursive, saved: Mapping[str, Any] | None = None
) -> Steps[Estimate]:
    """Estimate the unknowns sample by sample.

    Args:
        machine: The machine. The guesses of the plant's parameters are their start, and those of the effects
            too if `start` is "guess".
        data: The filtered log.
        settings: Table [recursive] of the case.
        saved: Memory of an earlier run to continue, as `jaxid.estimators.recursive.memory` reads it.

    Returns:
        The estimate at the end. Standard deviations include the residual's colour, the weights and the
        remaining pull of the start. `details` has the history and the memory.

    Raises:
        InputError: If the balance is not linear in the unknowns, a gain has no known term to scale it, an
            instrument has no gain, or rows of different units are to be summed.
    """
    gains, noisy = gains_of(machine), settings.instrument == "model"
    _check(machine, settings, gains, saved)
    full = yield from rows_steps(machine, data, _gates(data, settings))
    _check_rows(machine, full, gains)

    used = full.summed if settings.rows == "summed" else full
    recursion, memory = _recursion(machine, data, used, settings, gains)
    if saved is not None:
        recursion = replace(recursion, start=saved["start"], information=saved["information"])
        memory = RecursiveMemory(**{k: jnp.asarray(v) for k, v in saved["memory"].items()})

    every = max(1, -(-len(full.rows) // _MOST))
    memory, history, z = yield SolveRequest(
        run, (recursion, memory, full.rows, full.target, full.counts, every)
    )
    history, z = jax.tree.map(np.asarray, history), used.rows if z is None else np.asarray(z)
    theta, times = history.theta[-1], data.times[instants(len(full.rows), every)]
    precision, inflation = precision_of(machine, used, z, recursion, history, every, saved is None)

    converged = bool(np.all(np.isfinite(theta)))
    return Estimate(
        method="recursive",
        machine=machine.with_estimate(theta),
        theta=theta,
        precision=precision,
        converged=converged,
        message="converged" if converged else "the estimate is not finite",
        residual=np.where(used.counts, used.rows @ theta - used.target, np.nan),
        samples=int(used.counts.sum()),
        notes=_notes(machine, theta, settings, noisy),
        details={"recursive": details_of(machine, recursion, memory, history, times, inflation, settings)},
    )


def _recursion(
    machine: Machine, data: Prepared, used: Rows, settings: Recursive, gains: tuple
) -> tuple[Recursion, RecursiveMemory]:
    """Build the estimator that the case states, and its memory before the first sample."""
    period = data.period * data.recipe.decimation
    half_life = np.inf if settings.half_life is None else settings.half_life
    recursion = Recursion(
        start=machine.parameters.guess if settings.start == "guess" else start_of(machine),
        information=settings.regularization * _sizes(machine, used),
        forgetting=np.asarray(2.0 ** (-period / half_life)),
        summed=settings.rows == "summed",
        gains=gains,
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


def _check_rows(machine: Machine, rows: Rows, gains: tuple) -> None:
    """Check that there are enough rows, and that each gain is beside a known term.

    If all terms of a balance are unknown, unknowns of zero fit any log.

    Raises:
        InputError: If there are too few rows, or a gain has no known term to scale it.
    """
    names = machine.parameters.names
    if rows.counts.sum() <= len(names):
        raise InputError(
            f"{int(rows.counts.sum())} samples pass the gate, for {len(names)} unknowns",
            where="recursive",
            hint="lower gate_velocity or gate_acceleration, or take a log with more motion",
        )
    for k, g in enumerate(gains):
        known = np.abs(np.where(rows.counts, rows.target, 0.0)[:, k]).max()
        if g is not None and known <= _NOTHING * np.abs(rows.force[:, k]).max():
            raise InputError(
                f"{names[g]} is not identifiable: its balance has no known term, and any multiple of all "
                "unknowns fits as well",
                where="recursive",
                hint="declare the inertia or the gain known",
            )


def _notes(machine: Machine, theta: np.ndarray, settings: Recursive, instrument: bool) -> tuple[str, ...]:
    """Return the notes about forgetting, bounds and instruments."""
    lower, upper = machine.parameters.bounds
    out = [n for n, o in zip(machine.parameters.names, (theta < lower) | (theta > upper), strict=True) if o]
    notes = (
        [f"outside the bounds of sign or case, which this method ignores: {', '.join(out)}"] if out else []
    )
    if instrument:
        notes.append("instruments: the drive's force that the model fitted by least squares predicts")
    half = settings.half_life
    if not half:
        return ("nothing is forgotten", *notes)
    return (f"the weight of a sample halves every {half:g} s of motion", *notes)
