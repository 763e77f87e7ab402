"""One hidden case through jaxid: its result, and the gap that the true machine closes."""

import math
import time
from pathlib import Path

import numpy as np

import jaxid
from jaxid.gap import Gap, force_gap
from jaxid.logs.log import Log
from truth.axis.cases import recorded, write_case
from truth.hidden.bench import Case, known_text, oracle, text_of
from truth.hidden.cases import HiddenCase

Record = dict


def run_case(case: Case, folder: Path, *, refit: bool = False) -> Record:
    """Search one case, and return the oracle's evidence with the result, for JSON.

    Args:
        case: The case.
        folder: Folder in which its files are written.
        refit: Whether the models are refitted in simulation, as the command does.
    """
    record = {
        "id": case.id, "group": case.group, "what": case.what, "scale": case.scale,
        "noise": case.noise, "seed": case.seed, "rate": case.rate, "hidden": list(case.names),
        "declared": list(case.declared), "true": case.values,
        "oracle": oracle(case),
    }  # fmt: skip
    try:
        return record | _searched(case, folder, refit)
    except jaxid.InputError as error:
        return record | {"verdict": "refused", "named": [], "error": str(error)}
    except Exception as error:  # the bench must survive it; it counts as wrong
        return record | {"verdict": "crashed", "named": [], "error": repr(error)}


def _searched(case: Case, folder: Path, refit: bool) -> Record:
    logs = [logged(case, validation=v) for v in ((False, True) if case.validated else (False,))]
    path = write_case(folder, text_of(case))
    begin, busy = time.perf_counter(), time.process_time()
    d = jaxid.discover(path, logs[0], validate=logs[1:], refit=refit)
    seconds, busy = time.perf_counter() - begin, time.process_time() - busy
    return {
        "verdict": d.verdict, "named": [e.label for e in d.effects],
        "seconds": seconds, "cpu_seconds": busy,
        "samples": logs[0].samples, "refit": refit, "method": d.after.method,
        "evidence": [_number(e.score.total) for e in d.effects],
        "alternatives": [[s.candidate.label for s in e.alternatives] for e in d.effects],
        "parameters": _parameters(case, d),
        "gap": {
            "before": [float(g.force.rms[0]) for g in d.gaps_before],
            "after": [float(g.force.rms[0]) for g in d.gaps_after],
            "floor": float(d.noise_floor[0]),
            "truth": truth_gap(case, folder, logs) if case.hidden else None,
        },
        "simulated": {
            "before": [_simulated(g) for g in d.gaps_before],
            "after": [_simulated(g) for g in d.gaps_after],
        },
        "where": None if d.where is None else {
            "text": d.where.text, "variable": d.where.variable,
            "intervals": [list(i) for i in d.where.intervals],
            "frequency_hz": d.where.frequency_hz,
        },
        "outside": _outside(case),
    }  # fmt: skip


def logged(case: Case, *, validation: bool = False) -> Log:
    """Return the log of a run, with the columns of a user."""
    if isinstance(case, HiddenCase):
        return Log(**recorded(case.setup(validation=validation)))
    run, driven = case.run(validation=validation), case.machine.driven
    reference = run["reference"][:, driven]
    return Log(run["t"], run["position"], run["force"], reference=reference, source="chain.csv")


def truth_gap(case: Case, folder: Path, logs: list) -> list[float]:
    """Return the RMS force residual of the true machine [N], prepared by jaxid, by log."""
    path = Path(folder) / "truth.toml"
    path.write_text(known_text(case))
    session = jaxid.open_session(path, logs[0], logs[1:], align_hold=True)
    return [float(force_gap(r.machine(session.machine), r.data).rms[0]) for r in session.runs]


def _parameters(case: Case, d: object) -> dict[str, list]:
    """Return name -> true value, estimate, standard deviation; null where it is not identifiable."""
    names = d.after.machine.parameters.names
    out = {}
    for name, value, std in zip(names, d.after.theta, d.after.precision.std, strict=True):
        true = case.truth.get(name)
        if name.endswith(".phase") and true is not None:
            turns = round((float(value) - true) / (2 * math.pi))
            value = float(value) - 2 * math.pi * turns
        out[name] = [true, _number(value), _number(std)]
    return out


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _outside(case: Case) -> dict | None:
    if case.group != "outside":
        return None
    machine = case.setup().machine
    return {"bursts": [list(b) for b in machine.bursts], "clock": list(machine.clock_force)}


def _simulated(gap: Gap) -> list[list[float]] | None:
    """Return the relative gap in simulation of position and, in a loop, of command; null if it diverged."""
    s = gap.simulation
    if s is None:
        return None
    parts = [s.relative] if s.command_relative is None else [s.relative, s.command_relative]
    return [[float(x) for x in p] for p in parts]
