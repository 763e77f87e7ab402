"""Results as JSON, and the files that commands write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxid.files import found_case_file, json_text, signal_csv, write_results
from jaxid.model.unknowns import in_loop, leaf, several_places
from jaxid.results.by_joint import joints_json
from jaxid.results.found_case import case_text, changed_in_python
from jaxid.results.model_json import joint_name, model_json
from jaxid.results.parameters import Covariance
from jaxid.results.proposals import proposal_json
from jaxid.results.verdict.robot_file import values_of_file

if TYPE_CHECKING:
    from jaxid.commands.identify import Identification
    from jaxid.discovery.candidates import Candidate
    from jaxid.discovery.result import Discovery, NamedEffect
    from jaxid.discovery.score import Score
    from jaxid.estimators.common.derived import Derived
    from jaxid.estimators.estimate import Estimate
    from jaxid.gap import Gap
    from jaxid.model.plant import Plant
    from jaxid.model.unknowns import Free
    from jaxid.results.result import FitResult
    from jaxid.session import Session
from jaxid.simulation.sensor_noise import position_noise


def parameters_json(
    estimate: Estimate,
    names: Sequence[str] | None = None,
    *,
    incomplete: bool = False,
    of_file: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return value, standard deviation, unit and identifiability by name, and plant lists as lists.

    Args:
        estimate: The estimate.
        names: Names of the parameters to return; None: all.
        incomplete: Whether the model is incomplete, so that the deviations that hold then stand beside.
        of_file: Values of a robot's file by name, which stand beside as `in_file`; None or empty: there are
            none.
    """
    out: dict[str, Any] = {}
    plant = estimate.machine.plant
    rows = zip(
        estimate.machine.parameters.free,
        estimate.theta,
        estimate.std,
        estimate.identifiable,
        strict=True,
    )
    known_more = {"std_misspecified": estimate.std_misspecified} if incomplete else {}
    more = {key: std for key, std in known_more.items() if std is not None}

    for k, (f, value, std, identifiable) in enumerate(rows):
        if names is not None and f.name not in names:
            continue
        if f.log is not None:
            _add_of_log(out, f, value, std, identifiable)
            continue
        entry = {
            "value": float(value) if identifiable else None,
            "std": float(std) if identifiable else None,
            "unit": f.unit,
            "identifiable": bool(identifiable),
            **{key: float(s[k]) if identifiable and np.isfinite(s[k]) else None for key, s in more.items()},
            **({"in_file": of_file[f.name]} if of_file and f.name in of_file else {}),
        }
        if f.index is None or in_loop(f.path):
            out[f.name] = entry
            continue
        listed = out.setdefault(_key(f), _known(np.asarray(leaf(plant, f.path)), f.unit))
        beside = [key for key in entry if key in (*more, "in_file")]
        for key in beside:
            listed.setdefault(key, np.full(np.shape(listed["value"]), None).tolist())
        for key in ("value", "std", "identifiable", *beside):
            *row, at = np.atleast_1d(f.index)
            (listed[key][row[0]] if row else listed[key])[at] = entry[key]
    return out


def _parameters_json(result: FitResult) -> dict[str, Any]:
    """Return all parameters of a result, with the values of the robot's file beside them."""
    incomplete = result.model_complete is False
    return parameters_json(result.estimate, incomplete=incomplete, of_file=values_of_file(result.session))


def _add_of_log(out: dict[str, Any], f: Free, value: float, std: float, identifiable: bool) -> None:
    """Add the value of an unknown in one log to its entry."""
    entry = out.setdefault(
        f.parameter, {"value": None, "std": None, "unit": f.unit, "identifiable": True, "by_log": {}}
    )
    entry["identifiable"] = bool(entry["identifiable"] and identifiable)
    entry["by_log"][f.log] = {
        "value": float(value) if identifiable else None,
        "std": float(std) if identifiable else None,
        "identifiable": bool(identifiable),
    }


