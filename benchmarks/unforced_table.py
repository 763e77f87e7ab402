"""The table of `benchmarks.unforced`."""

from collections.abc import Iterator, Sequence
from datetime import date
from typing import Any

import numpy as np
from scipy.stats import binom

from benchmarks import unforced_arms, unforced_machines
from benchmarks.unforced_machines import VISIBLE

Record = dict[str, Any]


def table(records: list[Record]) -> str:
    """Return the results as Markdown."""

    def of(part: str) -> list[Record]:
        return [r for r in records if r["part"] == part]

    lines = [
        "# Logs without a force, by the exact stepper",
        "",
        f"Written by `python -m benchmarks.unforced` on {date.today()}, at "
        f"{', '.join(sorted({r['commit'] for r in records}))}.",
        "Machines, gains, delays, rates (loops of 200 to 1000 Hz, logs of 50 to 1000 Hz), commands and "
        "guesses are drawn in each run; the encoder of a servo has 4096 counts unless the table says "
        "otherwise, those of an arm 4096 or 16 000.",
        "",
        "## Servos: intervals of `identify`",
        "",
        *_intervals(of("coverage")),
        "## Servos: hidden effects",
        "",
        *_hidden(of("hidden"), unforced_machines.HIDDEN),
        *_nulls(of("nulls")),
        *_pace([*of("hidden"), *of("nulls")]),
        "",
        "## Servos with 16 000 counts, delays up to 0.1 s and no known gain: hidden effects",
        "",
        *_hidden(of("fine_hidden"), unforced_machines.UNASKED),
        *_nulls(of("fine_nulls")),
        *_pace([*of("fine_hidden"), *of("fine_nulls")]),
        "",
        "## Arms of two joints: intervals of `identify`",
        "",
        "All gains, rotors, frictions and delays are unknown, and every guess is two to five times off; the "
        "links are known.",
        "",
        *_intervals(of("arm_coverage")),
        "## Arms of two joints: hidden effects",
        "",
        "One effect at one joint; named means that it alone is named, at that joint. All gains, rotors, "
        "frictions and delays are unknown; the links are known.",
        "",
        *_hidden([*of("arm_hidden"), *of("arm_elastic")], (*unforced_arms.HIDDEN, "joint_flexibility")),
        *_nulls(of("arm_nulls")),
        *_pace([*of("arm_hidden"), *of("arm_elastic"), *of("arm_nulls")]),
        "",
        *[f"- failed: {r['part']} {r['number']}: {r['failed']}" for r in records if "failed" in r],
    ]
    return "\n".join(lines).rstrip() + "\n"


def right(record: Record) -> bool:
    """Check that the hidden effect is named, or stands among the alternatives, and nothing else is named."""
    named = [{kind, *others} for kind, others in zip(record["named"], record["alternatives"], strict=True)]
    return len(named) == 1 and record["hidden"] in named[0]


def _intervals(fits: Sequence[Record]) -> Iterator[str]:
    yield from (
        "| unknown | values | 95 % holds | 99 % range of so many draws | mean z | largest |",
        "|---|---|---|---|---|---|",
    )
    z: dict[str, list[float]] = {}
    for r in fits:
        for name, value in r.get("z", {}).items():
            # Both joints of an arm in one line.
            z.setdefault(name.replace("[1]", "").replace("[2]", ""), []).append(value)
    every = [v for values in z.values() for v in values]
    for name, values in [*z.items(), ("all", every)]:
        if not values:
            continue
        low, high = (100 * x / len(values) for x in binom.interval(0.99, len(values), 0.95))
        held = 100 * np.mean(np.abs(values) < 1.96)
        yield (
            f"| {name} | {len(values)} | {held:.1f} % | {low:.0f}-{high:.0f} % | {np.mean(values):+.2f} | "
            f"{np.max(np.abs(values)):.1f} |"
        )
    bad = sum(not r.get("converged", False) for r in fits)
    yield from ("", f"{len(fits)} fits; {bad} did not converge or failed.", "")


def _hidden(runs: Sequence[Record], kinds: Sequence[str]) -> Iterator[str]:
    yield "| hidden | runs | visible | of those named | others named as well or instead |"
    yield "|---|---|---|---|---|"
    for kind in (*kinds, "all"):
        some = [r for r in runs if kind in (r["hidden"].split("[")[0], "all") and "failed" not in r]
        seen = [r for r in some if r["oracle"] >= VISIBLE]
        if some:
            others = (f"{' + '.join(r['named']) or 'none'}{_for(r['hidden'])}" for r in seen if not right(r))
            wrong = "" if kind == "all" else ", ".join(others)
            yield f"| {kind} | {len(some)} | {len(seen)} | {sum(map(right, seen))} | {wrong} |"
    yield from ("", f"Visible: an oracle that knows the truth gains at least {VISIBLE:g} nats.", "")


def _for(hidden: str) -> str:
    """Return a remark on the joint at which an effect was hidden; none for a machine of one joint."""
    return f" (at joint {hidden[:-1].split('[')[1]})" if "[" in hidden else ""


def _nulls(runs: Sequence[Record]) -> Iterator[str]:
    nulls = [r for r in runs if "failed" not in r]
    false = [r for r in nulls if r["named"]]
    listed = "; ".join(" + ".join(r["named"]) for r in false)
    verdicts = sum(r["verdict"] == "nothing_missing" for r in nulls)
    yield (
        f"Complete cases: {len(nulls)}; {len(false)} with an effect named{f' ({listed})' if listed else ''}; "
        f"{verdicts} with the verdict nothing_missing."
    )
    yield ""


def _pace(runs: Sequence[Record]) -> Iterator[str]:
    seconds = [r["search_seconds"] for r in runs if "search_seconds" in r]
    hidden = [r["search_seconds"] for r in runs if "search_seconds" in r and r["hidden"]]
    if seconds:
        busy = [r["search_cpu_seconds"] for r in runs if "search_cpu_seconds" in r]
        of_cores = f"; {np.median(busy):.0f} s of a core's time (median of {len(busy)})" if busy else ""
        clock = f"{np.median(seconds):.0f} s (median), {np.max(seconds):.0f} s at most"
        clock += f", {np.median(hidden):.0f} s where an effect is hidden (median)" if hidden else ""
        yield f"A search takes {clock}{of_cores}."
