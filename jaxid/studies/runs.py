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
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.logs.log import Log
from jaxid.logs.prepare import Recipe
from jaxid.names import DISCOVER, IN_LOOP
from jaxid.numerics.lanes import Steps, run_alone, run_batched
from jaxid.session import Session, session_around, session_around_several
from jaxid.simulation.loops import Trajectory
from jaxid.simulation.replay import Numerics
from jaxid.studies.logs import machines_of
from jaxid.studies.loop_fits import LoopFits
from jaxid.studies.plan import Plan
from jaxid.studies.rows import COLUMNS, Arrays, RunRow, stacked, tracking_of


@dataclass(frozen=True)
class Ways:
    """Filter and integration of all runs at one level, which share compiled code.

    Args:
        recipe: Filter of the logs.
        numerics: Integration of fits that simulate; None: there are none.
        together: Fits of a chunk as a few compiled programs; None: each run asks its estimators.
    """

    recipe: Recipe
    numerics: Numerics | None
    together: LoopFits | None = None


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
        """Return filter and integration of the runs at a level, chosen at first use."""
        with self._lock:
            if level not in self._ways:
                self._ways[level] = self._chosen(level)
        return self._ways[level]

    def _chosen(self, level: int) -> Ways:
        """Choose as `identify` does on the log of the nominal machine."""
        at = self.plan.levels[level]
        _, _, simulated = machines_of(at.scene.case, at.scene.machine)[0]
        log = self._read(run_alone(at.scene.simulated_log(simulated, self.plan.drawn(0)[2])).log)
        _, _, fitted = machines_of(at.model, at.machine)[0]
        session = session_around(at.model, fitted, log)
        if len(at.model.fits) > 1:
            return Ways(session.recipe, None)
        if not set(SIMULATING) & set(self.plan.estimators):
            return Ways(session.recipe, None)
        solver = at.model.output_error.solver
        if self.plan.without_force:
            return Ways(session.recipe, choose_numerics(session.machine, log, solver=solver))
        first = inverse_dynamics(session.machine, session.fit.data)
        machine = first.machine if first.all_identified else session.machine
        numerics = choose_numerics(machine, log, solver=solver)
        return Ways(session.recipe, numerics, LoopFits.of(self.plan, at, session, numerics))

    def _read(self, log: Log) -> Log:
        """Return the columns of a simulated log that the case names."""
        if self.plan.without_force:
            log = replace(log, force=None)
        # A reference with unknowns is not in the log.
        return log if self.plan.machine.unknown_reference is None else replace(log, reference=None)

    def chunk(self, number: int) -> Arrays:
        """Run a chunk and return arrays by estimator and run.

        Returns:
            `estimate` and `std` (method, run, p), NaN if there is none; `converged` and
            `identifiable`; `steps`; `message` and `named` (method, run); `tracking` (method, run, drives,
            2), see `tracking_of`; `truth` and `start` (run, p); `seconds` that the chunk took.
        """
        began = time.perf_counter()
        level, runs = self.plan.chunks[number]
        ways = self.ways(level) if self.plan.fits else None
        drawn = [self.plan.drawn(k) for k in runs]
        done, out = np.zeros(len(runs), bool), None
        if ways is not None and ways.together is not None:
            done, out = ways.together.fitted(drawn)
        left = np.flatnonzero(~done)
        if left.size:
            found = run_batched([self._run(level, runs[k], ways) for k in left], self.plan.lanes)
            # An exception ends its run only, even one of a library.
            rows = [self._all_failed(x) if isinstance(x, Exception) else x for x in found]
            alone = {name: np.stack([row[name] for row in rows], axis=1) for name in (*COLUMNS, "tracking")}
            out = alone if out is None else _merged(out, alone, left)
        assert out is not None, "a chunk has runs"
        out["truth"] = np.stack([truth[self.plan.own] for truth, _, _ in drawn])
        out["start"] = np.stack([start for _, start, _ in drawn])
        out["seconds"] = np.asarray(time.perf_counter() - began)
        return out

    def _run(self, level: int, number: int, ways: Ways | None) -> Steps[Arrays]:
        plan, at = self.plan, self.plan.levels[level]
        truth, start, rng = plan.drawn(number)
        machine = at.machine.with_estimate(start)
        rows: list[RunRow] = []
        logs = []
        for _, _, own in machines_of(at.scene.case, at.scene.machine.with_estimate(truth)):
            logs.append((yield from at.scene.simulated_log(own, rng)))
        simulated_log = logs[0]

        def around(recipe: Recipe) -> Session:
            read = [self._read(made.log) for made in logs]
            if not at.model.fits:
                return session_around(at.model, machine, read[0], recipe)
            seen = machines_of(at.model, machine)
            named = [(name, own, log) for (name, own, _), log in zip(seen, read, strict=True)]
            return session_around_several(at.model, machine, named, recipe)

        session = None if ways is None else around(ways.recipe)
        for method in plan.estimators:
            try:
                if method == IN_LOOP:
                    rows.append(_row_of_law(plan, simulated_log.trajectory))
                    continue
                assert ways is not None, "a plan with fits has ways for them"
                assert session is not None
                if method == DISCOVER:
                    aligned = replace(ways.recipe, align_hold=True)
                    whole = around(aligned)
                    rows.append(_row_of_search(plan, whole))
                    continue
                options = {"numerics": ways.numerics} if method in SIMULATING and not session.more else {}
                estimate = yield from steps_of(method, session, **options)
                moved = np.asarray(simulated_log.trajectory.position)[0] - session.fit.log.filled[0]
                rows.append(_row(estimate, _combinations(session, estimate, truth[plan.own], moved)))
            except Exception as error:
                rows.append(RunRow.failed(len(plan.names), _words(error)))
        followed = np.asarray(simulated_log.trajectory.position)[:: at.scene.every]
        return self._arrays_of(level, rows, simulated_log.log.reference, followed)

    def _arrays_of(
        self, level: int, rows: list[RunRow], reference: np.ndarray | None, followed: np.ndarray
    ) -> Arrays:
        """Return the arrays of one run, whose joints followed a reference so, (time, n)."""
        driven = self.plan.levels[level].machine.plant.driven(followed.shape[1])
        return _run_arrays(rows, np.asarray(tracking_of(reference, followed[:, list(driven)])))

    def _all_failed(self, error: Exception) -> Arrays:
        drives = 0 if self.plan.machine.controller is None else self.plan.machine.gain.size
        rows = [RunRow.failed(len(self.plan.names), _words(error)) for _ in self.plan.estimators]
        return _run_arrays(rows, np.full((drives, 2), np.nan))


