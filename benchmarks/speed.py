"""Speed of jaxid on one axis, as ratios to hand-written loops and to other tools; and what it grows with.

    python -m benchmarks.speed [--quick] [--no-write] [--only ratios|optimistix|peers|scale] [--long]

prints the tables and writes results/speed.json and results/speed.md beside this file. `--long` goes on with
all commands of `benchmarks.cold`, those of minutes too: one run of every figure that needs no accelerator.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from datetime import date
from importlib.metadata import version
from pathlib import Path

# One BLAS thread: the problems are small, and more would only compete with what is measured.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
os.environ["NUMBA_NUM_THREADS"] = "2"
# Compiled code that a user keeps on disk would make the cold rows too kind.
os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)

import jax.numpy as jnp
import numpy as np

from benchmarks import axis, cold, speed_scale
from benchmarks import axis_loops as loops
from benchmarks import axis_rivals as rivals
from benchmarks.speed_peers import against_peers, installed
from benchmarks.speed_rows import HEAD, Row, compare, in_process, line, table
from benchmarks.stored_runs import commit_of
from jaxid.simulation.replay import Numerics

HERE = Path(__file__).parent
COLD_FIT = ("-m", "benchmarks.cold_fit")
WIDTH = 1e-3
LOOP = (axis.GAIN, 160.18, 243.45, 10.0, axis.PERIOD, WIDTH)
REST = (0.0, 0.0)
SETS, GROUP = 1024, 64


class Sides:
    """Both sides of every comparison on one log."""

    def __init__(self):
        self.reference, self.measured = axis.log()
        self.base, self.theta = axis.plant(axis.TRUTH), jnp.asarray(axis.TRUTH)
        self.theta_numba, self.measured_jax = tuple(axis.TRUTH), jnp.asarray(self.measured)
        self.runs = {
            name: axis.replay(self.reference, Numerics(set_valued=name == "ideal"))
            for name in ("smooth", "ideal")
        }
        spread = np.random.default_rng(0).uniform(0.8, 1.2, (SETS, 4))
        self.sets = axis.TRUTH * spread

    def compiled(self, function: Callable, name: str) -> axis.Compiled:
        return axis.Compiled(function, self.runs[name], self.base)

    def forward(self, name: str) -> Callable:
        function = self.compiled(axis.simulated, name)
        return lambda: function(self.theta)

    def loop_forward(self, function: Callable) -> Callable:
        out = np.empty(len(self.reference))

        def run() -> np.ndarray:
            function(self.theta_numba, self.reference, LOOP, REST, out)
            return out

        return run

    def force(self) -> np.ndarray:
        """Return the force of the loop [N], (time,), for tools that cannot close a sampled loop."""
        return np.asarray(self.runs["smooth"](self.base).command)[:, 0] * axis.GAIN

    def normal(self, name: str) -> Callable:
        function = self.compiled(axis.gauss_newton, name)
        return lambda: function(self.theta, self.measured_jax)[0]

    def loop_normal(self) -> np.ndarray:
        normal, gradient = np.zeros((4, 4)), np.zeros(4)
        loops.rk4_normal(self.theta_numba, self.reference, self.measured, LOOP, REST, normal, gradient)
        return normal

    def loop_sets(self) -> np.ndarray:
        costs = np.empty(SETS)
        loops.rk4_sets(self.sets, self.reference, self.measured, LOOP, REST, costs)
        return costs

    def two_threads(self, name: str) -> Callable:
        """Return a call that computes the cost of all sets, in vmapped groups on two threads.

        The lanes of one vmap run on one core. Larger groups leave the first-level cache, smaller ones leave
        lanes of the core idle.
        """
        function = self.compiled(axis.costs, name)
        groups = [jnp.asarray(part) for part in np.split(self.sets, SETS // GROUP)]

        def one(group: np.ndarray) -> np.ndarray:
            return np.asarray(function(group, self.measured_jax))

        def run() -> np.ndarray:
            with ThreadPoolExecutor(2) as pool:
                return np.concatenate(list(pool.map(one, groups)))

        return run

    def fit(self, name: str) -> Callable:
        run = self.runs[name]
        return lambda: axis.fit(run, self.base, axis.START, self.measured).theta

    def cost(self, name: str) -> Callable:
        run = self.runs[name]
        return lambda: axis.fit(run, self.base, axis.START, self.measured).cost

    def optimistix_cost(self, name: str, solver: str, scaled: bool) -> Callable:
        """Return a call that fits by optimistix and returns half the sum of squares reached [m^2]."""
        run, start = self.runs[name], jnp.asarray(axis.START)
        method = rivals.OPTIMISTIX[solver]
        return lambda: np.asarray(
            rivals.optimistix_fit(method, run, self.base, start, self.measured_jax, scaled)[1]
        )

    def scipy_fit(self, name: str) -> Callable:
        return lambda: rivals.lm_fit(name, self.reference, self.measured, LOOP, axis.START).x

    def many_fits(self, name: str, *, scipy: bool) -> Callable:
        """Return a call that fits from each of the sets, on two threads; its result is (sets, 4)."""
        run = self.runs[name]

        def one(start: np.ndarray) -> np.ndarray:
            if scipy:
                return rivals.lm_fit(name, self.reference, self.measured, LOOP, start).x
            return np.asarray(axis.fit(run, self.base, start, self.measured).theta)

        def all_of_them() -> np.ndarray:
            with ThreadPoolExecutor(2) as pool:
                return np.stack(list(pool.map(one, self.sets)))

        return all_of_them


def comparisons(sides: Sides, n: int, few: int) -> list[Row]:
    """Compare jaxid with every rival on one log.

    Args:
        sides: Both sides.
        n: Number of repeats.
        few: Number of repeats of slow calls.
    """
    rk4, ideal = sides.loop_forward(loops.rk4_forward), sides.loop_forward(loops.ideal_forward)
    sets, force = jnp.asarray(sides.sets), sides.force()
    vmapped = sides.compiled(axis.costs, "smooth")
    jacobian = sides.compiled(axis.jacobian, "smooth")
    of_jacobian = lambda: (lambda j: np.asarray(j.T @ j))(jacobian(sides.theta))
    ivp = lambda atol: rivals.solve_ivp(sides.theta_numba, force, axis.PERIOD, WIDTH, atol)
    tsit5 = lambda: rivals.tsit5(sides.base, jnp.asarray(force), axis.PERIOD)
    smooth, exact = sides.forward("smooth"), sides.forward("ideal")
    loop, by_hand = "numba loop", "numba, sensitivities by hand"
    prange, lm = "numba RK4, prange, 2 threads", "scipy lm, numba, differences"
    return [
        compare("forward, smoothed, RK4", smooth, loop, rk4, 1.3, n, 1e-10),
        # Wide tolerances are of models that differ: here where the axis starts and stops, with
        # diffrax and solve_ivp in the held force, of which the last stage sees the next sample.
        compare("forward, ideal step", exact, "numba RK4 loop", rk4, 0.40, n, 1e-3),
        compare("forward, ideal step", exact, "numba ideal loop", ideal, None, n, 1e-10),
        compare("Jacobian, 4 parameters", of_jacobian, by_hand, sides.loop_normal, None, n, 1e-9),
        compare("Gauss-Newton step", sides.normal("smooth"), by_hand, sides.loop_normal, 1.6, n,
                1e-9),
        compare("Gauss-Newton step, ideal", sides.normal("ideal"), by_hand, sides.loop_normal,
                None, n, 1.0),
        compare("fit, warm", sides.fit("smooth"), lm, sides.scipy_fit("smooth"), 0.40, n, 1e-3),
        compare("fit, warm, ideal", sides.fit("ideal"), lm + ", ideal", sides.scipy_fit("ideal"),
                None, n, 1e-3),
        compare("fit, warm, ideal", sides.fit("ideal"), lm, sides.scipy_fit("smooth"), None, n,
                0.1),
        compare("1024 fits, 2 threads, ideal", sides.many_fits("ideal", scipy=False),
                lm + ", ideal, 2 threads", sides.many_fits("ideal", scipy=True), None, few, 1e-3),
        compare("1024 sets, one vmap", lambda: vmapped(sets, sides.measured_jax), prange, sides.loop_sets,
                None, few, 1e-6),
        compare("1024 sets, 2 threads", sides.two_threads("smooth"), prange, sides.loop_sets,
                0.35, few, 1e-6),
        compare("1024 sets, 2 threads, ideal", sides.two_threads("ideal"), prange,
                sides.loop_sets, None, few, 1.0),
        compare("forward, smoothed, RK4", smooth, "diffrax Tsit5, constant step", tsit5, None,
                few, 1e-2),
        compare("forward, smoothed, RK4", smooth, "scipy RK45, atol 1e-6 (default)",
                lambda: ivp(1e-6), 1 / 300, few, 1e-2),
        compare("forward, smoothed, RK4", smooth, "scipy RK45, atol 1e-9", lambda: ivp(1e-9),
                1 / 300, few, 1e-2),
    ]  # fmt: skip


def against_optimistix(sides: Sides, n: int, cold: int) -> list[Row]:
    """Compare fits by jaxid's solver with those by optimistix, on the same residual from the same start."""
    rows = []
    for name in ("smooth", "ideal"):
        what = "fit, {}" + (", ideal" if name == "ideal" else "") + " (cost)"
        for solver, scaled in (
            ("LevenbergMarquardt", False),
            ("LevenbergMarquardt", True),
            ("Dogleg", False),
        ):
            rival = f"optimistix {solver}" + (", scaled" if scaled else "")
            theirs = sides.optimistix_cost(name, solver, scaled)
            rows.append(compare(what.format("warm"), sides.cost(name), rival, theirs, None, n, 1e-6))
        rows.append(cold_row(what.format("cold"), name, "LevenbergMarquardt", cold))
    return rows


