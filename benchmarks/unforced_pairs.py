"""Two logs of servos without a force: does `compare` name what differs, and nothing where nothing does?

    python -m benchmarks.unforced_pairs [--differ N] [--equal N] [--seconds S] [-o DIR]

Servos of the exact stepper (`unforced_machines.py`). The two logs of a pair follow different commands. In
pairs that differ one thing of the second servo is another. Runs are written to DIR/unforced_pairs.jsonl as
they end; a second call goes on from there, and rewrites DIR/unforced_pairs.md from all of them.
"""

import argparse
import dataclasses
import sys
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import scipy.optimize

import jaxid
from benchmarks.stored_runs import append_runs, commit_of, read_runs
from benchmarks.unforced_machines import COUNT, DECLARED, NOISE, VISIBLE, Servo, command_of, servo

HERE = Path(__file__).parent / "results"
FIRST = {"differ": 30_000, "equal": 40_000}
# What differs, and the names of changes that are it: a delay of the command is one of the controller.
NAMES = {
    "friction": ("coulomb_friction.level",),
    "grease": ("viscous_friction.coefficient",),
    "payload": ("inertia",),
    "delay": ("controller.delay",),
    "dead_band": ("dead_band",),
    "unbalance": ("unbalance",),
}


@dataclasses.dataclass(frozen=True)
class ServoPair:
    """Two servos with their logs.

    Attributes:
        first, second: The servos.
        what: What differs, a key of `NAMES`; None: nothing.
        change: Factor or value of the change.
    """

    first: Servo
    second: Servo
    what: str | None
    change: float

    def columns(self) -> list[dict[str, np.ndarray]]:
        """Return the two logs."""
        return [self.first.columns(), self.second.columns()]

    def evidence(self) -> float:
        """Return what an oracle sees of the difference [nats], by the exact stepper alone.

        One machine is fitted to both motions without noise, and what it leaves compared with the noise of a
        reading.
        """
        wholes = [s.run(exact=True)["position"] for s in (self.first, self.second)]
        truth = self.first.truth()
        names = [name for name in truth if not (name == "controller.kp" and self.first.known)]
        start = np.array([truth[name] for name in names])
        if not self.first.known:
            # Without a scale only ratios to the inertia show.
            names, start = names[1:], start[1:]

        def left(factors: np.ndarray) -> np.ndarray:
            values = truth | dict(zip(names, start * np.exp(factors), strict=True))
            effects = {kind: {name: values[f"{kind}.{name}"]} for kind, name in DECLARED.items()}
            effects["command_delay"] = {"delay": values["controller.delay"]}
            changed = {"inertia": values["inertia"], "kp": values["controller.kp"]}
            changed |= {"kd": values["controller.kd"], "effects": effects}
            off = [
                s.run(exact=True, **changed)["position"] - whole
                for s, whole in zip((self.first, self.second), wholes, strict=True)
            ]
            return np.nan_to_num(np.concatenate(off), nan=1e3, posinf=1e3, neginf=-1e3)

        best = scipy.optimize.least_squares(
            left, np.zeros(len(names)), bounds=(-3, 3), diff_step=1e-3, x_scale="jac", max_nfev=10
        )
        return float(best.cost / (NOISE**2 + COUNT**2 / 12))


def pair(part: str, number: int) -> ServoPair:
    """Draw a pair.

    Args:
        part: "differ" or "equal".
        number: Its number in that part; what differs goes round with it.
    """
    seed = FIRST[part] + number
    first = servo(seed)
    rng = np.random.default_rng([40, seed])
    effects = {kind: dict(values) for kind, values in first.effects.items()}
    second = dataclasses.replace(
        first, seed=seed + 5_000, command=command_of(rng, first.rate, first.every, seed + 5_000)
    )
    if part == "equal":
        return ServoPair(first, second, None, 1.0)

    what = list(NAMES)[number % len(NAMES)]
    change = float(
        {
            "friction": rng.uniform(1.2, 1.6),
            "grease": rng.uniform(1.3, 2.0),
            "payload": rng.uniform(1.1, 1.5),
            "delay": np.ceil(rng.uniform(0.01, 0.03) * first.rate) / first.rate,
            "dead_band": rng.uniform(0.005, 0.03),
            "unbalance": first.inertia * rng.uniform(10.0, 40.0) / 9.81,
        }[what]
    )
    if what == "friction":
        effects["coulomb_friction"]["level"] *= change
    elif what == "grease":
        effects["viscous_friction"]["coefficient"] *= change
    elif what == "delay":
        effects["command_delay"]["delay"] += change
    elif what == "dead_band":
        effects["dead_band"] = {"width": change}
    elif what == "unbalance":
        effects["unbalance"] = {"moment": change, "phase": float(rng.uniform(-np.pi, np.pi))}
    inertia = first.inertia * (change if what == "payload" else 1.0)
    return ServoPair(first, dataclasses.replace(second, effects=effects, inertia=inertia), what, change)


