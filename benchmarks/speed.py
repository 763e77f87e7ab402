"""Speed of jaxid on one axis, as ratios to hand-written loops, scipy and diffrax.

    python benchmarks/speed.py [--quick] [--no-write]

prints the table and writes results/speed.json and results/speed.md beside this file.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

# One BLAS thread: the problems are small, and more would only compete with what is measured.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
os.environ["NUMBA_NUM_THREADS"] = "2"

import axis
import axis_loops as loops
import axis_rivals as rivals
import jax.numpy as jnp
import numpy as np

from jaxid.replay import Numerics

HERE = Path(__file__).parent
WIDTH = 1e-3
LOOP = (axis.GAIN, 160.18, 243.45, 10.0, axis.PERIOD, WIDTH)
REST = (0.0, 0.0)
SETS, GROUP = 1024, 64


@dataclass
class Row:
    """One comparison.

    Args:
        quantity: What is computed.
        jaxid, alternative: Medians [s].
        rival: What it is compared with.
        ratio: jaxid over alternative, of the medians.
        best: The same of the fastest runs: what other load on the machine touches least.
        difference: Largest difference of the results, relative to their size.
        aim: Target of the ratio; None: none.
    """

    quantity: str
    rival: str
    jaxid: float
    alternative: float
    ratio: float
    best: float
    difference: float
    aim: float | None = None

    @property
    def met(self) -> bool:
        """By the fastest runs: other load on the machine must not decide."""
        return self.aim is None or self.best <= self.aim


def timed(function: Callable) -> float:
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def compare(
    quantity: str, ours: Callable, rival: str, theirs: Callable, aim: float | None, repeats: int,
    tolerance: float,
) -> Row:
    """Check that both compute the same, then time them in turn."""
    a, b = np.asarray(ours()), np.asarray(theirs())
    difference = float(np.abs(a - b).max() / np.abs(b).max())
    if not difference <= tolerance:
        raise SystemExit(f"{quantity}: {rival} differs by {difference:.1e}, over {tolerance:.0e}")
    times = np.array([(timed(ours), timed(theirs)) for _ in range(repeats)])
    (mine, other), (fast, rival_fast) = np.median(times, axis=0), times.min(axis=0)
    row = Row(
        quantity, rival, float(mine), float(other), float(mine / other), float(fast / rival_fast),
        difference, aim,
    )
    print(line(row), flush=True)
    return row


def line(row: Row) -> str:
    aim = "" if row.aim is None else f"{row.aim:.3g}"
    return (
        f"{row.quantity:34s} {row.rival:35s} {1e3 * row.jaxid:9.2f} {1e3 * row.alternative:9.2f} "
        f"{row.ratio:8.3g} {row.best:8.3g} {aim:>8s} {row.difference:9.1e}"
    )


class Sides:
    """Both sides of every comparison on one log."""

    def __init__(self):
        self.reference, self.measured = axis.log()
        self.base, self.theta = axis.plant(axis.TRUTH), jnp.asarray(axis.TRUTH)
        self.known, self.seen = tuple(axis.TRUTH), jnp.asarray(self.measured)
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
            function(self.known, self.reference, LOOP, REST, out)
            return out

        return run

    def force(self) -> np.ndarray:
        """What the loop gives the axis: input of those who cannot close a sampled loop."""
        return np.asarray(self.runs["smooth"](self.base).command)[:, 0] * axis.GAIN

    def normal(self, name: str) -> Callable:
        function = self.compiled(axis.gauss_newton, name)
        return lambda: function(self.theta, self.seen)[0]

    def loop_normal(self) -> np.ndarray:
        normal, gradient = np.zeros((4, 4)), np.zeros(4)
        loops.rk4_normal(
            self.known, self.reference, self.measured, LOOP, REST, normal, gradient
        )
        return normal

    def loop_sets(self) -> np.ndarray:
        costs = np.empty(SETS)
        loops.rk4_sets(self.sets, self.reference, self.measured, LOOP, REST, costs)
        return costs

    def two_threads(self, name: str) -> Callable:
        """Vmapped groups, shared out between two threads: one vmap's lanes run on one core.

        Larger groups leave the first-level cache, smaller ones leave lanes of the core idle.
        """
        function = self.compiled(axis.costs, name)
        groups = [jnp.asarray(part) for part in np.split(self.sets, SETS // GROUP)]

        def one(group: np.ndarray) -> np.ndarray:
            return np.asarray(function(group, self.seen))

        def run() -> np.ndarray:
            with ThreadPoolExecutor(2) as pool:
                return np.concatenate(list(pool.map(one, groups)))

        return run

    def fit(self, name: str) -> Callable:
        run = self.runs[name]
        return lambda: axis.fit(run, self.base, axis.START, self.measured).theta

    def scipy_fit(self, name: str) -> Callable:
        return lambda: rivals.lm_fit(name, self.reference, self.measured, LOOP, axis.START).x


def comparisons(sides: Sides, n: int, few: int) -> list[Row]:
    """Every comparison; n repeats, fewer of what takes long."""
    rk4, ideal = sides.loop_forward(loops.rk4_forward), sides.loop_forward(loops.ideal_forward)
    sets, force = jnp.asarray(sides.sets), sides.force()
    vmapped = sides.compiled(axis.costs, "smooth")
    jacobian = sides.compiled(axis.jacobian, "smooth")
    of_jacobian = lambda: (lambda j: np.asarray(j.T @ j))(jacobian(sides.theta))
    ivp = lambda atol: rivals.solve_ivp(sides.known, force, axis.PERIOD, WIDTH, atol)
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
        compare("1024 sets, one vmap", lambda: vmapped(sets, sides.seen), prange, sides.loop_sets,
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


def compile_times(sides: Sides) -> dict[str, dict]:
    """Seconds of tracing and compiling, and whether the loop flag was taken."""
    out = {}
    for name in ("smooth", "ideal"):
        for label, function, args in (
            ("forward", axis.simulated, (sides.theta,)),
            ("Gauss-Newton step", axis.gauss_newton, (sides.theta, sides.seen)),
        ):
            traced, compiled, text = sides.compiled(function, name).compile(*args)
            flag = 'xla_cpu_small_call="true"' in text
            out[f"{label}, {name}"] = {"trace_s": traced, "compile_s": compiled, "loop_flag": flag}
    return out


def in_process(*words: str, **environment: str) -> tuple[float, str]:
    """Wall time and output of a fresh Python."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=True,
        env={**os.environ, **environment},
    )
    return time.perf_counter() - begin, done.stdout


