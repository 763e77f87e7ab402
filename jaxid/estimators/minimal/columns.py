"""From a log to the columns of a minimal model: derivatives of what was measured, filtered alike.

Position, acceleration, force and the sign of the velocity pass the same zero-phase low-pass, are
differentiated by the same operator and decimated by the same filter, so that none of it biases a fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from jaxid.arrays import Array
from jaxid.estimators.minimal.basis import Basis
from jaxid.estimators.minimal.matrices import LinearBalance
from jaxid.estimators.minimal.models import Structure, Term, neighbour
from jaxid.logs.log import Log
from jaxid.logs.prepare import Recipe, affordable, differentiate, lasting, smeared, turning
from jaxid.machine import Machine
from jaxid.numerics import filters as signals

# Of the response to a jump of force, what a sample may still hold: beyond, a reversal is forgotten.
_FORGOTTEN = 0.01


@dataclass(frozen=True)
class Regression:
    """Y = W chi, sample by sample.

    Args:
        y: (kept, rows), each row in its own unit.
        w: (kept, rows, chi).
        counts: Which samples count, (kept, rows).
    """

    y: Float[np.ndarray, "kept rows"]
    w: Float[np.ndarray, "kept rows chi"]
    counts: Bool[np.ndarray, "kept rows"]


def decimator_of(recipe: Recipe, rate_hz: float) -> signals.Decimator:
    """The parallel filter; a stated one passes all of its recipe's band, and folds what it must."""
    if recipe.edge is not None or recipe.decimation == 1:
        return recipe.decimator
    band = max(0.8 / recipe.decimation, 2 * recipe.cutoff_hz / rate_hz)
    return signals.Decimator(recipe.decimation, recipe.trim, band=min(band, 0.99))


def reach_of(recipe: Recipe, rate_hz: float, order: int) -> int:
    """Samples of the log over which a jump of force shows in its derivative of some order."""
    f = np.fft.rfftfreq(1 << 14, 1 / rate_hz)
    through = decimator_of(recipe, rate_hz).response(f, rate_hz) * recipe.response(f, rate_hz)
    response = np.abs(np.fft.irfft(through * (1j * f) ** max(order - 1, 0)))[: 1 << 13]
    return int(np.flatnonzero(response > _FORGOTTEN * response.max())[-1]) + 1


def regression_of(
    log: Log,
    machine: Machine,
    structure: Structure,
    basis: Basis,
    known: np.ndarray,
    recipe: Recipe,
    balance: LinearBalance,
) -> Regression:
    """Columns of a model along a log.

    Args:
        log: The log; `load_acceleration` where the model asks for it.
        machine: Gain, delays and hold of the command.
        structure: The model.
        basis: What its coefficients are made of.
        known: Its known coefficients.
        recipe: How the log is filtered.
        balance: As it is known so far, by which a reversal of a hidden joint is seen.
    """
    moved = _signals(log, machine, structure, recipe, balance)
    kept = len(decimator_of(recipe, log.rate_hz).kept(log.samples))
    rows = structure.rows
    y, d = np.zeros((kept, rows)), np.zeros((kept, rows, len(structure.unknown)))
    for lead in structure.leading:
        if lead is not None:
            y[:, lead[1].row] -= _value(moved, lead[1])
    for c, (_, term) in zip(known, structure.known, strict=True):
        y[:, term.row] -= c * _value(moved, term)
    for k, ((_, term), c) in enumerate(zip(structure.unknown, basis.constant, strict=True)):
        x = _value(moved, term)
        d[:, term.row, k] = x
        y[:, term.row] -= c * x
    return Regression(y, d @ basis.spread, _counting(moved, log, structure, recipe))


def _value(moved: dict, term: Term) -> np.ndarray:
    """A term's signal, forces with their sign changed."""
    x = moved[term.signal, term.index][term.order]
    return -x if term.signal == "force" else x


@eqx.filter_jit
def _decimated(decimator: signals.Decimator, x: np.ndarray) -> Array:
    return decimator(x)


@eqx.filter_jit
def _delayed(force: np.ndarray, delays: np.ndarray, period: float, hold: float) -> Array:
    return signals.delayed(force, delays, period, hold=hold)


