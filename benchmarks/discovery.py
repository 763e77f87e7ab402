"""Rate at which `discover` names a hidden effect, and one that is not there.

    python -m benchmarks.discovery [--split test] [--groups effects,pairs] [--only cogging] [--resume]

Every case of `truth/hidden/cases.py` and `truth/hidden/chains.py` goes through `jaxid.discover`; a
line of JSON each, then the table as `discovery.md` and `discovery.json`. Exits with 1 where an aim is missed.
"""

import argparse
import fcntl
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from datetime import date
from pathlib import Path

from tqdm import tqdm

from benchmarks.discovery_table import aims_hold, markdown, summary
from benchmarks.stored_runs import commit_of, read_runs
from truth.hidden import cases as hidden_cases
from truth.hidden import chains as hidden_chains
from truth.hidden.bench import Case
from truth.hidden.cases import FIRST_SEED, NOISES, SCALES

ROOT = Path(__file__).parent.parent
GROUPS = ("effects", "pairs", "nulls", "outside", "short", "chains", "chain_nulls")
CHAINS = ("chain2", "chain3")
COLD = 5
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
}


def main() -> int:
    options = _options()
    chosen = [c for c in every(options.split, options.seeds) if _wanted(c, options)]
    folder = Path(options.o)
    folder.mkdir(parents=True, exist_ok=True)
    lines = folder / "cases.jsonl"
    if lines.exists() and not options.resume:
        print(f"{lines} exists; give --resume to go on, or another -o", file=sys.stderr)
        return 2
    if options.oracle:
        ask_again(lines, {c.id: c for c in chosen})
    done = {r["id"] for r in read_runs(lines)}
    if options.workers > 1:
        os.environ |= ONE_THREAD
    run([c for c in chosen if c.id not in done], lines, options.workers, refit=options.refit)
    if options.cold:
        measure_cold(chosen[:: max(1, len(chosen) // COLD)][:COLD], folder / "cold.json")
    ids = {c.id for c in chosen}
    cold = folder / "cold.json"
    table = summary(
        [r for r in read_runs(lines) if r["id"] in ids], json.loads(cold.read_text()) if cold.exists() else []
    )
    table["made"] = f"`python -m benchmarks.discovery --split {options.split}` on {date.today()}"
    (folder / "discovery.json").write_text(json.dumps(table, indent=1))
    (folder / "discovery.md").write_text(markdown(table))
    print(markdown(table))
    return 0 if aims_hold(table) else 1


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    words = lambda text: tuple(text.split(","))
    parser.add_argument("--split", choices=tuple(FIRST_SEED), default="calibrate")
    parser.add_argument("--groups", type=words, default=GROUPS, help="comma-separated")
    parser.add_argument("--only", metavar="KIND", help="cases in whose name this stands")
    parser.add_argument("--scales", type=words, default=(*SCALES, "coarse", *CHAINS))
    parser.add_argument("--noise", type=lambda s: tuple(map(float, s.split(","))), default=NOISES)
    parser.add_argument("--seeds", type=int, default=1, help="machines of each kind")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cold", action="store_true", help=f"time {COLD} fresh commands too")
    parser.add_argument("--resume", action="store_true", help="skip the cases that are done")
    parser.add_argument(
        "--no-refit", dest="refit", action="store_false", help="leave out the refit in simulation"
    )
    parser.add_argument("--oracle", action="store_true", help="let it speak anew of what is done")
    parser.add_argument("-o", metavar="DIR", default=str(ROOT / "results" / "discovery"))
    return parser.parse_args()


def every(split: str, seeds: int) -> list[Case]:
    """Return all cases of a split, on an axis and on chains."""
    chains = hidden_chains.cases(split, seeds) if split in hidden_chains.FIRST_SEED else ()
    return [*hidden_cases.cases(split, seeds), *chains]


def _wanted(case: Case, options: argparse.Namespace) -> bool:
    named = options.only is None or options.only in case.id
    return (
        named and case.group in options.groups and case.scale in options.scales
        and case.noise in options.noise
    )  # fmt: skip


def ask_again(lines: Path, cases: dict[str, Case]) -> None:
    """Replace the oracle's evidence of cases that are done, after a change of the oracle."""
    from truth.hidden.bench import oracle

    records = read_runs(lines)
    for record in tqdm(records, unit="case", desc="oracle"):
        if record["id"] in cases:
            record["oracle"] = oracle(cases[record["id"]])
    fresh = lines.with_suffix(".new")
    fresh.write_text("".join(json.dumps(r) + "\n" for r in records))
    fresh.replace(lines)


def run(chosen: Sequence[Case], lines: Path, workers: int, *, refit: bool) -> None:
    """Run the cases, those of one shape in one process.

    Args:
        chosen: Cases.
        lines: File to which a line of JSON each is added.
        workers: Number of processes.
        refit: Whether models are refitted in simulation, as the command does.
    """
    groups: dict[tuple, list[Case]] = {}
    for case in sorted(chosen, key=lambda c: (c.length, str(c.declared))):
        groups.setdefault((case.scale, case.rate), []).append(case)
    largest_first = sorted(groups.values(), key=len, reverse=True)
    # A process a group: compiled code serves the whole group, and is given back after it.
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1
    )
    with pool, tqdm(total=len(chosen), unit="case", desc="hidden cases") as bar:
        before = len(read_runs(lines))
        left: set[Future] = {pool.submit(_work, group, str(lines), refit) for group in largest_first}
        while left:
            finished, left = wait(left, timeout=2.0, return_when="FIRST_COMPLETED")
            for future in finished:
                future.result()
            bar.update(len(read_runs(lines)) - before - bar.n)


def _work(group: Sequence[Case], lines: str, refit: bool) -> None:
    from benchmarks.hidden_run import run_case

    commit = commit_of(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        for k, case in enumerate(group):
            record = run_case(case, Path(folder), refit=refit) | {"warm": k > 0, "commit": commit}
            with open(lines, "a") as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                file.write(json.dumps(record) + "\n")


def measure_cold(chosen: Sequence[Case], path: Path) -> None:
    """Time a fresh `jaxid discover` of each case, refits in simulation included, and write the times."""
    from truth.hidden.bench import write_files

    command = Path(sys.executable).parent / "jaxid"
    seconds = []
    for case in _shown(chosen):
        with tempfile.TemporaryDirectory() as folder:
            words = write_files(case, Path(folder))
            # Nothing compiled before, whatever this machine keeps.
            environment = {**os.environ, "XDG_CACHE_HOME": folder}
            begin = time.perf_counter()
            out = subprocess.run(
                [command, "discover", *words, "--quiet"], capture_output=True, text=True, env=environment
            )
            seconds.append({"id": case.id, "seconds": time.perf_counter() - begin, "status": out.returncode})
    path.write_text(json.dumps(seconds))


def _shown(chosen: Sequence[Case]) -> Iterator[Case]:
    return iter(tqdm(chosen, unit="case", desc="fresh commands"))


if __name__ == "__main__":
    sys.exit(main())
