"""Batches on an accelerator against all cores of the same machine: many sets at once, and whole studies.

    python -m benchmarks.accelerator [--quick] [--no-write] [--to FOLDER] [--seconds 300]

prints the table and writes accelerator.json and .md after every row, to results/ beside this file or to
another folder. Needs a machine with an accelerator that JAX sees, and a JAX that can use it. A process that
fails or takes too long leaves a dash in the table.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
# Sets in a call, and runs of a study: the studies first, which are what is asked for.
SETS, RUNS = (8192, 1024, 65536), {"axis": (4096, 1024, 16384), "stage": (1024,)}
# On cores: sets in a vmapped call.
GROUP = 64
KINDS = ("cost", "Gauss-Newton step")


def child(kind: str, patience: float, *words: object) -> dict:
    """Run one measurement in a fresh process on a device, and return the record that it prints.

    Args:
        kind: Platform of JAX: cpu, cuda.
        patience: Time after which the process is ended [s].
        words: Name of the measurement (sets, study, device) and its arguments.

    Returns:
        The record; `error` in its place if the process fails or takes too long.
    """
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    environment = os.environ | dict.fromkeys(names, "1") | {"JAX_PLATFORMS": kind}
    line = [sys.executable, "-m", "benchmarks.accelerator", "--child", *map(str, words)]
    options = dict(capture_output=True, text=True, env=environment, cwd=HERE.parent, timeout=patience)
    try:
        done = subprocess.run(line, **options)
    except subprocess.TimeoutExpired:
        return {"error": f"stopped after {patience:.0f} s"}
    return {"error": done.stderr[-1500:]} if done.returncode else json.loads(done.stdout.splitlines()[-1])


def sets(kind: str, count: int, numerics: str) -> dict:
    """Time many parameter sets of the axis on a log of 25 000 samples, and return seconds and results.

    Args:
        kind: "cost", half the sum of squares; or "Gauss-Newton step", of which J'e is kept.
        count: Number of sets of four parameters, drawn within 20 % of the true ones.
        numerics: "smooth" or "ideal" friction.

    Returns:
        `s`, median of three warm calls [s]; `first_s`, the call that compiles [s]; `found`, results of the
        first 1024 sets, each a cost [m^2] or J'e, four numbers.
    """
    import jax

    from benchmarks import axis
    from jaxid.simulation.replay import Numerics

    reference, measured = axis.log()
    run = axis.replay(reference, Numerics(set_valued=numerics == "ideal"))
    spread = np.random.default_rng(0).uniform(0.8, 1.2, (count, 4))
    thetas, measured = axis.TRUTH * spread, jax.numpy.asarray(measured)

    def step(run: object, base: object, thetas: jax.Array, measured: jax.Array) -> jax.Array:
        return jax.vmap(lambda theta: axis.gauss_newton(run, base, theta, measured)[1])(thetas)

    of_sets = {"cost": axis.costs, "Gauss-Newton step": step}[kind]
    function = axis.Compiled(of_sets, run, axis.plant(axis.TRUTH))
    alone = jax.default_backend() != "cpu"
    groups = [thetas] if alone else np.split(thetas, count // GROUP)
    groups = [jax.numpy.asarray(group) for group in groups]

    def whole() -> np.ndarray:
        with ThreadPoolExecutor(1 if alone else os.cpu_count()) as pool:
            return np.concatenate(list(pool.map(lambda g: np.asarray(function(g, measured)), groups)))

    begin = time.perf_counter()
    found = whole()
    first, seconds = time.perf_counter() - begin, []
    for _ in range(3):
        begin = time.perf_counter()
        whole()
        seconds.append(time.perf_counter() - begin)
    return {"s": float(np.median(seconds)), "first_s": first, "found": found[:1024].tolist()}


def study(name: str, runs: int) -> dict:
    """Time a whole study: the first in the process, which compiles, and the second, which is counted.

    Returns:
        `s` and `first_s` [s]; `ms` a run; the numbers of runs that failed and of runs that were fitted alone;
        the estimates, (runs, unknowns); runs in a chunk.
    """
    import jaxid
    from jaxid.studies.plan import Plan
    from jaxid.studies.runs import Runner

    case, alone = jaxid.load_case(HERE / "cases" / f"{dict(axis='fits', stage='stage')[name]}.toml"), []
    run = Runner._run

    def counted(self: Runner, level: int, number: int, ways: object) -> object:
        alone.append(number)
        return run(self, level, number, ways)

    Runner._run = counted
    seconds = []
    for seed in (0, 1):
        begin = time.perf_counter()
        result = jaxid.study(case, runs=runs, seed=seed)
        seconds.append(time.perf_counter() - begin)
    estimate = result.table["estimate"].values.reshape(runs, -1)
    return {
        "s": seconds[1],
        "first_s": seconds[0],
        "ms": 1e3 * seconds[1] / runs,
        "failed": sum(f["runs"] for f in result.failures),
        "alone": len(alone),
        "found": np.nan_to_num(estimate).tolist(),
        "chunk": Plan.of(case, runs=runs).chunk,
    }


def device() -> dict:
    """Describe the device that JAX sees, and the machine around it."""
    import jax

    around = {"cores": os.cpu_count(), "python": platform.python_version(), "jax": jax.__version__}
    return {"kind": jax.local_devices()[0].device_kind} | around


def row(what: str, count: int, kinds: tuple[str, str], patience: float, *words: object) -> dict:
    """Measure the same on the processor and on the accelerator, and compare the results.

    Args:
        what: Name of the row.
        count: Number of sets or runs.
        kinds: Platforms of the two sides.
        patience: Time that a process may take [s].
        words: Arguments of `child`.
    """
    sides = {side: child(kind, patience, *words) for side, kind in zip(("cpu", "cuda"), kinds, strict=True)}
    out = {"what": what, "count": count}
    found = [np.asarray(side.pop("found")) for side in sides.values() if "found" in side]
    if len(found) == 2:
        scale = np.maximum(np.abs(found[0]).max(axis=0), 1e-300)
        differ = np.abs(found[0] - found[1]) / scale
        out |= {"differ": float(np.max(differ)), "differ_median": float(np.median(differ))}
    print(json.dumps(out | sides), flush=True)
    return out | sides


def asked(quick: bool) -> list[tuple]:
    """Return all rows: name, number of sets or runs, and arguments of a process."""
    rows = [
        (f"study of the {name}", count, "study", name, count)
        for name, counts in RUNS.items() for count in counts[: 1 if quick else None]
    ]  # fmt: skip
    for kind in KINDS:
        for numerics in ("smooth", "ideal"):
            for count in SETS[: 1 if quick else None]:
                if kind == KINDS[0] or count < SETS[-1]:
                    rows.append((f"{kind}, {numerics}", count, "sets", kind, count, numerics))
    return rows


def table(rows: list[dict], machine: dict) -> str:
    """Return the table in Markdown."""
    lines = [
        "# Batches on an accelerator", "",
        "Written by `python -m benchmarks.accelerator`; what is measured is in `benchmarks/README.md`.", "",
        "{kind} against {cores} cores of the same machine, python {python}, jax {jax}.".format(**machine), "",
        "| of | sets or runs | cores s | accelerator s | ratio | first, cores s | accelerator s | differ |",
        "|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    number = lambda side, name: f"{side[name]:.3g}" if name in side else "–"
    for r in rows:
        a, b = r["cpu"], r["cuda"]
        ratio = f"{b['s'] / a['s']:.3g}" if "s" in a and "s" in b else "–"
        differ = f"{r['differ']:.0e}" if "differ" in r else "–"
        cells = (r["what"], r["count"], number(a, "s"), number(b, "s"), ratio, number(a, "first_s"),
                 number(b, "first_s"), differ)  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def write(found: dict, folder: Path) -> None:
    """Write the measurements as JSON, and their table, to a folder."""
    (folder / "accelerator.json").write_text(json.dumps(found, indent=1) + "\n")
    (folder / "accelerator.md").write_text(table(found["rows"], found["seen"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="the smallest batches only")
    parser.add_argument("--no-write", action="store_true", help="only print")
    parser.add_argument("--to", type=Path, default=HERE / "results", help="folder of the results")
    parser.add_argument("--seconds", type=float, default=np.inf, help="no row begins after so many seconds")
    parser.add_argument("--patience", type=float, default=600.0, help="seconds that a process may take")
    parser.add_argument("--accelerator", default="cuda", help="what JAX calls it")
    parser.add_argument("--child", nargs="+", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.child:
        what, *words = args.child
        numbers = [int(w) if w.isdigit() else w for w in words]
        print(json.dumps({"sets": sets, "study": study, "device": device}[what](*numbers)))
        return
    begin, kinds = time.perf_counter(), ("cpu", args.accelerator)
    found = {"seen": child(kinds[1], args.patience, "device"), "rows": []}
    for what, count, *words in asked(args.quick):
        if time.perf_counter() - begin > args.seconds:
            print(f"no time left for {what}, {count}")
            continue
        found["rows"].append(row(what, count, kinds, args.patience, *words))
        if not args.no_write:
            write(found, args.to)
    print(table(found["rows"], found["seen"]))


if __name__ == "__main__":
    main()
