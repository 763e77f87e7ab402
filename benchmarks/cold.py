"""Cost of commands in a fresh process: refusals, lists, `identify` on the demo, `discover` on hidden cases.

    python -m benchmarks.cold [--repeats 3] [--only TEXT] [--cases 5] [--long] [--no-write]

*First*: nothing was compiled before; *again*: with the compiled code of the first. Prints a row each, with
the fewest seconds of all repeats on the wall and of the processor, and writes results/cold.md and cold.json.
With --only, the other rows stay as they were written before. `--long` adds commands that take minutes.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from benchmarks.discovery import every
from benchmarks.stored_runs import commit_of
from truth.hidden.bench import Case, write_files

HERE = Path(__file__).parent
ROOT = HERE.parent
DEMO = ROOT / "jaxid" / "demo"
COMMAND = "from jaxid.cli import entry; entry()"
# A search as the command runs it, but without the refit in simulation.
SEARCH = "import sys; from jaxid import _cache; _cache.configure(); import jaxid; " + (
    "jaxid.discover(*sys.argv[1:], refit=False)"
)
# Seconds: of a refusal or a list, of `identify` first and again, of the median search from cold, of a search
# on a robot, of the fit of an arm's simulation.
AIMS = {
    "refusal": 0.3,
    "list": 0.3,
    "identify first": 4.0,
    "identify again": 2.0,
    "discover first": 8.0,
    "long": 60.0,
    "long fit": 15.0,
}


@dataclass(frozen=True)
class Row:
    """One command: fewest seconds of its repeats, with the load of the machine and the commit of jaxid."""

    what: str
    group: str
    wall: float
    processor: float
    repeats: int
    status: int
    load: float | None
    commit: str

    @property
    def aim(self) -> float | None:
        return AIMS.get(self.group)


def timed(words: list[str], cache: Path, code: str = COMMAND, root: Path = ROOT) -> tuple[float, float, int]:
    """Run one command; return wall time [s], processor time [s] and exit status."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "XLA"))}
    environment |= {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(root)}
    begin = time.perf_counter()
    ran = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        env=environment,
        # Python would import the jaxid of the folder in which it starts, before that of the path.
        cwd=cache,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(ran.pid, 0)
    ran.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - begin, used.ru_utime + used.ru_stime, ran.returncode


