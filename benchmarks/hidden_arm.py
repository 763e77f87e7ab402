"""An arm in MuJoCo of which the user's file lacks four things: jaxid beside MuJoCo's sysid.

    python -m benchmarks.hidden_arm [-o DIR]

The file states a wrong mass as well; the log is MuJoCo's, with torques. `jaxid discover` searches for what is
not in the file. `jaxid identify` and MuJoCo's sysid fit a list that the user names: first what such files
usually hold, then with springs as well. sysid simulates stretches of a quarter of a second, which start from
the log. Each result is a file of MuJoCo. DIR/hidden_arm.md holds what these files state, how well they follow
a log left out, the times, and what each tool says of what is missing.
"""

import argparse
import contextlib
import io
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import mujoco
import numpy as np
from mujoco import sysid
from scipy.signal import savgol_filter

import jaxid
from benchmarks.stored_runs import commit_of
from jaxid.commands.export import export
from jaxid.commands.robot_case import RobotCase
from jaxid.results.as_json import discovery_json, identification_json
from tests.support.hidden_arm import JOINTS, MASS, arm_log, inertial_forces, stated, true_file, user_file
from tests.support.written_logs import write_csv

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
SECONDS, RATE = 6.0, 200
# Random states in which torques are compared.
STATES = 200
# Rows of a stretch. An arm that stands upright falls away from its log in an open loop.
STRETCH = 50
# Ranges of sysid's lists and where the fit starts: attributes of joints, in SI units.
RANGES = {
    "armature": (0.0, 1.0, 0.01),
    "damping": (0.0, 5.0, 0.1),
    "frictionloss": (0.0, 5.0, 0.1),
    "stiffness": (0.0, 20.0, 0.5),
    "springref": (-2.0, 2.0, 0.1),
}
USUAL = ("armature", "damping", "frictionloss")
BODIES = {"base": 2.0, "upper": 1.5, "forearm": 0.5}
# A residual of order one is so small that sysid's solver is content at once.
SCALE = 1e4


@dataclass(frozen=True)
class Outcome:
    """What a fit gave.

    Args:
        heading: Who fitted which list.
        file: The corrected file.
        seconds: Time by the clock and of a processor [s], compiling included.
        words: What the tool says of anything that is missing.
        halves: Half widths of the 95 % intervals of sysid, by joint and attribute.
    """

    heading: str
    file: str
    seconds: tuple[float, float]
    words: str
    halves: Mapping[str, float]


def main() -> int:
    """Fit the arm by all, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()

    columns = arm_log(seconds=SECONDS, rate=RATE)
    with tempfile.TemporaryDirectory() as folder:
        robot = Path(folder) / "robot.xml"
        robot.write_text(user_file())
        log = write_csv(Path(folder) / "log.csv", columns)
        outcomes = [searched(robot, log), identified(robot, log, USUAL)]
        outcomes.append(identified(robot, log, (*USUAL, "stiffness")))
    outcomes += [by_sysid(columns, USUAL), by_sysid(columns, tuple(RANGES))]

    text = page(outcomes)
    (options.o / "hidden_arm.md").write_text(text)
    print(text)
    return 0


def searched(robot: Path, log: Path) -> Outcome:
    """Search for what the file lacks, without a list."""
    begin = clocks()
    found = jaxid.discover(RobotCase.of(str(robot), [str(log)], search=True).tables, log)
    seconds = since(begin)
    words = f"{found.verdict}: {', '.join(effect.label for effect in found.effects)}"
    file = export(discovery_json(found), "mjcf").content.decode()
    return Outcome("jaxid discover", file, seconds, words, {})


def identified(robot: Path, log: Path, listed: tuple[str, ...]) -> Outcome:
    """Fit a list that the user names, and the sums of the bodies."""
    begin = clocks()
    tables = RobotCase.of(str(robot), [str(log)]).tables
    tables["plant"]["unknown"] = ["base", *listed]
    found = jaxid.identify(tables, log)
    seconds = since(begin)
    words = {True: "the model explains the log", False: "the model is incomplete", None: "cannot tell"}
    file = export(identification_json(found), "mjcf").content.decode()
    return Outcome(_heading("jaxid identify", listed), file, seconds, words[found.model_complete], {})


def by_sysid(columns: Mapping[str, np.ndarray], listed: tuple[str, ...]) -> Outcome:
    """Fit a list that the user names, and the masses, by MuJoCo's sysid."""
    begin = clocks()
    unknown = parameters(listed)
    residual = residual_of(columns)

    # At its default tolerances the solver does not start on a residual of order one.
    def scaled(*args, **more):
        parts, *rest = residual(*args, **more)
        return ([SCALE * part for part in parts], *rest)

    # Each step is printed, whatever `verbose` says.
    with contextlib.redirect_stdout(io.StringIO()):
        found, solved = sysid.optimize(
            initial_params=unknown, residual_fn=scaled, optimizer="mujoco", verbose=False, x_scale="jac"
        )
    parts, _, _ = scaled(found.as_vector(), found)
    _, halves = sysid.calculate_intervals([np.ravel(part) for part in parts], solved.jac)
    seconds = since(begin)

    fitted = mujoco.MjSpec.from_string(user_file())
    sysid.apply_param_modifiers_spec(found, fitted)
    fitted.compile()
    widths = dict(zip(found.keys(), np.ravel(halves), strict=True))
    return Outcome(_heading("mujoco.sysid", listed), fitted.to_xml(), seconds, "none", widths)


