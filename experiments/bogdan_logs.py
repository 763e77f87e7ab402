"""Logs, cases and judged fits of the micropositioning stage, for its studies."""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

import jaxid
from jaxid.commands.identify import identify_many
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.within_prior.evaluations import criterion_steps
from jaxid.estimators.within_prior.prior import Prior
from jaxid.logs.log import Log
from jaxid.numerics.lanes import cores, run_alone, run_batched
from jaxid.session import open_session
from truth.chain import stages

PRIOR = 0.5
ON_FORCE = f'[output_error]\non = "force"\nprior = {PRIOR}\n'


def noise_of(data: int, resolution: float) -> float:
    """Noise on the current [A] that, beside what rounding does, puts the criterion at the published one."""
    reference = stages.move(0.5, **stages.MOVES[data])
    stage = stages.machine(data, rigid=True)
    fine = stages.record(stage, reference, resolution=0.0)["true_i"]
    starts = np.random.default_rng(0).uniform(-0.5, 0.5, 20) * resolution
    off = [stages.record(stage, reference, resolution=resolution, start=s)["true_i"] - fine for s in starts]
    wanted = stages.CRITERION[data] / 100 * np.var(fine)
    return float(np.sqrt(max(wanted - np.mean(np.square(off)), 0.1 * wanted)))


def logs_of(
    data: int,
    runs: int,
    *,
    rigid: bool = True,
    resolution: float = stages.COUNT,
    noise: float | None = None,
    reference: np.ndarray | None = None,
    truths: Sequence[Mapping[str, float]] = (),
) -> tuple[list[Log], np.ndarray]:
    """Logs that differ in noise, and in where within its first count the motor stood: that too [rad].

    Of the published move, or of another reference, where that begins; of the published stage, or each of its
    own `truths`.
    """
    reference = stages.move(0.5, **stages.MOVES[data]) if reference is None else reference
    noise = noise_of(data, resolution) if noise is None else noise
    rng = np.random.default_rng(1)
    out, starts = [], rng.uniform(-0.5, 0.5, runs) * resolution
    first = np.round(reference[0] / resolution) * resolution if resolution else reference[0]
    for k in range(runs):
        stage = stages.machine(data, rigid=rigid, **(truths[k] if truths else {}))
        made = stages.record(
            stage,
            reference,
            noise=noise,
            resolution=resolution,
            seed=k,
            step=5e-6 if rigid else 2e-6,
            start=first + starts[k],
        )
        out.append(
            Log(
                time=made["t"],
                position=made["q"][:, None],
                force=made["i"][:, None],
                reference=reference[:, None],
                source=f"run {k} of data {data}",
            )
        )
    return out, starts


def _ordered(true: Mapping[str, float], names: Sequence[str]) -> np.ndarray:
    """Return the true values in the order of some unknowns."""
    return np.array([true[n] for n in names])


def off_in_sigma(
    estimate: Estimate, case: Path, log: Log, start: float, true: Mapping[str, float]
) -> np.ndarray:
    """Return how far each direction is from the truth, in its standard deviations, the start included."""
    machine = open_session(case, log).machine
    w = Prior.of(machine, PRIOR, np.zeros(0)).inward(_ordered(true, estimate.names))
    truth = dict(zip(estimate.names, w, strict=True))
    if start:
        truth["start position 1"] = start / float(np.max(machine.sensor.position_std))
    directions = estimate.details["directions"]
    at = [sum(v * truth.get(n, 0.0) for n, v in d["combination"].items()) for d in directions]
    return np.array([(d["value"] - t) / d["std"] for d, t in zip(directions, at, strict=True)])


def case_of(
    folder: Path,
    name: str,
    data: int,
    *,
    guess: int | None = None,
    believed: bool = False,
    more: str = ON_FORCE,
    **stated: Any,
) -> Path:
    """Write a case file; guesses are the truth, drawn up to 50 % around it, or as the prior says."""
    draw = stages.believed if believed else stages.drawn
    drawn = None if guess is None else draw(guess, PRIOR, data)
    path = folder / f"{name}.toml"
    path.write_text(stages.text(data, guess=drawn, more=more, **stated))
    return path