def cold_row(quantity: str, name: str, solver: str, repeats: int) -> Row:
    """Compare the first fits of fresh processes in turn, tracing and compiling included."""
    pairs = np.array(
        [
            [json.loads(in_process(*COLD_FIT, name, *who)[1].splitlines()[-1]) for who in ((), (solver,))]
            for _ in range(repeats)
        ]
    )
    (mine, other), (fast, rival_fast) = np.median(pairs, axis=0)[:, 0], pairs.min(axis=0)[:, 0]
    a, b = pairs[0, :, 2]
    row = Row(
        quantity,
        f"optimistix {solver}",
        float(mine),
        float(other),
        float(mine / other),
        float(fast / rival_fast),
        float(abs(a - b) / b),
    )
    print(line(row), flush=True)
    return row


def compile_times(sides: Sides) -> dict[str, dict]:
    """Time tracing and compiling [s], and check whether the compiled loops have the loop flag."""
    out = {}
    for name in ("smooth", "ideal"):
        for label, function, args in (
            ("forward", axis.simulated, (sides.theta,)),
            ("Gauss-Newton step", axis.gauss_newton, (sides.theta, sides.measured_jax)),
        ):
            traced, compiled, text = sides.compiled(function, name).compile(*args)
            flag = 'xla_cpu_small_call="true"' in text
            out[f"{label}, {name}"] = {"trace_s": traced, "compile_s": compiled, "loop_flag": flag}
    return out


