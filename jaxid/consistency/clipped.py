"""A force whose recording is clipped, found by the balance of forces."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from jaxid.consistency.balance_fit import BalanceFit
from jaxid.consistency.hold import with_friction
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

# Beginning of the finding.
SEEMS = "the recording of the force seems to be clipped"
# Readings this close to the extreme one, as a part of it, stand at it.
_EQUAL = 1e-9
# Fewest rows at an extreme, and fewest of them in a row. Most rows, as a part of the log: a force that is at
# its extremes more often was commanded so.
_FEWEST, _IN_A_ROW, _MOST = 5, 3, 0.25
# Fewest independent samples beyond the number of unknowns.
_ENOUGH = 10
# Part of a stated limit by which a force at that limit may be below it.
_NEAR = 1e-3
# Standard deviations by which the force is beyond its extreme.
_CLEARLY = 5.0


def at_extremes(force: Float[np.ndarray, "time m"]) -> Bool[np.ndarray, "2 time m"]:
    """Return the masks of the rows at the largest and at the smallest force, if several follow each other."""
    out = np.zeros((2, *force.shape), bool)
    for k, column in enumerate(force.T):
        for side, extreme in enumerate((column.max(), column.min())):
            there = np.abs(column - extreme) <= _EQUAL * abs(extreme)
            lasts = np.convolve(there, np.ones(_IN_A_ROW), "valid").max(initial=0.0) >= _IN_A_ROW
            beyond_zero = extreme > 0 if side == 0 else extreme < 0
            if lasts and beyond_zero and there.sum() >= _FEWEST:
                out[side, :, k] = there
    return out


def clipped_force(
    machine: Machine, log: Log, data: Prepared, fit: BalanceFit
) -> tuple[Bool[np.ndarray, "time m"], Finding] | None:
    """Find a force that stands at its extremes while the motion shows that a larger one acted.

    A force beyond each extreme in the rows that stand there is fitted beside the declared forces, potential
    ones, and a viscous and a Coulomb friction of every joint. A force that a drive limits needs none.

    Args:
        machine: The machine.
        log: The log.
        data: The prepared log.
        fit: Its balance.

    Returns:
        The rows that are clipped, and the warning; None if there are none.
    """
    if log.force.shape[1] != data.force.shape[1] or not fit.finite or data.recipe.median is not None:
        return None
    stands = at_extremes(log.force)
    stands &= ~_stated(machine, log)
    stands &= stands.any(axis=0).mean(axis=0) <= _MOST
    if not stands.any():
        return None

    driven = np.asarray(machine.plant.driven(machine.plant.joints))[: log.force.shape[1]]
    sides = [(side, k) for side in range(2) for k in range(len(driven)) if stands[side, :, k].any()]
    units = np.zeros((*fit.force.shape, len(sides)))
    for i, (side, k) in enumerate(sides):
        # What the low-pass leaves of a force of one unit in the rows at an extreme.
        beyond_extreme = stands[side, :, k].astype(float) * machine.gain[k] * (1 - 2 * side)
        units[:, driven[k], i] = np.asarray(data.recipe.decimator(beyond_extreme[:, None]))[:, 0]
    whole = with_friction(fit).beside(-units)
    missing, std = _last(whole, len(sides), data.recipe.independent)
    beyond = [(m, k, side) for m, s, (side, k) in zip(missing, std, sides, strict=True) if m > _CLEARLY * s]
    if not beyond:
        return None
    # What clips one side of a recording leaves no trust in the other.
    clipped = np.isin(np.arange(len(driven)), [k for _, k, _ in beyond])
    rows = stands.any(axis=0) & clipped
    return rows, _finding(machine, log, rows, max(beyond))


def _last(fit: BalanceFit, number: int, independent: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the last values of a least-squares fit with their standard deviations, (number,) each.

    Args:
        fit: The balance.
        number: Number of values.
        independent: Part of the samples with independent noise.
    """
    values, residual = fit.fit(bounded=False)
    columns = np.concatenate([fit.columns, fit.potential], axis=2) / fit.scale[:, None]
    rows = columns[fit.counts]
    others, last = rows[:, :-number], rows[:, -number:]
    last = last - others @ np.linalg.lstsq(others, last, rcond=1e-10)[0]
    free = independent * len(rows) - rows.shape[1]
    if free < _ENOUGH:
        return np.zeros(number), np.full(number, np.inf)
    noise = float(np.sum((residual / fit.scale)[fit.counts] ** 2)) / free
    return values[-number:], np.sqrt(np.diagonal(np.linalg.pinv(last.T @ last, rcond=1e-10)) * noise)


def _stated(machine: Machine, log: Log) -> Bool[np.ndarray, " m"]:
    """Return the mask of the forces that reach the limit which the case states for the controller."""
    limit = None if machine.controller is None else getattr(machine.controller, "limit", None)
    if limit is None:
        return np.zeros(log.force.shape[1], bool)
    return np.abs(log.force).max(axis=0) >= (1 - 1e-3) * np.broadcast_to(
        np.asarray(limit), log.force.shape[1]
    )


def _finding(
    machine: Machine, log: Log, rows: Bool[np.ndarray, "time m"], most: tuple[float, int, int]
) -> Finding:
    """Return the warning.

    Args:
        machine: The machine.
        log: The log.
        rows: The rows that are clipped.
        most: Mean force beyond the extreme, in units of the command, its drive and its side; the largest one.
    """
    missing, drive, side = most
    extreme = float((log.force.min if side else log.force.max)(axis=0)[drive])
    gain, unit = abs(float(machine.gain[drive])), machine.unit("force")
    which = f" {drive + 1}" if log.force.shape[1] > 1 else ""
    count, share = int(rows.any(axis=1).sum()), 100 * float(rows.any(axis=1).mean())
    what = (
        f"{SEEMS} at {extreme:.4g}: in the {count} rows ({share:.2g} %) at that level the motion needs "
        f"{gain * missing:.3g} {unit} more on average"
    )
    hint = "record the force with a larger range"
    return Finding("warning", what, f"{log.source}, force{which}", hint)
