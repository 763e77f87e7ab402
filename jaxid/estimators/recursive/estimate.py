"""Recursive estimation along a log: the rows of a plant's balance, taken one sample at a time.

What was corrected of the paper: its regularisation goes towards zero and fades (see
`jaxid.estimators.recursive.recursion`); beta = 1 + T ln(0.5) / T_HL is the first order of the 2^(-T / T_HL)
that is taken here; (49) lacks its root in our copy. The paper's gate and its sum of rows are over the whole
sample. Here both go by row: where one joint slides and another sticks, the force that holds the second is
in no model. What does not count does not forget either: the half-life is of motion.
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

# Instants at which a log's history is written down, at most.
_MOST = 200
# Below this part of a row's force its right-hand side is nothing.
_NOTHING = 1e-9


def start_of(machine: Machine) -> Float[np.ndarray, " p"]:
    """Gains from one, friction and other forces from zero, and what is the plant's own from its guess."""
    out = machine.parameters.guess
    for k, f in enumerate(machine.parameters.free):
        if f.path[0] == "effects":
            effect = type(machine.plant.effects[f.path[1]])
            gain = effect.in_drive and not carries_force(parameters_of(effect)[f.path[2]])
            out[k] = 1.0 if gain else 0.0
    return out


def gains_of(machine: Machine) -> tuple[int | None, ...]:
    """Which unknown is the gain of the drive of each joint."""
    out: list[int | None] = [None] * machine.plant.joints
    for k, f in enumerate(machine.parameters.free):
        effect = machine.plant.effects[f.path[1]] if f.path[0] == "effects" else None
        if effect is not None and effect.kind == "actuator_gain":
            out[effect.port] = k
    return tuple(out)


def recursive_steps(
    machine: Machine, data: Prepared, settings: Recursive, saved: Mapping[str, Any] | None = None
) -> Steps[Estimate]:
    """Estimate the unknowns sample by sample.

    Args:
        machine: The machine. Its guesses matter for what is the plant's own, and where `start` says so.
        data: The log, prepared.
        settings: Table [recursive] of the case.
        saved: Memory of an earlier run, as `jaxid.estimators.recursive.memory` reads it; it goes on
            from there.

    Returns:
        The estimate at the end. Standard deviations hold the residual's colour, the weights and how far the
        start may still pull. `details` have the history and the memory.

    Raises:
        InputError: If the unknowns do not enter the balance in proportion, a gain has nothing known to be
            told against, an instrument has no gain, or rows of unlike units are to be summed.
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
    memory, told, z = yield SolveRequest(run, (recursion, memory, full.rows, full.target, full.counts, every))
    told, z = jax.tree.map(np.asarray, told), used.rows if z is None else np.asarray(z)
    theta, times = told.theta[-1], data.times[instants(len(full.rows), every)]
    precision, inflation = precision_of(machine, used, z, recursion, told, every, saved is None)
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
        details={"recursive": details_of(machine, recursion, memory, told, times, inflation, settings)},
    )


def _recursion(
    machine: Machine, data: Prepared, used: Rows, settings: Recursive, gains: tuple
) -> tuple[Recursion, RecursiveMemory]:
    """The estimator as the case states it, and its memory before the first sample."""
    period = data.period * data.recipe.decimation
    half_life = np.inf if settings.half_life is None else settings.half_life
    recursion = Recursion(
        machine.parameters.guess if settings.start == "guess" else start_of(machine),
        settings.regularization * _sizes(machine, used),
        np.asarray(2.0 ** (-period / half_life)),
        settings.rows == "summed",
        gains,
        settings.instrument == "model",
    )
    return recursion, recursion.memory()


def _sizes(machine: Machine, used: Rows) -> Float[np.ndarray, " p"]:
    """Mean square of each column over the samples that count; of one that never stirs, that of the force."""
    natural = np.where(machine.parameters.guess == 0, 1.0, machine.parameters.guess)
    return np.asarray(column_squares(used.rows, used.counts, used.force, natural)[0])


def _gates(data: Prepared, settings: Recursive) -> tuple[np.ndarray, np.ndarray] | None:
    """Stated gates by joint; an acceleration alone stands beside the recipe's rest velocity."""
    if settings.gate_velocity is None and settings.gate_acceleration is None:
        return None
    joints = data.q.shape[1]
    velocity = data.recipe.rest_velocity if settings.gate_velocity is None else settings.gate_velocity
    acceleration = np.inf if settings.gate_acceleration is None else settings.gate_acceleration
    return tuple(np.broadcast_to(np.asarray(x, float), (joints,)) for x in (velocity, acceleration))


def _check(machine: Machine, settings: Recursive, gains: tuple, saved: Mapping[str, Any] | None) -> None:
    """Refuse what cannot be, whatever the log."""
    rows, instrument = settings.rows, settings.instrument
    if instrument == "model" and not any(g is not None for g in gains):
        raise InputError(
            'instrument = "model" is for gains of drives, and none is unknown',
            where="recursive",
            hint="leave it out, or add an effect actuator_gain with gain = { guess = 1.0 }",
        )
    if rows == "summed" and len({machine.plant.motion(i) for i in range(machine.plant.joints)}) > 1:
        raise InputError(
            'rows = "summed" would add forces to torques', where="recursive", hint='take rows = "full"'
        )
    was = saved and {"summed": rows == "summed", "instrument": instrument == "model"}
    if was and any(saved[k] != v for k, v in was.items()):
        raise InputError(
            "restart is of a run with other rows or another instrument",
            where="recursive",
            hint="state rows and instrument as that run did",
        )


def _check_rows(machine: Machine, rows: Rows, gains: tuple) -> None:
    """Refuse rows that are too few, or of which all is unknown: zero then fits any log."""
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
                f"{names[g]} has nothing known in its balance to be told against: any multiple of all "
                "unknowns fits as well",
                where="recursive",
                hint="declare the inertia or the gain known",
            )


def _notes(machine: Machine, theta: np.ndarray, settings: Recursive, instrument: bool) -> tuple[str, ...]:
    lower, upper = machine.parameters.bounds
    out = [n for n, o in zip(machine.parameters.names, (theta < lower) | (theta > upper), strict=True) if o]
    notes = [f"beyond the bounds that sign or case set: {', '.join(out)}; no bound is kept"] if out else []
    if instrument:
        notes.append("instruments: the drive's force as the model of least squares asks for it")
    half = settings.half_life
    what = "nothing is forgotten" if half is None else f"half of a sample's weight is left after {half:g} s"
    return (f"{what} of motion", *notes) if half else (what, *notes)
