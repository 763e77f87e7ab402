"""Cost of fits against cores, length of the log, masses and joints; and of commands in a fresh process.

Each number is of a fresh process, because peak memory and cores belong to a process.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
FITS, STAGE = (HERE / "cases" / f"{name}.toml" for name in ("fits", "stage"))
# Studies: the axis, the stage read exactly, and by as many counts a turn as published.
CASES = {"axis": (FITS, None), "stage": (STAGE, None), "stage, 500 counts": (STAGE, 2 * np.pi / 500)}
LENGTHS = (1_000, 10_000, 100_000, 1_000_000)
# Kinds of what has several joints, and how many.
JOINTS = {"chain": (1, 2, 4, 6, 10), "arm": (1, 2, 4, 7)}
# Milliseconds a fit of studies and of one log that is warm; bytes of a log of a million samples;
# seconds of `jaxid --help`.
AIMS = {"axis": 2.0, "stage": 10.0, "fit": 30.0, "memory": 2 * 2**30, "help": 0.5}


# Runs of a study, and of a quick look at one; seconds after which a process is given up, and the part of its
# fits that may fail if its time is to count.
RUNS, QUICK = {"axis": 1024, "stage": 256, "stage, 500 counts": 256}, 128
PATIENCE, FAILED = 600.0, 0.05


def child(what: str, *words: object, cores: int | None = None, patience: float | None = None) -> dict:
    """Run one measurement in a fresh process on some cores, and return the record that it prints.

    Args:
        what: Name of the measurement: study, fit or joints.
        words: Its arguments.
        cores: Number of cores; None: all.
        patience: Time after which the process is ended [s]; None: none.

    Raises:
        subprocess.TimeoutExpired: If it takes longer.
    """
    prefix = [] if cores is None else ["taskset", "-c", f"0-{cores - 1}"]
    line = [*prefix, sys.executable, "-m", "benchmarks.speed_scale", what, *map(str, words)]
    options = {"capture_output": True, "text": True, "check": True, "cwd": HERE.parent}
    done = subprocess.run(line, timeout=patience, **options)
    return json.loads(done.stdout.splitlines()[-1])


def study_row(name: str, runs: int, processes: int, cores: int) -> dict:
    """Measure a study on some cores; the row has no time if the study does not end in time."""
    row = {"case": name, "cores": cores}
    try:
        return row | child("study", name, runs, processes, cores=cores, patience=PATIENCE)
    except subprocess.TimeoutExpired:
        return row | {"processes": processes, "ms": None, "runs": runs, "failed": runs, "memory": 0}


def study(name: str, runs: int, processes: int = 0) -> dict:
    """Measure a whole study, the second in its process: the first one compiles.

    Args:
        name: Name of the case, of `CASES`.
        runs: Number of runs.
        processes: Number of worker processes of one thread each, behind a scheduler; 0: threads of this
            process.

    Returns:
        `ms`, time of a run [ms]; `first_s`, the study that compiles [s]; `failed`, runs; `memory`, peak
        [bytes].
    """
    if processes:
        from distributed import LocalCluster

        options = {"threads_per_worker": 1, "processes": True, "dashboard_address": None}
        with LocalCluster(processes, **options, worker_dashboard_address=None) as cluster:
            return {"processes": processes} | _study(name, runs, cluster.scheduler_address)
    return {"processes": 0} | _study(name, runs)


def _study(name: str, runs: int, scheduler: str | None = None) -> dict:
    import jaxid
    from jaxid.numerics.lanes import cores
    from jaxid.studies.plan import Plan

    path, counts = CASES[name]
    with tempfile.TemporaryDirectory() as folder:
        if counts is not None:
            # Workers read the case from its file, so a change must stand there.
            text = path.read_text()
            path = Path(folder) / path.name
            path.write_text(text.replace("[sensor]\n", f"[sensor]\nposition_resolution = {counts!r}\n", 1))
        case = jaxid.load_case(path)
        chunk = Plan.of(case, runs=runs).chunk

        # Two chunks a core: whichever worker takes them, all compile.
        first = _timed(lambda: jaxid.study(case, runs=2 * chunk * cores(), scheduler=scheduler), 1)[0]
        begin = time.perf_counter()
        result = jaxid.study(case, runs=runs, seed=1, scheduler=scheduler)
        ms = 1e3 * (time.perf_counter() - begin) / runs
    failed = sum(f["runs"] for f in result.failures)
    return {"ms": ms, "runs": runs, "failed": failed, "first_s": first, "memory": _memory()}


def fit(samples: int, repeats: int) -> dict:
    """Measure one log: simulation, preparation, and fits by two methods, cold and warm [s].

    Args:
        samples: Number of samples of the log.
        repeats: Number of warm repeats, of which the median is taken.
    """
    import jaxid
    from jaxid.estimators import METHODS
    from jaxid.numerics.lanes import run_alone

    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case.toml"
        case.write_text(lasting(samples))
        made = _timed(lambda: jaxid.simulate(case), 1)[0]
        log = jaxid.simulate(case).log
        session = jaxid.open_session(case, log)
        prepared = _timed(lambda: jaxid.open_session(case, log), repeats)
        out = {"samples": log.samples, "simulate_s": made, "prepare_s": float(np.median(prepared))}
        for method in ("inverse_dynamics", "output_error"):
            seconds = _timed(lambda m=method: run_alone(METHODS[m](session)), repeats + 1)
            out[method] = {"cold_s": seconds[0], "warm_s": float(np.median(seconds[1:]))}
    return out | {"memory": _memory()}


def lasting(samples: int) -> str:
    """Return the case of the study, with its reference repeated or cut to a number of samples at 1 kHz."""
    text, seconds = FITS.read_text(), samples / 1000
    found = re.search(r"targets = \[(.*)\]", text)
    times = max(1, int(np.ceil(seconds / 25.0)))
    targets = ", ".join([found[1]] * times)
    text = text.replace(found[0], f"targets = [{targets}]")
    # A second is too short for a stroke of the study's.
    if samples < 5_000:
        text = text.replace("speed = 0.12", "speed = 0.5").replace("acceleration = 0.8", "acceleration = 8.0")
    return text.replace("duration = 25.0", f"duration = {seconds}")


def joints(kind: str, count: int, samples: int, repeats: int) -> dict:
    """Measure a machine of several masses or joints in its loop, with two unknowns each.

    Args:
        kind: "chain" or "arm".
        count: Number of masses or joints.
        samples: Number of samples at 1 kHz.
        repeats: Number of warm repeats, of which the fastest is taken.

    Returns:
        Times of a simulated run and of a Gauss-Newton step [ms], and of compiling either [s].
    """
    import jax
    import jax.numpy as jnp

    import jaxid
    from jaxid.estimators.simulated_output import choose_numerics, output_residual
    from jaxid.session import open_session
    from jaxid.simulation.replay import make_replay

    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case.toml"
        case.write_text({"chain": chain_case, "arm": arm_case}[kind](count, samples / 1000))
        log = jaxid.simulate(case).log
        machine = open_session(case, log).machine
    replay = make_replay(machine, log, choose_numerics(machine, log))
    places, plant, theta = machine.parameters.places, machine.plant, jnp.asarray(machine.parameters.guess)
    residual = output_residual(replay, places, plant, jnp.asarray(log.position), 1.0)

    def normal(theta: jax.Array) -> tuple:
        jacobian, e = jax.jacfwd(lambda x: (residual(x).ravel(),) * 2, has_aux=True)(theta)
        return jacobian.T @ jacobian, jacobian.T @ e

    out = {"kind": kind, "joints": count, "unknowns": theta.size, "samples": log.samples}
    for name, function in (("run", residual), ("step", normal)):
        compiled = jax.jit(function)
        seconds = _timed(lambda f=compiled: jax.block_until_ready(f(theta)), repeats + 1)
        # The fastest run: other load on the machine touches it least.
        out |= {f"{name}_ms": 1e3 * min(seconds[1:]), f"{name}_compile_s": seconds[0]}
    return out


def chain_case(masses: int, seconds: float) -> str:
    """Return the case of a chain with a drive at every mass; masses and friction are unknown."""
    each = lambda value: f"[{', '.join([value] * masses)}]"
    plant = f"""
