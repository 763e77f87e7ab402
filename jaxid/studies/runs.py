"""One run of a study, and a chunk of them solved together."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace

import numpy as np

from jaxid.errors import InputError
from jaxid.estimators import SIMULATING, steps_of
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.estimators.output_error import choose_numerics
from jaxid.logs.prepare import Recipe
from jaxid.names import DISCOVER, IN_LOOP
from jaxid.numerics.lanes import Steps, run_alone, run_batched
from jaxid.session import Session, session_around
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Numerics
from jaxid.studies.plan import Plan

Arrays = dict[str, np.ndarray]


@dataclass(frozen=True)
class Ways:
    """How all runs at one level are filtered and integrated: alike, so as to share code."""

    recipe: Recipe
    numerics: Numerics | None


@dataclass
class Runner:
    """Runs chunks of a plan; threads may share one.

    Args:
        plan: The study.
    """

    plan: Plan
    _ways: dict[int, Ways] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def ways(self, level: int) -> Ways:
        """How runs at a level are filtered and integrated, as the first of them asks."""
        with self._lock:
            if level not in self._ways:
                self._ways[level] = self._chosen(level)
        return self._ways[level]

    def _chosen(self, level: int) -> Ways:
        """As `identify` would choose on the log of the nominal machine."""
        at = self.plan.levels[level]
        log = run_alone(at.scene.simulated_log(at.scene.machine, self.plan.drawn(0)[2])).log
        session = session_around(at.model, at.machine, log)
        if not set(SIMULATING) & set(self.plan.estimators):
            return Ways(session.recipe, None)
        first = inverse_dynamics(session.machine, session.fit.data)
        machine = first.machine if first.all_identified else session.machine
        solver = at.model.output_error.get("solver")
        return Ways(session.recipe, choose_numerics(machine, log, solver=solver))

    def chunk(self, number: int) -> Arrays:
        """All runs of a chunk, as arrays by estimator and run.

        Returns:
            `estimate` and `std` (method, run, p), NaN where there is none; `converged` and
            `identifiable`; `steps`; `message` and `named` (method, run); `tracking` (method, run, drives,
            2), see `_tracking`; `truth` and `start` (run, p); `seconds` that the chunk took.
        """
        began = time.perf_counter()
        level, runs = self.plan.chunks[number]
        ways = self.ways(level) if self.plan.fits else None
        found = run_batched([self._run(level, k, ways) for k in runs], self.plan.lanes)
        # Whatever ends a run, in a library too, ends that run only.
        found = [self._all_failed(x) if isinstance(x, Exception) else x for x in found]
        out = {name: np.stack([row[name] for row in found], axis=1) for name in (*_BY_METHOD, "tracking")}
        drawn = [self.plan.drawn(k) for k in runs]
        out["truth"] = np.stack([truth[self.plan.own] for truth, _, _ in drawn])
        out["start"] = np.stack([start for _, start, _ in drawn])
        out["seconds"] = np.asarray(time.perf_counter() - began)
        return out

    def _run(self, level: int, number: int, ways: Ways | None) -> Steps[Arrays]:
        plan, at = self.plan, self.plan.levels[level]
        truth, start, rng = plan.drawn(number)
        machine = at.machine.with_estimate(start)
        rows = []
        simulated_log = yield from at.scene.simulated_log(at.scene.machine.with_estimate(truth), rng)
        # What is unknown of a reference is not in the log.
        log = (
            simulated_log.log
            if machine.unknown_reference is None
            else replace(simulated_log.log, reference=None)
        )
        session = None if ways is None else session_around(at.model, machine, log, ways.recipe)
        for method in plan.estimators:
            options = {"numerics": ways.numerics} if method in SIMULATING else {}
            try:
                if method == IN_LOOP:
                    rows.append(_told(plan, simulated_log.trajectory))
                    continue
                if method == DISCOVER:
                    aligned = replace(ways.recipe, align_hold=True)
                    whole = session_around(at.model, machine, log, aligned)
                    rows.append(_found(plan, whole))
                    continue
                rows.append(_row((yield from steps_of(method, session, **options))))
            except Exception as error:
                rows.append(_failed(plan, _words(error)))
        driven = machine.plant.driven(simulated_log.trajectory.position.shape[1])
        followed = np.asarray(simulated_log.trajectory.position)[:: at.scene.every, list(driven)]
        return _stacked(rows, _tracking(simulated_log.log.reference, followed))

    def _all_failed(self, error: Exception) -> Arrays:
        drives = 0 if self.plan.machine.controller is None else self.plan.machine.gain.size
        rows = [_failed(self.plan, _words(error)) for _ in self.plan.estimators]
        return _stacked(rows, np.full((drives, 2), np.nan))


_BY_METHOD = ("estimate", "std", "identifiable", "converged", "steps", "message", "named")


def _row(estimate: Estimate) -> Arrays:
    told = estimate.identifiable & np.all(np.isfinite(estimate.theta))
    return {
        "estimate": np.where(told, estimate.theta, np.nan),
        "std": np.where(told, estimate.std, np.nan),
        "identifiable": told,
        "converged": np.asarray(estimate.converged),
        "steps": np.asarray(estimate.steps),
        "message": np.asarray(estimate.message),
        "named": np.asarray(""),
    }


def _told(plan: Plan, run: Trajectory) -> Arrays:
    """What a law that identifies had found when the run ended; of its own certainty nothing is kept."""
    theta, closed = np.asarray(run.found.theta)[-1], bool(np.asarray(run.found.closed)[-1])
    row = _failed(plan, "" if closed else "the law never trusted what it found")
    told = np.full(len(theta), closed) & np.isfinite(theta)
    return row | {
        "estimate": np.where(told, theta, np.nan),
        "identifiable": told,
        "converged": np.asarray(closed),
    }


# Part of a run, from its end, over which tracking errors are counted: what a law learns it has learnt.
_SETTLED = 0.25


def _tracking(reference: np.ndarray | None, followed: np.ndarray) -> np.ndarray:
    """Root mean square and peak of what a loop's drives are off the reference at the end, (drives, 2)."""
    if reference is None:
        return np.zeros((0, 2))
    error = (reference - followed)[-max(1, round(_SETTLED * len(followed))) :]
    return np.stack([np.sqrt(np.mean(error**2, axis=0)), np.abs(error).max(axis=0)], axis=1)


def _found(plan: Plan, session: Session) -> Arrays:
    """What `discover` makes of a run: the model's own parameters, and what it names beside them."""
    from jaxid.commands.discover import explore

    found = explore(session, refit=False, experiments=False)
    at = [found.after.names.index(name) for name in plan.names]
    row = {name: x[at] if np.ndim(x) else x for name, x in _row(found.after).items()}
    named = " + ".join(sorted(e.label for e in found.effects)) or found.verdict
    return row | {"named": np.asarray(named)}


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"


def _failed(plan: Plan, why: str) -> Arrays:
    none = np.full(len(plan.names), np.nan)
    return {
        "estimate": none,
        "std": none,
        "identifiable": np.zeros(len(none), bool),
        "converged": np.asarray(False),
        "steps": np.asarray(0),
        "message": np.asarray(why),
        "named": np.asarray(""),
    }


def _stacked(rows: list[Arrays], tracking: np.ndarray) -> Arrays:
    """Of one run, by method; its tracking is the same for all."""
    out = {name: np.stack([row[name] for row in rows]) for name in _BY_METHOD}
    return out | {"tracking": np.stack([tracking] * len(rows))}
