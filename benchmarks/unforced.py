"""Logs of servos without a force, by the exact stepper: intervals of `identify`, and what `discover` names.

    python -m benchmarks.unforced [--coverage N] [--hidden N] [--nulls N] [--seconds S] [-o DIR]

Coverage: the share of 95 % intervals that hold the truth. Hidden: one effect that the case does not declare,
with what an oracle sees of it. Nulls: complete cases, in which nothing should be named. Runs are written to
DIR/unforced.jsonl as they end; a second call goes on from there, and rewrites DIR/unforced.md from all of
them. --seconds ends a call after so much time.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom

import jaxid
from benchmarks.unforced_machines import HIDDEN, VISIBLE, Servo, servo

HERE = Path(__file__).parent / "results"
# First seeds of the parts: no servo is in two of them.
FIRST = {"coverage": 0, "hidden": 10_000, "nulls": 20_000}


def of(part: str, number: int) -> Servo:
    """Return a servo of a part of the benchmark, by its number."""
    hidden = HIDDEN[number % len(HIDDEN)] if part == "hidden" else None
    return servo(FIRST[part] + number, hidden)


def covered(drawn: Servo) -> dict[str, Any]:
    """Fit a complete case; return the deviations from the truth over the standard deviations."""
    result = jaxid.identify(drawn.case(), drawn.columns())
    truth, estimate = drawn.truth(), result.estimate
    relative = estimate.details.get("relative")
    z, error = {}, {}
    for name, value, std, ok in zip(
        estimate.names, estimate.theta, estimate.std, estimate.identifiable, strict=True
    ):
        if ok and std > 0:
            z[name], error[name] = (value - truth[name]) / std, value / truth[name] - 1
    for name, ratio in (relative["values"] if relative else {}).items():
        true = truth[name] / truth[relative["to"]]
        if ratio["std"]:
            z[name], error[name] = (ratio["value"] - true) / ratio["std"], ratio["value"] / true - 1
    return {"converged": estimate.converged, "complete": result.model_complete, "z": z, "error": error}


def searched(drawn: Servo) -> dict[str, Any]:
    """Search a case for what it does not declare; return what was named, and what an oracle sees."""
    sees = drawn.evidence() if drawn.hidden else None
    begin = time.perf_counter()
    found = jaxid.discover(drawn.case(), drawn.columns())
    return {
        "verdict": found.verdict,
        "named": found.kinds,
        "alternatives": [[s.candidate.kind for s in e.alternatives] for e in found.effects],
        "evidence": [e.score.evidence for e in found.effects],
        "oracle": sees,
        "search_seconds": time.perf_counter() - begin,
    }


def right(record: dict[str, Any]) -> bool:
    """Check that the hidden effect is named, or stands among the alternatives, and nothing else is named."""
    named = [{kind, *others} for kind, others in zip(record["named"], record["alternatives"], strict=True)]
    return len(named) == 1 and record["hidden"] in named[0]


def missing(records: list[dict[str, Any]], counts: dict[str, int]) -> Iterator[tuple[str, int]]:
    """Yield the runs that are not done, in turn by part."""
    done = {(r["part"], r["number"]) for r in records}
    for number in range(max(counts.values(), default=0)):
        for part, count in counts.items():
            if number < count and (part, number) not in done:
                yield part, number


def table(records: list[dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    parts = {part: [r for r in records if r["part"] == part] for part in FIRST}
    lines = [
        "# Logs without a force, by the exact stepper",
        "",
        f"Written by `python -m benchmarks.unforced` on {date.today()}, at "
        f"{', '.join(sorted({r['commit'] for r in records}))}.",
        "Machines, gains, delays, rates (loops of 200 to 1000 Hz, logs of 50 to 1000 Hz), commands and "
        "guesses are drawn in each run; the encoder has 4096 counts.",
        "",
        "## Intervals of `identify`",
        "",
        "| unknown | values | 95 % holds | 99 % range of so many draws | mean z | largest |",
        "|---|---|---|---|---|---|",
    ]
    z: dict[str, list[float]] = {}
    for r in parts["coverage"]:
        for name, value in r.get("z", {}).items():
            z.setdefault(name, []).append(value)
    every = [v for values in z.values() for v in values]
    for name, values in [*z.items(), ("all", every)]:
        if not values:
            continue
        low, high = (100 * x / len(values) for x in binom.interval(0.99, len(values), 0.95))
        held = 100 * np.mean(np.abs(values) < 1.96)
        lines.append(
            f"| {name} | {len(values)} | {held:.1f} % | {low:.0f}-{high:.0f} % | {np.mean(values):+.2f} | "
            f"{np.max(np.abs(values)):.1f} |"
        )
    fits = parts["coverage"]
    bad = sum(not r.get("converged", False) for r in fits)
    lines += ["", f"{len(fits)} fits; {bad} did not converge or failed.", "", "## Hidden effects", ""]
    lines += [
        "| hidden | runs | visible | of those named | others named as well or instead |",
        "|---|---|---|---|---|",
    ]
    for kind in (*HIDDEN, "all"):
        some = [r for r in parts["hidden"] if kind in (r["hidden"], "all") and "failed" not in r]
        seen = [r for r in some if r["oracle"] >= VISIBLE]
        if some:
            wrong = (
                ", ".join(" + ".join(r["named"]) or "none" for r in seen if not right(r))
                if kind != "all"
                else ""
            )
            lines.append(f"| {kind} | {len(some)} | {len(seen)} | {sum(map(right, seen))} | {wrong} |")
    nulls = [r for r in parts["nulls"] if "failed" not in r]
    false = [r for r in nulls if r["named"]]
    listed = "; ".join(" + ".join(r["named"]) for r in false)
    verdicts = sum(r["verdict"] == "nothing_missing" for r in nulls)
    seconds = [r["search_seconds"] for r in records if "search_seconds" in r]
    lines += [
        "",
        f"Visible: an oracle that knows the truth gains at least {VISIBLE:g} nats.",
        "",
        "## Nulls",
        "",
        f"{len(nulls)} complete cases: {len(false)} with an effect named{f' ({listed})' if listed else ''}; "
        f"{verdicts} with the verdict nothing_missing.",
        "",
        f"A search takes {np.median(seconds):.0f} s (median), {np.max(seconds):.0f} s at most."
        if seconds
        else "",
    ]
    failed = [f"{r['part']} {r['number']}: {r['failed']}" for r in records if "failed" in r]
    lines += ["", *[f"- failed: {text}" for text in failed]]
    return "\n".join(lines).rstrip() + "\n"


def main() -> int:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for part, runs in (("coverage", 40), ("hidden", 40), ("nulls", 40)):
        parser.add_argument(f"--{part}", type=int, default=runs)
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored = options.o / "unforced.jsonl"
    lines = stored.read_text().splitlines() if stored.exists() else []
    records = [json.loads(line) for line in lines if line.endswith("}")]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=HERE.parent, check=False
    ).stdout.strip()
    counts, begin = {part: getattr(options, part) for part in FIRST}, time.perf_counter()
    for part, number in missing(records, counts):
        if time.perf_counter() - begin > options.seconds:
            break
        drawn, start = of(part, number), time.perf_counter()
        record: dict[str, Any] = {"part": part, "number": number, "hidden": drawn.hidden, "commit": commit}
        record |= {"rate": drawn.rate, "every": drawn.every, "known": drawn.known}
        try:
            record |= covered(drawn) if part == "coverage" else searched(drawn)
        except jaxid.InputError as error:
            record["failed"] = str(error)
        record["seconds"] = time.perf_counter() - start
        with stored.open("a") as file:
            file.write(json.dumps(record) + "\n")
        records.append(record)
        print(
            f"{part} {number}: {record.get('named', record.get('z', record.get('failed')))}", file=sys.stderr
        )
    text = table(records)
    (options.o / "unforced.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
