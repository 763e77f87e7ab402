"""SO-101 as a whole: its MJCF and raw motions in, the MJCF with fitted servos out, by one command.

    JAXID_DATA=FOLDER python -m benchmarks.so101_arm [-o DIR]

Runs `jaxid identify so101.xml MOTION... --validate MOTION... -o out` in a fresh process, on the files as they
are. What the command prints of MuJoCo's replay stands in DIR/so101_arm.md, with the time that it took.
Then the same case is fitted with what an MJCF does not hold, and `jaxid export --check` says what that moves.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import numpy as np

from benchmarks.measured import measured_folder
from benchmarks.play_operator import fitted, left_of
from benchmarks.so101 import ROW, motions
from benchmarks.stored_runs import commit_of

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
FITTED = ("multisine", "friction_gravity", "prbs_excitation")
# The motions that `benchmarks.so101` leaves out as well.
LEFT_OUT = ("backlash_detection", "single_joint_rotation", "slow_precision")
LEFT_OUT += ("step_response", "trapezoidal_profile", "wave_motion")
# A fitted motion and one that was left out, on which single effects are taken out.
CHECKED = ("multisine", "step_response")
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def main() -> int:
    """Run the commands, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    data = measured_folder(parser, "so101")

    with tempfile.TemporaryDirectory() as folder:
        found = _found(data, Path(folder))
    if found is None:
        return 1
    page = _page(found)
    (options.o / "so101_arm.md").write_text(page)
    print(page)
    return 0


@dataclass(frozen=True)
class Found:
    """Outcome of the commands.

    Args:
        plain: Fit of the servos as the MJCF knows them, and its result.
        fuller: Fit with what an MJCF does not hold, and its result.
        checked: What `jaxid export --check` prints of the second fit, by motion.
        play: Mean RMS that play operators leave of the motions left out, first five joints [mrad].
    """

    plain: "Ran"
    first: dict
    fuller: "Ran"
    second: dict
    checked: dict[str, str]
    play: float


def _found(data: Path, folder: Path) -> Found | None:
    """Run the commands on the files in a folder; None if a fit has left no result."""
    out, more = folder / "out", folder / "more"
    motions = [str(data / f"{name}.csv") for name in FITTED]
    for name in LEFT_OUT:
        motions += ["--validate", str(data / f"{name}.csv")]

    plain = Ran.of(["identify", str(data / "so101.xml"), *motions, "-o", str(out)])
    first = plain.result(out)
    if first is None:
        return None
    case = (out / "first_case.toml").read_text() + "".join(map(_effects, range(1, 7)))
    (out / "more.toml").write_text(case)
    fuller = Ran.of(["identify", str(out / "more.toml"), *motions, "-o", str(more)])
    second = fuller.result(more)
    if second is None:
        return None

    export = ["export", str(more / "result.json"), "--to", "mjcf", "-o", str(more / "found.xml"), "--force"]
    checked = {name: Ran.of([*export, "--check", str(data / f"{name}.csv")]).text for name in CHECKED}
    return Found(plain, first, fuller, second, checked, _play(data))


def _play(data: Path) -> float:
    """Fit play operators to the fitted motions; return what they leave of the others, as `_mean_left_out`."""
    logs, left = motions(data), []
    rows = min(len(logs[name]) for name in FITTED)
    for joint in range(1, 6):
        course = {name: (motion[f"cmd{joint}"], motion[f"q{joint}"]) for name, motion in logs.items()}
        numbers = fitted([(course[name][0][:rows], course[name][1][:rows]) for name in FITTED], ROW)
        left += [left_of(numbers, *course[name], ROW) for name in LEFT_OUT]
    return 1e3 * float(np.mean(left))


