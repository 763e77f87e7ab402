"""Rate at which `compare` names the difference of two machines, and one where there is none.

    python -m benchmarks.compare [--split test] [--count 100] [--only belt] [--minutes 3] [--resume]

Every pair of `truth/hidden/pairs.py` goes through `jaxid.compare`; a line of JSON each, then the table as
`compare.md` and `compare.json`. Exits with 1 where an aim is missed, with 3 while pairs are left.
"""

import argparse
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import jaxid
from benchmarks.stored_runs import append_runs, commit_of, read_runs
from jaxid.logs.log import Log
from truth.hidden.pairs import ALIKE, FIRST_SEED, Pair, pairs

ROOT = Path(__file__).parent.parent
NAMED_AIM, FALSE_AIM = 0.95, 0
# Names that mean one thing: a mass is the inertia of an axis.
SAME = {"added_mass": "inertia"}


def main() -> int:
    options = _options()
    chosen = [p for p in pairs(options.split, options.count) if options.only in p.id]
    # Pairs of one shape follow each other, since compiled code serves them all: the most first, belts last.
    many = Counter((p.scale, p.noise) for p in chosen)
    chosen.sort(key=lambda p: (p.scale == "belt", -many[p.scale, p.noise], p.scale, p.noise))
    lines = Path(options.o) / f"compare_{options.split}.jsonl"
    lines.parent.mkdir(parents=True, exist_ok=True)
    if lines.exists() and not options.resume:
        print(f"{lines} exists; give --resume to go on, or another -o", file=sys.stderr)
        return 2
    done = {record["id"] for record in read_runs(lines)}
    end = time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        for pair in chosen:
            if pair.id not in done and time.monotonic() < end:
                record = run(pair, Path(folder))
                append_runs(lines, [record])
                print(_line(record), flush=True)
    records = [r for r in read_runs(lines) if r["id"] in {p.id for p in chosen}]
    table = summary(records, options.split) | {"left": len(chosen) - len(records)}
    (Path(options.o) / "compare.json").write_text(json.dumps(table, indent=1) + "\n")
    (Path(options.o) / "compare.md").write_text(markdown(table, records))
    print(markdown(table, records))
    if table["left"]:
        print(f"{len(records)} of {len(chosen)} pairs are done; --resume goes on")
        return 3
    return int(not table["aims_hold"])


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", choices=tuple(FIRST_SEED), default="calibrate")
    parser.add_argument("--count", type=int, default=100, help="pairs that differ, and as many that do not")
    parser.add_argument("--only", metavar="TEXT", default="", help="pairs in whose name this stands")
    parser.add_argument("--minutes", type=float, default=1e6, help="start no pair after so many")
    parser.add_argument("--resume", action="store_true", help="skip the pairs that are done")
    parser.add_argument("-o", metavar="DIR", default=str(ROOT / "results" / "compare"))
    return parser.parse_args()


def run(pair: Pair, folder: Path) -> dict:
    """Compare the machines of a pair; return the oracle's evidence and the result of jaxid."""
    case = pair.write_case(folder)
    logs = [
        log if pair.scale == "belt" else Log(**(log | {"source": name}))
        for log, name in zip(pair.logs(), ("first.csv", "second.csv"), strict=True)
    ]
    record = {
        "id": pair.id, "what": pair.what, "scale": pair.scale, "noise": pair.noise, "alike": pair.alike,
        "sensor": pair.sensor, "names": list(pair.names), "change": pair.change,
        "oracle": {name: list(seen) for name, seen in pair.sights().items()}, "visible": pair.visible,
    }  # fmt: skip
    begin = time.process_time()
    try:
        found = jaxid.compare(case, logs)
    except jaxid.InputError as error:
        return record | {"verdict": "refused", "named": [], "error": str(error)}
    except Exception as error:  # the benchmark must survive it; it counts as wrong
        return record | {"verdict": "crashed", "named": [], "error": repr(error)}
    return record | {
        "verdict": found.verdict,
        "named": [_kind(d.label) for d in found.differences],
        "alternatives": [[_kind(r.label) for r in d.alternatives] for d in found.differences],
        "evidence": [d.evidence for d in found.differences],
        "false_alarm": [d.false_alarm for d in found.differences],
        "threshold": found.threshold,
        "missing_alike": list(found.alike),
        "why": found.why,
        "cpu_seconds": time.process_time() - begin,
    }


def _kind(label: str) -> str:
    """Return a label without the place of a backlash, of which the machine has one spring."""
    return SAME.get(label, label.split("[")[0] if label.startswith("backlash") else label)


