"""The noise part of `wi_mimo_coulomb.py`: what the paper leaves out."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

import jaxid
from experiments import wi_figures
from experiments.common import Table
from experiments.wi_cases import FIRST, noisy
from experiments.wi_loop import driven, true_values
from jaxid.estimators import METHODS
from truth.chain.six_masses import KINDS

FORMS = [name for name in METHODS if name.startswith("algebraic")]
RUNS, EXACT_RUNS = 1000, 30
# Standard deviations of the readings [m].
LEVELS = [1e-9, 1e-8, 1e-7, 1e-6, 1e-5]
# Of 30 runs a standard deviation is known to 13 %, its median over a kind hardly better.
ALIKE = 1.4


def noise(folder: Path, runs: int = RUNS, exact_runs: int = EXACT_RUNS) -> bool:
    """Compare every form, inverse dynamics and output error against noise, by a study.

    The study's logs come from jaxid's own simulator. What it says of `algebraic` is held against fewer
    logs of the exact one, with noise in the loop too.
    """
    begin, rows = time.perf_counter(), _study(folder, runs)
    table = Table(
        "RMS error, median over the parameters of a kind [%]; failed [%]",
        ["method", "noise [m]", *KINDS, "failed"],
    )
    methods: dict[str, list[dict]] = {}
    for row in rows:
        methods.setdefault(row["estimator"], []).append(row)
    lines = {"Cramer-Rao": {(k, "spread"): _over_noise(rows, k, "bound") for k in KINDS}}
    for name, own in methods.items():
        cells = {k: _over_noise(own, k, "rmse") for k in KINDS}
        for i, level in enumerate(LEVELS):
            failed = np.mean([1 - r["used"] / r["runs"] for r in own if r["noise"] == level])
            table.row(name, f"{level:g}", *(f"{cells[k][i]:.2g}" for k in KINDS), f"{100 * failed:.0f}")
        # What fails in most runs has no line.
        if np.mean([1 - r["used"] / r["runs"] for r in own]) < 0.5:
            lines[name] = {(k, w): _over_noise(own, k, w) for k in KINDS for w in ("spread", "bias")}
    table.show(time.perf_counter() - begin)
    begin, exact = time.perf_counter(), _exact(folder, exact_runs)
    crosses = {k: _over_noise(exact, k, "spread") for k in KINDS}
    wi_figures.noise(folder / "noise.png", lines, LEVELS, crosses)
    good = _compared(methods["algebraic"], exact)
    print(f"{exact_runs} runs a level of the exact simulator, {time.perf_counter() - begin:.0f} s")
    return good


def _study(folder: Path, runs: int) -> list[dict]:
    """Rows of the study's summary, `noise` in metres."""
    names = ", ".join(f'"{m}"' for m in (*FORMS, "inverse_dynamics", "output_error"))
    factors = ", ".join(f"{level / LEVELS[0]:g}" for level in LEVELS)
    case = noisy(folder, "noise", LEVELS[0], f"\n[study]\nestimators = [{names}]\nnoise = [{factors}]\n")
    out = folder / "noise"
    found = jaxid.study(case, runs=runs, folder=out, resume=(out / "study.json").exists())
    by_factor = {round(level / LEVELS[0]): level for level in LEVELS}
    return [r | {"noise": by_factor[round(r["noise"])]} for r in found.summary]


def _over_noise(rows: list[dict], kind: str, what: str) -> list[float]:
    """At every level."""
    return [_median([r for r in rows if r["noise"] == level], kind, what) for level in LEVELS]


def _median(rows: list[dict], kind: str, what: str) -> float:
    """Over the parameters of a kind [% of true]."""
    own = [100 * abs(r[what] / r["true"]) for r in rows if r["parameter"].startswith(kind)]
    return float(np.median(own)) if own else np.nan


def _exact(folder: Path, runs: int) -> list[dict]:
    """Return rows as those of a study, of `algebraic` on logs of the exact simulator.

    Each run is simulated anew: its noise goes through the controller and changes the motion.
    """
    rows = []
    for level in LEVELS:
        case = noisy(folder, f"exact_{level:g}", level)
        true, found = true_values(case), []
        for seed in range(runs):
            log = driven(case, FIRST, noise=level, seed=seed).log
            estimate = jaxid.identify(case, log, method="algebraic").estimate
            found.append(np.where(estimate.identifiable, estimate.theta, np.nan))
        error = np.stack(found) - np.array(list(true.values()))
        used = np.isfinite(error).sum(axis=0)
        spread = np.nanstd(error, axis=0, ddof=1)
        bias, bias_std = np.nanmean(error, axis=0), spread / np.sqrt(used)
        columns = zip(true, true.values(), bias, bias_std, spread, 1 - used / runs, strict=True)
        names = "parameter", "true", "bias", "bias_std", "spread", "failed"
        rows += [{"noise": level} | dict(zip(names, column, strict=True)) for column in columns]
    return rows


def _compared(study: list[dict], exact: list[dict]) -> bool:
    """Check that both agree on `algebraic`: in spread, and in bias as far as their runs determine it."""
    head = ["noise [m]", "parameter", "spread, study", "exact", "bias, study", "exact", "its deviation"]
    table = Table("`algebraic` on logs of jaxid's own simulator (study) and of the exact one [%]", head)
    good = True
    for level in LEVELS:
        one, other = ([r for r in rows if r["noise"] == level] for rows in (study, exact))
        for kind in KINDS:
            spreads = [_median(rows, kind, "spread") for rows in (one, other)]
            biases = [_median(rows, kind, "bias") for rows in (one, other)]
            shown = [*spreads, *biases, _median(other, kind, "bias_std")]
            table.row(f"{level:g}", kind, *(f"{x:.2g}" for x in shown))
            good &= 1 / ALIKE < spreads[1] / spreads[0] < ALIKE
        off = [
            abs(a["bias"] - b["bias"]) / np.hypot(a["bias_std"], b["bias_std"])
            for a, b in zip(one, other, strict=True)
        ]
        table.row(f"{level:g}", "biases apart, in deviations: largest", *[""] * 4, f"{max(off):.1f}")
    table.show(0.0)
    print(f"spreads within a factor {ALIKE} of each other: {'yes' if good else 'NO'}")
    return good
