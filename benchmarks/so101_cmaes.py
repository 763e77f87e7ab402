"""SO-101 by an evolution strategy on MuJoCo rollouts, beside jaxid, on the same motions and the same machine.

    JAXID_DATA=FOLDER python -m benchmarks.so101_cmaes [--fit pace|gains|stiff|jaxid]... [-o DIR]

`pace` fits what PACE fits (armature, viscous damping, dry friction, a bias of the reading and a delay, for
each joint) at the gains of the community's MJCF; `gains` fits kp and kv as well, and `stiff` does so with
MuJoCo's dry friction as stiff as it can be. `jaxid` is the command that corrects the MJCF. All see the first
rows of three motions, and are scored by MuJoCo on six other motions.
Writes so101_cmaes.json and so101_cmaes.md.
"""

import argparse
import copy
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import cma
import mujoco
import numpy as np
from mujoco import rollout as threads

from benchmarks.measured import measured_folder
from benchmarks.so101 import JOINTS, ROW, STEP, columns, motions, rollout
from benchmarks.so101_arm import FITTED, LEFT_OUT
from benchmarks.stored_runs import commit_of
from jaxid.export.soft_friction import Softness

HERE = Path(__file__).parent / "results"
ROOT = Path(__file__).parents[1]
# First rows of each fitted motion, 40 s: the three together are 0.23 s of rollout.
ROWS = 2001
# Ranges of the search, which runs over the logarithm where a third entry says so. PACE's own ranges are part
# of a robot's settings; these are wide.
RANGES = {
    "armature": (1e-4, 1.0, "log"),
    "damping": (1e-2, 300.0, "log"),
    "frictionloss": (1e-3, 3.0, "log"),
    "bias": (-0.1, 0.1, ""),
    "delay": (0.0, 0.1, ""),
    "kp": (1.0, 1000.0, "log"),
    "kv": (1e-2, 100.0, "log"),
}
PACE = ("armature", "damping", "frictionloss", "bias", "delay")
FITS = {"pace": PACE, "gains": (*PACE, "kp", "kv"), "stiff": (*PACE, "kp", "kv")}
# MuJoCo's own softness of dry friction.
SOFT = Softness((0.02, 1.0), (0.9, 0.95))
# Evaluations of the three motions, and candidates in one generation.
EVALUATIONS, POPULATION = 960, 16
# The start is the middle of all ranges, with this standard deviation in units of a range.
SPREAD = 0.25
SEED = 1
UNITS = ("kg m^2", "N m s/rad", "N m", "rad", "s", "N m/rad", "N m s/rad")


@dataclass(frozen=True)
class Course:
    """A motion on the steps of MuJoCo: the row whose command holds at each step, and the step of each row."""

    commands: np.ndarray
    measured: np.ndarray
    held: np.ndarray
    read: np.ndarray

    @classmethod
    def of(cls, motion: np.ndarray) -> "Course":
        """Lay out a motion; its first reading is taken before the first step."""
        commands, measured = columns(motion, "cmd"), columns(motion, "q")
        read = np.round(np.arange(len(motion)) * ROW / STEP).astype(int)
        held = np.searchsorted(read, np.arange(read[-1]), side="right") - 1
        return cls(commands, measured, held, read)

    def delayed(self, delays: np.ndarray) -> np.ndarray:
        """Return the command of each joint, (steps, joints), by its delay [s] in whole steps."""
        at = np.arange(len(self.held))[:, None] - np.round(delays / STEP).astype(int)
        return np.take_along_axis(self.commands, self.held[np.maximum(at, 0)], axis=0)


def model_of(base: mujoco.MjModel, values: dict[str, np.ndarray]) -> mujoco.MjModel:
    """Return a model with other values, (joints,) each, by name."""
    model = copy.copy(base)
    model.dof_armature[:] = values["armature"]
    model.dof_damping[:] = values["damping"]
    model.dof_frictionloss[:] = values["frictionloss"]
    if "kp" in values:
        model.actuator_gainprm[:, 0] = values["kp"]
        model.actuator_biasprm[:, 1] = -values["kp"]
        model.actuator_biasprm[:, 2] = -values["kv"]
    return model


