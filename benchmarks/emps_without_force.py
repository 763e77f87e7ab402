"""EMPS, a measured axis, from position and reference alone, beside the values that use its force.

    JAXID_DATA=FOLDER python -m benchmarks.emps_without_force [-o DIR]

`identify` reads neither the command nor the force, only the gains that were published with the data. Its
values stand beside those of methods that use the logged force. The force judges all of them: each fitted
machine follows both logs in its loop, and its command is compared with the logged one. Writes
emps_without_force.json and .md.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

import jaxid
from benchmarks.stored_runs import commit_of
from experiments.common import case_with_data
from experiments.emps import PUBLISHED
from jaxid.commands.identify import Identification
from jaxid.gap import gaps
from jaxid.session import OpenedLog, open_session

HERE = Path(__file__).parent / "results"
ROOT = Path(__file__).parents[1]
FILES = ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")
CASES = ("emps_no_force.toml", "emps_recipe.toml")
# What the published model lacks, by `discover` on the logged force (docs/evidence/emps.md).
BY_DIRECTION = '[[effects]]\nkind = "asymmetric_viscous"\ncoefficient = { guess = 0.0 }\n\n[actuator]'
UNITS = {**{name: unit for name, (_, unit) in PUBLISHED.items()}, "asymmetric_viscous.coefficient": "N s/m"}
PUBLISHED_SIGMA = {
    "inertia": 0.11,
    "viscous_friction.coefficient": 1.15,
    "coulomb_friction.level": 0.10,
    "constant_force.level": 0.044,
}


@dataclass(frozen=True)
class Fit:
    """A fit of the benchmark.

    Attributes:
        name: Name in the table.
        case: File of the case.
        options: Options of `identify`.
        by_direction: Whether viscous friction may differ by direction.
    """

    name: str
    case: str
    options: Mapping[str, str]
    by_direction: bool = False

    @property
    def uses_force(self) -> bool:
        """Whether the fit reads the logged force."""
        return self.case != "emps_no_force.toml"


FITS = (
    Fit("no force", "emps_no_force.toml", {}),
    Fit("force, inverse dynamics", "emps_aligned.toml", {"method": "inverse_dynamics"}),
    Fit("force, in the loop", "emps_aligned.toml", {"method": "output_error", "on": "force"}),
    Fit("no force", "emps_no_force.toml", {}, by_direction=True),
    Fit("force, inverse dynamics", "emps_aligned.toml", {"method": "inverse_dynamics"}, by_direction=True),
)


def folder_of_cases(folder: Path) -> Path:
    """Write the cases of all fits to a folder, with links to the logs."""
    case_with_data(folder, CASES, "emps", FILES)
    recipe = (folder / "emps_recipe.toml").read_text()
    # The force of a held command counts at the middle of its interval.
    (folder / "emps_aligned.toml").write_text(recipe.replace("trim = 50", "trim = 50\nalign_hold = true"))
    for name in ("emps_no_force", "emps_aligned"):
        text = (folder / f"{name}.toml").read_text()
        (folder / f"{name}_by_direction.toml").write_text(text.replace("[actuator]", BY_DIRECTION))
    return folder


def fitted(fit: Fit, folder: Path) -> Identification:
    """Run one fit in the folder of the cases."""
    name = fit.case.replace(".toml", "_by_direction.toml") if fit.by_direction else fit.case
    return jaxid.identify(folder / name, folder / FILES[0], **fit.options)


def judged(result: Identification, logs: tuple[OpenedLog, ...]) -> dict[str, dict[str, float]]:
    """Return how far a fitted machine is from logs with their force, in the loop and by inverse dynamics."""
    out = {}
    for gap in gaps(result.estimate.machine, logs):
        run = gap.simulation
        assert run is not None, "the loop of a fitted axis is stable"
        assert run.command_relative is not None, "these logs have a force"
        out[gap.name] = {
            "position_rms": float(run.rms[0]),
            "position_relative": float(run.relative[0]),
            "command_relative": float(run.command_relative[0]),
            "force_relative": float(gap.force.relative[0]),
        }
    return out


def record(fit: Fit, folder: Path, logs: tuple[OpenedLog, ...]) -> dict[str, Any]:
    """Run one fit and return its record."""
    begin = time.perf_counter()
    result = fitted(fit, folder)
    seconds = time.perf_counter() - begin
    return {
        "name": fit.name,
        "uses_force": fit.uses_force,
        "by_direction": fit.by_direction,
        "method": result.estimate.method,
        "converged": bool(result.estimate.converged),
        "complete": result.model_complete,
        "seconds": round(seconds, 1),
        "parameters": {
            name: {"value": p.value, "std": p.std, "unit": p.unit} for name, p in result.parameters.items()
        },
        "gaps": judged(result, logs),
        "notes": list(result.estimate.notes),
    }


def published() -> dict[str, Any]:
    """Return the published values as a record, with the errors in the loop that were published with them."""
    names = ("position_relative", "command_relative", "force_relative")
    errors = {"fit": (1.38e-4, 0.0585, 0.0408), "pulses": (8.0e-5, 0.0894, 0.0598)}
    return {
        "name": "published (IDIM-LS)",
        "uses_force": True,
        "by_direction": False,
        "parameters": {
            name: {"value": value, "std": PUBLISHED_SIGMA[name], "unit": unit}
            for name, (value, unit) in PUBLISHED.items()
        },
        "gaps": {log: dict(zip(names, values, strict=True)) for log, values in errors.items()},
    }


def difference(ours: dict[str, Any], other: dict[str, Any], name: str) -> tuple[float, float]:
    """Return how far a value is from that of another record: relative to that one, and in its own sigma."""
    mine, theirs = ours["parameters"][name], other["parameters"][name]
    off = mine["value"] - theirs["value"]
    return off / abs(theirs["value"]), off / mine["std"]


def table(content: dict[str, Any]) -> str:
    """Return the page."""
    lines = [
        "# EMPS without its force column",
        "",
        f"Written by `python -m benchmarks.emps_without_force` on {content['date']}, at {content['commit']}.",
        "Fits named *no force* read position and reference. Known are gains and period of the loop, and the",
        "force per volt. Values with their σ:",
        "",
    ]
    for by_direction in (False, True):
        records = [r for r in content["records"] if r["by_direction"] == by_direction]
        names = [n for n in UNITS if n in records[0]["parameters"]]
        title = "Viscous friction by direction, a fifth unknown:" if by_direction else "The published model:"
        lines += [title, "", "| | " + " | ".join(f"{n} [{UNITS[n]}]" for n in names) + " |"]
        lines.append("|---" * (len(names) + 1) + "|")
        rows = records if by_direction else [*records, published()]
        for r in rows:
            p = r["parameters"]
            cells = " | ".join(f"{p[n]['value']:.2f} ± {p[n]['std']:.2f}" for n in names)
            lines.append(f"| {r['name']} | {cells} |")
        lines += ["", "*No force* less the others, in % of theirs and in σ of *no force*:", ""]
        lines += ["| | " + " | ".join(names) + " |", "|---" * (len(names) + 1) + "|"]
        for r in rows[1:]:
            pairs = [difference(rows[0], r, n) for n in names]
            cells = " | ".join(f"{100 * part:+.1f} %, {sigmas:+.1f} σ" for part, sigmas in pairs)
            lines.append(f"| {r['name']} | {cells} |")
        lines += ["", "What is left, relative to what was measured, fitted log and validation log [%]:", ""]
        lines.append("| | position in the loop | command in the loop | force by inverse dynamics |")
        lines.append("|---|---|---|---|")
        for r in rows:
            cells = []
            for key, digits in (("position_relative", 5), ("command_relative", 2), ("force_relative", 2)):
                cells.append(", ".join(f"{100 * g[key]:.{digits}f}" for g in r["gaps"].values()))
            lines.append(f"| {r['name']} | {' | '.join(cells)} |")
        first = rows[0]
        says = "complete" if first["complete"] else "not complete"
        rms = ", ".join(f"{1e6 * g['position_rms']:.2f}" for g in first["gaps"].values())
        left = f"jaxid calls the model of *no force* {says}; {rms} µm RMS of the position are left."
        lines += ["", left, ""]
    lines += [f"Notes of the first fit: {'; '.join(content['records'][0]['notes'])}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", type=Path, default=HERE)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = folder_of_cases(Path(temporary))
        # The published filter, for the force of the last column.
        logs = open_session(folder / "emps_recipe.toml", folder / FILES[0]).runs
        records = [record(fit, folder, logs) for fit in FITS]
    content = {"date": date.today().isoformat(), "commit": commit_of(ROOT), "records": records}
    kept = args.o / "emps_without_force.json"
    kept.write_text(json.dumps(content, indent=1, default=_plain) + "\n")
    page = table(content)
    (args.o / "emps_without_force.md").write_text(page)
    print(page, flush=True)


def _plain(x: Any) -> Any:
    """Return a number of numpy as one of Python."""
    return np.asarray(x).tolist()


if __name__ == "__main__":
    main()
