"""Share of 95 % intervals that hold the truth, by machine, loop and sensor: logs of the exact steppers.

    python -m benchmarks.intervals [--runs N] [--cell NAME]... [--method M]... [-o DIR]

Truth, motion and noise are drawn anew in each run. Without --method the fit is the one that `jaxid identify`
chooses. Runs are written to DIR/intervals.jsonl as they end; a second call goes on from there, and rewrites
the table DIR/intervals.md from all of them.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

import jaxid
from truth.axis.cases import case_text
from truth.axis.machines import EMPS_LOOP, Setup, emps_like, moves, multisine
from truth.axis.stepper import Loop, Sensor
from truth.chain import flexible_axes

HERE = Path(__file__).parent / "results"
CHUNK = 10
LOOPS, SENSORS = ("open", "known", "unknown"), ("stated", "not stated")
SAMPLES = 2500


def axis(seed: int, loop: str, sensor: str) -> tuple[str, dict[str, np.ndarray], dict[str, float]]:
    """Return case, columns and truth of a slide of 95 kg: trapezoids in a loop, or a multisine of force."""
    rng = np.random.default_rng([1, seed])
    base = emps_like()
    scale = rng.uniform(0.8, 1.2, 3).tolist()
    true = {
        "inertia": 95.1 * scale[0],
        "viscous_friction.coefficient": 203.5 * scale[1],
        "coulomb_friction.level": 20.39 * scale[2],
    }
    effects = {
        "viscous_friction": {"coefficient": true["viscous_friction.coefficient"]},
        "coulomb_friction": {"level": true["coulomb_friction.level"]},
    }
    machine = dataclasses.replace(base.machine, inertia=true["inertia"], effects=effects)
    t = np.arange(SAMPLES) / 1000.0
    if loop == "open":
        force = multisine(t, [0.8, 1.9, 3.7, 6.1], 3.0 * rng.uniform(0.9, 1.1), seed)
        law = Loop(kind="open_loop", input=force)
    else:
        speeds = np.array([0.05, 0.3, 0.13, 0.2]) * rng.uniform(0.8, 1.2, 4)
        reference = moves(
            t, np.array([0.0, 0.02, 0.12, 0.05]) * rng.uniform(0.9, 1.1), speeds, 1.7, rest=0.03
        )
        law = dataclasses.replace(EMPS_LOOP, reference=reference)
    read = Sensor(position_resolution=1e-6, position_noise=0.7e-6, force_noise=0.05)
    setup = Setup(machine, law, read, rate=1000.0, duration=SAMPLES / 1000.0, seed=seed)
    run = setup.run()
    text = case_text(setup, list(effects.items()), sensor=sensor == "stated", closed=loop == "known")
    return text, {"t": run["t"], "q": run["position"], "u": run["force"], "ref": run["reference"]}, true


def flexible_axis(seed: int, loop: str, sensor: str) -> tuple[str, dict[str, np.ndarray], dict[str, float]]:
    """Return case, columns and truth of the ball-screw axis of Janot et al., with both encoders."""
    rng = np.random.default_rng([2, seed])
    true = {name: float(value * rng.uniform(0.85, 1.15)) for name, value in flexible_axes.TRUTH.items()}
    t = np.arange(SAMPLES) / 1000.0
    speeds = np.array([0.08, 0.2, 0.13, 0.25]) * rng.uniform(0.8, 1.2, 4)
    reference = moves(t, (0.0, 0.12, 0.05, 0.1), speeds, 1.5, 0.05)
    count = flexible_axes.COUNT
    read = Sensor(position_resolution=count, position_noise=count, force_noise=0.05)
    law = {"kp": 40.0, "kv": 320.0, "velocity_average": 2}
    pulses = {"level": 4.0, "on": 0.012, "off": 0.119, "start": 0.2505}
    run = flexible_axes.record(
        flexible_axes.machine(**true),
        duration=SAMPLES / 1000.0,
        reference=reference,
        pulses=pulses,
        law=law,
        sensor=read,
        seed=seed,
    )
    text = flexible_axes.text(pulses=pulses, law=law, sensor=read)
    if loop == "unknown":
        text = text[: text.index("[controller]")] + text[text.index("[sensor]") :]
    if sensor == "not stated":
        text = text[: text.index("[sensor]")]
    return text, flexible_axes.columns(run), true


MACHINES: dict[str, tuple[Callable, tuple[str, ...]]] = {
    "axis": (axis, LOOPS),
    "flexible_axis": (flexible_axis, ("known", "unknown")),
}
CELLS = [f"{m}/{loop}/{s}" for m, (_, loops) in MACHINES.items() for loop in loops for s in SENSORS]


def run_chunk(cell: str, method: str | None, seeds: list[int], commit: str) -> list[dict[str, Any]]:
    """Return a record for each seed: deviations of the printed values over their std, or the failure."""
    machine, loop, sensor = cell.split("/")
    cases, logs, truths = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            text, log, true = MACHINES[machine][0](seed, loop, sensor)
            path = Path(folder) / f"{seed}.toml"
            path.write_text(text)
            cases.append(path)
            logs.append(log)
            truths.append(true)
        begin = time.perf_counter()
        fits = jaxid.identify_many(cases, logs, method=method, lanes=CHUNK)
        seconds = (time.perf_counter() - begin) / len(seeds)
    records = []
    for seed, fit, true in zip(seeds, fits, truths, strict=True):
        record: dict[str, Any] = {"cell": cell, "asked": method or "chosen", "seed": seed}
        record |= {"seconds": seconds, "commit": commit}
        if isinstance(fit, Exception):
            record |= {"failed": str(fit)}
        elif not fit.converged:
            record |= {"method": fit.method, "failed": fit.message}
        else:
            z = {
                name: (value - true[name]) / std
                for name, value, std, ok in zip(fit.names, fit.theta, fit.std, fit.identifiable, strict=True)
                if ok
            }
            record |= {"method": fit.method, "z": z, "not_identifiable": len(fit.names) - len(z)}
        records.append(record)
    return records


def table(records: list[dict[str, Any]]) -> str:
    """Return the table of all cells as Markdown."""
    lines = [
        "# Intervals of `identify` on logs of the exact steppers",
        "",
        f"Written by `python -m benchmarks.intervals` on {date.today()}.",
        "Of the values that are printed: the share of 95 % intervals that hold the truth, with the 99 %",
        "range of so many Bernoulli draws at 95 %, and the largest deviation in standard deviations.",
        "Truth, motion and noise are drawn in each run.",
        "",
        "| cell | method | runs | failed | values | 95 % holds | range | largest | not printed | s a fit "
        "| commit |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for record in records:
        groups.setdefault((record["cell"], record["asked"]), []).append(record)
    for (cell, asked), of in sorted(groups.items()):
        z = np.array([v for r in of for v in r.get("z", {}).values()])
        methods = sorted({r["method"] for r in of if "method" in r})
        name = ", ".join(methods) + (" (chosen)" if asked == "chosen" else "")
        failed = sum("failed" in r for r in of)
        hold = f"{100 * np.mean(np.abs(z) < 1.96):.1f} %" if z.size else "-"
        low, high = binom.interval(0.99, max(z.size, 1), 0.95)
        share = [100 * x / max(z.size, 1) for x in (low, high)]
        blind = sum(r.get("not_identifiable", 0) for r in of)
        largest = f"{np.abs(z).max():.1f}" if z.size else "-"
        commits = ", ".join(sorted({r["commit"] for r in of}))
        seconds = np.median([r["seconds"] for r in of])
        lines.append(
            f"| {cell} | {name} | {len(of)} | {failed} | {z.size} | {hold} | "
            f"{share[0]:.1f}-{share[1]:.1f} % | {largest} | {blind} | {seconds:.2f} | {commits} |"
        )
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is missing of the cells that are asked for, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--cell", choices=CELLS, action="append", help="default: all")
    parser.add_argument("--method", action="append", help="default: the one that identify chooses")
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored = options.o / "intervals.jsonl"
    lines = stored.read_text().splitlines() if stored.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    done = {(r["cell"], r["asked"], r["seed"]) for r in records}
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=HERE.parent, check=False
    ).stdout.strip()

    for method in options.method or [None]:
        for cell in options.cell or CELLS:
            missing = [s for s in range(options.runs) if (cell, method or "chosen", s) not in done]
            for at in range(0, len(missing), CHUNK):
                new = run_chunk(cell, method, missing[at : at + CHUNK], commit)
                with stored.open("a") as file:
                    file.writelines(json.dumps(r) + "\n" for r in new)
                records += new
                print(f"{cell} {method or 'chosen'}: {at + len(new)} of {len(missing)}", file=sys.stderr)
    text = table(records)
    (options.o / "intervals.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
