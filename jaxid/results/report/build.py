"""The reports of `identify` and `discover`, from their results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.case.case import UNNAMED
from jaxid.estimators.minimal.report import minimal_rows
from jaxid.model.units import joined
from jaxid.results import as_json as results
from jaxid.results.by_joint import joint_rows
from jaxid.results.drive_chain import drive_chain
from jaxid.results.friction_curve import friction_views
from jaxid.results.poses import poses_of
from jaxid.results.precision import precision_content, ratio_rows
from jaxid.results.proposals import sentence
from jaxid.results.report.data import (
    CandidateScore,
    ExperimentView,
    HistoryView,
    LogView,
    ParameterRow,
    ReportData,
    SearchStep,
    WherePlot,
)
from jaxid.results.run_facts import run_facts
from jaxid.results.verdict.robot_file import values_of_file

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification
    from jaxid.discovery.result import Discovery, Round
    from jaxid.discovery.separating.propose import Proposal
    from jaxid.estimators.estimate import Estimate
    from jaxid.gap import Gap
    from jaxid.session import OpenedLog, Session


def identification_data(result: Identification) -> ReportData:
    """Return the content of the report of `identify`."""
    content = results.identification_json(result)
    session = result.session
    rows, below = minimal_rows(content["minimal"]) if "minimal" in content else ((), ())
    return ReportData(
        title=f"Identification of {_machine_title(session)}",
        command="identify",
        verdict=None,
        gap=content["gap"],
        unidentifiable=tuple(content["unidentifiable"]),
        ratios=tuple(tuple(row) for row in ratio_rows(result.estimate)),
        converged=result.converged,
        within_prior=content if "directions" in content else None,
        coefficients=tuple(rows),
        statistics=tuple(below),
        history=history_of(result.estimate),
        **_judged(result),
        **_common(result, content["notes"], "identify"),
    )


def discovery_data(result: Discovery) -> ReportData:
    """Return the content of the report of `discover`."""
    content = results.discovery_json(result)
    session = result.session
    return ReportData(
        title=f"What is missing in {_machine_title(session)}",
        command="discover",
        verdict=result.verdict,
        gap=content["gap"],
        unidentifiable=tuple(content["unidentifiable"]),
        effects=tuple(_described(content["effects"], result)),
        joints=tuple(joint_rows(content)),
        where=content["where"],
        steps=tuple(search_step(r) for r in result.rounds),
        where_plot=where_plot(result),
        experiments=tuple(_experiment(p, session) for p in result.proposals),
        converged=result.converged,
        misread=result.force_reading is not None,
        **_judged(result),
        **_common(result, content["notes"], "discover"),
    )


def _machine_title(session: Session) -> str:
    """Return the name of the case's file, or of the plant if the file has none of its own."""
    title = session.case.title
    return f"the {session.machine.plant.kind.replace('_', ' ')}" if title.startswith(UNNAMED) else title


def views(result: Identification | Discovery) -> tuple[LogView, ...]:
    """Return the logs of a result, by joint, as the plots take them."""
    return _views(result.session, _gaps_before(result), result.gaps)


def view_of(result: Identification | Discovery, run: int, joint: int) -> LogView:
    """Return one joint of one log of a result.

    Args:
        result: The result.
        run: Number of the log, 0 for the fitted one.
        joint: Joint with an encoder, 0-based.
    """
    before = _gaps_before(result)
    joints = int(np.sum(result.session.fit.log.measured))
    earlier = None if before is None else before[run]
    return _view(result.session.runs[run], earlier, result.gaps[run], joint, joints)


def _gaps_before(result: Identification | Discovery) -> Sequence[Gap] | None:
    """Return the gaps of the baseline of a search that changed it; None for any other result."""
    return getattr(result, "gaps_before", None) if getattr(result, "effects", ()) else None


