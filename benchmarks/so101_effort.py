"""SO-101: what the load that its servos report says of the forces of the fitted loop.

    JAXID_DATA=FOLDER python -m benchmarks.so101_effort [-o DIR]

Each joint is fitted to one motion from command and encoder alone, as in `benchmarks.so101`. The load column,
a magnitude, stands beside the log as `[log] effort`. Writes so101_effort.json and so101_effort.md.
"""

import argparse
import json
import time
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from benchmarks.measured import measured_folder
from benchmarks.so101 import HERE, JOINTS, ROOT, ROW, ROWS, case_of, motions
from benchmarks.stored_runs import commit_of

MOTION = "multisine"


def run(joint: int, motion: np.ndarray) -> dict[str, Any]:
    """Fit one joint, 1-based, and return what its load says."""
    case = case_of()
    case["log"] = {**case["log"], "effort": "load"}
    columns = {"t": ROW * np.arange(len(motion)), "q": motion[f"q{joint}"], "r": motion[f"cmd{joint}"]}
    begin = time.perf_counter()
    result = jaxid.identify(case, {**columns, "load": motion[f"load{joint}"]})
    (entry,) = result.estimate.details["effort"]
    return {"joint": joint, "seconds": round(time.perf_counter() - begin, 1), **entry}


def table(content: dict[str, Any]) -> str:
    """Return the page."""
    lines = [
        "# The load of the SO-101's servos beside the fitted force",
        "",
        f"Written by `python -m benchmarks.so101_effort` on {content['date']}, at {content['commit']}.",
        f"Each joint is fitted to the first {ROWS} rows of {MOTION} alone; the load is a magnitude.",
        "The scale of the forces is that of the file's inertia of the rotor, 0.028 kg m^2.",
        "The gain is the load over the force.",
        "",
        "| joint | variance explained | by chance up to | gain | delay [ms] | lag [ms] | used for |",
        "|---|---|---|---|---|---|---|",
    ]
    for entry in content["joints"]:
        cells = [JOINTS[entry["joint"] - 1]]
        if "agreement" in entry:
            cells += [f"{100 * entry['agreement']:.0f} %", f"{100 * entry['chance']:.0f} %"]
            cells += [number(entry["gain"], 1.0), number(entry["delay"], 1e3), number(entry["lag"], 1e3)]
        else:
            cells += 5 * [""]
        lines.append(f"| {' | '.join(cells)} | {entry['use']}: {entry['reason']} |")
    return "\n".join(lines) + "\n"


def number(entry: dict[str, Any] | None, factor: float) -> str:
    """Return a value with its standard deviation; without one it is at an end of the search."""
    if entry is None:
        return ""
    std = "" if entry["std"] is None else f" ± {factor * entry['std']:.2g}"
    return f"{factor * entry['value']:.3g}{std}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    motion = motions(measured_folder(parser, "so101"))[MOTION][:ROWS]
    joints = [run(joint, motion) for joint in range(1, len(JOINTS) + 1)]
    content = {"commit": commit_of(ROOT), "date": date.today().isoformat(), "joints": joints}
    (options.o / "so101_effort.json").write_text(json.dumps(content, indent=1) + "\n")
    (options.o / "so101_effort.md").write_text(table(content))
    print(table(content))


if __name__ == "__main__":
    main()
