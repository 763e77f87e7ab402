"""Logs of a comparison without a force: positions against those of the simulated loop.

Loops whose forces have no scale have the same motion with all forces, inertias and gains multiplied by one
factor. One of these unknowns then keeps its value in the first log, and may differ in the others: a payload
in one of them is a difference of this one alone.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from jaxid.comparison.rows import ComparedLog, own_values
from jaxid.discovery.candidates import Candidate, CandidateModel, View
from jaxid.discovery.in_loop.positions import NUMERICS, LoopSamples, PositionDomain
from jaxid.errors import InputError
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.machine import Machine
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.session import OpenedLog
from jaxid.simulation.sensor_noise import position_noise

# Latest evaluations that are kept: a search asks for most of them again.
_KEPT = 8


@dataclass(frozen=True)
class LoopLog(ComparedLog):
    """One log of a loop without a force.

    Args:
        superset: Machine with all candidates.
    """

    superset: CandidateModel
    _latest: OrderedDict[tuple, tuple[np.ndarray, np.ndarray]] = field(default_factory=OrderedDict)

    @classmethod
    def of(cls, runs: Sequence[OpenedLog], machine: Machine, superset: CandidateModel) -> LoopLog:
        """Open a log for a comparison of positions.

        Args:
            runs: The log.
            machine: The machine of the case at fitted values, without candidates.
            superset: The machine with all candidates.

        Raises:
            InputError: If the log is in pieces, or holds velocities in place of positions.
        """
        run, *pieces = runs
        log = run.log
        if pieces or log.integrated:
            what = "has gaps" if pieces else "holds velocities in place of positions"
            hint = "choose rows without a gap, with the position" if pieces else "name the position column"
            raise InputError(
                f"a log that {what} cannot be compared without a force", where=log.source, hint=hint
            )
        own = run.machine(machine)
        view = View.of(superset.machine, own_values(run), np.ones(log.position.shape[1]))
        numerics = choose_numerics(own, log)
        period = log.period if own.controller is None else own.controller.period
        samples = LoopSamples.of(run, machine, superset, numerics, view)

        floor = position_noise(own, log)
        wrong = NUMERICS * np.std(log.filled, axis=0)
        smallest = np.where(floor > 0, np.hypot(floor, wrong), 1.0)
        return cls(
            name=own_values(run).log,
            runs=tuple(runs),
            domain=PositionDomain.of(superset, period, numerics),
            samples=samples,
            view=view,
            colour=tuple(NoiseModel(np.zeros(0), float(s)) for s in smallest),
            floor=floor,
            smallest=smallest,
            numerics=float(np.sum(samples.moving.sum(axis=0) * (wrong / smallest) ** 2)),
            independent=1.0,
            times=log.time,
            position=log.filled,
            velocity=np.gradient(log.filled, log.time, axis=0),
            superset=superset,
        )

    def evaluate(
        self, theta: np.ndarray, wanted: Sequence[int] = ()
    ) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
        """Compute the residual and its Jacobian; see `ComparedLog`."""
        asked = frozenset(int(k) for k in wanted)
        for (known, columns), found in self._latest.items():
            if known == theta.tobytes() and asked <= columns:
                return found
        found = self._latest[theta.tobytes(), asked] = super().evaluate(theta, sorted(asked))
        if len(self._latest) > _KEPT:
            self._latest.popitem(last=False)
        return found

    def renewed(self, theta: np.ndarray, effects: Sequence[Candidate] = ()) -> LoopLog:
        """Return the log with the noise of its encoder in the loop, as it is at some values."""
        samples = self.samples.renewed(self.superset, effects, theta)
        return replace(self, samples=samples, _latest=OrderedDict())

    def drawn_noise(
        self, theta: np.ndarray, effects: Sequence[Candidate], runs: int
    ) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals by the noise in its loop; see `ComparedLog`."""
        return self.samples.drawn_noise(self.superset, effects, theta, runs)
