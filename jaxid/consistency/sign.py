"""Sign of the logged force: if it brakes the motion, its sign, column or unit is wrong."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from jaxid.consistency.balance_fit import BalanceFit, balance_fits
from jaxid.logs.finding import Finding
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.logs.rough_inertia import correlation
from jaxid.machine import Machine

# Part of a joint's force that a model with any values of its unknowns leaves, from which the sign is doubted.
_DOUBTFUL = 0.1
# Standard deviations below zero from which a mass or a dissipated power counts as negative.
_SIGMAS = 5.0
# Part of the gap that the turned sign may leave at most.
_HALF = 0.5
# Part of the force that remains although every value is free: from here on it is reported.
_UNEXPLAINED = 0.7
# Most drives for which every choice of signs is tried; for more, one drive after the other is turned.
_ALL_CHOICES = 6
# Correlation of the force of one unit with the velocity from which an unknown counts as friction.
_DISSIPATES = 0.6
# Turns within which a force that depends on the angle alone may do work, and the correlation of force with
# velocity from which a drive counts as the one that turns its joint.
_TURNS = 3.0
_DRIVES = 0.3
# Correlation from which two columns count as one quantity.
_EQUAL = 0.999
# Part of a force that the declared model leaves if the force is not one of this machine.
_FOREIGN = 0.5


def sign_findings(
    machine: Machine, log: Log, data: Prepared, declared: BalanceFit, gain: Sequence[float] | None
) -> list[Finding]:
    """Check that the force of a log drives its motion.

    A sign counts as wrong if least squares without bounds gives a negative mass or friction by more than
    five standard deviations, and if the opposite sign, with bounds, leaves at most half of the gap. A mean
    power below zero is no proof, because lowering a weight, braking, and a spring push with negative power
    too: forces that depend on the position only are therefore free in all of these fits. A drive that keeps a
    joint turning is not refused: what varies at one speed is the answer of its controller to disturbances,
    which opposes the velocity like friction of the wrong sign.

    Args:
        machine: The machine at its guesses.
        log: The log, for its columns.
        data: The prepared log.
        declared: Balance of the log with the declared signs.
        gain: Declared gain of each drive, for the hint; None: the log is one of motors behind gears.

    Returns:
        An error if a sign is wrong, a warning if the force remains unexplained, or an empty list.
    """
    if not all(log.measured) or not declared.unknowns or not declared.counts.any():
        return []
    driven = [int(j) for j in machine.plant.driven(machine.plant.joints)]
    followers = _positions(log, declared, driven)
    if followers:
        return followers
    remaining = declared.rms(declared.fit(bounded=True)[1]) / declared.scale
    doubtful = [k for k, j in enumerate(driven) if declared.counts[:, j].any() and remaining[j] > _DOUBTFUL]
    turning = {k: _turning(machine, data, declared, driven[k]) for k in range(len(driven))}
    braked = _braked(log, [k for k in turning if turning[k] < -_DRIVES], len(driven))
    if not doubtful:
        return braked
    turned, better = _best_signs(machine, data, declared, driven, doubtful)
    gap, after = (f.rms(f.fit(bounded=True)[1]) for f in (declared, better))
    halved = [k for k in turned if after[driven[k]] <= _HALF * gap[driven[k]]]
    halved = [k for k in halved if turning[k] < _DRIVES]
    brakes = _brakes(declared, better, [driven[k] for k in halved]) if halved else None
    if brakes is not None:
        return [_wrong_sign(machine, log, halved, driven, gain, (gap, after), brakes)]
    return [*_unexplained(machine, log, doubtful, driven, remaining, gap), *braked]


def _best_signs(
    machine: Machine, data: Prepared, declared: BalanceFit, driven: Sequence[int], doubtful: Sequence[int]
) -> tuple[list[int], BalanceFit]:
    """Return the drives to turn for the least gap, joints in parts of their force, and the balance then."""

    def cost(fit: BalanceFit) -> float:
        return float(np.sum((fit.rms(fit.fit(bounded=True)[1]) / fit.scale)[list(driven)] ** 2))

    drives = range(len(driven))
    if len(driven) <= _ALL_CHOICES:
        choices = [list(c) for size in drives for c in itertools.combinations(drives, size + 1)]
        fits = balance_fits(machine, data, choices)
        best = int(np.argmin([cost(f) for f in fits]))
        return choices[best], fits[best]
    turned, best, least = [], declared, cost(declared)
    while True:
        choices = [sorted({*turned} ^ {k}) for k in drives if k in doubtful or k in turned]
        fits = balance_fits(machine, data, choices)
        costs = [cost(f) for f in fits]
        k = int(np.argmin(costs))
        if not costs[k] < least:
            return turned, best
        turned, best, least = choices[k], fits[k], costs[k]


def _brakes(fit: BalanceFit, better: BalanceFit, joints: Sequence[int]) -> str | None:
    """Describe the negative unknowns of a fit without bounds at some joints; None if none is surely negative.

    Friction that takes up energy at one of these joints, by five standard deviations, is evidence for the
    sign as it is.

    Args:
        fit: Balance with the declared signs.
        better: Balance with the signs that leave the least gap. With several drives its residual is the
            noise: one turned force distorts the balance of all joints.
        joints: Joints whose drives would be turned.
    """
    values, residual = fit.fit(bounded=False)
    if fit.force.any(axis=0).sum() > 1:
        residual = better.fit(bounded=False)[1]
    precision = fit.precision(values, residual)
    std = precision.std
    p = len(fit.unknowns)
    at = np.zeros(p, bool)
    for j in joints:
        at |= np.any(fit.columns[fit.counts[:, j], j] != 0, axis=0)
        power, spread = _dissipated(fit, j, values, precision.covariance)
        if power > _SIGMAS * spread:
            return None
    bounded = np.array([f.sign != "free" for f in fit.unknowns]) & at & np.isfinite(std[:p])
    depth = np.where(bounded, -values[:p] / np.where(std[:p] > 0, std[:p], np.inf), -np.inf)
    if depth.max(initial=-np.inf) <= _SIGMAS:
        return None
    named = [int(k) for k in np.argsort(-depth) if depth[k] > _SIGMAS][:2]
    return " and ".join(
        f"{fit.unknowns[k].name} = {values[k]:.3g} +- {std[k]:.1g} {fit.unknowns[k].unit}".rstrip()
        for k in sorted(named)
    )


def _turning(machine: Machine, data: Prepared, fit: BalanceFit, joint: int) -> float:
    """Return the correlation of force and velocity over several turns in which a joint does not slow down.

    No weight and no spring of such a joint gives or returns work, so that friction alone takes it up: a
    positive correlation shows that the sign is right, a negative one that it is wrong. A load on a winch is
    the exception, and must be declared as a weight.

    Args:
        machine: The machine.
        data: The prepared log.
        fit: Its balance with the declared signs.
        joint: Joint of the drive.

    Returns:
        The correlation, means not removed; 0 for a joint that moves along a line, carries a declared weight,
        or makes fewer turns.
    """
    if (machine.plant.motion(joint) or machine.units.motion) != "rotary":
        return 0.0
    if np.any(np.asarray(machine.plant.port_gravity(np.zeros(machine.plant.joints)))[joint]):
        return 0.0
    rows = np.flatnonzero(fit.counts[:, joint])
    v = fit.velocity[rows, joint]

    # Between these two samples the kinetic energy does not fall.
    first = int(np.argmin(np.abs(v[: max(len(v) // 4, 1)])))
    last = int(np.flatnonzero(np.abs(v) >= np.abs(v[first]))[-1])
    v, u = v[first : last + 1], fit.force[rows, joint][first : last + 1]
    turns = abs(float(np.sum(v))) * data.period * data.recipe.decimation / (2 * np.pi)
    size = float(np.linalg.norm(u) * np.linalg.norm(v))
    return float(u @ v) / size if turns > _TURNS and size > 0 else 0.0


def _braked(log: Log, drives: Sequence[int], count: int) -> list[Finding]:
    """Return warnings on drives that brake joints which keep turning."""
    findings = []
    for k in drives:
        number = f" {k + 1}" if count > 1 else ""
        what = f"the force brakes the joint over more than {_TURNS:.0f} turns in which it does not slow down"
        hint = "set sign = { force = -1 } in [log] if its sign is turned, or declare the load that drives it"
        findings.append(Finding("warning", what, f"{log.source}, force{number}", hint))
    return findings


def _dissipated(
    fit: BalanceFit, joint: int, values: np.ndarray, covariance: np.ndarray
) -> tuple[float, float]:
    """Return the mean power that the unknown frictions of a joint take up, and its standard deviation."""
    rows = fit.counts[:, joint]
    v, columns = fit.velocity[rows, joint], fit.columns[rows, joint]
    size = np.linalg.norm(columns, axis=0) * np.linalg.norm(v)
    work = v @ columns
    friction = (work > _DISSIPATES * size) & np.isfinite(np.diag(covariance))[: work.size]
    weight = np.where(friction, work / max(rows.sum(), 1), 0.0)
    known = np.nan_to_num(covariance[: work.size, : work.size])
    return float(weight @ values[: work.size]), float(np.sqrt(max(weight @ known @ weight, 0.0)))


def _wrong_sign(
    machine: Machine,
    log: Log,
    turned: Sequence[int],
    driven: Sequence[int],
    gain: Sequence[float] | None,
    gaps: tuple[np.ndarray, np.ndarray],
    negative: str,
) -> Finding:
    """Return the error that the force of some drives has the wrong sign."""
    several = len(driven) > 1
    which = "the force"
    if several:
        names = " and ".join(
            [", ".join(str(k + 1) for k in turned[:-1]), str(turned[-1] + 1)][-len(turned) :]
        )
        which = f"force {names} ({len(turned)} of {len(driven)})" if turned[:-1] else f"force {names}"
    j = driven[turned[0]]
    unit = machine.unit("force", j)
    what = (
        f"{which} brakes the motion that it is meant to drive: least squares gives {negative}; with the "
        f"sign turned the force gap falls from {gaps[0][j]:.3g} to {gaps[1][j]:.3g} {unit}"
    )
    signs = "-1" if not several else str([-1 if k in turned else 1 for k in range(len(driven))])
    if gain is None:
        hint = f"set sign = {{ force = {signs} }} in [log]"
    else:
        signed = [-g if k in turned else g for k, g in enumerate(gain)]
        shown = f"{signed[0]:.6g}" if not several else "[" + ", ".join(f"{g:.6g}" for g in signed) + "]"
        hint = f"set gain = {shown} in [actuator], or sign = {{ force = {signs} }} in [log]"
    return Finding("error", what, f"{log.source}, force", hint)


def _positions(log: Log, fit: BalanceFit, driven: Sequence[int]) -> list[Finding]:
    """Return warnings on forces that follow the position of their joint, which nothing in the model does."""
    bare = replace(fit, potential=fit.potential[..., :0])
    remaining = bare.rms(bare.fit(bounded=True)[1]) / np.maximum(fit.rms(fit.force), 1e-300)
    findings = []
    for k, j in enumerate(driven):
        alike = correlation(log.force[:, k], log.position[:, j])
        if abs(alike) > _EQUAL and remaining[j] > _FOREIGN:
            what = f"the force follows the position (correlation {alike:.4f}), and no declared effect does"
            hint = "name the column of the force or current, not that of a position or its command"
            number = f" {k + 1}" if len(driven) > 1 else ""
            findings.append(Finding("warning", what, f"{log.source}, force{number}", hint))
    return findings


def _unexplained(
    machine: Machine,
    log: Log,
    doubtful: Sequence[int],
    driven: Sequence[int],
    remaining: np.ndarray,
    gap: np.ndarray,
) -> list[Finding]:
    """Return warnings on drives whose force no values of the unknowns explain."""
    findings = []
    for k in doubtful:
        j = driven[k]
        if remaining[j] <= _UNEXPLAINED:
            continue
        what = (
            f"no values of the unknowns explain the force: {gap[j]:.3g} {machine.unit('force', j)} remain, "
            f"{100 * remaining[j]:.0f} % of its part that does not depend on the position alone"
        )
        hint = "check the column, the unit and the sign of force, and whether an effect is missing"
        number = f" {k + 1}" if len(driven) > 1 else ""
        findings.append(Finding("warning", what, f"{log.source}, force{number}", hint))
    return findings
