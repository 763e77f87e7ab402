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
from jaxid.discovery import candidates as cand
from jaxid.discovery.candidates import Candidate, CandidateModel, View
from jaxid.discovery.final import machine_with
from jaxid.discovery.in_loop.positions import NUMERICS, LoopSamples, PositionDomain
from jaxid.errors import InputError
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.machine import Machine
from jaxid.numerics.precision import NoiseModel
from jaxid.session import OpenedLog
from jaxid.simulation.noisy_loop import drawn_readings, estimated_noise
from jaxid.simulation.sensor_noise import position_noise

# Latest evaluations that are kept: a search asks for most of them again.
_KEPT = 8


@dataclass(frozen=True)
class LoopLog(ComparedLog):
    """One log of a loop without a force.

    Args:
        superset: Machine with all candidates, with the values that are known in this log.
        machine: The machine of this log without candidates. The noise in its loop takes hundreds of runs,
            which the superset would make slow.
    """

    superset: CandidateModel
    machine: Machine
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
        mine = view.superset(superset)
        numerics = choose_numerics(own, log)
        period = log.period if own.controller is None else own.controller.period
        samples = LoopSamples.of(run.machine(mine.machine), log, numerics)

        floor = position_noise(own, log)
        wrong = NUMERICS * np.std(log.filled, axis=0)
        smallest = np.where(floor > 0, np.hypot(floor, wrong), 1.0)
        return cls(
            name=own_values(run).log,
            runs=tuple(runs),
            domain=PositionDomain.of(mine, period, numerics),
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
            superset=mine,
            machine=own,
        )

    def evaluate(
        self, theta: np.ndarray, wanted: Sequence[int] = ()
    ) -> tuple[Float[np.ndarray, "kept n"], Float[np.ndarray, "kept n p"]]:
        """Compute the residual and its Jacobian; see `ComparedLog`."""
        at, asked = self.view.theta(theta), frozenset(self.view.wanted(wanted))
        for (known, columns), found in self._latest.items():
            if known == at.tobytes() and asked <= columns:
                return found[0], self.view.jacobian(found[1])
        found = self.domain.evaluate(self.samples, at, sorted(asked))
        self._latest[at.tobytes(), asked] = found
        if len(self._latest) > _KEPT:
            self._latest.popitem(last=False)
        return found[0], self.view.jacobian(found[1])

    def points(self, rest: list[Candidate], theta: np.ndarray, e: np.ndarray) -> list[cand.Point]:
        """Linearise candidates at each of their starts; see `ComparedLog`."""
        return self.domain.points(rest, self.samples, self.view.theta(theta), e)

    def renewed(self, theta: np.ndarray, effects: Sequence[Candidate] = ()) -> LoopLog:
        """Return the log with the noise of its encoder in the loop, as it is at some values."""
        alone = self._alone(theta, effects)
        springs = any(cand.effect_of(self.superset, c).adds_spring for c in effects)
        noise = estimated_noise(alone, self.runs[0].log, self.samples.quiet[springs], follows=False)
        return replace(self, samples=self.samples.with_noise(noise), _latest=OrderedDict())

    def drawn_noise(
        self, theta: np.ndarray, effects: Sequence[Candidate], runs: int
    ) -> Float[np.ndarray, "runs time n"] | None:
        """Draw residuals by the noise in its loop; see `ComparedLog`."""
        noise = self.samples.noise
        if noise is None:
            return None
        machine = self._alone(theta, effects)
        springs = any(cand.effect_of(self.superset, c).adds_spring for c in effects)
        replay = self.samples.quiet[springs].following(machine.parameters.places, machine.parameters.guess)
        return drawn_readings(noise, replay, machine.plant, runs)

    def _alone(self, theta: np.ndarray, effects: Sequence[Candidate]) -> Machine:
        """Return the machine with some effects only, at values of the superset's unknowns in this log."""
        at = self.view.theta(theta)
        names = self.superset.machine.parameters.names
        index = [names.index(name) for name in self.machine.parameters.names]
        plain = replace(self.superset, base=np.array(index, int))
        return machine_with(self.machine, plain, effects, at)[0]
