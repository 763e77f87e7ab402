"""The logs of a fit, each with its machine and its unknowns among those of all logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jaxid.estimators.common.levenberg_marquardt import BODY_STEPS, BODY_TOLERANCE, Transform
from jaxid.logs.log import Log
from jaxid.logs.prepare import Prepared
from jaxid.machine import Machine

if TYPE_CHECKING:
    from jaxid.session import OpenedLog, Session


@dataclass(frozen=True)
class Part:
    """One of the logs that are fitted together; a fit of one log has one part.

    Args:
        name: Name of the log in results.
        log: The log.
        machine: Its machine, with the values and the unknowns that hold in it.
        index: Number of each of its unknowns among those of all logs, (own,).
        prepared: The prepared log; None for a method that takes the log as it is.
    """

    name: str
    log: Log
    machine: Machine
    index: np.ndarray
    prepared: Prepared | None = None

    @classmethod
    def alone(cls, machine: Machine, log: Log, prepared: Prepared | None = None) -> Part:
        """Return the part of a fit of one log, which has all unknowns."""
        return cls("fit", log, machine, np.arange(len(machine.parameters.free)), prepared)

    @property
    def data(self) -> Prepared:
        """The prepared log."""
        assert self.prepared is not None, "the log of this fit was not prepared"
        return self.prepared

    def at(self, theta: Float[np.ndarray, " p"]) -> Machine:
        """Return the machine of this log with its unknowns at values of those of all logs, (p,)."""
        return self.machine.with_estimate(theta[self.index])

    def widened(self, own: Float[np.ndarray, "... own"], width: int) -> Float[np.ndarray, "... p"]:
        """Return derivatives by the unknowns of this log as those by `width` unknowns of all logs."""
        out = np.zeros((*own.shape[:-1], width))
        out[..., self.index] = own
        return out


def parts_of(session: Session) -> list[Part]:
    """Return the fitted logs of a session."""
    return [part_of(run, session.machine) for run in session.fits]


def part_of(run: OpenedLog, machine: Machine) -> Part:
    """Return an opened log with its machine.

    Args:
        run: The log.
        machine: Machine of all logs.
    """
    own, names = run.machine(machine), machine.parameters.names
    index = np.array([names.index(name) for name in own.parameters.names], dtype=int)
    return Part(run.name, run.log, own, index, run.data)


@dataclass(frozen=True)
class Scale:
    """The scale on which several logs are fitted.

    Args:
        transform: Scale of the unknowns of all logs.
        lower, upper: Bounds on the physical values, (p,).
        more: Number of further unknowns of single logs behind them, which are free.
    """

    transform: Transform
    lower: Float[np.ndarray, " p"]
    upper: Float[np.ndarray, " p"]
    more: int = 0

    @classmethod
    def of(cls, machine: Machine, transform: Transform | None = None, more: int = 0) -> Scale:
        """Return the scale of the unknowns of a machine."""
        transform = Transform.of(machine.parameters) if transform is None else transform
        return cls(transform, *machine.parameters.bounds, more)

    @property
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds on the scale of the solver, (p + more,) each."""
        lower, upper = (np.asarray(b) for b in self.transform.bounds(self.lower, self.upper))
        free = np.full(self.more, np.inf)
        return np.concatenate([lower, -free]), np.concatenate([upper, free])

    def inward(self, theta: np.ndarray, more: np.ndarray | None = None) -> np.ndarray:
        """Return physical values, and the further unknowns, on the scale of the solver."""
        more = np.zeros(self.more) if more is None else more
        theta = np.clip(theta, self.lower, self.upper)
        return np.concatenate([np.asarray(self.transform.inward(theta)), more])

    def outward(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return physical values and the further unknowns."""
        p = self.lower.size
        return np.asarray(self.transform.outward(x[:p])), x[p:]

    def inner(self, columns: np.ndarray, theta: np.ndarray) -> np.ndarray:
        """Return derivatives by the physical values theta as those by the solver's, (rows, p + more)."""
        if not self.transform.bodies:
            return columns * np.concatenate([np.asarray(self.transform.slope(theta)), np.ones(self.more)])
        of_unknowns = np.asarray(self.transform.inner(columns[:, : theta.size], theta))
        return np.concatenate([of_unknowns, columns[:, theta.size :]], axis=1)

    def limits(self, tolerance: float, most: int) -> dict[str, Any]:
        """Return when a descent ends, as keyword arguments: bodies take more steps to a looser tolerance."""
        if self.transform.bodies:
            tolerance, most = max(tolerance, BODY_TOLERANCE), max(most, BODY_STEPS)
        return {"tolerance": (tolerance, 0.0), "max_steps": most}


def by_log(parts: Sequence[Part], entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return results of each log by its name, as details of an estimate."""
    return {"fits": {part.name: entry for part, entry in zip(parts, entries, strict=True)}}