def _signals(
    log: Log, machine: Machine, structure: Structure, recipe: Recipe, balance: LinearBalance
) -> dict[tuple[str, int], list[np.ndarray]]:
    """Derivatives of each signal at the kept samples; under "speed" of each joint at all samples."""
    every = [t for _, t in (*structure.unknown, *structure.known)]
    every += [lead[1] for lead in structure.leading if lead is not None]
    highest: dict[str, int] = {"position": 1, "force": 0}
    if structure.form.hidden:
        highest = {"position": 3, "force": 1}
    for t in every:
        highest[t.signal] = max(highest.get(t.signal, 0), t.order)
    delays = np.asarray(machine.plant.command_delays(log.force.shape[1]))
    hold = recipe.hold(log, machine.hold_period)
    force = np.asarray(_delayed(log.force * machine.gain, delays, log.period, hold))
    seen = [i for i, m in enumerate(log.measured) if m]
    raw = {"position": (seen, log.position[:, seen]), "force": (range(force.shape[1]), force)}
    if "acceleration" in highest:
        raw["acceleration"] = (structure.form.hidden, log.load_acceleration)
    how = (log.period, recipe.cutoff_hz, recipe.order, recipe.derivatives)
    through = lambda x, orders: differentiate(x, *how, orders)
    moved = {name: through(x, highest[name]) for name, (_, x) in raw.items()}
    direction = {i: np.sign(moved["position"][1][:, k]) for k, i in enumerate(seen)}
    joints = range(len(log.measured))
    moving = [direction[i if i in seen else neighbour(i, tuple(seen))] for i in joints]
    moved["sign"] = through(np.stack(moving, axis=1), 0)
    moved["one"] = [np.ones((log.samples, len(moving)))]
    decimator = decimator_of(recipe, log.rate_hz)
    out = {("speed", i): [moved["position"][1][:, k]] for k, i in enumerate(seen)}
    for i in structure.form.hidden:
        out["speed", i] = [_hidden_speed(i, moved, seen, balance)]
    widths = [(n, j, a.shape[1]) for n, many in moved.items() for j, a in enumerate(many)]
    whole = np.concatenate([moved[n][j] for n, j, _ in widths], axis=1)
    whole = np.asarray(_decimated(decimator, whole))
    at = 0
    for name, _, width in widths:
        index = raw[name][0] if name in raw else range(width)
        for k, i in enumerate(index):
            out.setdefault((name, i), []).append(whole[:, at + k])
        at += width
    return out


def _hidden_speed(
    joint: int, moved: dict[str, Sequence[np.ndarray]], seen: list[int], balance: LinearBalance
) -> Float[np.ndarray, " time"]:
    """Speed of a hidden joint, by what the spring to it must do in the balance of a measured one.

    A resonance turns it round where the motor only slows down, and its friction with it.
    """
    motion = np.asarray(balance.motion)
    row = max(seen, key=lambda r: abs(motion[0, r, joint]))
    if motion[0, row, joint] == 0:
        return moved["position"][1][:, seen.index(neighbour(joint, tuple(seen)))]
    pull = -moved["force"][1] @ np.asarray(balance.force)[row]
    for k, i in enumerate(seen):
        for order in range(3):
            pull = pull + motion[order, row, i] * moved["position"][order + 1][:, k]
    return -pull / motion[0, row, joint]


def _counting(moved: dict, log: Log, structure: Structure, recipe: Recipe) -> Bool[np.ndarray, "kept rows"]:
    """Samples at which the direction of all joints in a row is sure, as far as the model needs it.

    Without eliminated joints a reversal harms no more than in inverse dynamics. With them the model
    lacks the derivatives of the sign, and leaves out all that the filters have seen of a reversal.
    """
    seen = tuple(i for i, m in enumerate(log.measured) if m)
    joints = range(len(log.measured))
    near = [i if i in seen else neighbour(i, seen) for i in joints]
    speed = np.stack([moved["speed", i][0] for i in joints], axis=1)
    still = np.abs(speed) < np.asarray(recipe.rest_velocity)[near]
    still |= speed * speed[:, near] < 0
    decimator = decimator_of(recipe, log.rate_hz)
    order = max((t.order for _, t in structure.unknown if t.signal == "force"), default=0)
    order = max(order, max((k[1].order for k in structure.leading if k is not None), default=0))
    if order:
        reach = affordable(still, turning(speed), reach_of(recipe, log.rate_hz, order))
        slow = smeared(still | turning(speed), reach)
    elif recipe.keeps_reversals:
        slow = smeared(lasting(still, 2 * recipe.decimation), decimator.reach)
    else:
        reach = affordable(still, turning(speed), max(decimator.reach, recipe.decimation - 1))
        slow = smeared(still | (turning(speed) & (reach > 0)), reach)
    kept = decimator.kept(log.samples)
    fine = ~slow[kept]
    needs = np.zeros((structure.rows, len(joints)), bool)
    for _, t in (*structure.unknown, *structure.known):
        if t.signal == "sign":
            needs[t.row, t.index] = True
    if order:
        needs[:] = True
    return np.stack([fine[:, n].all(axis=1) for n in needs], axis=1)