def quickly_ended(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Return commands that need no fit: name -> group and arguments."""
    case, log = str(DEMO / "case.toml"), str(DEMO / "log.csv")
    text = (DEMO / "case.toml").read_text()
    faults = {
        "wrong key of the plant": ("inertia =", "inertai ="),
        "wrong key of an effect": ("level =", "levle ="),
        "wrong key of [log]": ("position =", "positon ="),
        "wrong key of [controller]": ("kp =", "pk ="),
    }
    out = {}
    for what, (old, new) in faults.items():
        path = folder / f"{what.replace(' ', '_')}.toml"
        path.write_text(text.replace(old, new, 1))
        out[f"identify, {what}"] = ("refusal", ["identify", str(path), log])
    out["identify LOG CASE, wrong order"] = ("refusal", ["identify", log, case])
    for words in (["--help"], ["methods"], ["plants"], ["effects"], ["schema", "case"]):
        out[" ".join(words)] = ("list", words)
    return out


def rows_of(options: argparse.Namespace) -> list[Row]:
    """Time every command whose row is wanted."""
    rows, repeats, only = [], options.repeats, options.only
    commit = commit_of(ROOT)

    def add(what: str, group: str, seconds: list[tuple[float, float, int]], of: str = commit) -> None:
        wall, processor, status = np.min(seconds, axis=0)
        load = round(os.getloadavg()[0], 1)
        rows.append(
            Row(
                what=what,
                group=group,
                wall=float(wall),
                processor=float(processor),
                repeats=len(seconds),
                status=int(status),
                load=load,
                commit=of,
            )
        )
        print(line_of(rows[-1]), flush=True)
        if not options.no_write:
            write_down(kept_rows(rows) if only else rows)

    with tempfile.TemporaryDirectory() as room:
        for what, (group, words) in quickly_ended(Path(room)).items():
            if only in f"{group} {what}":
                add(what, group, [timed(words, Path(room)) for _ in range(3 * repeats)])
    demo = ["identify", str(DEMO / "case.toml"), str(DEMO / "log.csv")]
    for what, words in {
        "identify, demo": demo,
        "identify, demo, --method inverse_dynamics": [*demo, "--method", "inverse_dynamics"],
        "identify, demo, -o": [*demo, "--force", "-o"],
        "check, demo": ["check", *demo[1:]],
    }.items():
        if only in what:
            first, again = first_and_again(words, repeats)
            group = "identify" if what == "identify, demo" else "other"
            add(f"{what}, first", f"{group} first", first)
            add(f"{what}, again", f"{group} again", again)
    trees = {commit: ROOT}
    if options.against:
        trees = {commit_of(Path(options.against)): Path(options.against), **trees}
    if only in "discover":
        found: dict[str, list] = {of: [] for of in trees}
        for case in searched(options.cases):
            for of, root in trees.items():
                with tempfile.TemporaryDirectory() as room:
                    words = [str(word) for word in write_files(case, Path(room))]
                    found[of].append(timed(["discover", *words, "--quiet"], Path(room), root=root))
                add(f"discover, {case.id}", "", found[of][-1:], of)
        for of, seconds in found.items():
            *middle, status = np.median(seconds, axis=0)
            what = f"discover, median of {len(seconds)}"
            add(what, "discover first", [(*map(float, middle), int(status))], of)
    if options.long:
        for what, (group, write) in long_commands().items():
            if only not in f"{group} {what}":
                continue
            with tempfile.TemporaryDirectory() as room:
                words = write(Path(room))
                if words:
                    code = SEARCH if "no refit" in what else COMMAND
                    add(what, group, [timed(words, Path(room), code)])
    return rows


def long_commands() -> dict[str, tuple[str, Callable[[Path], list[str] | None]]]:
    """Return commands that take minutes: name -> group, function that writes files and returns arguments."""
    from benchmarks.long_commands import FIVE_BAR, five_bar, seven_joints, tx40_search

    robots = {
        f"discover, {what}": ("long", lambda room, name=name: ["discover", *five_bar(room, name), "--quiet"])
        for name, what in FIVE_BAR.items()
    }
    fit = "identify --method output_error, PA-10 with 57 unknowns"
    return {"discover, TX40, no refit": ("long", tx40_search), fit: ("long fit", seven_joints), **robots}


def first_and_again(words: list[str], repeats: int) -> tuple[list, list]:
    """Run a command with an empty cache, and with what that run has left there; see `timed`."""
    first, again = [], []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as room:
            own = [*words, str(Path(room) / "out")] if words[-1] == "-o" else words
            first.append(timed(own, Path(room)))
            again += [timed(own, Path(room)) for _ in range(2)]
    return first, again


def searched(count: int) -> list[Case]:
    """Return some cases of `benchmarks.discovery`, spread over all of them."""
    every_case = list(every("test", 1))
    return every_case[:: max(1, len(every_case) // count)][:count]


def line_of(row: Row) -> str:
    """Return a row of the table in Markdown."""
    aim = "" if row.aim is None else f"{row.aim:g}"
    met = "" if row.aim is None else "yes" if row.wall <= row.aim else "**no**"
    seconds = (f"{row.wall:.2f}", f"{row.processor:.2f}")
    cells = (
        row.what,
        *seconds,
        row.repeats,
        row.status,
        aim,
        met,
        "" if row.load is None else row.load,
        row.commit,
    )
    return f"| {' | '.join(map(str, cells))} |"


def origin() -> dict[str, str | int]:
    """Return the processor, its cores, and the versions of the packages."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "equinox", "numpy")},
    }


def kept_rows(rows: list[Row]) -> list[Row]:
    """Return the stored rows that were not measured now, and then those that were."""
    path = HERE / "results" / "cold.json"
    if not path.exists():
        return rows
    before = json.loads(path.read_text())
    old = [Row(**{"load": None, "commit": before.get("commit", ""), **row}) for row in before["rows"]]
    new = {row.what for row in rows}
    return [row for row in old if row.what not in new] + rows


def report(rows: list[Row], seen: dict[str, str | int]) -> str:
    """Return the page in Markdown."""
    head = "| command | wall s | processor s | repeats | exit status | aim, wall s | met | load | commit |"
    return "\n".join(
        [
            "# Commands from cold", "",
            "Written by `python -m benchmarks.cold`; fewest seconds of some fresh processes.",
            "Load: processes that run or wait for a core, mean of a minute, at the end of a row.",
            "Where it exceeds the cores, only seconds of the processor compare.", "",
            ", ".join(f"{name} {value}" for name, value in seen.items()) + ".", "",
            head, "|---" * head.count(" | ") + "|---|", *map(line_of, rows), "",
        ]
    )  # fmt: skip


def write_down(rows: list[Row]) -> None:
    """Write the page; after each row, so that a run that is cut short leaves what it has measured."""
    seen = origin()
    (HERE / "results" / "cold.md").write_text(report(rows, seen))
    content = {**seen, "rows": [asdict(row) for row in rows]}
    (HERE / "results" / "cold.json").write_text(json.dumps(content, indent=1) + "\n")


def main(words: Sequence[str] | None = None) -> int:
    """Time the commands that are wanted; return 1 where an aim is missed.

    Args:
        words: Arguments; by default those of the process.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cases", type=int, default=6, help="cases of `discover`")
    parser.add_argument("--long", action="store_true", help="commands that take minutes too")
    parser.add_argument("--against", metavar="TREE", help="time `discover` of another working tree in turn")
    parser.add_argument("--only", default="", help="rows in whose name or group this stands")
    parser.add_argument("--no-write", action="store_true", help="only print")
    options = parser.parse_args(words)
    rows = rows_of(options)
    return 0 if all(row.aim is None or row.wall <= row.aim for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
