"""Starts of a fit of a servo's joint, by a balance that is linear in the reciprocal of its gain.

With the law u = kp (r - q) - kd dq the error of the position is

    r - q = (J ddq - load) / kp + (kd + c) / kp dq + F / kp sign(dq)

in which only the delay of the reference r is not linear. Errors of the encoder are small beside the error of
the position, and nothing has to be near the truth: a gain of the file may be wrong by a factor of fifty.
Where a joint carries little, the accelerations alone hardly show the gain. So some gains are tried too, each
with the friction that fits it best.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from jaxid.controllers.linear import CascadePD
from jaxid.estimators.apart.balance import (
    DELAYS,
    Reduced,
    errors_by_delay,
    fit_nonnegative,
    rows_in_motion,
)
from jaxid.estimators.apart.joint import JointAlone
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER

# Steps of the delays that are tried on either side of a fit from which it is tried again.
_BESIDE = 2
# Gains that are tried, as parts of the guess.
_GAINS = (1 / 300, 1 / 100, 1 / 30, 1 / 10, 1 / 3, 1.0)
# Largest factor by which a start may differ from the guess.
_FARTHEST = 1e3
# Part of the guess at which a friction starts that the balance does not show.
_LITTLE = 1e-2
# Fewest rows in motion.
_FEWEST = 10


def starts_by_balance(alone: JointAlone) -> list[Float[np.ndarray, " own"]]:
    """Return values of a joint's unknowns by the balance of its servo, the one with the best gain first.

    Unknowns that do not enter the balance stay at their guesses.

    Args:
        alone: The joint, with its logs.
    """
    machine = alone.machine
    unknown = {_role(f.path, machine): k for k, f in enumerate(machine.parameters.free)}
    if "kp" not in unknown:
        return []
    balance = _Balance.of(alone)
    if balance is None:
        return []
    delays = range(len(DELAYS)) if "delay" in unknown else [_nearest(_delay(machine))]
    starts = [_start(machine, unknown, found) for found in balance.solutions(delays, _stiffness(machine))]
    return [start for start in starts if is_stable(machine.with_estimate(start))]


def starts_beside(alone: JointAlone) -> list[Float[np.ndarray, " own"]]:
    """Return values of a joint's unknowns by the balance at delays near that of its fit; none if it is known.

    A command that is held from row to row leaves the cost several minima along the delay, less than a row
    apart.

    Args:
        alone: The joint at the values of a fit.
    """
    machine = alone.machine
    unknown = {_role(f.path, machine): k for k, f in enumerate(machine.parameters.free)}
    balance = _Balance.of(alone) if {"kp", "delay"} <= unknown.keys() else None
    if balance is None:
        return []
    own = _nearest(float(machine.parameters.guess[unknown["delay"]]))
    beside = [k for k in range(own - _BESIDE, own + _BESIDE + 1) if 0 <= k < len(DELAYS)]
    found = [next(balance.solutions([k], _stiffness(machine))) for k in beside]
    starts = [_start(machine, unknown, one) for one in found]
    return [start for start in starts if is_stable(machine.with_estimate(start))]


def is_stable(machine: Machine) -> bool:
    """Check that the sampled loop of a joint, without its delay and dry friction, comes to rest.

    A loop that does not may still end near the log, in a small vibration between the limits of its force, and
    its derivatives grow without bound.
    """
    law, inertia = machine.controller, float(np.asarray(machine.plant.own_inertia()))
    assert law is not None, "checked by stands_apart"
    known = _damping(machine)
    # State and held force over one period: d/dt (q, v, u) = (v, (u - c v) / J, 0).
    rates = np.array([[0, 1, 0], [0, -known["viscous"] / inertia, 1 / inertia], [0, 0, 0]], dtype=float)
    over = scipy.linalg.expm(rates * law.period)
    closed = over[:2, :2] - np.outer(over[:2, 2], [_stiffness(machine), known["kd"]])
    return bool(np.max(np.abs(np.linalg.eigvals(closed))) < 1.0)


@dataclass(frozen=True)
class _Found:
    """Reciprocal of the gain, damping and dry friction over the gain, and the delay."""

    compliance: float
    lag: float
    dry: float
    delay: float


@dataclass(frozen=True)
class _Balance:
    """The balance at all rows in motion, with the columns of force, damping and dry friction."""

    rows: Reduced

    @classmethod
    def of(cls, alone: JointAlone) -> _Balance | None:
        """Return the balance along all logs of a joint; None if it hardly moves."""
        rows, errors = [], []
        for part in alone.parts:
            log, machine = part.log, part.machine
            assert machine.load is not None, "a joint alone has one"
            q, v, a = (x[:, 0] for x in (part.data.q, part.data.qd, part.data.qdd))
            force = float(np.asarray(machine.plant.own_inertia())) * a - machine.load[:, 0]
            counts = rows_in_motion(log, v)
            rows.append(np.stack([force, v, np.sign(v)], axis=1)[counts])
            errors.append(errors_by_delay(log, 0, q, counts))
        columns = np.concatenate(rows)
        if len(columns) < _FEWEST:
            return None
        return cls(Reduced.of(columns, np.concatenate(errors, axis=1)))

    def solutions(self, delays: range | list[int], stiffness: float) -> Iterator[_Found]:
        """Return the best values at any gain, and those at some gains about a guess."""
        best = self._best(delays, None)
        if best.compliance > 0:
            yield best
        for part in _GAINS:
            yield self._best(delays, 1.0 / (part * stiffness))

    def _best(self, delays: range | list[int], compliance: float | None) -> _Found:
        found = [self._at(k, compliance) for k in delays]
        return min(found, key=lambda one: one[1])[0]

    def _at(self, delay: int, compliance: float | None) -> tuple[_Found, float]:
        """Return the values at a delay, and the misfit; a gain may be given."""
        columns, error = self.rows.columns, self.rows.errors[delay]
        if compliance is None:
            values, misfit = fit_nonnegative(columns, error)
        else:
            values, misfit = fit_nonnegative(columns[:, 1:], error - compliance * columns[:, 0])
            values = np.append(compliance, values)
        inverse, lag, dry = (float(x) for x in values)
        found = _Found(inverse, lag, dry, float(DELAYS[delay]))
        return found, float(np.hypot(misfit, np.sqrt(self.rows.rest[delay])))


def _start(machine: Machine, unknown: dict[str, int], found: _Found) -> Float[np.ndarray, " own"]:
    """Return values of the unknowns for a solution of the balance."""
    stiffness, drive = 1.0 / found.compliance, float(np.abs(machine.gain[0]))
    damping, known = found.lag * stiffness, _damping(machine)
    free = [name for name in ("kd", "viscous") if name in unknown]
    # Both dampings act alike: their guesses divide the sum that was found.
    spare = max(damping - sum(v for n, v in known.items() if n not in free), _LITTLE * damping)
    weights = {n: max(known[n], 1e-12) for n in free}
    values = {n: spare * weights[n] / sum(weights.values()) for n in free}
    values |= {"kp": stiffness / drive, "dry": found.dry * stiffness, "delay": found.delay}
    if "kd" in free:
        values["kd"] /= drive
    if isinstance(machine.controller, CascadePD):
        # Its gain of the position multiplies that of the velocity.
        values["kp"] /= max(values.get("kd", known["kd"] / drive), 1e-12)

    start, guess = machine.parameters.guess, machine.parameters.guess
    for name, value in values.items():
        k = unknown.get(name)
        if k is None:
            continue
        size = abs(guess[k]) if guess[k] else max(abs(value), 1e-12)
        least = 0.0 if name == "delay" else _LITTLE * size / _FARTHEST
        start[k] = np.clip(value, least, _FARTHEST * size)
    return np.clip(start, *machine.parameters.bounds)


def _role(path: tuple[str | int, ...], machine: Machine) -> str:
    """Return the part that an unknown has in the balance; its own name if it has none."""
    if path[0] == CONTROLLER:
        name = str(path[1])
        return "kd" if isinstance(machine.controller, CascadePD) and name == "kv" else name
    if path[0] == "effects" and isinstance(path[1], int):
        effect = machine.plant.effects[path[1]]
        roles = {effect.viscous_coefficient: "viscous", effect.sliding_level: "dry"}
        return roles.get(str(path[-1]), f"{effect.kind}.{path[-1]}")
    return str(path[0])


def _delay(machine: Machine) -> float:
    law = machine.controller
    return 0.0 if law is None or law.delay is None else float(np.max(np.asarray(law.delay)))


def _nearest(delay: float) -> int:
    return int(np.argmin(np.abs(DELAYS - delay)))


def _stiffness(machine: Machine) -> float:
    """Return the stiffness of the servo at the guesses, seen at the joint."""
    law = machine.controller
    inner = np.max(np.asarray(law.kv)) if isinstance(law, CascadePD) else 1.0
    kp = np.max(np.asarray(getattr(law, "kp")))  # noqa: B009 (a law of either class)
    return float(np.abs(machine.gain[0]) * kp * inner)


def _damping(machine: Machine) -> dict[str, float]:
    """Return the damping of the servo and that of the joint at their guesses, seen at the joint."""
    law = machine.controller
    kd = getattr(law, "kv" if isinstance(law, CascadePD) else "kd")
    own = [getattr(e, e.viscous_coefficient) for e in machine.plant.effects if e.viscous_coefficient]
    return {
        "kd": float(np.abs(machine.gain[0]) * np.max(np.asarray(kd))),
        "viscous": sum(float(np.asarray(value)) for value in own),
    }