def studied(
    cases: Path | Sequence[Path],
    logs: Sequence[Log],
    starts: np.ndarray,
    true: Mapping[str, float] | Sequence[Mapping[str, float]],
    on: str = "force",
) -> tuple[list[Estimate], list[dict[str, Any]]]:
    """Estimates, and what `judged` says of each, of logs that are not refused; `true` of all or of each."""
    cases = [cases] * len(logs) if isinstance(cases, Path) else cases
    true = [true] * len(logs) if isinstance(true, Mapping) else true
    found = zip(identify_many(cases, logs), cases, logs, starts, true, strict=True)
    kept = []
    for estimate, *of in found:
        if isinstance(estimate, Estimate):
            kept.append((estimate, *of))
        elif not isinstance(estimate, jaxid.InputError):
            raise estimate
    machine = open_session(*kept[0][1:3]).machine
    opened = [open_session(case, log).fit.log for _, case, log, *_ in kept]
    theta = [_ordered(own, machine.parameters.names) for *_, own in kept]
    steps = [criterion_steps(machine, log, t, on=on) for log, t in zip(opened, theta, strict=True)]
    at = run_batched(steps, 16)
    return [e for e, *_ in kept], [judged(*of, c) for of, c in zip(kept, at, strict=True)]


def judged(
    estimate: Estimate, case: Path, log: Log, start: float, true: Mapping[str, float], percent: float
) -> dict[str, Any]:
    """Return the facts of a fit: its criterion over that of the truth, its directions off in sigma.

    `percent`: the criterion of the truth. "nats": by how much the truth is less probable than what was found,
    the guesses counted in; of exact encoders, for it leaves the motor's start out.
    """
    found = estimate.details["criterion_percent"]
    prior = Prior.of(open_session(case, log).machine, PRIOR, np.zeros(0))
    far, near = (prior.inward(theta) for theta in (_ordered(true, estimate.names), estimate.theta))
    freedom = log.samples - len(estimate.details["directions"])
    return {
        "converged": bool(estimate.converged),
        "percent": found,
        "ratio": found / percent,
        "effective": estimate.details["effective_parameters"],
        "nats": float(0.5 * (freedom * (percent / found - 1) + far @ far - near @ near)),
        "off": off_in_sigma(estimate, case, log, start, true).tolist(),
    }


def apart(
    file: Path,
    cases: Sequence[Path],
    logs: Sequence[Log],
    starts: np.ndarray,
    truths: Sequence[Mapping[str, float]],
) -> list[dict[str, Any]]:
    """Fit each log by itself, one to a core at a time: of many steps each, they are slower side by side.

    Each is a line of a file as soon as it ends, and those that the file has are not run again.
    """
    # A run that was killed may have left half a line.
    whole = file.read_text().split("\n")[:-1] if file.exists() else []
    file.write_text("".join(f"{line}\n" for line in whole))
    known = [json.loads(line) for line in whole]
    done = {row["run"] for row in known}
    wanted = [k for k in range(len(cases)) if k not in done]
    # A thread each: theirs would wait for one another.
    for library in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(library, "1")
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(cores(), spawn) as pool, file.open("a") as out:
        asked = [pool.submit(_fitted, k, cases[k], logs[k], starts[k], truths[k]) for k in wanted]
        for ended in tqdm(as_completed(asked), "fits", len(cases), initial=len(done)):
            known.append(ended.result())
            out.write(json.dumps(known[-1]) + "\n")
            out.flush()
    return sorted((row for row in known if row["run"] < len(cases)), key=lambda row: row["run"])


def _fitted(run: int, case: Path, log: Log, start: float, true: Mapping[str, float]) -> dict[str, Any]:
    """Fit one log by itself, but not by `identify`, whose gaps are compiled anew for each log."""
    (estimate,) = identify_many(case, [log], lanes=1)
    if isinstance(estimate, jaxid.InputError):
        return {"run": run, "refused": str(estimate)}
    if isinstance(estimate, Exception):
        raise estimate
    opened = open_session(case, log)
    truth = _ordered(true, opened.machine.parameters.names)
    at = run_alone(criterion_steps(opened.machine, opened.fit.log, truth, on="force"))
    return {"run": run, **judged(estimate, case, log, start, true, at)}
