"""Starts of `identify` on servos without a force: do guesses a factor of 5 off lead to one optimum?

    python -m benchmarks.unforced_starts [--servos N] [--starts N] [-o DIR]

Servos of the exact stepper, as in `benchmarks.unforced`, are drawn. The log of each is fitted from several
sets of guesses. In each set every guess is 5 times the true value or a 5th of it, by chance, and the delay
too. The fit that leaves least is the optimum of the log. A fit reached it if no value is further from it than
half a standard deviation; ratios count where nothing gives a scale. Runs are written to
DIR/unforced_starts.jsonl as they end, a second call goes on from there and rewrites DIR/unforced_starts.md.
"""

import argparse
import sys
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from benchmarks.stored_runs import append_runs, commit_of, read_runs
from benchmarks.unforced_machines import Servo, servo
from jaxid.estimators.estimate import Estimate

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
# First seed of the servos, which no other benchmark draws.
FIRST = 70_000
FACTOR = 5.0
# Part of a standard deviation within which two fits have the same values.
SAME = 0.5
# Entries of a case that hold guesses.
Table = dict[str, Any]


def far_case(drawn: Servo, start: int) -> Table:
    """Return the case of a servo, each guess a factor of 5 above or below the truth."""
    case, truth = drawn.case(), drawn.truth()
    signs = np.random.default_rng([391, drawn.seed, start])

    def guess(name: str) -> dict[str, float]:
        return {"guess": float(truth[name] * FACTOR ** signs.choice([-1, 1]))}

    case["plant"]["parameters"]["inertia"] = guess("inertia")
    for effect in case["effects"]:
        [name] = [key for key in effect if key != "kind"]
        effect[name] = guess(f"{effect['kind']}.{name}")
    for name, value in case["controller"].items():
        if isinstance(value, dict):
            case["controller"][name] = guess(f"controller.{name}")
    return case


def values_of(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Return values and standard deviations of what is identifiable, and of ratios without a scale."""
    rows = zip(estimate.names, estimate.theta, estimate.std, estimate.identifiable, strict=True)
    out = {name: (float(value), float(std)) for name, value, std, ok in rows if ok}
    relative = estimate.details.get("relative")
    for name, ratio in (relative["values"] if relative else {}).items():
        if ratio["std"]:
            out[f"{name} / {relative['to']}"] = ratio["value"], ratio["std"]
    return out


def ran(number: int, start: int) -> dict[str, Any]:
    """Fit one servo from one set of guesses."""
    drawn, begin = servo(FIRST + number), time.perf_counter()
    result = jaxid.identify(far_case(drawn, start), drawn.columns())
    simulation = result.gaps[0].simulation
    return {
        "servo": number,
        "start": start,
        "known": drawn.known,
        "converged": result.converged,
        "left": None if simulation is None else float(simulation.rms[0]),
        "values": values_of(result.estimate),
        "seconds": time.perf_counter() - begin,
    }


def reached(records: list[dict[str, Any]]) -> list[bool]:
    """Return which fits of one servo are at the optimum of its log."""
    finite = [r for r in records if r["left"] is not None]
    best = min(finite, key=lambda r: r["left"])["values"]
    out = []
    for record in records:
        values = record["values"]
        near = [abs(values[n][0] - v) < SAME * std for n, (v, std) in best.items() if n in values]
        out.append(record["left"] is not None and values.keys() == best.keys() and all(near))
    return out


def table(records: list[dict[str, Any]]) -> str:
    """Return the page."""
    by_servo: dict[int, list[dict[str, Any]]] = {}
    for record in records:
        by_servo.setdefault(record["servo"], []).append(record)
    commits = ", ".join(sorted({r["commit"] for r in records}))
    lines = [
        "# Starts far from the truth, in logs without a force",
        "",
        f"Written by `python -m benchmarks.unforced_starts` on {date.today()}, at {commits}.",
        f"Every guess is {FACTOR:g} times the true value, or a {FACTOR:g}th of it.",
        "At the optimum: the fits whose values are all within half a standard deviation of those of the fit",
        "that leaves least of the log.",
        "",
        "| servo | kp | fits | at the optimum | converged | left [mrad] | s a fit |",
        "|---|---|---|---|---|---|---|",
    ]
    total = 0
    for number, of in sorted(by_servo.items()):
        there = reached(of)
        total += sum(there)
        left = [1e3 * r["left"] for r in of if r["left"] is not None]
        lines.append(
            f"| {number} | {'known' if of[0]['known'] else 'unknown'} | {len(of)} | {sum(there)} "
            f"| {sum(r['converged'] for r in of)} | {min(left):.3g} to {max(left):.3g} "
            f"| {np.median([r['seconds'] for r in of]):.1f} |"
        )
    lines += ["", f"{total} of {len(records)} fits are at the optimum of their log."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is missing, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--servos", type=int, default=10, metavar="N")
    parser.add_argument("--starts", type=int, default=10, metavar="N")
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored, commit = options.o / "unforced_starts.jsonl", commit_of(ROOT)
    records = read_runs(stored)
    done = {(r["servo"], r["start"]) for r in records}
    for number in range(options.servos):
        for start in range(options.starts):
            if (number, start) in done:
                continue
            record = ran(number, start) | {"commit": commit}
            append_runs(stored, [record])
            records.append(record)
            print(f"servo {number}, start {start}: {record['left']}", file=sys.stderr)
    text = table(records)
    (options.o / "unforced_starts.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
