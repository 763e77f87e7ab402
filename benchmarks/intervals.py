"""Share of 95 % intervals that hold the truth, by machine, loop and sensor: logs of the exact steppers.

    python -m benchmarks.intervals [--runs N] [--first SEED] [--cell NAME]... [--method M]... [-o DIR]

Truth, motion and noise are drawn anew in each run, by its seed. Runs from another first seed have a line of
their own in the table: seeds that nobody looked at while a method was written. Without --method the fit is
the one that `jaxid identify` chooses. Runs are written to DIR/intervals.jsonl as they end; a second call goes
on from there, and rewrites the table DIR/intervals.md from all of them.
"""

import argparse
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

import jaxid
from benchmarks.interval_machines import CELLS, MACHINES
from benchmarks.stored_runs import append_runs, commit_of, read_runs
from jaxid.estimators.estimate import Estimate

HERE = Path(__file__).parent / "results"
CHUNK = 10
# Guesses are half as large again as the truth, or smaller by as much.
WITHIN_PRIOR = "[within_prior]\nprior = 0.5\n"


def run_chunk(
    cell: str, method: str | None, seeds: list[int], first: int, commit: str
) -> list[dict[str, Any]]:
    """Return a record for each seed: deviations of the printed values over their std, or the failure."""
    machine, loop, sensor = cell.split("/")
    cases, logs, truths = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            text, log, true = MACHINES[machine](seed, loop, sensor)
            text += WITHIN_PRIOR if method == "within_prior" else ""
            path = Path(folder) / f"{seed}.toml"
            path.write_text(text)
            cases.append(path)
            logs.append(log)
            truths.append(true)
        begin = time.perf_counter()
        # Machines that differ share few compiled calls: run by run they take least time.
        fits = jaxid.identify_many(cases, logs, method=method, lanes=1)
        seconds = (time.perf_counter() - begin) / len(seeds)
    records = []
    for seed, fit, true in zip(seeds, fits, truths, strict=True):
        record: dict[str, Any] = {"cell": cell, "asked": method or "chosen", "seed": seed, "first": first}
        record |= {"seconds": seconds, "commit": commit}
        if isinstance(fit, Exception):
            record |= {"failed": str(fit)}
        elif not fit.converged:
            record |= {"method": fit.method, "failed": fit.message}
        else:
            columns = zip(fit.names, fit.theta, fit.std, fit.identifiable, strict=True)
            printed = {name: (value - true[name], std) for name, value, std, ok in columns if ok}
            z = {name: error / std for name, (error, std) in printed.items()}
            record |= {"method": fit.method, "z": z, "not_identifiable": len(fit.names) - len(z)}
            record["error"] = {name: error for name, (error, _) in printed.items()}
            record["chi2"] = _chi_square(fit, np.array(list(record["error"].values())))
            if "least_std" in fit.details:
                record["bound"] = fit.details["least_std"]
        records.append(record)
    return records


def _chi_square(fit: Estimate, errors: np.ndarray) -> float:
    """Return the chi-square of the errors of the printed values by their covariance."""
    printed = np.flatnonzero(fit.identifiable)
    std = fit.std[printed]
    correlation = fit.precision.covariance[np.ix_(printed, printed)] / np.outer(std, std)
    return float(errors / std @ np.linalg.solve(correlation, errors / std))