def clocks() -> tuple[float, float]:
    """Return the time by the clock and of a processor [s]."""
    return time.perf_counter(), time.process_time()


def since(begin: tuple[float, float]) -> tuple[float, float]:
    """Return the times since others [s]."""
    now = clocks()
    return now[0] - begin[0], now[1] - begin[1]


def _heading(tool: str, listed: tuple[str, ...]) -> str:
    return f"{tool}, {'springs listed as well' if 'stiffness' in listed else 'usual list'}"


def parameters(listed: tuple[str, ...]) -> sysid.ParameterDict:
    """Return sysid's unknowns: a list of attributes at every joint, and the mass of every body."""
    out = sysid.ParameterDict()
    for joint in JOINTS:
        for name in listed:
            low, high, start = RANGES[name]
            out.add(sysid.Parameter(f"{joint} {name}", start, low, high, modifier=_of_joint(joint, name)))
    for body, mass in BODIES.items():
        change = lambda spec, p, body=body: setattr(spec.body(body), "mass", p.value[0])
        out.add(sysid.Parameter(f"{body} mass", mass, 0.1, 5.0, modifier=change))
    return out


def _of_joint(joint: str, name: str) -> Callable:
    """Return what writes an attribute of a joint into a file; some have entries for higher powers."""
    several = name in ("damping", "stiffness")

    def change(spec, parameter):
        value = parameter.value[0]
        setattr(spec.joint(joint), name, [value, 0, 0] if several else value)

    return change


def residual_of(columns: Mapping[str, np.ndarray]) -> Callable:
    """Return sysid's residual over the stretches of a log."""
    spec = mujoco.MjSpec.from_string(user_file())
    for joint in JOINTS:
        kind, of = mujoco.mjtSensor.mjSENS_JOINTPOS, mujoco.mjtObj.mjOBJ_JOINT
        spec.add_sensor(name=f"at {joint}", type=kind, objtype=of, objname=joint)
    model = spec.compile()
    position, velocity, torque = signals(columns)
    step = model.opt.timestep
    inner = round(1.0 / RATE / step)

    starts, controls, measured = [], [], []
    for first in range(0, len(position) - STRETCH, STRETCH):
        rows = slice(first, first + STRETCH + 1)
        starts.append(sysid.create_initial_state(model, position[first], velocity[first]))
        held = np.repeat(torque[rows][:-1], inner, axis=0)
        controls.append(sysid.TimeSeries(step * np.arange(len(held)), held))
        times = np.arange(STRETCH + 1) / RATE
        measured.append(sysid.TimeSeries.from_names(times, columns_of(columns, "q")[rows], model))
    names = [f"stretch {k}" for k in range(len(starts))]
    return sysid.build_residual_fn(
        models_sequences=[sysid.ModelSequences("arm", spec, names, starts, controls, measured)]
    )


