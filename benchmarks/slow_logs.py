"""Joints whose loop is faster than their log: effects that `discover` names, hidden ones and none.

    python -m benchmarks.slow_logs [--runs N] [--first SEED] [-o DIR]

Each seed is one joint (`truth/axis/slow_logs.py`), searched complete and with each effect hidden. The case
states neither controller nor sensor. Runs are written to DIR/slow_logs.jsonl as they end; a second call goes
on from there, and rewrites the table DIR/slow_logs.md from all of them.
"""

import argparse
import sys
import time
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

import jax
import numpy as np
from scipy.stats import binom

import jaxid
from benchmarks.stored_runs import append_runs, commit_of, read_runs
from truth.axis.cases import case_text
from truth.axis.machines import Setup
from truth.axis.slow_logs import HIDDEN, robot_joint, with_hidden
from truth.hidden.oracle import effect_force, evidence_beyond

HERE = Path(__file__).parent / "results"
NONE = "none"
# Gain of the oracle from which an effect counts as visible [nats].
_VISIBLE = 30.0
# Velocity from which a sample counts there [rad/s].
_SLOWEST = 0.01


def run(seed: int, kind: str, commit: str) -> dict[str, Any]:
    """Search one joint, and return the record."""
    setup, rate = robot_joint(seed)
    declared = tuple(setup.machine.effects.items())
    if kind != NONE:
        setup = with_hidden(setup, kind)
    log = setup.run(log_rate=rate)
    case = tomllib.loads(case_text(setup, declared, motion="rotary", sensor=False, closed=False))
    begin = time.perf_counter()
    found = jaxid.discover(case, {"t": log["t"], "q": log["position"], "u": log["force"]})
    truth = {"inertia": setup.machine.inertia}
    truth |= {f"{k}.{name}": value for k, of in setup.machine.effects.items() for name, value in of.items()}
    fit = found.estimate
    columns = zip(fit.names, fit.theta, fit.std, fit.identifiable, strict=True)
    return {
        "seed": seed,
        "hidden": kind,
        "rate": rate,
        "oracle": None if kind == NONE else visible(setup, log, kind),
        "verdict": found.verdict,
        "complete": found.model_complete,
        "named": list(found.kinds),
        "z": {n: float((value - truth[n]) / std) for n, value, std, ok in columns if ok and n in truth},
        "seconds": time.perf_counter() - begin,
        "commit": commit,
    }


def visible(setup: Setup, log: dict[str, np.ndarray], kind: str) -> float:
    """Return what an oracle gains in log-likelihood by a hidden effect [nats].

    It knows the true motion, the effect's force and the noise of a row: what the loop makes of its encoder's
    noise, and that of the current's sensor. The part of the force that inertia and declared frictions can
    take on is taken off.

    Args:
        setup: The joint with the effect.
        log: Its log, with the truth behind it.
        kind: Kind of the effect.
    """
    v, a = log["true_velocity"], log["true_acceleration"]
    sensor, loop = setup.sensor, setup.loop
    reading = np.hypot(sensor.position_noise, sensor.position_resolution / np.sqrt(12))
    slope = loop.kv * setup.rate / loop.velocity_average
    of_loop = np.hypot(slope + loop.kv * loop.kp, slope) * reading
    noise = setup.machine.actuator_gain * np.hypot(of_loop, sensor.force_noise)
    in_motion = np.abs(v) > _SLOWEST
    columns = np.stack([a, v, np.sign(v)], axis=1)[in_motion]
    return evidence_beyond(columns, effect_force(kind, setup, log)[in_motion] / noise)


def table(records: list[dict[str, Any]]) -> str:
    """Return the table as Markdown."""
    commits = ", ".join(sorted({r["commit"] for r in records}))
    lines = [
        "# Joints whose loop is faster than their log, by the exact stepper",
        "",
        f"Written by `python -m benchmarks.slow_logs` on {date.today()}, at {commits}.",
        "Loops of 1 kHz, logs of 100 to 500 Hz with a force; encoders of 14 to 18 bits. Neither controller",
        "nor sensor is stated. Named: the effect alone. Visible: an oracle that knows motion, force and",
        f"noise gains at least {_VISIBLE:g} nats. Intervals: the share of 95 % intervals that hold the truth",
        "where the model has all effects, with the 99 % range of so many draws.",
        "",
        "| hidden | runs | visible | of those named | others named as well or instead | intervals | range |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in (NONE, *HIDDEN):
        of = [r for r in records if r["hidden"] == kind]
        if not of:
            continue
        right = [] if kind == NONE else [kind]
        seen = [r for r in of if kind == NONE or r["oracle"] >= _VISIBLE]
        named = sum(r["named"] == right for r in seen)
        wrong = sorted({" + ".join(r["named"]) for r in of if r["named"] not in (right, [])})
        z = np.array([v for r in of if r["named"] == right for v in r["z"].values()])
        hold = f"{100 * np.mean(np.abs(z) < 1.96):.1f} % of {z.size}" if z.size else "-"
        low, high = (100 * x / max(z.size, 1) for x in binom.interval(0.99, max(z.size, 1), 0.95))
        cells = [kind, len(of), "-" if kind == NONE else len(seen), named, ", ".join(wrong), hold]
        lines.append(f"| {' | '.join(str(c) for c in cells)} | {low:.0f}-{high:.0f} % |")
    complete = [r["complete"] for r in records if r["hidden"] == NONE]
    lines += ["", f"Of {len(complete)} complete models {complete.count(True)} are called complete, "]
    lines[-1] += f"{complete.count(False)} incomplete. A search takes "
    lines[-1] += f"{np.median([r['seconds'] for r in records]):.0f} s (median)."
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run what is missing, and write the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=30, help="joints")
    parser.add_argument("--first", type=int, default=0, help="seed of the first joint")
    parser.add_argument("--kind", choices=(NONE, *HIDDEN), action="append", help="default: all")
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    options.o.mkdir(parents=True, exist_ok=True)
    stored = options.o / "slow_logs.jsonl"
    records, commit = read_runs(stored), commit_of(HERE.parents[1])
    done = {(r["seed"], r["hidden"]) for r in records}
    for seed in range(options.first, options.first + options.runs):
        # A process has room for the compiled code of some dozen searches.
        jax.clear_caches()
        for kind in options.kind or (NONE, *HIDDEN):
            if (seed, kind) in done:
                continue
            records.append(run(seed, kind, commit))
            append_runs(stored, records[-1:])
            last = records[-1]
            print(seed, kind, last["verdict"], last["named"], f"{last['seconds']:.0f} s", file=sys.stderr)
    text = table(records)
    (options.o / "slow_logs.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
