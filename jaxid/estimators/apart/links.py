"""Starts for unknown links of an arm of servos, by the balances of all joints along the measured motion.

With the law u = kp (r - q) - kd dq the error of the position of every joint is

    r - q = 1 / kp (links + rotor ddq) + (kd + c) / kp dq + F / kp sign(dq)

The force of the links is linear in their parameters. At given ones the error is linear in all that belongs to
the joint, so that a search has to try values of the links alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.optimize
import scipy.stats
from jaxtyping import Float

from jaxid.controllers.linear import CascadePD
from jaxid.estimators.apart.balance import Reduced, errors_by_delay, fit_nonnegative, rows_in_motion
from jaxid.estimators.apart.joint import ROTOR, gear_squares, links_of, of_links
from jaxid.estimators.several.parts import Part
from jaxid.machine import Machine
from jaxid.model.unknowns import CONTROLLER, Free
from jaxid.plants.link_tree import LinkTree

# Points that are tried about the guesses, and the factor by which they differ.
_POINTS, _SPREAD = 256, 6.0
# Most values that are tried from the best of these, for each unknown.
_TRIALS = 200
# Size of an unknown whose guess is zero: its part of the links' forces.
_PART = 0.1


def links_by_balance(
    machine: Machine, parts: Sequence[Part], unknown: Sequence[int]
) -> Float[np.ndarray, " p"]:
    """Return values of an arm's unknowns with those of its links by the balances of the joints.

    Args:
        machine: Machine of all logs.
        parts: The logs.
        unknown: Numbers of the links' unknowns, the forces are linear in each.

    Returns:
        The guesses, with other values of these unknowns, (p,).
    """
    free = [machine.parameters.free[k] for k in unknown]
    joints = [_JointBalance.of(machine, parts, unknown, joint) for joint in range(machine.plant.joints)]
    scale = _Scale(free, joints)

    def cost(x: Float[np.ndarray, " k"]) -> float:
        return sum(joint.cost(scale.change(x)) for joint in joints)

    draws = scipy.stats.qmc.Sobol(len(free), scramble=False).random(_POINTS)
    points = np.concatenate([np.zeros((1, len(free))), np.log(_SPREAD) * (2 * draws - 1)])
    begun = points[np.argmin([cost(x) for x in points])]
    best = scipy.optimize.minimize(
        cost, begun, method="Nelder-Mead", options={"maxfev": _TRIALS * len(free), "adaptive": True}
    )
    theta = machine.parameters.guess
    theta[list(unknown)] += scale.change(best.x)
    return np.clip(theta, *machine.parameters.bounds)


class _Scale:
    """Coordinates of a search: logarithms of positive unknowns, and parts of the size of others."""

    def __init__(self, free: Sequence[Free], joints: Sequence[_JointBalance]) -> None:
        self.guess = np.array([f.guess for f in free])
        self.positive = np.array([f.sign != "free" for f in free]) & (self.guess > 0)
        shown = np.max([joint.sizes for joint in joints], axis=0)
        self.size = np.where(self.guess != 0, np.abs(self.guess), _PART / np.maximum(shown, 1e-300))

    def change(self, x: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        """Return changes of the unknowns from their guesses."""
        return np.where(self.positive, self.guess * np.expm1(x), self.size * x)


@dataclass(frozen=True)
class _JointBalance:
    """The balance of a joint at all rows in motion, reduced to a triangular matrix.

    Args:
        known: Column of the forces at the guesses, (m,).
        slopes: Columns of the forces by the links' unknowns, (m, k).
        own: Columns of the joint: of its rotor if that is unknown, of damping and of dry friction, (m, own).
        errors: Error of the position by delay, (delays, m).
        rest: Squares that no value explains, by delay, (delays,).
        rows: Number of rows.
        compliance: Reciprocal of a gain that is known; None: it is unknown.
    """

    known: Float[np.ndarray, " m"]
    slopes: Float[np.ndarray, "m k"]
    own: Float[np.ndarray, "m own"]
    errors: Float[np.ndarray, "delays m"]
    rest: Float[np.ndarray, " delays"]
    rows: int
    compliance: float | None

    @property
    def sizes(self) -> Float[np.ndarray, " k"]:
        """Size of the force of each unknown's unit beside that of the guesses."""
        return np.linalg.norm(self.slopes, axis=0) / max(float(np.linalg.norm(self.known)), 1e-300)

    @classmethod
    def of(cls, machine: Machine, parts: Sequence[Part], unknown: Sequence[int], joint: int) -> _JointBalance:
        """Return the balance of a joint along all logs."""
        rows, errors = zip(*(_rows(machine, part, unknown, joint) for part in parts), strict=True)
        whole = np.concatenate(rows)
        reduced, k = Reduced.of(whole, np.concatenate(errors, axis=1)), 1 + len(unknown)
        return cls(
            known=reduced.columns[:, 0],
            slopes=reduced.columns[:, 1:k],
            own=reduced.columns[:, k:],
            errors=reduced.errors,
            rest=reduced.rest,
            rows=len(whole),
            compliance=_compliance(machine, joint),
        )

    def cost(self, change: Float[np.ndarray, " k"]) -> float:
        """Return the negative log-likelihood at changes of the links' unknowns, at its best delay."""
        force, columns, errors = self.known + self.slopes @ change, self.own, self.errors
        if self.compliance is None:
            columns = np.column_stack([force, columns])
        else:
            errors = errors - self.compliance * force
        left = [fit_nonnegative(columns, error)[1] ** 2 for error in errors]
        return 0.5 * self.rows * float(np.log(max(np.min(np.array(left) + self.rest), 1e-300)))