def _key(f: Free) -> str:
    """Return the key of an unknown in results: its name, or that of the plant's list in which it is."""
    return f.name if f.index is None or in_loop(f.path) else str(f.path[0])


def _known(values: np.ndarray, unit: str) -> dict[str, Any]:
    """Return the entry of a plant's list before its unknown elements are filled in."""
    known = np.asarray(values, float)
    std, identifiable = np.full(known.shape, None), np.full(known.shape, True)
    return {"value": known.tolist(), "std": std.tolist(), "unit": unit, "identifiable": identifiable.tolist()}


def one_or_list(x: np.ndarray | None) -> Any:
    """Return a number for one joint, a list for several."""
    if x is None:
        return None
    x = np.atleast_1d(x)
    return float(x[0]) if x.size == 1 else [float(v) for v in x]


def _worst(gaps: Sequence[Gap], pick: str) -> Any:
    values = [_pick(g, pick) for g in gaps]
    values = [v for v in values if v is not None]
    return one_or_list(np.max(values, axis=0)) if values else None


def _pick(gap: Gap, what: str) -> np.ndarray | None:
    domain, _, field = what.partition(".")
    part = gap.force if domain == "force" else gap.simulation
    return None if part is None else getattr(part, field)


def gap_json(session: Session, gaps: Sequence[Gap], floor: np.ndarray) -> dict[str, Any]:
    """Return the object `gap` of result.json.

    Of several fitted logs `fit` holds the worst, and `fits` each by its name.
    """
    fitted, others = gaps[: len(session.fits)], gaps[len(session.fits) :]
    unit, measured = session.machine.unit_by_joint, np.flatnonzero(session.fit.log.measured).tolist()

    out: dict[str, Any] = {
        "unit": unit("force"),
        "band_hz": _band(session),
        "fit": _worst(fitted, "force.rms"),
        "validation": _worst(others, "force.rms"),
        "noise_floor": one_or_list(floor),
        "relative": {
            "fit": _worst(fitted, "force.relative"),
            "validation": _worst(others, "force.relative"),
        },
        "simulation": {
            "unit": unit("position", None if len(measured) > 1 else measured),
            "fit": _worst(fitted, "simulation.rms"),
            "validation": _worst(others, "simulation.rms"),
            "relative": {
                "fit": _worst(fitted, "simulation.relative"),
                "validation": _worst(others, "simulation.relative"),
            },
            "command_relative": {
                "fit": _worst(fitted, "simulation.command_relative"),
                "validation": _worst(others, "simulation.command_relative"),
            },
        },
    }

    out["simulation"] |= _position_floor(session)
    if len(fitted) > 1:
        out["fits"] = {g.name: _of_one(g) for g in fitted}
    if len(others) > 1:
        out["validations"] = {g.name: _of_one(g) for g in others}
    return out


def _position_floor(session: Session) -> dict[str, Any]:
    """Return the noise of the positions that a log without a force is judged by; empty for other logs."""
    log = session.fit.log
    if not session.machine.unforced(log):
        return {}
    floor = position_noise(session.machine, log)[list(log.measured)]
    return {"noise_floor": one_or_list(floor)}


def _band(session: Session) -> float | None:
    """Return the edge of the band in which forces are compared [Hz]; None if there are none, or no time."""
    log = session.fit.log
    if log.steady is not None or session.machine.unforced(log):
        return None
    return session.recipe.band_hz(log.rate_hz)


def _of_one(gap: Gap) -> dict[str, Any]:
    """Return the gap of one of several logs."""
    return {
        "force": one_or_list(gap.force.rms),
        "relative": one_or_list(gap.force.relative),
        "simulation": one_or_list(_pick(gap, "simulation.rms")),
        "simulation_relative": one_or_list(_pick(gap, "simulation.relative")),
    }


def versions() -> dict[str, str]:
    """Return the versions of the packages on which the numbers depend."""
    return {name: version(name) for name in ("jaxid", "jax", "diffrax", "numpy")}


