"""SO-101, an arm of hobby servos, from command and encoder alone, on motions that no fit has seen.

    JAXID_DATA=FOLDER python -m benchmarks.so101 [--joint N]... [-o DIR]

Each joint is an axis behind a servo of unknown gains, and is fitted by `identify` to stretches of six
motions. The fitted model then follows the six other motions from their commands. Beside it stand the
community's MJCF, replayed by MuJoCo, a play operator with a lag that is fitted to the same stretches, and a
simulation that goes where it is told. Writes so101.json, so101.md and so101.svg.
"""

import argparse
import json
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import jaxid
from benchmarks.cold import commit_of
from benchmarks.measured import measured_folder
from benchmarks.play_operator import fitted, left_of
from benchmarks.so101_picture import picture
from jaxid.gap import SimulationGap, simulation_of_log
from jaxid.logs.log import Log
from jaxid.machine import Machine

HERE = Path(__file__).parent / "results"
ROOT = Path(__file__).parents[1]
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
# Time between two rows [s], and ticks of the servo's loop between them: the loop's own rate is not known, and
# so fast a loop is all but continuous for these gains.
ROW, TICKS = 0.02006, 4
# Stretches that are fitted, all of one length, so that they share compiled code; others are left out.
FITTED = {
    "chirp_sweep": 3999,
    "friction_gravity": 0,
    "hold_under_gravity": 0,
    "multisine": 0,
    "prbs_excitation": 0,
    "single_joint_elbow": 0,
}
ROWS = 2001
# Least travel of the command of a joint that is fitted to a motion [rad].
MOVES = 0.05
# Motions in which the arm touches the table: joints whose command rests are pushed out of place.
TOUCHING = ("hold_under_gravity", "single_joint_elbow")
# The motion whose joints are faster than the limit of acceleration that the chirp shows allows; its command
# jumps between two values. Why the servo has no limit there is not known.
WITHOUT_LIMIT = "prbs_excitation"
# Step of MuJoCo [s].
STEP = 0.002
# Part of a motion left out that the picture shows: motion, joint, first and last row.
SHOWN = (("step_response", 3, 550, 2050), ("wave_motion", 5, 500, 1000))


def motions(data: Path) -> dict[str, np.ndarray]:
    """Return all motions by name, each with the columns of its file."""
    files = sorted(data.glob("*.csv"))
    return {file.stem: np.genfromtxt(file, delimiter=",", names=True) for file in files}


def columns(motion: np.ndarray, name: str) -> np.ndarray:
    """Return a quantity of all six joints, (rows, 6)."""
    return np.stack([motion[f"{name}{k}"] for k in range(1, 7)], axis=1)


def rollout(model: mujoco.MjModel, motion: np.ndarray) -> np.ndarray:
    """Return the positions at which MuJoCo has the joints, (rows, 6), from the first reading at rest."""
    state, commands = mujoco.MjData(model), columns(motion, "cmd")
    out = np.empty_like(commands)
    state.qpos[:] = columns(motion, "q")[0]
    for k, command in enumerate(commands):
        out[k] = state.qpos
        state.ctrl[:] = command
        while state.time < (k + 1) * ROW - 0.5 * STEP:
            mujoco.mj_step(model, state)
    return out


def case_of() -> dict[str, Any]:
    """Return the case of one joint; its guesses are those of any small servo."""
    return {
        # Command and encoder have no scale: the file's inertia of the rotor, behind its gear, gives it.
        "plant": {"kind": "axis", "motion": "rotary", "parameters": {"inertia": 0.028}},
        "effects": [
            {"kind": "viscous_friction", "coefficient": {"guess": 0.8}},
            {"kind": "coulomb_friction", "level": {"guess": 0.2}},
            {"kind": "stribeck_friction", "level": {"guess": 0.1}, "velocity": {"guess": 0.1}},
            # The weight at about one pose.
            {"kind": "constant_force", "level": {"guess": 0.0}},
            {"kind": "acceleration_limit", "limit": {"guess": 50.0}},
        ],
        "controller": {
            "kind": "pd",
            "kp": {"guess": 20.0},
            "kd": {"guess": 0.4},
            "delay": {"guess": 0.015},
            "limit": {"guess": 3.0},
            "period": ROW / TICKS,
        },
        # A count of the encoder is 1.534 mrad.
        "sensor": {"position_noise": 1.534e-3 / 12**0.5},
        "log": {"time": "t", "position": "q", "reference": "r", "reference_hold": "zero_order"},
    }


