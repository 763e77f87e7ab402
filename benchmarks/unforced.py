"""Logs of servos and of arms without a force, by the exact stepper: what `identify` and `discover` find.

    python -m benchmarks.unforced [--coverage N] [--hidden N] [--nulls N] [--arm-hidden N] [--arm-nulls N]
                                  [--arm-coverage N] [--arm-elastic N] [--fine-hidden N] [--fine-nulls N]
                                  [--first N] [--seconds S] [-o DIR]

Coverage: the share of 95 % intervals that hold the truth, from guesses up to three times off, and for arms
two to five times off. Hidden: one effect that the case does not declare, with what an oracle sees of it; on
an arm of two joints it acts at one of them. Elastic: arms with a spring at one joint, for which the case
asks. Fine: servos with an encoder of 16 000 counts, delays up to 0.1 s and no known gain. Nulls: complete
cases, in which nothing should be named. The runs of a part have the numbers from
--first (0) to below N. They are written to DIR/unforced.jsonl as they end; a second call goes on from there,
and rewrites DIR/unforced.md from all of them. --seconds ends a call after so much time.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from benchmarks import unforced_arms, unforced_machines
from benchmarks.unforced_arms import Arm, arm
from benchmarks.unforced_machines import Servo, servo
from benchmarks.unforced_table import table

HERE = Path(__file__).parent / "results"
# First seeds of the parts: no machine is in two of them.
FIRST = {"coverage": 0, "hidden": 10_000, "nulls": 20_000, "arm_hidden": 30_000, "arm_nulls": 40_000}
FIRST |= {"arm_coverage": 50_000, "arm_elastic": 60_000, "fine_hidden": 80_000, "fine_nulls": 90_000}
RUNS = {"coverage": 40, "hidden": 40, "nulls": 40, "arm_hidden": 16, "arm_nulls": 8, "arm_coverage": 12}
# A search for springs takes many minutes.
RUNS |= {"arm_elastic": 0, "fine_hidden": 0, "fine_nulls": 0}


def of(part: str, number: int) -> Servo | Arm:
    """Return a machine of a part of the benchmark, by its number."""
    seed = FIRST[part] + number
    if part.startswith("arm"):
        kinds = unforced_arms.HIDDEN
        # The second joint in every other run, and in the next round of kinds the other one.
        hidden, joint = kinds[number % len(kinds)], (number + number // len(kinds)) % 2
        if part == "arm_elastic":
            drawn = arm(seed, "joint_flexibility", number % 2)
        else:
            drawn = arm(seed, hidden, joint) if part == "arm_hidden" else arm(seed)
        return replace(drawn, far=part == "arm_coverage")
    fine = part.startswith("fine")
    kinds = unforced_machines.UNASKED if fine else unforced_machines.HIDDEN
    hidden = kinds[number % len(kinds)] if part.endswith("hidden") else None
    return servo(seed, hidden, fine=fine)


def covered(drawn: Servo | Arm) -> dict[str, Any]:
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


def searched(drawn: Servo | Arm) -> dict[str, Any]:
    """Search a case for what it does not declare; return what was named, and what an oracle sees."""
    sees = drawn.evidence() if drawn.hidden else None
    begin, busy = time.perf_counter(), time.process_time()
    found = jaxid.discover(drawn.case(), drawn.columns())
    return {
        "verdict": found.verdict,
        "named": [drawn.label(e.kind, e.score.candidate.port) for e in found.effects],
        "alternatives": [
            [drawn.label(s.candidate.kind, s.candidate.port) for s in e.alternatives] for e in found.effects
        ],
        "evidence": [e.score.evidence for e in found.effects],
        "oracle": sees,
        "search_seconds": time.perf_counter() - begin,
        "search_cpu_seconds": time.process_time() - busy,
    }


def missing(records: list[dict[str, Any]], counts: dict[str, int], first: int) -> Iterator[tuple[str, int]]:
    """Yield the runs that are not done, in turn by part, from a first number on."""
    done = {(r["part"], r["number"]) for r in records}
    for number in range(first, max(counts.values(), default=0)):
        for part, count in counts.items():
            if number < count and (part, number) not in done:
                yield part, number


def ran(part: str, number: int) -> dict[str, Any]:
    """Return the record of a run, without its commit."""
    drawn, start = of(part, number), time.perf_counter()
    hidden = drawn.hidden and drawn.label(drawn.hidden, getattr(drawn, "joint", 0))
    record: dict[str, Any] = {"part": part, "number": number, "hidden": hidden}
    record |= {"rate": drawn.rate, "every": drawn.every, "known": drawn.known}
    try:
        if part.endswith("coverage"):
            record |= covered(drawn)
        else:
            record |= searched(drawn)
    except jaxid.InputError as error:
        record["failed"] = str(error)
    return record | {"seconds": time.perf_counter() - start}


def main() -> int:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for part, runs in RUNS.items():
        parser.add_argument(f"--{part.replace('_', '-')}", type=int, default=runs, metavar="N")
    parser.add_argument("--first", type=int, default=0, metavar="N")
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
    for part, number in missing(records, counts, options.first):
        if time.perf_counter() - begin > options.seconds:
            break
        record = ran(part, number) | {"commit": commit}
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