def history_of(estimate: Estimate) -> HistoryView | None:
    """Return the history of a recursive estimate; None for any other."""
    history = estimate.details.get("recursive", {}).get("history")
    if history is None:
        return None
    free = estimate.machine.parameters.free
    value, std = (np.stack([history[k][f.name] for f in free], axis=1) for k in ("value", "std"))
    return HistoryView(
        history["time"], [f.name for f in free], [f.unit for f in free], value, std, history["residual"]
    )


def _judged(result: Identification | Discovery) -> dict:
    judgement = result.judgement
    return {
        "findings": judgement.findings,
        "model_complete": judgement.model_complete,
        "explains": judgement.explains,
        "identified": judgement.identified,
        "drifted": judgement.drifted,
    }


def _common(result: Identification | Discovery, notes: Sequence[str], command: str) -> dict:
    session, estimate = result.session, result.estimate
    incomplete = result.model_complete is False
    drives = "directions" in estimate.details
    shown = _views(session, _gaps_before(result), result.gaps, drives=drives)
    joints = int(np.sum(session.fit.log.measured))
    return {
        "case_name": session.case.name,
        "log_name": ", ".join(dict.fromkeys(Path(run.log.source).name for run in session.fits)),
        "parameters": _rows(session, estimate, incomplete=incomplete),
        "precision": precision_content(estimate),
        "derived": _derived(session, estimate),
        "units": units_of(session),
        "notes": tuple(notes),
        "versions": results.versions(),
        "views": shown,
        "facts": run_facts(result, command),
        "chain": drive_chain(session, estimate.machine),
        "poses": poses_of(session, session.fit, result.gaps[0]),
        "friction": friction_views(session, estimate, shown[:joints], incomplete=incomplete),
    }


def _described(effects: Sequence[Mapping[str, Any]], result: Discovery) -> list[dict[str, Any]]:
    """Return the found effects with the docstrings of their classes, which describe those of the user."""
    docs = {e.kind: type(e).__doc__ or "" for e in result.after.machine.plant.effects}
    return [{**effect, "doc": docs.get(effect["kind"], "")} for effect in effects]


def units_of(session: Session) -> dict[str, str]:
    """Return the labels of position, velocity, force and time, of all joints."""
    unit = session.machine.unit_by_joint
    return {
        "position": joined(unit("position")),
        "velocity": joined(unit("position/time")),
        "force": joined(unit("force")),
        "time": "s",
    }


def _units_at(session: Session, joint: int) -> dict[str, str]:
    """Return the labels of position, velocity and force at a joint."""
    unit = session.machine.unit
    return {
        "position": unit("position", joint),
        "velocity": unit("position/time", joint),
        "force": unit("force", joint),
    }


def _rows(session: Session, estimate: Estimate, *, incomplete: bool) -> tuple[ParameterRow, ...]:
    """Return the parameters; of an incomplete model with the deviations that hold for it."""
    beside, of_file = estimate.std_misspecified if incomplete else None, values_of_file(session)
    out = []
    for k, f in enumerate(estimate.machine.parameters.free):
        ok = bool(estimate.identifiable[k])
        value, std = (float(x[k]) if ok else None for x in (estimate.theta, estimate.std))
        more = None if beside is None or not ok or not np.isfinite(beside[k]) else float(beside[k])
        out.append(ParameterRow(f.name, value, std, f.unit, ok, more, of_file.get(f.name)))
    return tuple(out)


def _derived(session: Session, estimate: Estimate) -> tuple[ParameterRow, ...]:
    """Return the quantities derived from the parameters."""
    known = [d for d in results.derived(session, estimate) if np.isfinite(d.std)]
    return tuple(ParameterRow(d.name, d.value, d.std, d.unit) for d in known)


def _views(
    session: Session, before: Sequence[Gap] | None, after: Sequence[Gap], drives: bool = False
) -> tuple[LogView, ...]:
    """Return the logs by joint; with `drives` also the commands of their loops."""
    earlier = before or [None] * len(after)
    joints = np.flatnonzero(session.fit.log.measured).tolist()
    driven = _driven if drives else lambda *of: {}
    return tuple(
        replace(
            _view(run, old, new, joint, len(joints)),
            units=_units_at(session, joint),
            **driven(session, run, new, joint),
        )
        for run, old, new in zip(session.runs, earlier, after, strict=True)
        for joint in joints
    )