def run(drawn: ServoPair) -> dict[str, Any]:
    """Compare the logs of a pair, and return what was named."""
    sees = drawn.evidence() if drawn.what else None
    begin = time.process_time()
    found = jaxid.compare(drawn.first.case(), drawn.columns())
    return {
        "what": drawn.what,
        "change": drawn.change,
        "known": drawn.first.known,
        "oracle": sees,
        "verdict": found.verdict,
        "named": [d.label for d in found.differences],
        "alternatives": [[r.label for r in d.alternatives] for d in found.differences],
        "evidence": [d.evidence for d in found.differences],
        "alike": list(found.alike),
        "cpu_seconds": time.process_time() - begin,
    }


def right(record: dict[str, Any]) -> bool:
    """Check that exactly what differs is named."""
    return tuple(record["named"]) == NAMES[record["what"]]


def table(records: list[dict[str, Any]]) -> str:
    """Return the results as Markdown."""
    commits = ", ".join(sorted({r["commit"] for r in records}))
    lines = [
        "# Two logs without a force: what differs",
        "",
        f"Written by `python -m benchmarks.unforced_pairs` on {date.today()}, at {commits}.",
        "Servos, commands and changes are drawn; the exact stepper makes the logs of command and encoder.",
        f"Visible: an oracle that knows the truth gains at least {VISIBLE:g} nats.",
        "",
        "| differs | pairs | visible | of those named alone | otherwise |",
        "|---|---|---|---|---|",
    ]
    differ = [r for r in records if r["part"] == "differ" and "failed" not in r]
    for what in (*NAMES, "all"):
        some = [r for r in differ if what in (r["what"], "all")]
        seen = [r for r in some if r["oracle"] >= VISIBLE]
        wrong = [" + ".join(r["named"]) or r["verdict"] for r in seen if not right(r)]
        listed = "" if what == "all" else ", ".join(wrong)
        lines.append(f"| {what} | {len(some)} | {len(seen)} | {sum(map(right, seen))} | {listed} |")

    equal = [r for r in records if r["part"] == "equal" and "failed" not in r]
    false = [r for r in equal if r["verdict"] != "same"]
    words = "; ".join(" + ".join(r["named"]) or r["verdict"] for r in false)
    lines += ["", f"{len(equal)} pairs of equal servos: {len(false)} with another verdict than `same`"]
    lines[-1] += f" ({words})." if false else "."
    seconds = [r["cpu_seconds"] for r in (*differ, *equal)]
    if seconds:
        lines += ["", f"A comparison takes {np.median(seconds):.0f} s of a processor (median)."]
    failed = [f"{r['part']} {r['number']}: {r['failed']}" for r in records if "failed" in r]
    lines += ["", *[f"- failed: {text}" for text in failed]] if failed else []
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--differ", type=int, default=24)
    parser.add_argument("--equal", type=int, default=24)
    parser.add_argument("--seconds", type=float, default=np.inf)
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored = options.o / "unforced_pairs.jsonl"
    records = read_runs(stored)
    done = {(r["part"], r["number"]) for r in records}
    end, counts = time.monotonic() + options.seconds, {part: getattr(options, part) for part in FIRST}
    for number in range(max(counts.values())):
        for part, count in counts.items():
            if number >= count or (part, number) in done or time.monotonic() > end:
                continue
            record: dict[str, Any] = {"part": part, "number": number, "commit": commit_of(HERE.parent)}
            try:
                record |= run(pair(part, number))
            except jaxid.InputError as error:
                record["failed"] = str(error)
            append_runs(stored, [record])
            records.append(record)
            print(f"{part} {number}: {record.get('named', record.get('failed'))}", file=sys.stderr)
    (options.o / "unforced_pairs.md").write_text(table(records))
    print(table(records))
    return 0


if __name__ == "__main__":
    sys.exit(main())