def covariance_of(estimate: Estimate) -> Covariance:
    """Return the covariance of an estimate's parameters."""
    precision = estimate.precision
    return Covariance(tuple(estimate.names), precision.covariance, precision.kind)


def derived(session: Session, estimate: Estimate) -> list[Derived]:
    """Return the natural frequency, and friction in its other form if the case states gravity."""
    from jaxid.estimators.common.derived import dry_friction, natural_frequency

    friction = [] if session.case.plant.gravity is None else dry_friction(estimate)
    return [*natural_frequency(estimate), *friction]


def derived_json(session: Session, estimate: Estimate) -> dict[str, Any]:
    """Return the object `derived` of results, with its key; empty if nothing is derived."""
    known = [d for d in derived(session, estimate) if np.isfinite(d.std)]
    entries = {d.name: {"value": d.value, "std": d.std, "unit": d.unit} for d in known}
    return {"derived": entries} if entries else {}


def judgement_json(result: FitResult) -> dict[str, Any]:
    """Return the verdict on the model, with its reasons, as keys of result.json and discovery.json."""
    judgement = result.judgement
    return {
        "model_complete": judgement.model_complete,
        "explains_log": judgement.explains,
        "findings": list(judgement.findings),
    }


def identification_json(result: Identification) -> dict[str, Any]:
    """Return the content of result.json."""
    estimate = result.estimate
    return {
        "method": estimate.method,
        "converged": estimate.converged,
        "message": estimate.message,
        **judgement_json(result),
        "samples": estimate.samples,
        "parameters": _parameters_json(result),
        **derived_json(result.session, estimate),
        "covariance": covariance_of(estimate).json(),
        "unidentifiable": [{"combination": c} for c in estimate.precision.unidentifiable],
        **estimate.details,
        "settings": result.settings,
        **model_json(result.session, estimate),
        "gap": gap_json(result.session, result.gaps, result.noise_floor),
        "preprocess": recipe_json(result.session),
        "versions": versions(),
        "notes": notes(result.session, estimate),
    }


def readings_json(session: Session) -> dict[str, Any]:
    """Return how each log was read, under `logs`; empty if nothing was assumed."""
    logs = {run.name: [a.json() for a in run.log.assumed] for run in session.runs if run.log.assumed}
    return {"logs": logs} if logs else {}


def reading_lines(session: Session) -> list[str]:
    """Return a line for everything that was assumed to read each log."""
    named = len(session.runs) > 1
    return [
        f"log{' ' + run.name if named else ''}: {assumed}"
        for run in session.runs
        for assumed in run.log.assumed
    ]


def recipe_json(session: Session) -> dict[str, Any]:
    """Return the settings of the filter, chosen or stated."""
    r = session.recipe
    stated = {"median": r.median} if r.median else {}
    if r.derivatives == "parabolic":
        stated["reach"] = r.reach
    return {
        "cutoff_hz": r.cutoff_hz,
        "order": r.order,
        "decimation": r.decimation,
        "trim": r.trim,
        "rest_velocity": list(r.rest_velocity),
        "align_hold": r.align_hold,
        "derivatives": r.derivatives,
        **stated,
    }


def notes(session: Session, estimate: Estimate) -> list[str]:
    """Return the warnings on the logs, and remarks on the fit."""
    warnings = [f"{f.where}: {f.what}; {f.hint}" for f in session.findings]
    return [*warnings, *estimate.notes]


def effect_json(effect: NamedEffect, estimate: Estimate, names: Sequence[str] = ()) -> dict[str, Any]:
    """Return one entry of `effects` in discovery.json; names are those of the joints, if a file has them."""
    parameters = parameters_json(estimate, effect.names)
    fields = {f.name: str(f.path[-1]) for f in estimate.machine.parameters.free}
    return {
        "kind": effect.kind,
        effect.place[0]: effect.place[1],
        **joint_name(effect.place, names),
        "parameters": {fields[name]: entry for name, entry in parameters.items()},
        "evidence": effect.score.evidence,
        "alternatives": [_alternative(s, estimate.machine.plant) for s in effect.alternatives],
    }