def _rows(
    machine: Machine, part: Part, unknown: Sequence[int], joint: int
) -> tuple[Float[np.ndarray, "rows m"], Float[np.ndarray, "delays rows"]]:
    """Return the columns of a joint's balance along a log, and the error of its position by delay."""
    log, theta, data = part.log, machine.parameters.guess, part.data
    plant, drive = machine.plant, machine.plant.driven(machine.plant.joints).index(joint)
    q, v, a = (x[:, joint] for x in (data.q, data.qd, data.qdd))
    counts = rows_in_motion(log, v)

    def force(theta: np.ndarray) -> np.ndarray:
        return np.asarray(of_links(links_of(part.at(theta)), data.q, data.qd, data.qdd))[:, joint]

    known, columns = force(theta), []
    for k in unknown:
        # The forces are linear in it, so that a difference is exact.
        more = np.where(np.arange(len(theta)) == k, max(abs(theta[k]), 1.0), 0.0)
        columns.append((force(theta + more) - known) / more[k])
    own = [v, np.sign(v)]
    if any(f.path == (ROTOR,) and f.index == joint for f in machine.parameters.free):
        own = [a, *own]
    elif isinstance(plant, LinkTree) and plant.rotor_inertia is not None:
        known = known + gear_squares(plant)[joint] * float(np.asarray(plant.rotor_inertia)[joint]) * a
    return np.stack([known, *columns, *own], axis=1)[counts], errors_by_delay(log, drive, q, counts)


def _compliance(machine: Machine, joint: int) -> float | None:
    """Return the reciprocal of the gain from the error of a joint to its force; None if it is unknown."""
    law, drive = machine.controller, machine.plant.driven(machine.plant.joints).index(joint)
    names = ("kp", "kv") if isinstance(law, CascadePD) else ("kp",)
    own = [f for f in machine.parameters.free if f.path[0] == CONTROLLER and f.index in (drive, None)]
    if any(f.path[1] in names for f in own):
        return None
    gains = [np.broadcast_to(np.asarray(getattr(law, name)), len(machine.gain))[drive] for name in names]
    return 1.0 / float(np.prod(gains) * abs(machine.gain[drive]))