def _page(found: Found) -> str:
    """Return the page."""
    plain, first, fuller, second = found.plain, found.first, found.fuller, found.second
    replay = plain.text[plain.text.index("replay by MuJoCo") :].rstrip()
    shown = f"jaxid identify so101.xml {' '.join(f'{n}.csv' for n in FITTED)} --validate ... -o out"
    lines = [
        "# SO-101 by one command",
        "",
        f"Written by `python -m benchmarks.so101_arm` on {date.today()}, at {commit_of(ROOT)}.",
        f"`{shown}` took {plain.wall:.0f} s, {plain.cpu:.0f} s of a processor.",
        f"It ended with status {plain.status}; converged: {_yes(first['converged'])}.",
        f"Left out of the fit: {', '.join(LEFT_OUT)}.",
        "",
        "```",
        replay,
        "```",
        "",
        "jaxid's own simulation of the arm is off the motions, by joint, in mrad:",
        "",
        *_gaps(first),
        "",
        f"The mean over the motions left out and the first five joints is {_mean_left_out(first):.1f} mrad.",
        "A play operator with a lag and a delay, four numbers a joint without physics, fitted to the same",
        f"motions, leaves {found.play:.1f} mrad of them.",
        "",
        "## What the file has wrong",
        "",
        "Values of the community's file, and those that were found, by joint; with one standard deviation.",
        "",
        *_beside_file(first),
        "",
        "## What an MJCF does not hold",
        "",
        "The same case, dead bands and friction in proportion to the load unknown at every joint:",
        f"{fuller.wall:.0f} s, {fuller.cpu:.0f} s of a processor; converged: {_yes(second['converged'])}.",
        "",
        "| effect | " + " | ".join(JOINTS) + " |",
        "|---" * 7 + "|",
        *(_row(second, what) for what in ("dead_band width rad", "load_friction coefficient -")),
        "",
        "jaxid's own simulation of the arm is then off the motions, by joint, in mrad:",
        "",
        *_gaps(second),
        "",
        "What each thing moves, by `jaxid export --check`. The file of this result lacks dead bands",
        "and the friction by load; the friction of the file above was fitted without them, and stands in for",
        "them.",
    ]
    for name, text in found.checked.items():
        table = text[text.index("replay by MuJoCo") :].rstrip()
        lines += ["", f"{name}:", "", "```", table, "```"]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Ran:
    """A command of jaxid that ran in a fresh process.

    Args:
        text: What it printed; error: what it printed of errors.
        status: Its exit status.
        wall: Time by the clock [s].
        cpu: Time of a processor [s].
    """

    text: str
    error: str
    status: int
    wall: float
    cpu: float

    @classmethod
    def of(cls, arguments: list[str]) -> "Ran":
        """Run a command."""
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        command = [sys.executable, "-m", "jaxid.cli", *arguments]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        wall = time.perf_counter() - begin
        cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        return cls(done.stdout, done.stderr, done.returncode, wall, cpu)

    def result(self, folder: Path) -> dict | None:
        """Return the result that it wrote into a folder; None, and its error printed, if there is none."""
        if not (folder / "result.json").exists():
            print(self.error, file=sys.stderr)
            return None
        return json.loads((folder / "result.json").read_text())


def _yes(flag: bool) -> str:
    return str(flag).lower()


def _effects(joint: int) -> str:
    """Return the tables of a case for what a servo has and an MJCF lacks."""
    return f"""
[[effects]]
kind = "dead_band"
joint = {joint}
width = {{ guess = 0.005 }}

[[effects]]
kind = "load_friction"
joint = {joint}
coefficient = {{ guess = 0.1 }}
"""


def _gaps(result: dict) -> list[str]:
    """Return a table of the gaps of all logs in jaxid's own simulation."""
    rows = ["| motion | " + " | ".join(JOINTS) + " |", "|---" * 7 + "|"]
    for name, gap in {**result["gap"]["fits"], **result["gap"]["validations"]}.items():
        rows.append(f"| {name} | " + " | ".join(f"{1e3 * x:.3g}" for x in gap["simulation"]) + " |")
    return rows


def _mean_left_out(result: dict) -> float:
    """Return the mean RMS of the first five joints on the motions left out [mrad]."""
    gaps = result["gap"]["validations"].values()
    return 1e3 * float(np.mean([gap["simulation"][:5] for gap in gaps]))


def _beside_file(result: dict) -> list[str]:
    """Return a table of the values of the file, and of those that were found in their place."""
    rows: dict[str, list[str]] = {}
    for name, found in result["parameters"].items():
        if "in_file" not in found or "[" not in name:
            continue
        joint = int(name.split("[")[1].split("]")[0])
        what = f"{name.replace(f'[{joint}]', '')} [{found['unit']}]"
        value = "not identifiable"
        if found["value"] is not None:
            value = f"{found['value']:.3g} ({found['std']:.2g})"
        rows.setdefault(what, ["-"] * len(JOINTS))[joint - 1] = f"{found['in_file']:.3g} -> {value}"
    head = ["| value | " + " | ".join(JOINTS) + " |", "|---" * 7 + "|"]
    return [*head, *(f"| {what} | " + " | ".join(cells) + " |" for what, cells in rows.items())]


def _row(result: dict, what: str) -> str:
    """Return an effect's values and their deviations by joint."""
    kind, name, unit = what.split()
    cells = []
    for joint in range(1, 7):
        found = result["parameters"][f"{kind}[{joint}].{name}"]
        if found["value"] is None:
            cells.append("not identifiable")
        else:
            cells.append(f"{found['value']:.3g} ({found['std']:.2g})")
    return f"| {kind} [{unit}] | " + " | ".join(cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