def _alternative(score: Score, plant: Plant) -> dict[str, Any]:
    c = score.candidate
    return {"kind": c.kind, **_place(c, plant), "evidence": score.evidence}


def _place(c: Candidate, plant: Plant) -> dict[str, int]:
    """Return the joint or spring of a candidate, if the machine has several."""
    return dict([plant.place(c.port)]) if several_places(plant) else {}


def where_json(result: Discovery) -> dict[str, Any] | None:
    """Return the object `where` of discovery.json."""
    w = result.where
    if w is None:
        return None
    return {
        "joint": w.joint,
        **joint_name(("joint", w.joint), result.session.case.plant.names),
        "variable": w.variable,
        "region": list(w.region),
        "intervals": [list(i) for i in w.intervals],
        "text": w.text,
        "frequency_hz": w.frequency_hz,
        "periods": list(w.periods),
    }


def discovery_json(result: Discovery) -> dict[str, Any]:
    """Return the content of discovery.json."""
    declared = {_key(f) for f in result.session.machine.parameters.free}
    before, after = result.gaps_before, result.gaps_after
    fits = len(result.session.fits)
    on = "validation" if len(after) > fits else "fit"
    judged = slice(fits, None) if len(after) > fits else slice(0, fits)
    machine = result.session.machine
    measured = np.flatnonzero(result.session.fit.log.measured).tolist()
    motion = {
        "unit": machine.unit_by_joint("position", None if len(measured) > 1 else measured),
        "before": _worst(before[judged], "simulation.rms"),
        "after": _worst(after[judged], "simulation.rms"),
        **_position_floor(result.session),
    }

    return {
        "verdict": result.verdict,
        "converged": result.converged,
        **judgement_json(result),
        "where": where_json(result),
        "effects": [effect_json(e, result.after, result.session.case.plant.names) for e in result.effects],
        **({reading.key: reading.json()} if (reading := result.force_reading) is not None else {}),
        "experiments": [proposal_json(p, machine) for p in result.proposals],
        "steps": [
            step_json(r, result.session.machine.plant)
            for k, r in enumerate(result.rounds)
            # The baseline, and the rounds that changed it; the last round mostly adds nothing.
            if k == 0 or r.step.added or r.step.dropped
        ],
        "gap": {
            "unit": machine.unit_by_joint("force"),
            "band_hz": _band(result.session),
            "before": _worst(before[judged], "force.rms"),
            "after": _worst(after[judged], "force.rms"),
            "noise_floor": one_or_list(result.noise_floor),
            "on": on,
            "relative": {
                "before": _worst(before[judged], "force.relative"),
                "after": _worst(after[judged], "force.relative"),
            },
            "simulation": motion,
        },
        **({"joints": joints_json(result, motion)} if result.joints else {}),
        "parameters": {k: v for k, v in _parameters_json(result).items() if k in declared},
        **derived_json(result.session, result.after),
        "covariance": covariance_of(result.after).json(),
        **model_json(result.session, result.after),
        "unidentifiable": [{"combination": c} for c in result.after.precision.unidentifiable],
        "fit_gap": gap_json(result.session, after, result.noise_floor),
        "method": result.after.method,
        "settings": result.settings,
        "preprocess": recipe_json(result.session),
        "versions": versions(),
        "notes": [*notes(result.session, result.after), *turned_down(result)],
    }