def columns_of(columns: Mapping[str, np.ndarray], what: str) -> np.ndarray:
    """Return columns of all joints, (time, 3)."""
    return np.stack([columns[f"{what}_{joint}"] for joint in JOINTS], axis=1)


def signals(columns: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return smoothed positions and velocities, where stretches start, and the torques: (time, 3) each."""
    position = columns_of(columns, "q")
    smooth = savgol_filter(position, 9, 4, axis=0)
    velocity = savgol_filter(position, 9, 4, deriv=1, delta=1.0 / RATE, axis=0)
    return smooth, velocity, columns_of(columns, "torque")


def followed(file: str, columns: Mapping[str, np.ndarray]) -> float:
    """Return how far a file is from a log over its stretches: RMS of all joints [rad]."""
    model = mujoco.MjModel.from_xml_string(file)
    data, inner = mujoco.MjData(model), round(1.0 / RATE / model.opt.timestep)
    position, velocity, torque = signals(columns)
    measured, off = columns_of(columns, "q"), []
    for first in range(0, len(position) - STRETCH, STRETCH):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = position[first], velocity[first]
        for row in range(first, first + STRETCH):
            data.ctrl[:] = torque[row]
            mujoco.mj_step(model, data, inner)
            off.append(data.qpos - measured[row + 1])
    return float(np.sqrt(np.mean(np.square(off))))


def page(outcomes: list[Outcome]) -> str:
    """Return the page of the results."""
    true = stated(true_file())
    files = [stated(outcome.file) for outcome in outcomes]
    row = lambda what, cells: f"| {what} | " + " | ".join(cells) + " |"
    lines = [
        "# An arm in MuJoCo of which the file lacks four things",
        "",
        f"Written by `python -m benchmarks.hidden_arm` on {date.today()}, at {commit_of(ROOT)}.",
        f"The log has {SECONDS:g} s at {RATE} Hz with torques, by MuJoCo; noise of its encoders is 10 urad.",
        f"The file states {BODIES['forearm']} kg for the forearm, {MASS} are true. Friction, damping, a",
        "rotor and a spring are not in the file.",
        "",
        "| | true | " + " | ".join(o.heading for o in outcomes) + " |",
        "|---" * (2 + len(outcomes)) + "|",
    ]
    shown = [name for name in true if true[name] or any(abs(f[name]) > 0.02 for f in files)]
    for name in shown:
        cells = []
        for outcome, file in zip(outcomes, files, strict=True):
            half = outcome.halves.get(name)
            cells.append(f"{file[name]:.4g}" + ("" if half is None else f" ± {half:.2g}"))
        lines.append(row(name, [f"{true[name]:g}", *cells]))

    exact = inertial_forces(true_file(), STATES)
    apart = lambda file: np.max(np.abs(inertial_forces(file, STATES) - exact) / np.abs(exact).max(axis=0))
    left_out = arm_log(seed=1, seconds=SECONDS, rate=RATE)
    shown_rms = lambda file: f"{1e3 * followed(file, left_out):.3g} mrad"
    every = [o.file for o in outcomes]
    lines += [
        row(
            "bodies and rotors, largest error of a torque", ["-", *(f"{100 * apart(f):.2g} %" for f in every)]
        ),
        row("a log left out, stretches of 0.25 s", [shown_rms(true_file()), *map(shown_rms, every)]),
        row("time, of a processor", ["", *("{:.0f} s, {:.0f} s".format(*o.seconds) for o in outcomes)]),
        row("statement on what is missing", ["", *(o.words for o in outcomes)]),
        "",
        f"The user's file is wrong by up to {100 * apart(user_file()):.2g} % in a torque of the bodies, and",
        f"by {shown_rms(user_file())} on the log left out. Times include compiling. Behind ± stands half of",
        "sysid's 95 % interval. A springref without stiffness has no effect.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