def _combinations(session: Session, estimate: Estimate, truth: np.ndarray, moved: np.ndarray) -> np.ndarray:
    """Return the errors of the combinations that a fit within a prior identifies, over their deviations.

    Args:
        session: Case and log of the fit.
        estimate: The estimate.
        truth: True values of the unknowns, (p,).
        moved: True minus read position of each joint at the start, (n,).
    """
    directions = estimate.details.get("directions")
    if not directions:
        return np.zeros(0)
    from jaxid.estimators.within_prior.coverage import errors_of_directions

    return errors_of_directions(session.machine, session.case.need_prior().prior, directions, truth, moved)


def _row(estimate: Estimate, combinations: np.ndarray | None = None) -> RunRow:
    identifiable = estimate.identifiable & np.all(np.isfinite(estimate.theta))
    errors = np.zeros(0) if combinations is None else combinations
    padded = np.full(len(estimate.theta), np.nan)
    padded[: len(errors)] = errors[: len(padded)]
    return RunRow(
        estimate=np.where(identifiable, estimate.theta, np.nan),
        std=np.where(identifiable, estimate.std, np.nan),
        identifiable=identifiable,
        converged=estimate.converged,
        steps=estimate.steps,
        message=estimate.message,
        named="",
        combinations=len(errors),
        combination_error=padded,
    )


def _row_of_law(plan: Plan, run: Trajectory) -> RunRow:
    """Return the last estimate of a control law that identifies, without standard deviations."""
    theta, closed = np.asarray(run.found.theta)[-1], bool(np.asarray(run.found.closed)[-1])
    row = RunRow.failed(len(plan.names), "" if closed else "the law never trusted its estimate")
    identifiable = np.full(len(theta), closed) & np.isfinite(theta)
    estimate = np.where(identifiable, theta, np.nan)
    return replace(row, estimate=estimate, identifiable=identifiable, converged=closed)


def _row_of_search(plan: Plan, session: Session) -> RunRow:
    """Return the declared parameters that `discover` estimates, and the effects that it names."""
    from jaxid.commands.discover import explore

    result = explore(session, refit=False, experiments=False)
    at, row = [result.after.names.index(name) for name in plan.names], _row(result.after)
    return replace(
        row,
        estimate=row.estimate[at],
        std=row.std[at],
        identifiable=row.identifiable[at],
        combination_error=row.combination_error[at],
        named=" + ".join(sorted(e.label for e in result.effects)) or result.verdict,
    )


def _words(error: Exception) -> str:
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"


def _merged(together: Arrays, alone: Arrays, places: np.ndarray) -> Arrays:
    """Return the arrays of a chunk, those of the runs at some places replaced by others."""
    order = np.arange(together["steps"].shape[1])
    order[places] = len(order) + np.arange(len(places))
    return {name: np.concatenate([together[name], alone[name]], axis=1)[:, order] for name in alone}


def _run_arrays(rows: list[RunRow], tracking: np.ndarray) -> Arrays:
    """Return the arrays of one run by estimator; its tracking is the same for all."""
    return stacked(rows) | {"tracking": np.stack([tracking] * len(rows))}