def cold_fits(repeats: int) -> dict[str, tuple[float, float]]:
    """Time the first fit of a process, without and with compiled code on disk: wall and processor [s]."""
    out = {}
    for name in ("smooth", "ideal"):
        with tempfile.TemporaryDirectory() as folder:
            cache = {
                "JAX_COMPILATION_CACHE_DIR": folder,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            fits: dict[str, list] = {"no cache": [], "cache": []}
            in_process(*COLD_FIT, name, **cache)
            for _ in range(repeats):
                for label, environment in (("no cache", {}), ("cache", cache)):
                    words = in_process(*COLD_FIT, name, **environment)[1]
                    fits[label].append(json.loads(words.splitlines()[-1])[:2])
        for label, seconds in fits.items():
            out[f"first fit, {name}, {label}"] = tuple(np.median(seconds, axis=0).tolist())
    return out


def start_times(repeats: int) -> dict[str, float]:
    """Time import and help in a fresh process, without the start of Python itself [s]."""
    words = {"nothing": ("-c", "pass"), "import jaxid": ("-c", "import jaxid")}
    words["import jaxid, with JAX"] = ("-c", "import jaxid, jaxid.simulation.loops")
    if (HERE.parent / "jaxid" / "cli.py").exists():
        words["jaxid --help"] = ("-c", "from jaxid.cli import main; main(['--help'])")
    seconds = {name: min(in_process(*w)[0] for _ in range(repeats)) for name, w in words.items()}
    nothing = seconds.pop("nothing")
    return {name: s - nothing for name, s in seconds.items()}


def versions() -> dict[str, str]:
    names = ["jax", "jaxlib", "diffrax", "optimistix", "equinox", "numba", "numpy", "scipy"]
    names += [n for n in ("mujoco", "jax_sysid", "figaroh") if installed(n)]
    return {"python": platform.python_version(), **{n: version(n) for n in names}}


def report(rows: list[Row], compiled: dict, fits: dict, starts: dict[str, float], scale: dict) -> str:
    shown = ", ".join(f"{k} {v}" for k, v in versions().items())
    machine = f"{cold.origin()['processor']}, {os.cpu_count()} cores"
    flag = all(c["loop_flag"] for c in compiled.values())
    lines = [
        "# Speed",
        "",
        "Written by `python -m benchmarks.speed`; what is measured is in `benchmarks/README.md`.",
        "",
        f"Commit {commit_of(HERE.parent)}, {date.today()}; {machine}, {shown}.",
        "",
        *table(rows),
        "",
        f"Loop flag in all compiled loops: {'yes' if flag else '**no**'}.",
        "",
        "| once a process | s | CPU s |",
        "|---|---|---|",
        *[f"| {name} | {s:.2f} | |" for name, s in starts.items()],
        *[f"| {name} | {wall:.2f} | {cpu:.2f} |" for name, (wall, cpu) in fits.items()],
        *[
            f"| {name}: trace + compile | | {c['trace_s']:.2f} + {c['compile_s']:.2f} |"
            for name, c in compiled.items()
        ],
        "",
        *speed_scale.tables(scale),
    ]
    return "\n".join(lines) + "\n" + (HERE / "speed_notes.md").read_text()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few repeats, to see that it runs")
    parser.add_argument("--no-write", action="store_true", help="only print")
    parts = ("ratios", "optimistix", "peers", "scale")
    parser.add_argument("--only", choices=parts, help="only print this part")
    parser.add_argument(
        "--long", action="store_true", help="then all commands of benchmarks.cold, minutes each"
    )
    options = parser.parse_args()
    n, few, fresh = (5, 2, 1) if options.quick else (41, 5, 3)
    if options.only == "scale":
        print("\n".join(speed_scale.tables(speed_scale.measured(quick=options.quick))))
        return 0
    sides = Sides()
    print(HEAD)
    own = {
        "ratios": lambda: comparisons(sides, n, few),
        "optimistix": lambda: against_optimistix(sides, n, fresh),
        "peers": lambda: against_peers(sides, few),
    }
    rows = [row for part in own if options.only in (None, part) for row in own[part]()]
    if options.only:
        return 0
    compiled = compile_times(sides)
    fits, starts = cold_fits(fresh), start_times(3 * fresh)
    scale = speed_scale.measured(quick=options.quick)
    text = report(rows, compiled, fits, starts, scale)
    print("\n" + text, flush=True)
    if not options.no_write:
        folder = HERE / "results"
        folder.mkdir(exist_ok=True)
        (folder / "speed.md").write_text(text)
        data = {
            "commit": commit_of(HERE.parent),
            "date": str(date.today()),
            "processor": cold.origin()["processor"],
            "cpu_count": os.cpu_count(),
            "versions": versions(),
            "rows": [asdict(r) for r in rows],
            "compile": compiled,
            "first_fits": fits,
            "starts": starts,
            "scale": scale,
        }
        (folder / "speed.json").write_text(json.dumps(data, indent=1) + "\n")
    if options.long:
        print("# Commands from cold\n", flush=True)
        less = ["--repeats", "1"] if options.quick else []
        cold.main(["--long", *less, *(["--no-write"] if options.no_write else [])])
    return 0


if __name__ == "__main__":
    sys.exit(main())