def turned_down(result: Discovery, most: int = 3) -> list[str]:
    """Return the reasons for removed effects, and for the best candidates that were not added."""
    if not result.rounds:
        return []
    effects = result.session.machine.plant.effects
    steps = [r.step for r in result.rounds]
    lines = [f"{s.dropped.label} was taken out again: {s.why}" for s in steps if s.dropped and s.why]
    if all(e.break_away_level is None for e in effects) and result.unseen:
        lines.append(f"break-away friction (static_friction) was not searched for: {result.unseen}")
    session = result.session
    loop = session.machine.controller is not None and session.fit.log.reference is not None
    if result.verdict == "unexplained" and loop and session.case.within_prior is None:
        # Force rows hold no sample at rest, and blur effects that depend on whether speed grows.
        lines.append(
            "effects at rest, or at constant speed, may show in the simulated loop: state `[within_prior] "
            "prior`, the relative error of the guesses, and effects are searched for there"
        )
    for own in result.joints.values() or [result]:
        lines += _refusals(own, most)
    if not session.machine.plant.designs_experiments and not result.proposals:
        tied = [e.label for e in result.effects if e.alternatives]
        missing = f"no experiment was designed to separate {', '.join(tied)} from rivals"
        lines += [f"{missing}: --experiments does, in minutes"] if tied else []
    return lines


def _refusals(result: Discovery, most: int) -> list[str]:
    """Return the reasons for the best candidates that a search did not add at its end."""
    steps = [r.step for r in result.rounds]
    last = [s for s in steps if s.added is None and s.dropped is None][-1]
    refused = [s for s in last.scores if s.reason and s.evidence > last.threshold]
    return [
        f"{s.candidate.label} was not added, at {s.evidence:.0f} nats: {s.reason}" for s in refused[:most]
    ]


def step_json(r: Any, plant: Plant) -> dict[str, Any]:
    """Return one entry of `steps`: the effect added or dropped, its place, and the gap after it."""
    step = r.step
    changed = step.added.candidate if step.added else step.dropped
    out = {
        "added": step.added.candidate.kind if step.added else None,
        **(_place(changed, plant) if changed else {}),
        "fit": one_or_list(r.fit),
        "validation": one_or_list(r.validation),
    }
    if r.position_fit is not None:
        out["simulation"] = {
            "fit": one_or_list(r.position_fit),
            "validation": one_or_list(r.position_validation),
        }
    if step.dropped is not None:
        out["dropped"] = step.dropped.kind
    return out


def save_identification(result: Identification, folder: Path, *, overwrite: bool = False) -> Path:
    """Write result.json, report.html and the curves of the report."""
    from jaxid.results.report.build import identification_data
    from jaxid.results.report.kept import drop_old_page, report_files

    files = {
        **report_files(folder, identification_data(result)),
        "result.json": json_text(identification_json(result)),
    }
    write_results(folder, files, overwrite=overwrite)
    drop_old_page(folder, "identify")
    return folder


def discovery_files(result: Discovery, folder: Path) -> list[str]:
    """Return the names of the files that `save_discovery` writes to a folder."""
    experiments = [p.file for p in result.proposals if p.separates]
    case = result.session.declared
    corrected = [] if changed_in_python(case) else [found_case_file(case.path, folder)]
    return ["discovery.json", "report.html", *corrected, *experiments]


def save_discovery(result: Discovery, folder: Path, *, overwrite: bool = False) -> Path:
    """Write discovery.json, report.html with its curves, the corrected case, and proposed experiments.

    A case that was changed in Python has no file to correct, and none is written.
    """
    from jaxid.results.report.build import discovery_data
    from jaxid.results.report.kept import drop_old_page, report_files

    files: dict[str, str | bytes] = {}
    for proposal in result.proposals:
        if proposal.separates and proposal.values is not None:
            files[proposal.file] = signal_csv(proposal.signal, proposal.time, proposal.values)
    corrected = found_case_file(result.session.declared.path, folder)
    if corrected in discovery_files(result, folder):
        files[corrected] = case_text(result, folder)
    files |= report_files(folder, discovery_data(result))
    files["discovery.json"] = json_text(discovery_json(result))
    write_results(folder, files, overwrite=overwrite)
    drop_old_page(folder, "discover")
    return folder