[plant]
kind = "chain"
[plant.parameters]
mass = {each("{ guess = 1.6, true = 2.0 }")}
damping = {each("8.0")}
stiffness = [{", ".join(["1500.0"] * (masses + 1))}]
[[effects]]
kind = "coulomb_friction"
level = {each("{ guess = 2.0, true = 3.0 }")}
joint = [{", ".join(str(k + 1) for k in range(masses))}]
"""
    return plant + LOOP.format(kp=3000.0, kd=80.0, targets="0.03, -0.02, 0.01, 0.04, 0.0", speed=0.2,
                               acceleration=4.0, seconds=seconds)  # fmt: skip


def arm_case(count: int, seconds: float) -> str:
    """Return the case of the first joints of the PA-10, with bodies of its size; friction is unknown."""
    from jaxid.plants import pa10

    table = pa10()
    links = "".join(
        f"""
[[plant.links]]
joint = "revolute"
alpha = {float(table.alpha[k])!r}
a = {float(table.a[k])!r}
d = {float(table.d[k])!r}
mass = 5.0
first_moment = [0.1, 0.2, 0.3]
inertia = [0.1, 0.0, 0.0, 0.1, 0.0, 0.1]
rotor_inertia = 0.5
"""
        for k in range(count)
    )
    friction = """
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 4.0, true = 6.0 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 2.0, true = 4.0 }
"""
    return '[plant]\nkind = "serial_arm"\n' + links + friction + LOOP.format(
        kp=4000.0, kd=200.0, targets="0.6, -0.4, 0.2, 0.8, 0.0", speed=1.0, acceleration=8.0, seconds=seconds
    )  # fmt: skip


LOOP = """
[controller]
kind = "pd"
kp = {kp}
kd = {kd}
period = 0.001
[sensor]
position_noise = 1e-6
[reference]
kind = "trapezoid"
start = 0.0
targets = [{targets}]
speed = {speed}
acceleration = {acceleration}
[simulation]
duration = {seconds}
sample_rate = 1000.0
"""


def commands() -> list[dict]:
    """Time every command on the log of the demo, with an empty cache and once more [s]."""
    demo = HERE.parent / "jaxid" / "demo"
    case, log, other = (str(demo / name) for name in ("case.toml", "log.csv", "validation.csv"))
    words = {
        "--help": ["--help"],
        "plants": ["plants"],
        "effects": ["effects"],
        "check": ["check", case, log],
        "identify": ["identify", case, log],
        "identify --method inverse_dynamics": ["identify", case, log, "--method", "inverse_dynamics"],
        "discover --validate": ["discover", case, log, "--validate", other],
        "simulate": ["simulate", str(FITS), "-o", "{out}/log.csv", "--force"],
        "design": ["design", str(HERE / "cases" / "design.toml"), "-o", "{out}/reference.csv", "--force"],
        "study --runs 64": ["study", str(FITS), "--runs", "64"],
        "demo": ["demo", "-o", "{out}/demo", "--force"],
    }
    rows = []
    for name, own in words.items():
        with tempfile.TemporaryDirectory() as folder:
            environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX")}
            environment |= {"XDG_CACHE_HOME": folder, "PYTHONPATH": str(HERE.parent)}
            seconds = []
            for _ in range(2):
                begin = time.perf_counter()
                code = "from jaxid.cli import entry; entry()"
                line = [sys.executable, "-c", code, *[w.replace("{out}", folder) for w in own]]
                subprocess.run(line, env=environment, capture_output=True, check=True)
                seconds.append(time.perf_counter() - begin)
        rows.append({"command": name, "cold_s": seconds[0], "again_s": seconds[1]})
    return rows


def measured(*, quick: bool) -> dict:
    """Measure all parts of the page.

    Args:
        quick: Whether repeats are few, and the largest sizes are left out.
    """
    n = os.cpu_count() or 1
    repeats = 2 if quick else 5
    out = {"study": [], "lengths": [], "joints": []}
    for name in CASES:
        runs = QUICK if quick else RUNS[name]
        for cores, processes in dict.fromkeys([(1, 0), (n, 0), (n, n)]):
            out["study"].append(study_row(name, runs, processes, cores))
        for found in [s for s in out["study"] if s["case"] == name]:
            print(f"study: {found}", flush=True)
    for samples in (25_000, *(LENGTHS[:-1] if quick else LENGTHS)):
        out["lengths"].append(child("fit", samples, repeats if samples < 1e6 else 1))
        print(f"{samples} samples: {out['lengths'][-1]}", flush=True)
    for kind, counts in JOINTS.items():
        for count in counts[:3] if quick else counts:
            out["joints"].append(child("joints", kind, count, 10_000, repeats))
            print(f"{kind} of {count}: {out['joints'][-1]}", flush=True)
    out["commands"] = commands()
    return out


def tables(found: dict) -> list[str]:
    """Return the lines of the page in Markdown."""
    met = lambda value, aim: "yes" if value <= aim else "**no**"
    megabytes = lambda x: f"{x / 2**20:.0f}"
    lines = ["## Fits by the study", "",
             "| of | cores | as | ms a fit | failed | aim | met | of one core | peak MB |",
             "|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    counts = lambda s: s["ms"] is not None and s["failed"] <= FAILED * s["runs"]
    one = {s["case"]: s["ms"] for s in found["study"] if s["cores"] == 1 and counts(s)}
    most = max(s["cores"] for s in found["study"])
    for s in found["study"]:
        aim = AIMS.get(s["case"]) if s["cores"] == most and counts(s) else None
        shown = "|" if aim is None else f"{aim:g} | {met(s['ms'], aim)}"
        ms = f"{s['ms']:.1f}" if counts(s) else "not measured"
        part = f"{s['ms'] / one[s['case']]:.2f}" if counts(s) and s["case"] in one else ""
        # Of a cluster only the memory of the process that asks it is known.
        memory, way = ("", "processes") if s["processes"] else (megabytes(s["memory"]), "threads")
        failed = f"{s['failed']} of {s['runs']}"
        cells = (s["case"], s["cores"], way, ms, failed, shown, part, memory)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += ["", "## Against the length of the log", "",
              "| samples | prepare s | inverse dynamics, warm s | output error, cold s | warm s | peak MB |",
              "|---|---|---|---|---|---|"]  # fmt: skip
    for r in sorted(found["lengths"], key=lambda r: r["samples"]):
        own = r["inverse_dynamics"]["warm_s"], r["output_error"]["cold_s"], r["output_error"]["warm_s"]
        shown = " | ".join(f"{x:.3g}" for x in (r["prepare_s"], *own))
        lines.append(f"| {r['samples']} | {shown} | {megabytes(r['memory'])} |")
    single = next(r for r in found["lengths"] if 20_000 < r["samples"] < 30_000)
    warm = 1e3 * single["output_error"]["warm_s"]
    lines += ["", "One warm fit of 25 000 samples: "
              f"{warm:.0f} ms (aim {AIMS['fit']:g}: {met(warm, AIMS['fit'])})."]  # fmt: skip
    longest = max(found["lengths"], key=lambda r: r["samples"])
    if longest["samples"] >= 1_000_000:
        lines += [f"A million samples: {megabytes(longest['memory'])} MB "
                  f"(aim 2048: {met(longest['memory'], AIMS['memory'])})."]  # fmt: skip
    lines += ["", "## Against the number of masses, of joints, of unknowns", "",
              "A chain, every mass driven, and an arm, in their loops, 10 000 samples; fastest runs.",
              "", "| | masses or joints | unknowns | run, ms | us a sample | Gauss-Newton step, ms "
              "| over the run | compiling the run, s | the step, s |",
              "|---|---|---|---|---|---|---|---|---|"]  # fmt: skip
    for r in found["joints"]:
        each = (r["run_ms"], 1e3 * r["run_ms"] / r["samples"], r["step_ms"], r["step_ms"] / r["run_ms"],
                r["run_compile_s"], r["step_compile_s"])  # fmt: skip
        shown = " | ".join(f"{x:.3g}" for x in each)
        lines.append(f"| {r['kind']} | {r['joints']} | {r['unknowns']} | {shown} |")
    lines += ["", "## Commands", "", "Seconds of a fresh process on the demo's log, nothing compiled before; "
              "and once more.", "", "| jaxid | first | again |", "|---|---|---|"]  # fmt: skip
    for r in found["commands"]:
        lines.append(f"| {r['command']} | {r['cold_s']:.2f} | {r['again_s']:.2f} |")
    slow = next(r for r in found["commands"] if r["command"] == "--help")["again_s"]
    lines += ["", f"`jaxid --help` is to take {AIMS['help']:g} s at most: {met(slow, AIMS['help'])}.", ""]
    return lines


def _timed(function: object, repeats: int) -> list[float]:
    """Return the time of each of several calls [s]."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - begin)
    return seconds


def _memory() -> int:
    """Return the peak memory of this process [bytes]; that of `getrusage` may be its parent's."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return 1024 * int(found[1])


def main(what: str, *words: str) -> None:
    numbers = [int(w) if w.isdigit() else w for w in words]
    print(json.dumps({"study": study, "fit": fit, "joints": joints}[what](*numbers)))


if __name__ == "__main__":
    arguments: Sequence[str] = sys.argv[1:]
    main(*arguments)
