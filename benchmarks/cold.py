"""What commands cost in a fresh process: refusals, lists, `identify` on the demo, `discover` on hidden cases.

    python -m benchmarks.cold [--repeats 3] [--only TEXT] [--cases 5] [--no-write]

*First*: nothing was compiled before; *again*: with the compiled code of the first. Prints a row each, with
the fewest seconds of all repeats on the wall and of the processor, and writes results/cold.md and cold.json.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
DEMO = HERE.parent / "jaxid" / "demo"
COMMAND = "from jaxid.cli import entry; entry()"
# Seconds: of a refusal or a list, of `identify` first and again, of the median search from cold.
AIMS = {"refusal": 0.3, "list": 0.3, "identify first": 4.0, "identify again": 2.0, "discover first": 8.0}


@dataclass(frozen=True)
class Row:
    """One command: fewest seconds of its repeats."""

    what: str
    group: str
    wall: float
    processor: float
    repeats: int
    status: int

    @property
    def aim(self) -> float | None:
        return AIMS.get(self.group)


def timed(words: list[str], cache: Path) -> tuple[float, float, int]:
    """Wall seconds, seconds of the processor, and exit status of one command."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX", "XLA"))}
    environment |= {"XDG_CACHE_HOME": str(cache), "PYTHONPATH": str(HERE.parent)}
    begin = time.perf_counter()
    ran = subprocess.Popen(
        [sys.executable, "-c", COMMAND, *words],
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(ran.pid, 0)
    ran.returncode = os.waitstatus_to_exitcode(status)
    return time.perf_counter() - begin, used.ru_utime + used.ru_stime, ran.returncode


def quickly_ended(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Commands that need no fit: what they are, their group, and their words."""
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


def rows_of(repeats: int, cases: int, only: str) -> list[Row]:
    """Time every command whose row is wanted."""
    rows = []

    def add(what: str, group: str, seconds: list[tuple[float, float, int]]) -> None:
        wall, processor, status = np.min(seconds, axis=0)
        rows.append(Row(what, group, float(wall), float(processor), len(seconds), int(status)))
        print(line_of(rows[-1]), flush=True)

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
    if only in "discover":
        seconds = searches(cases)
        for what, each in seconds.items():
            add(what, "", [each])
        if seconds:
            middle = np.median([s[:2] for s in seconds.values()], axis=0)
            rows.append(Row("discover, median of these", "discover first", *map(float, middle), 1, 0))
            print(line_of(rows[-1]), flush=True)
    return rows


def first_and_again(words: list[str], repeats: int) -> tuple[list, list]:
    """Seconds with an empty cache, and with what that run has left there."""
    first, again = [], []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as room:
            own = [*words, str(Path(room) / "out")] if words[-1] == "-o" else words
            first.append(timed(own, Path(room)))
            again += [timed(own, Path(room)) for _ in range(2)]
    return first, again


def searches(count: int) -> dict[str, tuple[float, float, int]]:
    """Seconds of a fresh `jaxid discover`, by case, spread over those of `benchmarks.discovery`."""
    from benchmarks.discovery import every
    from truth.hidden.bench import write_files

    every_case = list(every("test", 1))
    out = {}
    for case in every_case[:: max(1, len(every_case) // count)][:count]:
        with tempfile.TemporaryDirectory() as room:
            words = [str(word) for word in write_files(case, Path(room))]
            out[f"discover, {case.id}"] = timed(["discover", *words, "--quiet"], Path(room))
    return out


def line_of(row: Row) -> str:
    """A row of the table in Markdown."""
    aim = "" if row.aim is None else f"{row.aim:g}"
    met = "" if row.aim is None else "yes" if row.wall <= row.aim else "**no**"
    cells = (row.what, f"{row.wall:.2f}", f"{row.processor:.2f}", row.repeats, row.status, aim, met)
    return f"| {' | '.join(map(str, cells))} |"


def origin() -> dict[str, str | int]:
    """The commit, the machine and the versions."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=8", "--exclude=*"],
        capture_output=True, text=True, cwd=HERE, check=False,
    ).stdout.strip()  # fmt: skip
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "commit": commit,
        "processor": models[0] if models else platform.processor(),
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        **{name: version(name) for name in ("jax", "jaxlib", "equinox", "numpy")},
    }


def report(rows: list[Row], seen: dict[str, str | int]) -> str:
    """The table in Markdown."""
    head = "| command | wall s | processor s | repeats | exit status | aim, wall s | met |"
    return "\n".join(
        [
            "# Commands from cold", "",
            "Written by `python -m benchmarks.cold`; fewest seconds of some fresh processes.", "",
            ", ".join(f"{name} {value}" for name, value in seen.items()) + ".", "",
            head, "|---" * head.count(" | ") + "|---|", *map(line_of, rows), "",
        ]
    )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--cases", type=int, default=5, help="cases of `discover`")
    parser.add_argument("--only", default="", help="rows in whose name or group this stands")
    parser.add_argument("--no-write", action="store_true", help="only print")
    options = parser.parse_args()
    rows, seen = rows_of(options.repeats, options.cases, options.only), origin()
    if not options.no_write:
        (HERE / "results" / "cold.md").write_text(report(rows, seen))
        content = {**seen, "rows": [asdict(row) for row in rows]}
        (HERE / "results" / "cold.json").write_text(json.dumps(content, indent=1) + "\n")
    return 0 if all(row.aim is None or row.wall <= row.aim for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