def run(joint: int, logs: dict[str, np.ndarray]) -> dict[str, Any]:
    """Fit one joint, 1-based, and follow the motions left out; return the record."""
    case = {**case_of(), "fit": []}
    never = {"acceleration_limit.limit": 1e9}
    with tempfile.TemporaryDirectory() as folder:
        for name, motion in logs.items():
            table = {
                "t": ROW * np.arange(len(motion)),
                "q": motion[f"q{joint}"],
                "r": motion[f"cmd{joint}"],
            }
            path = Path(folder) / f"{name}.csv"
            np.savetxt(
                path, np.stack(list(table.values()), 1), "%.9g", ",", header=",".join(table), comments=""
            )
            if name in FITTED and np.ptp(table["r"]) > MOVES:
                entry = {"name": name, "log": str(path), "rows": [FITTED[name], FITTED[name] + ROWS]}
                case["fit"].append({**entry, "set": never} if name == WITHOUT_LIMIT else entry)
        begin = time.perf_counter()
        result = jaxid.identify(case)
        seconds = time.perf_counter() - begin
        left = {
            name: followed(result.estimate.machine, Path(folder) / f"{name}.csv")
            for name in logs
            if name not in {entry["name"] for entry in case["fit"]}
        }
    fitted = {gap.name: gap.simulation for gap in result.gaps}
    shown = {}
    for name, at, first, last in SHOWN:
        simulated = left.get(name)
        if at == joint and simulated is not None:
            shown[name] = [round(float(x), 6) for x in simulated.position[first:last, 0]]
    return {
        "joint": joint,
        "seconds": round(seconds, 1),
        "converged": result.estimate.converged,
        "parameters": {
            name: {"value": _number(p.value), "std": _number(p.std), "unit": p.unit}
            for name, p in result.parameters.items()
        },
        "rms": {name: None if s is None else 1e3 * float(s.rms[0]) for name, s in {**fitted, **left}.items()},
        "shown": shown,
        "notes": list(result.estimate.notes),
    }


def followed(machine: Machine, path: Path) -> SimulationGap | None:
    """Simulate a motion from its command alone; a joint may stand still in it."""
    table = np.genfromtxt(path, delimiter=",", names=True)
    still = np.zeros(len(table))
    log = Log(table["t"], table["q"], still, reference=table["r"], source=str(path))
    return simulation_of_log(machine, log)


