"""Columns of a minimal model along a log: derivatives of the measured signals, all with the same filters.

Position, acceleration, force and the sign of the velocity pass the same zero-phase low-pass, are
differentiated by the same operator and decimated by the same filter, so that filtering does not bias a fit.
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

# Fraction of the largest response to a jump of force below which the jump is forgotten.
_FORGOTTEN = 0.01


@dataclass(frozen=True)
class Regression:
    """The linear regression Y = W chi, by sample.

    Args:
        y: Left-hand side Y, (kept, rows); each row has its unit.
        w: Columns W, (kept, rows, chi).
        counts: Mask of the samples that count in each row, (kept, rows).
    """

    y: Float[np.ndarray, "kept rows"]
    w: Float[np.ndarray, "kept rows chi"]
    counts: Bool[np.ndarray, "kept rows"]


def decimator_of(recipe: Recipe, rate_hz: float) -> signals.Decimator:
    """Return the parallel filter of a recipe.

    If decimation and cut-off are stated, it passes the whole band up to the cut-off, even if some of that is
    folded.
    """
    if recipe.edge is not None or recipe.decimation == 1:
        return recipe.decimator
    band = max(0.8 / recipe.decimation, 2 * recipe.cutoff_hz / rate_hz)
    return signals.Decimator(recipe.decimation, recipe.trim, band=min(band, 0.99))


def reach_of(recipe: Recipe, rate_hz: float, order: int) -> int:
    """Return the number of samples over which a jump of force shows in its derivative of an order."""
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
    """Compute the columns of a model along a log.

    Args:
        log: The log, with `load_acceleration` if the model needs it.
        machine: The machine, for gain, delays and hold of the command.
        structure: The structure of the model.
        basis: The basis of its coefficients.
        known: Its known coefficients.
        recipe: Filters of the log.
        balance: The balance at the estimate so far, which locates the reversals of hidden joints.
    """
    moved = _signals(log, machine, structure, recipe, balance)
    kept = len(decimator_of(recipe, log.rate_hz).kept(log.samples))
    rows = structure.rows
    y, d = np.zeros((kept, rows)), np.zeros((kept, rows, len(structure.unknown)))

    # Leading forces and known terms go to the left-hand side, and so does the constant of unknown ones.
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
    """Return the signal of a term; forces have their sign changed."""
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
    """Return the derivatives of each signal by name and index, filtered.

    They are at the kept samples, except "speed", the velocity of each joint, which is at all samples.
    """
    # The highest derivative of each signal that any term needs.
    every = [t for _, t in (*structure.unknown, *structure.known)]
    every += [lead[1] for lead in structure.leading if lead is not None]
    highest: dict[str, int] = {"position": 1, "force": 0}
    if structure.form.hidden:
        highest = {"position": 3, "force": 1}
    for t in every:
        highest[t.signal] = max(highest.get(t.signal, 0), t.order)

    # The signals and their derivatives, all filtered in the same way.
    delays = np.asarray(machine.plant.command_delays(log.force.shape[1]))
    hold = recipe.hold(log, machine.hold_period)
    force = np.asarray(_delayed(log.force * machine.gain, delays, log.period, hold))
    measured = [i for i, m in enumerate(log.measured) if m]
    raw: dict[str, tuple[Sequence[int], np.ndarray]] = {
        "position": (measured, log.position[:, measured]),
        "force": (range(force.shape[1]), force),
    }
    if "acceleration" in highest:
        assert log.load_acceleration is not None, "a form that needs it was chosen by its presence"
        raw["acceleration"] = (structure.form.hidden, log.load_acceleration)

    def derivatives(x: np.ndarray, orders: int) -> Sequence[np.ndarray]:
        return differentiate(x, log.period, recipe.cutoff_hz, recipe.order, recipe.derivatives, orders)

    moved: dict[str, Sequence[np.ndarray]] = {n: derivatives(x, highest[n]) for n, (_, x) in raw.items()}
    direction = {i: np.sign(moved["position"][1][:, k]) for k, i in enumerate(measured)}
    joints = range(len(log.measured))
    moving = [direction[i if i in measured else neighbour(i, tuple(measured))] for i in joints]
    moved["sign"] = derivatives(np.stack(moving, axis=1), 0)
    moved["one"] = [np.ones((log.samples, len(moving)))]
    out = {("speed", i): [moved["position"][1][:, k]] for k, i in enumerate(measured)}
    for i in structure.form.hidden:
        out["speed", i] = [_hidden_speed(i, moved, measured, balance)]

    # One call of the decimator for all of them, side by side.
    decimator = decimator_of(recipe, log.rate_hz)
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
    joint: int, moved: dict[str, Sequence[np.ndarray]], measured: list[int], balance: LinearBalance
) -> Float[np.ndarray, " time"]:
    """Compute the velocity of a hidden joint from the balance of a measured one, by the spring between them.

    At a resonance the hidden joint may reverse, and its friction with it, while the motor only slows down.
    """
    motion = np.asarray(balance.motion)
    row = max(measured, key=lambda r: abs(motion[0, r, joint]))
    if motion[0, row, joint] == 0:
        return moved["position"][1][:, measured.index(neighbour(joint, tuple(measured)))]
    pull = -moved["force"][1] @ np.asarray(balance.force)[row]
    for k, i in enumerate(measured):
        for order in range(3):
            pull = pull + motion[order, row, i] * moved["position"][order + 1][:, k]
    return -pull / motion[0, row, joint]


def _counting(moved: dict, log: Log, structure: Structure, recipe: Recipe) -> Bool[np.ndarray, "kept rows"]:
    """Return the mask of the samples at which the directions that a row of the model needs are certain.

    Without eliminated joints a reversal does no more harm than in inverse dynamics. A model with eliminated
    joints lacks the derivatives of the sign, and omits all samples within the filters' reach of a reversal.
    """
    measured = tuple(i for i, m in enumerate(log.measured) if m)
    joints = range(len(log.measured))
    near = [i if i in measured else neighbour(i, measured) for i in joints]

    # Slow samples, and those at which a hidden joint moves against the measured one that stands for it.
    speed = np.stack([moved["speed", i][0] for i in joints], axis=1)
    still = np.abs(speed) < np.asarray(recipe.rest_velocity)[near]
    still |= speed * speed[:, near] < 0

    # Samples within the reach of the filters from those.
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
    fine = ~slow[decimator.kept(log.samples)]

    # Each row needs the joints whose sign it holds; after elimination it needs all.
    needs = np.zeros((structure.rows, len(joints)), bool)
    for _, t in (*structure.unknown, *structure.known):
        if t.signal == "sign":
            needs[t.row, t.index] = True
    if order:
        needs[:] = True
    return np.stack([fine[:, n].all(axis=1) for n in needs], axis=1)