def mean_squares(
    base: mujoco.MjModel,
    candidates: Sequence[dict[str, np.ndarray]],
    course: Course,
    pool: list[mujoco.MjData],
) -> np.ndarray:
    """Return the mean square of simulated less measured position, (candidates, joints) [rad^2]."""
    models = [model_of(base, values) for values in candidates]
    biases = np.stack([values["bias"] for values in candidates])
    size = mujoco.mj_stateSize(base, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    start = np.zeros((len(models), size))
    # The state: time, positions, velocities.
    start[:, 1 : 1 + base.nq] = course.measured[0] + biases
    control = np.stack([course.delayed(values["delay"]) for values in candidates])
    states, _ = threads.rollout(models, pool, start, control)
    positions = states[:, course.read[1:] - 1, 1 : 1 + base.nq]
    errors = positions - biases[:, None] - course.measured[1:]
    # A diverging candidate is as bad as one that is a turn away.
    return np.nan_to_num(np.mean(errors**2, axis=1), nan=40.0, posinf=40.0)


def in_range(name: str, share: np.ndarray) -> np.ndarray:
    """Return values of a parameter from shares of its range."""
    low, high, scale = RANGES[name]
    return low * (high / low) ** share if scale == "log" else low + share * (high - low)


def evolve(base: mujoco.MjModel, courses: Sequence[Course], names: Sequence[str]) -> dict[str, np.ndarray]:
    """Fit the parameters of all joints, and return the mean of the last generation.

    Every joint has a strategy of its own, and one rollout carries a candidate of each: with five or seven
    unknowns a strategy converges within a budget that is hardly a start for one with six times as many. The
    joints move each other little, so that the error of a joint is its own candidate's.
    """
    options = {"bounds": [0.0, 1.0], "popsize": POPULATION, "seed": SEED, "verbose": -9, "maxiter": 10**6}
    searches = [
        cma.CMAEvolutionStrategy(len(names) * [0.5], SPREAD, {**options, "seed": SEED + k})
        for k in range(base.nq)
    ]
    pool = [mujoco.MjData(base)]
    for _ in range(EVALUATIONS // POPULATION):
        shares = np.array([search.ask() for search in searches])
        candidates = [
            {name: in_range(name, shares[:, c, k]) for k, name in enumerate(names)} for c in range(POPULATION)
        ]
        costs = np.mean([mean_squares(base, candidates, course, pool) for course in courses], axis=0)
        for k, search in enumerate(searches):
            search.tell(list(shares[k]), costs[:, k].tolist())
    found = np.array([search.result.xfavorite for search in searches])
    return {name: in_range(name, found[:, k]) for k, name in enumerate(names)}


def base_model(data: Path) -> mujoco.MjModel:
    """Return the community's model; damping is implicit, so that light and damped candidates stay stable."""
    model = mujoco.MjModel.from_xml_path(str(data / "so101.xml"))
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return model


def stiffened(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose dry friction is as stiff as it can be."""
    return with_softness(model, Softness.least(STEP))


def softened(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a model whose dry friction is as soft as MuJoCo's own."""
    return with_softness(model, SOFT)


def with_softness(model: mujoco.MjModel, softness: Softness) -> mujoco.MjModel:
    """Return a model with one softness of the dry friction of all joints."""
    model = copy.copy(model)
    for dof in range(model.nv):
        softness.put(model, dof)
    return model


def by_strategy(data: Path, fit: str) -> dict[str, Any]:
    """Fit by the evolution strategy; return times, values and RMS on all motions by name [mrad]."""
    logs, base, names = motions(data), base_model(data), FITS[fit]
    base = stiffened(base) if fit == "stiff" else base
    begin, used = time.perf_counter(), time.process_time()
    values = evolve(base, [Course.of(logs[name][:ROWS]) for name in FITTED], names)
    seconds = {"seconds": time.perf_counter() - begin, "processor": time.process_time() - used}
    pool = [mujoco.MjData(base)]
    rms = {
        name: 1e3 * np.sqrt(mean_squares(base, [values], Course.of(motion), pool)[0])
        for name, motion in shown(logs).items()
    }
    return {**seconds, "values": {n: v.tolist() for n, v in values.items()}, "rms": as_lists(rms)}


def by_jaxid(data: Path) -> dict[str, Any]:
    """Fit by the command that corrects the MJCF, in a fresh process; score its file in MuJoCo."""
    logs = motions(data)
    with tempfile.TemporaryDirectory() as folder:
        cut = []
        for name in FITTED:
            lines = (data / f"{name}.csv").read_text().splitlines()[: ROWS + 1]
            cut.append(Path(folder) / f"{name}.csv")
            cut[-1].write_text("\n".join(lines) + "\n")
        out = Path(folder) / "out"
        command = [sys.executable, "-m", "jaxid.cli", "identify", str(data / "so101.xml"), *map(str, cut)]
        for name in LEFT_OUT:
            command += ["--validate", str(data / f"{name}.csv")]
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([*command, "-o", str(out)], capture_output=True, check=False)
        seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
        result = json.loads((out / "result.json").read_text())
        model = mujoco.MjModel.from_xml_path(str(out / "so101_found.xml"))
    model.opt.timestep = STEP
    own = result["gap"]["validations"]
    return {
        "seconds": seconds,
        "processor": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "converged": result["converged"],
        "rms": as_lists({name: replayed(model, motion) for name, motion in shown(logs).items()}),
        "soft": as_lists({name: replayed(softened(model), motion) for name, motion in shown(logs).items()}),
        "own": as_lists({name: 1e3 * np.array(own[name]["simulation"]) for name in LEFT_OUT}),
    }


def by_file(data: Path) -> dict[str, Any]:
    """Score the community's file as it is."""
    model = mujoco.MjModel.from_xml_path(str(data / "so101.xml"))
    model.opt.timestep = STEP
    return {"rms": as_lists({name: replayed(model, log) for name, log in shown(motions(data)).items()})}


def replayed(model: mujoco.MjModel, motion: np.ndarray) -> np.ndarray:
    """Return the RMS of MuJoCo's position less the measured one, by joint [mrad]."""
    return 1e3 * np.sqrt(np.mean((rollout(model, motion) - columns(motion, "q")) ** 2, axis=0))


def shown(logs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the motions that are scored: the fitted rows of three, and six whole ones left out."""
    return {**{name: logs[name][:ROWS] for name in FITTED}, **{name: logs[name] for name in LEFT_OUT}}


def as_lists(rms: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """Return figures of joints 1 to 5 as JSON has them."""
    return {name: [round(float(x), 3) for x in values[: len(JOINTS)]] for name, values in rms.items()}


def table(content: dict[str, Any]) -> str:
    """Return the page."""
    words = {
        "file": "the file as it is",
        "pace": "CMA-ES, PACE's parameters",
        "gains": "CMA-ES, kp and kv as well",
        "stiff": "CMA-ES, these, stiff friction",
        "softened": "jaxid's file, soft friction",
        "jaxid": "jaxid's file",
        "own": "jaxid's own simulation",
    }
    runs = {name: content["runs"][name] for name in words if name in content["runs"]}
    if "jaxid" in runs:
        runs["softened"] = {"rms": runs["jaxid"]["soft"]}
        runs["own"] = {"rms": runs["jaxid"]["own"]}
        runs = {name: runs[name] for name in words if name in runs}
    made = [f"{name} on {run['date']} at {run['commit']}" for name, run in runs.items() if "commit" in run]
    left = {name: np.mean([run["rms"][m] for m in LEFT_OUT], axis=0) for name, run in runs.items()}
    lines = [
        "# SO-101 by an evolution strategy, and by jaxid",
        "",
        f"Written by `python -m benchmarks.so101_cmaes`: {', '.join(made)}.",
        "Figures are RMS of simulated minus measured position in mrad, the mean over six motions left out:",
        f"{', '.join(LEFT_OUT)}.",
        f"Fitted: the first {ROWS} rows of {', '.join(FITTED)}, by all.",
        f"CMA-ES (`cma`, population {POPULATION}) has {EVALUATIONS} evaluations of these, in one thread;",
        "each joint has its own strategy, and one rollout of MuJoCo carries a candidate of each. The time of",
        "jaxid is that of the whole command in a fresh process, with simulations of nine motions and replays",
        "of them by MuJoCo. Stiff friction: `solreffriction` of two steps and `solimpfriction` of 0.9999.",
        "",
        f"| joint | {' | '.join(words[name] for name in runs)} |",
        "|---" * (1 + len(runs)) + "|",
    ]
    for k, joint in enumerate(JOINTS):
        lines.append(f"| {joint} | {' | '.join(f'{left[name][k]:.1f}' for name in runs)} |")
    lines.append(f"| **mean** | {' | '.join(f'**{np.mean(left[name]):.1f}**' for name in runs)} |")
    fitted = [
        f"{np.mean([run['rms'][m] for m in FITTED]):.1f}" if name != "own" else ""
        for name, run in runs.items()
    ]
    lines.append(f"| mean, fitted rows | {' | '.join(fitted)} |")
    if "jaxid" in runs:
        cells = [_yes(run.get("converged")) if name == "jaxid" else "" for name, run in runs.items()]
        lines.append(f"| converged | {' | '.join(cells)} |")
    for what, head in (("seconds", "time [s]"), ("processor", "processor [s]")):
        cells = [f"{run[what]:.0f}" if what in run and name != "own" else "" for name, run in runs.items()]
        lines.append(f"| {head} | {' | '.join(cells)} |")
    for fit in FITS:
        if fit not in runs:
            continue
        values = runs[fit]["values"]
        lines += ["", f"Values of {words[fit]} (no standard deviation comes with them):", ""]
        heads = [f"{name} [{unit}]" for name, unit in zip(RANGES, UNITS, strict=True) if name in values]
        lines.append(f"| joint | {' | '.join(heads)} |")
        lines.append("|---" * (1 + len(values)) + "|")
        for k, joint in enumerate(JOINTS):
            lines.append(f"| {joint} | {' | '.join(f'{v[k]:.3g}' for v in values.values())} |")
    return "\n".join(lines) + "\n"


def _yes(flag: bool | None) -> str:
    return "yes" if flag else "no"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--fit", action="append", choices=[*FITS, "jaxid"], default=[], help="may be repeated"
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    data, kept = measured_folder(parser, "so101"), options.o / "so101_cmaes.json"
    for fit in options.fit or [*FITS, "jaxid"]:
        run = by_jaxid(data) if fit == "jaxid" else by_strategy(data, fit)
        content = json.loads(kept.read_text()) if kept.exists() else {"runs": {"file": by_file(data)}}
        content["runs"][fit] = {**run, "commit": commit_of(ROOT), "date": date.today().isoformat()}
        kept.write_text(json.dumps(content, indent=1) + "\n")
        (options.o / "so101_cmaes.md").write_text(table(content))
    print(table(json.loads(kept.read_text())))


if __name__ == "__main__":
    main()