def _driven(session: Session, run: OpenedLog, gap: Gap, joint: int) -> dict[str, np.ndarray]:
    """Return the declared force of a joint's drive, logged and simulated; empty if either is missing."""
    gain = session.machine.gain
    drive = session.machine.plant.drive_of(joint, gain.size)
    if drive is None or gap.simulation is None or gap.simulation.command is None:
        return {}
    both = {"drive_measured": run.log.force, "drive_simulated": gap.simulation.command}
    return {name: (command * gain)[:, drive] for name, command in both.items()}


def _view(run: OpenedLog, before: Gap | None, after: Gap, joint: int, joints: int) -> LogView:
    data, log = run.data, run.log
    # Without a force in the log there is nothing to draw of forces.
    rows = data.moving[:, joint] & bool(np.isfinite(after.force.rms[joint]))
    name = run.name if joints == 1 else f"{run.name}, joint {joint + 1}"

    def simulated(gap: Gap | None) -> np.ndarray | None:
        return None if gap is None or gap.simulation is None else gap.simulation.position[:, joint]

    return LogView(
        name=name,
        joint=joint,
        time=log.time,
        position_measured=log.position[:, joint],
        position_simulated_before=simulated(before),
        position_simulated_after=simulated(after),
        band_time=log.time[data.kept][rows],
        velocity=data.at_kept(data.qd)[rows, joint],
        position=data.at_kept(data.q)[rows, joint],
        force_measured=after.force.measured[rows, joint],
        residual_before=None if before is None else before.force.residual[rows, joint],
        residual_after=after.force.residual[rows, joint],
        steady=log.steady is not None,
    )


def search_step(r: Round) -> SearchStep:
    """Return one step of a search as it is drawn."""
    step = r.step
    fit, validation = (
        (r.fit, r.validation) if r.position_fit is None else (r.position_fit, r.position_validation)
    )
    added = step.added.candidate if step.added else None
    return SearchStep(
        added=added.label if added else None,
        dropped=step.dropped.label if step.dropped else None,
        gap_fit=float(np.max(fit)),
        gap_validation=None if validation is None else float(np.max(validation)),
        candidates=tuple(
            CandidateScore(s.candidate.label, s.evidence, s.candidate is added) for s in step.scores
        ),
        threshold=step.threshold,
    )


def _experiment(proposal: Proposal, session: Session) -> ExperimentView:
    machine, limits = session.machine, proposal.limits
    joints = machine.plant.driven(machine.plant.joints)
    loop = proposal.signal == "reference"
    driven = machine.plant.at_drives
    # A command has no known unit if a gain turns it into a force.
    is_force = np.all(machine.gain == 1.0)
    signal_unit = joined(machine.unit_by_joint("position" if loop else "force", joints))
    ends = (driven(limits.low), driven(limits.high)) if loop else (-limits.force, limits.force)
    return ExperimentView(
        text=sentence(proposal, machine),
        signal=proposal.signal,
        unit=signal_unit if loop or is_force else "command",
        time=proposal.time,
        values=proposal.values if proposal.separates else None,
        limits=np.stack(ends, axis=1),
        speed=np.asarray(driven(limits.speed)) if loop else None,
    )


def where_plot(result: Identification | Discovery) -> WherePlot | None:
    """Return the bins of the residual's mean; None if nothing is missing or nothing was searched."""
    w = getattr(result, "where", None)
    if w is None:
        return None
    unit = {
        "velocity": "position/time",
        "position": "position",
        "acceleration": "position/time2",
        "force": "force",
    }.get(w.variable, "position" if w.variable.startswith("elongation") else "time")
    label = result.session.machine.unit(unit, w.joint - 1)
    return WherePlot(w.variable, label, w.x, w.mean, w.low, w.high)