def table(records: list[dict[str, Any]]) -> str:
    """Return the table of all cells as Markdown."""
    lines = [
        "# Intervals of `identify` on logs of the exact steppers",
        "",
        f"Written by `python -m benchmarks.intervals` on {date.today()}.",
        "Of the values that are printed: the share of 95 % intervals that hold the truth, with the 99 %",
        "range of so many Bernoulli draws at 95 %, and the largest deviation in standard deviations.",
        "Truth, motion and noise are drawn in each run. Efficiency is the bound of Cramer and Rao, by the",
        "innovations of the Kalman filter at the truth, over the mean squared error. Jointly: the share of",
        "runs whose 95 % ellipsoid, by the covariance of all printed values, holds the truth; older runs",
        "have none.",
        "",
        "| cell | method | seeds | runs | failed | values | 95 % holds | range | largest | jointly "
        "| efficiency | not printed | s a fit | commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    bounds = {(r["cell"], r["seed"]): r["bound"] for r in records if "bound" in r}
    groups: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["cell"], record["asked"], record.get("first", 0)), []).append(record)
    for (cell, asked, first), of in sorted(groups.items()):
        z = np.array([v for r in of for v in r.get("z", {}).values()])
        methods = sorted({r["method"] for r in of if "method" in r})
        name = ", ".join(methods) + (" (chosen)" if asked == "chosen" else "")
        failed = sum("failed" in r for r in of)
        hold = f"{100 * np.mean(np.abs(z) < 1.96):.1f} %" if z.size else "-"
        low, high = binom.interval(0.99, max(z.size, 1), 0.95)
        share = [100 * x / max(z.size, 1) for x in (low, high)]
        blind = sum(r.get("not_identifiable", 0) for r in of)
        largest = f"{np.abs(z).max():.1f}" if z.size else "-"
        joint = [r["chi2"] < chi2.ppf(0.95, len(r["z"])) for r in of if "chi2" in r]
        jointly = f"{100 * np.mean(joint):.0f} % of {len(joint)}" if joint else "-"
        ratios = np.array(
            [
                error / bound[name]
                for r in of
                if (bound := bounds.get((r["cell"], r["seed"])))
                for name, error in r.get("error", {}).items()
            ]
        )
        efficiency = f"{1 / np.mean(ratios**2):.2f}" if ratios.size else "-"
        commits = ", ".join(sorted({r["commit"] for r in of}))
        seconds = np.median([r["seconds"] for r in of])
        seeds = f"{first}-{max(r['seed'] for r in of)}"
        lines.append(
            f"| {cell} | {name} | {seeds} | {len(of)} | {failed} | {z.size} | {hold} | "
            f"{share[0]:.1f}-{share[1]:.1f} % | {largest} | {jointly} | {efficiency} | {blind} | "
            f"{seconds:.2f} | {commits} |"
        )
    return "\n".join([*lines, *_pooled(records)]) + "\n"


def _pooled(records: list[dict[str, Any]]) -> list[str]:
    """Return the lines of a table of the chosen method with all lots of a cell together."""
    lines = [
        "",
        "## All lots of a cell together, method as chosen",
        "",
        "Lots are of different commits. Too wide or too narrow: the share is outside the range.",
        "",
        "| cell | runs | values | 95 % holds | range | |",
        "|---|---|---|---|---|---|",
    ]
    cells: dict[str, list[dict[str, Any]]] = {}
    for record in records:
        if record["asked"] == "chosen":
            cells.setdefault(record["cell"], []).append(record)
    for cell, of in sorted(cells.items()):
        z = np.abs([v for r in of for v in r.get("z", {}).values()])
        share = 100 * float(np.mean(z < 1.96))
        low, high = (100 * x / z.size for x in binom.interval(0.99, z.size, 0.95))
        side = "too wide" if share > high else "too narrow" if share < low else ""
        lines.append(f"| {cell} | {len(of)} | {z.size} | {share:.1f} % | {low:.1f}-{high:.1f} % | {side} |")
    return lines


def main() -> int:
    """Run what is missing of the cells that are asked for, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="seed of the first run")
    parser.add_argument("--cell", choices=CELLS, action="append", help="default: all")
    parser.add_argument("--method", action="append", help="default: the one that identify chooses")
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored = options.o / "intervals.jsonl"
    records, commit = read_runs(stored), commit_of(HERE.parents[1])
    done = {(r["cell"], r["asked"], r["seed"]) for r in records}

    for method in options.method or [None]:
        for cell in options.cell or CELLS:
            seeds = range(options.first, options.first + options.runs)
            missing = [s for s in seeds if (cell, method or "chosen", s) not in done]
            for at in range(0, len(missing), CHUNK):
                new = run_chunk(cell, method, missing[at : at + CHUNK], options.first, commit)
                append_runs(stored, new)
                records += new
                print(f"{cell} {method or 'chosen'}: {at + len(new)} of {len(missing)}", file=sys.stderr)
    text = table(records)
    (options.o / "intervals.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