def right(record: dict) -> bool:
    """Check that exactly the difference is named."""
    return sorted(record["named"]) == sorted(record["names"])


def listed(record: dict) -> bool:
    """Check that the difference is named, or stands among the alternatives of a named one."""
    if len(record["named"]) != len(record["names"]):
        return False
    pairs = zip(record["named"], record["alternatives"], strict=True)
    known = [{name, *others} for name, others in pairs]
    return all(any(name in one for one in known) for name in record["names"])


def summary(records: Sequence[dict], split: str) -> dict:
    """Return the table, by kind of difference."""
    rows = []
    for what in dict.fromkeys(r["what"] for r in records if r["names"]):
        own = [r for r in records if r["what"] == what]
        seen = [r for r in own if r["visible"]]
        rows.append(
            {
                "what": what, "pairs": len(own), "visible": len(seen),
                "named": sum(map(right, seen)), "listed": sum(map(listed, seen)),
                "same": sum(r["verdict"] == "same" for r in seen),
            }
        )  # fmt: skip
    nulls = []
    for what, alike in (("complete", False), ("incomplete in both alike", True)):
        own = [r for r in records if not r["names"] and bool(r["alike"]) == alike]
        false = [r for r in own if r["verdict"] != "same"]
        nulls.append(
            {"what": what, "pairs": len(own), "false": len(false), "which": [r["id"] for r in false]}
        )
    visible, named = (sum(row[key] for row in rows) for key in ("visible", "named"))
    seconds = sorted(r["cpu_seconds"] for r in records if "cpu_seconds" in r)
    return {
        "split": split, "commit": commit_of(ROOT), "date": time.strftime("%Y-%m-%d"),
        "differ": rows, "nulls": nulls, "visible": visible, "named": named,
        "median_cpu_seconds": seconds[len(seconds) // 2] if seconds else None,
        "aims_hold": named >= NAMED_AIM * visible and sum(n["false"] for n in nulls) <= FALSE_AIM,
    }  # fmt: skip


def markdown(table: dict, records: Sequence[dict]) -> str:
    """Return the table as a page."""
    lines = [
        "# Do two logs come from one machine?",
        "",
        f"`python -m benchmarks.compare --split {table['split']}` at commit {table['commit']}, "
        f"{table['date']}. Logs are made by exact steppers that share no line with the package; the two of "
        "a pair follow different tours. An oracle reads the exact forces. Median "
        f"{table['median_cpu_seconds'] or 0.0:.1f} s of a processor a pair."
        + (f" {table['left']} pairs are still to run (`--resume`)." if table["left"] else ""),
        "",
        "| differs | pairs | an oracle sees | named | named or among the alternatives | called same |",
        "|---|---|---|---|---|---|",
        *[
            f"| {r['what'].replace('_', ' ')} | {r['pairs']} | {r['visible']} | {r['named']} | {r['listed']} "
            f"| {r['same']} |"
            for r in table["differ"]
        ],
        f"| all | {sum(r['pairs'] for r in table['differ'])} | {table['visible']} | {table['named']} "
        f"| {sum(r['listed'] for r in table['differ'])} | {sum(r['same'] for r in table['differ'])} |",
        "",
        "| nothing differs, the model is | pairs | false |",
        "|---|---|---|",
        *[f"| {n['what']} | {n['pairs']} | {n['false']} |" for n in table["nulls"]],
        "",
        f"Effects that the model lacks in both alike: {', '.join(ALIKE)}.",
        "",
        f"Aims: {100 * NAMED_AIM:.0f} % of what an oracle sees named, {FALSE_AIM} false: "
        f"{'held' if table['aims_hold'] else 'missed'}{' so far' if table['left'] else ''}.",
        "",
    ]
    wrong = [
        r for r in records if (r["visible"] and not right(r)) or (not r["names"] and r["verdict"] != "same")
    ]
    if wrong:
        lines += ["Not as they should be:", "", *[f"- {_line(r)}" for r in wrong], ""]
    return "\n".join(lines)


def _line(record: dict) -> str:
    found = ", ".join(record["named"]) or record.get("error") or record.get("why") or ""
    seen = "" if record["visible"] or not record["names"] else " (invisible)"
    mark = "ok " if record["verdict"] == "same" and not record["names"] or right(record) else "NOT"
    return f"{mark} {record['id']}{seen}: {record['verdict']} {found}"


if __name__ == "__main__":
    sys.exit(main())