def cold_fits(repeats: int) -> dict[str, tuple[float, float]]:
    """First fit of a fresh process, without and with compiled code on disk [s, CPU s]."""
    script, out = str(HERE / "cold_fit.py"), {}
    for name in ("smooth", "ideal"):
        with tempfile.TemporaryDirectory() as folder:
            cache = {
                "JAX_COMPILATION_CACHE_DIR": folder,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            fits: dict[str, list] = {"no cache": [], "cache": []}
            in_process(script, name, **cache)
            for _ in range(repeats):
                for label, environment in (("no cache", {}), ("cache", cache)):
                    words = in_process(script, name, **environment)[1]
                    fits[label].append(json.loads(words.splitlines()[-1]))
        for label, seconds in fits.items():
            out[f"first fit, {name}, {label}"] = tuple(np.median(seconds, axis=0).tolist())
    return out


def start_times(repeats: int) -> dict[str, float]:
    """Import and help in a fresh process, less what Python itself takes [s]."""
    words = {"nothing": ("-c", "pass"), "import jaxid": ("-c", "import jaxid")}
    words["import jaxid, with JAX"] = ("-c", "import jaxid, jaxid.simulation")
    if (HERE.parent / "jaxid" / "cli.py").exists():
        words["jaxid --help"] = ("-c", "from jaxid.cli import main; main(['--help'])")
    seconds = {
        name: min(in_process(*w)[0] for _ in range(repeats))
        for name, w in words.items()
    }
    nothing = seconds.pop("nothing")
    return {name: s - nothing for name, s in seconds.items()}


def versions() -> dict[str, str]:
    names = ("jax", "jaxlib", "diffrax", "equinox", "numba", "numpy", "scipy")
    return {"python": platform.python_version(), **{n: version(n) for n in names}}


HEAD = (
    f"{'quantity':34s} {'compared with':35s} {'jaxid ms':>9s} {'other ms':>9s} {'ratio':>8s} "
    f"{'fastest':>8s} {'aim':>8s} {'differ':>9s}"
)


def table(rows: list[Row]) -> list[str]:
    out = [
        "| quantity | compared with | ratio | of the fastest runs | aim | met | differ |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        aim, met = ("", "") if r.aim is None else (f"{r.aim:.3g}", "yes" if r.met else "no")
        out.append(
            f"| {r.quantity} | {r.rival} | {r.ratio:.3g} | {r.best:.3g} | {aim} | {met} "
            f"| {r.difference:.0e} |"
        )
    return out


def report(rows: list[Row], compiled: dict, fits: dict, starts: dict[str, float]) -> str:
    shown = ", ".join(f"{k} {v}" for k, v in versions().items())
    flag = all(c["loop_flag"] for c in compiled.values())
    lines = [
        "# Speed", "",
        "Written by `python benchmarks/speed.py`; what is measured is in `benchmarks/README.md`.",
        "", f"{os.cpu_count()} CPU cores, {shown}.", "",
        *table(rows), "",
        f"Loop flag in all compiled loops: {'yes' if flag else '**no**'}.", "",
        "| once a process | s | CPU s |", "|---|---|---|",
        *[f"| {name} | {s:.2f} | |" for name, s in starts.items()],
        *[f"| {name} | {wall:.2f} | {cpu:.2f} |" for name, (wall, cpu) in fits.items()],
        *[
            f"| {name}: trace + compile | | {c['trace_s']:.2f} + {c['compile_s']:.2f} |"
            for name, c in compiled.items()
        ],
        "",
    ]
    return "\n".join(lines) + "\n" + (HERE / "speed_notes.md").read_text()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few repeats, to see that it runs")
    parser.add_argument("--no-write", action="store_true", help="only print")
    options = parser.parse_args()
    n, few, cold = (5, 2, 1) if options.quick else (41, 5, 3)
    sides = Sides()
    print(HEAD)
    rows = comparisons(sides, n, few)
    compiled = compile_times(sides)
    fits, starts = cold_fits(cold), start_times(3 * cold)
    text = report(rows, compiled, fits, starts)
    print("\n" + text)
    if not options.no_write:
        folder = HERE / "results"
        folder.mkdir(exist_ok=True)
        (folder / "speed.md").write_text(text)
        data = {
            "cpu_count": os.cpu_count(), "versions": versions(),
            "rows": [asdict(r) for r in rows], "compile": compiled, "first_fits": fits, "starts": starts,
        }
        (folder / "speed.json").write_text(json.dumps(data, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