def compared(model: mujoco.MjModel, logs: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return RMS [mrad] by motion and joint of what stands beside the fitted model, and shown curves."""
    out: dict[str, Any] = {"file": {}, "command": {}, "play": plays(logs), "shown": {}}
    for name, motion in logs.items():
        q, simulated = columns(motion, "q"), rollout(model, motion)
        for what, course in (("file", simulated), ("command", columns(motion, "cmd"))):
            rms = 1e3 * np.sqrt(np.mean((course - q) ** 2, axis=0))
            out[what][name] = [round(float(x), 2) for x in rms[: len(JOINTS)]]
        for shown, joint, first, last in SHOWN:
            if shown == name:
                rows = slice(first, last)
                curves = {"measured": q, "file": simulated, "command": columns(motion, "cmd")}
                out["shown"][name] = {
                    what: [round(float(x), 6) for x in course[rows, joint - 1]]
                    for what, course in curves.items()
                }
    return out


def plays(logs: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """Return RMS [mrad] by motion and joint of play operators that are fitted to the stretches of `run`."""
    out: dict[str, list[float]] = {name: [] for name in logs}
    for joint in range(1, len(JOINTS) + 1):
        courses = {name: (motion[f"cmd{joint}"], motion[f"q{joint}"]) for name, motion in logs.items()}
        stretches = [
            (command[first : first + ROWS], position[first : first + ROWS])
            for name, first in FITTED.items()
            for command, position in [courses[name]]
        ]
        numbers = fitted([s for s in stretches if np.ptp(s[0]) > MOVES], ROW)
        for name, course in courses.items():
            out[name].append(round(1e3 * left_of(numbers, *course, ROW), 2))
    return out


def mean(record: dict[str, Any], names: list[str]) -> float:
    """Return the mean RMS of one joint over some motions [mrad]; infinite where a simulation diverges."""
    values = [record["rms"][name] for name in names]
    return float("inf") if None in values else float(np.mean(values))


def table(content: dict[str, Any]) -> str:
    """Return the page."""
    joints = {r["joint"]: r for r in content["joints"]}
    names = list(content["compared"]["command"])
    left = [name for name in names if name not in FITTED]

    def others(what: str, joint: int, of: list[str]) -> float:
        return float(np.mean([content["compared"][what][name][joint - 1] for name in of]))

    lines = [
        "# SO-101 from command and encoder alone",
        "",
        f"Written by `python -m benchmarks.so101` on {content['date']}, at {content['commit']}.",
        "Figures are RMS of simulated minus measured position in mrad; a count of the encoder is 1.5.",
        f"Fitted: {ROWS} rows each of {', '.join(FITTED)}, where the joint moves.",
        f"Left out: {', '.join(left)}.",
        "",
        "| joint | left out | fitted motions | left out, community's MJCF | left out, play operator "
        "| left out, as commanded | s |",
        "|---|---|---|---|---|---|---|",
    ]
    rows = []
    for joint, record in sorted(joints.items()):
        row = [mean(record, left), mean(record, list(FITTED)), others("file", joint, left)]
        row += [others("play", joint, left), others("command", joint, left), record["seconds"]]
        rows.append(row)
        cells = " | ".join(f"{x:.1f}" for x in row)
        lines.append(f"| {JOINTS[joint - 1]} | {cells} |")
    if len(rows) == len(JOINTS):
        *averaged, _ = np.mean(rows, axis=0)
        total = sum(row[-1] for row in rows)
        lines.append(f"| **mean** | {' | '.join(f'**{x:.1f}**' for x in averaged)} | {total:.0f} |")
    lines += [
        "",
        "The play operator has a lag and a delay: four numbers a joint without physics, of the same rows.",
        f"In {' and '.join(TOUCHING)} the arm touches the table, which a joint alone does not know.",
        "Which motions are fitted was decided with all twelve in view, and so was the model.",
    ]
    lines += ["", "By motion:", "", f"| joint | {' | '.join([*left, *FITTED])} |"]
    lines.append("|---" * (len(names) + 1) + "|")
    for joint, record in sorted(joints.items()):
        cells = [
            "diverges" if record["rms"][n] is None else f"{record['rms'][n]:.1f}" for n in [*left, *FITTED]
        ]
        lines.append(f"| {JOINTS[joint - 1]} | {' | '.join(cells)} |")
    lines += ["", "Values (σ):", "", f"| | {' | '.join(JOINTS[j - 1] for j in sorted(joints))} |"]
    lines.append("|---" * (len(joints) + 1) + "|")
    for name in dict.fromkeys(n for r in joints.values() for n in r["parameters"]):
        cells, unit = [], ""
        for _, record in sorted(joints.items()):
            found = record["parameters"].get(name)
            unit = found["unit"] if found else unit
            known = found is not None and found["value"] is not None
            cells.append(
                f"{found['value']:.3g} ({found['std']:.2g})" if found and known else "not identifiable"
            )
        lines.append(f"| {name} [{unit}] | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _number(x: float) -> float | None:
    """Return a number, or None where it is not finite: JSON has no such numbers."""
    return x if np.isfinite(x) else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joint", type=int, action="append", default=[], help="1 to 5; may be repeated")
    parser.add_argument("-o", type=Path, default=HERE)
    args = parser.parse_args()
    data = measured_folder(parser, "so101")
    kept = args.o / "so101.json"
    logs = motions(data)
    for joint in args.joint or range(1, len(JOINTS) + 1):
        record = run(joint, logs)
        # Read now: another joint may have ended meanwhile.
        content = json.loads(kept.read_text()) if kept.exists() else {"joints": []}
        if "play" not in content.get("compared", {}):
            model = mujoco.MjModel.from_xml_path(str(data / "so101.xml"))
            model.opt.timestep = STEP
            content["compared"] = compared(model, logs)
        content["joints"] = [r for r in content["joints"] if r["joint"] != joint] + [record]
        content |= {"commit": commit_of(ROOT), "date": date.today().isoformat()}
        kept.write_text(json.dumps(content, indent=1) + "\n")
        (args.o / "so101.md").write_text(table(content))
        (args.o / "so101.svg").write_text(picture(content, SHOWN, JOINTS, ROW))
        print(table(content).split("By motion")[0], flush=True)


if __name__ == "__main__":
    main()
