"""Raw public logs through `jaxid init`, `check`, `identify` and `discover`, beside the values known of them.

    JAXID_DATA=FOLDER python -m benchmarks.public_logs [--only PART]... [--again] [-o DIR]

Nothing is edited between the commands. Results are kept in DIR/public_logs.jsonl as they end; a second call
goes on from there, and rewrites the table DIR/public_logs.md from all of them. --again runs them anew.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
import tomllib
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.measured import measured_folder
from benchmarks.public_logs_table import ROWS, Row

HERE = Path(__file__).parent / "results"
ROOT = Path(__file__).parents[1]
# Longest time of one command [s].
LIMIT = 120
# Deviation from the known value beyond which a value is called wrong.
WRONG = 0.1


def command(*words: object) -> tuple[int, str, float]:
    """Run one command; return its status, its output or the last line of its errors, and its time."""
    begin = time.perf_counter()
    call = [sys.executable, "-m", "jaxid.cli", *map(str, words)]
    try:
        ended = subprocess.run(call, capture_output=True, text=True, timeout=LIMIT, cwd=ROOT, check=False)
    except subprocess.TimeoutExpired:
        return 124, f"over {LIMIT} s", LIMIT
    said = ended.stdout if ended.returncode == 0 else (ended.stderr.strip().splitlines() or [""])[-1]
    return ended.returncode, said.removeprefix("jaxid: "), time.perf_counter() - begin


def run(row: Row, data: Path, folder: Path) -> dict[str, Any]:
    """Run the commands on one log; return its record."""
    log = data / row.file
    if row.made is not None:
        log = folder / Path(row.file).name
        row.made(data, log)
    case = folder / "case.toml"
    record: dict[str, Any] = {"file": row.file}

    def without_path(text: str) -> str:
        return text.replace(str(log), log.name).replace(f"{data}/", "")

    def step(name: str, *words: object) -> bool:
        status, said, seconds = command(*words)
        record[name] = {"status": status, "seconds": round(seconds, 1)}
        if status not in (0, 1):
            record[name]["said"] = without_path(said)
        return status in (0, 1)

    if not step("init", "init", log, "-o", case):
        return record
    record["assumed"] = case.read_text().count("# assumed")
    record["questions"] = case.read_text().count("# question")
    record["case"] = tomllib.loads(case.read_text())
    if not step("check", "check", case, log):
        return record
    if step("identify", "identify", case, log, "-o", folder / "fit"):
        result = json.loads((folder / "fit/result.json").read_text())
        record |= {key: result[key] for key in ("method", "converged", "parameters", "model_complete", "gap")}
        record["first_words"] = without_path(result["findings"][0]) if result["findings"] else None
    if row.search and step("discover", "discover", case, log, "-o", folder / "found", "--no-experiments"):
        found = json.loads((folder / "found/discovery.json").read_text())
        record |= {"verdict": found["verdict"], "found": [e["kind"] for e in found["effects"]]}
        record |= {"parameters_found": found["parameters"], "where": (found["where"] or {}).get("text")}
    return record


def numbers_of(record: dict[str, Any], key: str) -> dict[str, float]:
    """Return a number of each unknown of a record, such as its "value" or its "std", by its name."""
    numbers: dict[str, float] = {}
    for name, entry in record.get("parameters", {}).items():
        several = isinstance(entry[key], list)
        listed = entry[key] if several else [entry[key]]
        names = [f"{name}[{k}]" if several else name for k in range(1, len(listed) + 1)]
        numbers |= {n: v for n, v in zip(names, listed, strict=True) if v is not None}
    return numbers


def printed(row: Row, record: dict[str, Any]) -> dict[str, float]:
    """Return the values of a record that the table compares."""
    values = numbers_of(record, "value")
    if row.derived is not None and values:
        return dict(row.derived(values))
    return {name: values[name] for name in row.truth if name in values} if row.truth else values


def cells(row: Row, record: dict[str, Any]) -> list[str]:
    """Return the cells of one row of the table."""
    steps = [name for name in ("init", "check", "identify", "discover") if name in record]
    failed = next((name for name in steps if record[name]["status"] not in (0, 1)), None)
    ran = ", ".join(f"{name} {record[name]['seconds']:g} s" for name in steps)
    values, std = printed(row, record), {} if row.derived is not None else numbers_of(record, "std")
    shown, off = [], []
    for name, value in values.items():
        shown.append(f"{name} {value:.4g}")
        if name in row.truth:
            part = value / row.truth[name] - 1
            away = f", {abs(value - row.truth[name]) / std[name]:.1f} σ" if std.get(name) else ""
            off.append(f"{100 * part:+.1f} %{away}" + (" **wrong**" if abs(part) > WRONG else ""))
    missing = [name for name in row.truth if name not in values and "parameters" in record]
    shown += [f"{name} not identified" for name in missing]
    if failed is not None:
        shown.append(f"`{failed}` refuses: {record[failed]['said']}")
    if "parameters" in record and not record["converged"]:
        shown.append("not converged")
    if record.get("first_words") and (any("wrong" in o for o in off) or not record.get("model_complete")):
        shown.append(f"first words: {record['first_words']}")
    elif record.get("model_complete") is False:
        shown.append("the model is said to be incomplete")
    if "verdict" in record:
        shown.append(f"discover: {record['verdict'].replace('_', ' ')} {', '.join(record['found'])}".rstrip())
        if record["verdict"] == "unexplained" and record.get("where"):
            shown.append(record["where"])
    truth = ", ".join(f"{value:.4g}" for value in row.truth.values()) or "-"
    cells = [row.file, ran, "<br>".join(shown), truth, "<br>".join(off) or "-", row.of]
    return [*cells, record.get("commit", ""), record.get("date", "")]


def table(records: dict[str, dict[str, Any]]) -> str:
    """Return the page."""
    rows = [cells(row, records[row.file]) for row in ROWS if row.file in records]
    head = ["log", "commands", "result", "known", "off", "known from", "commit", "date"]
    lines = [
        "# Raw public logs, three commands each",
        "",
        "Written by `python -m benchmarks.public_logs`. Each log goes as it is through `jaxid init LOG`,",
        "`jaxid check case.toml LOG` and `jaxid identify case.toml LOG -o out`; if the row says so,",
        "`jaxid discover` follows. No case is edited. Known values are in the order of the results and in",
        "the units of the case: per A, V or count if the log states no more. σ is the standard deviation",
        f"that `identify` prints. A value more than {100 * WRONG:.0f} % off stands as wrong. Times are",
        "those of two shared cores, with import and compilation. The simulator of field/ leaves the exact",
        "motion by some counts of the encoder: see docs/public_logs.md.",
        "",
        "| " + " | ".join(head) + " |",
        "|" + "---|" * len(head),
        *("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", action="append", default=[], help="part of a file's name; may be repeated")
    parser.add_argument("--again", action="store_true", help="run logs that have a result already")
    parser.add_argument("-o", type=Path, default=HERE)
    args = parser.parse_args()
    data = measured_folder(parser)
    kept = args.o / "public_logs.jsonl"
    lines = kept.read_text().splitlines() if kept.exists() else []
    records = {entry["file"]: entry for entry in map(json.loads, lines)}
    describe = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(describe, capture_output=True, text=True, cwd=ROOT, check=True).stdout.strip()
    for row in ROWS:
        wanted = not args.only or any(part in row.file for part in args.only)
        if not wanted or (row.file in records and not args.again):
            continue
        with tempfile.TemporaryDirectory() as folder:
            record = run(row, data, Path(folder)) | {"commit": commit, "date": date.today().isoformat()}
        records[row.file] = record
        kept.write_text("".join(json.dumps(r) + "\n" for r in records.values()))
        (args.o / "public_logs.md").write_text(table(records))
        print(" | ".join(cells(row, record)), flush=True)
    (args.o / "public_logs.md").write_text(table(records))


if __name__ == "__main__":
    main()
