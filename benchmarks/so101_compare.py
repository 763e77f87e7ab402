"""SO-101's motions among themselves: are they of one machine? `compare` is asked joint by joint.

    JAXID_DATA=FOLDER python -m benchmarks.so101_compare [--joint N]... [-o DIR]

The motions were recorded with one arm, so that nothing should differ, except where the arm touches the table.
The model of a joint is that of `benchmarks.so101`. Writes so101_compare.json and so101_compare.md.
"""

import argparse
import json
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from benchmarks.measured import measured_folder
from benchmarks.so101 import FITTED, JOINTS, MOVES, ROW, TOUCHING, case_of, motions
from benchmarks.stored_runs import commit_of

HERE = Path(__file__).parent / "results"
# Rows of each motion that are compared: 20 s.
ROWS = 1001


def run(joint: int, logs: dict[str, np.ndarray]) -> dict[str, Any]:
    """Compare the motions of one joint, 1-based, in which it moves; return the record."""
    case: dict[str, Any] = {**case_of(), "fit": []}
    # The base, to which the others are compared, is the motion that moves the joint most.
    logs = dict(sorted(logs.items(), key=lambda item: -float(np.std(np.diff(item[1][f"q{joint}"])))))
    with tempfile.TemporaryDirectory() as folder:
        for name, motion in logs.items():
            first = FITTED.get(name, 0)
            some = slice(first, min(first + ROWS, len(motion)))
            position, command = motion[f"q{joint}"][some], motion[f"cmd{joint}"][some]
            if np.ptp(command) <= MOVES:
                continue
            path = Path(folder) / f"{name}.csv"
            table = np.stack([ROW * np.arange(len(position)), position, command], axis=1)
            np.savetxt(path, table, "%.9g", ",", header="t,q,r", comments="")
            case["fit"].append({"name": name, "log": str(path)})
        begin = time.perf_counter()
        result = jaxid.compare(case)
        seconds = time.perf_counter() - begin
    return {
        "joint": joint,
        "commit": commit_of(HERE.parents[1]),
        "verdict": result.verdict,
        "why": result.why,
        "differences": [
            {
                "label": d.label,
                "evidence": d.evidence,
                "threshold": d.threshold,
                "false_alarm": d.false_alarm,
                "alternatives": [r.label for r in d.alternatives],
                "values": {log: _words(v) for log, v in d.by_log.items()},
            }
            for d in result.differences
        ],
        "alike": list(result.alike),
        "left": {gap.name: 1e3 * float(gap.explained[0]) for gap in result.gaps},
        "seconds": round(seconds, 1),
    }


def _words(found: Any) -> Any:
    """Return the values of a difference in one log as JSON."""
    if found is None:
        return None
    if isinstance(found, dict):
        return {name: _words(one) for name, one in found.items()}
    return {"value": found.value, "std": found.std if np.isfinite(found.std) else None, "unit": found.unit}


def table(content: dict[str, Any]) -> str:
    """Return the page."""
    lines = [
        "# SO-101's motions among themselves",
        "",
        f"Written by `python -m benchmarks.so101_compare` on {content['date']}, at "
        f"{', '.join(sorted({r['commit'] for r in content['joints']}))}.",
        f"{ROWS} rows of each motion in which the joint moves. One arm made all of them; in",
        f"{' and '.join(TOUCHING)} it touches the table, which the model of a joint does not know.",
        "",
        "| joint | motions | verdict | differs | in all alike | left, mrad RMS | s |",
        "|---|---|---|---|---|---|---|",
    ]
    for record in sorted(content["joints"], key=lambda r: r["joint"]):
        differs = [f"{d['label']} ({d['evidence']:.0f} nats)" for d in record["differences"]]
        left = list(record["left"].values())
        cells = [
            JOINTS[record["joint"] - 1],
            str(len(left)),
            record["verdict"],
            ", ".join(differs) or record["why"] or "nothing",
            ", ".join(record["alike"]) or "nothing",
            f"{min(left):.1f} to {max(left):.1f}",
            f"{record['seconds']:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    for record in sorted(content["joints"], key=lambda r: r["joint"]):
        for d in record["differences"]:
            lines += ["", f"{JOINTS[record['joint'] - 1]}, {d['label']}: {json.dumps(d['values'])}"]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joint", type=int, action="append", default=[], help="1 to 5; may be repeated")
    parser.add_argument("-o", type=Path, default=HERE)
    args = parser.parse_args()
    kept = args.o / "so101_compare.json"
    logs = motions(measured_folder(parser, "so101"))
    for joint in args.joint or range(1, len(JOINTS) + 1):
        record = run(joint, logs)
        content = json.loads(kept.read_text()) if kept.exists() else {"joints": []}
        content["joints"] = [r for r in content["joints"] if r["joint"] != joint] + [record]
        content["date"] = date.today().isoformat()
        kept.write_text(json.dumps(content, indent=1) + "\n")
        (args.o / "so101_compare.md").write_text(table(content))
        print(table(content), flush=True)


if __name__ == "__main__":
    main()
