"""An arm whose URDF states no friction, no rotors and no payload: what `discover` and `identify` find.

    python -m benchmarks.silent_urdf [-o DIR]

The log is Pinocchio's: a UR5 in a joint controller that the case does not know, with rotors, viscous and dry
friction at all joints and a payload, its torques and positions noisy. The two commands get the public URDF
and the log. DIR/silent_urdf.md holds what they found beside the truth, and their times. It needs the package
example-robot-data (`pip install 'jaxid[robots]'`).
"""

import argparse
import json
import sys
import tempfile
from datetime import date
from pathlib import Path

import numpy as np
import pinocchio

from benchmarks.so101_arm import Ran
from benchmarks.stored_runs import commit_of
from tests.support.public_robots import SHARE
from tests.support.written_logs import write_csv

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
SECONDS, RATE, INNER = 8.0, 1000, 10
ROTORS = np.array([1.2, 1.5, 0.8, 0.12, 0.1, 0.09])
VISCOUS = np.array([8.0, 9.0, 5.0, 1.5, 1.2, 1.0])
DRY = np.array([6.0, 7.0, 4.0, 1.0, 1.0, 0.8])
# Payload at the flange: mass, centre and inertia.
PAYLOAD = pinocchio.Inertia(1.5, np.array([0.0, 0.05, 0.08]), np.diag([0.004, 0.004, 0.003]))
KP = np.array([900.0, 900.0, 600.0, 200.0, 150.0, 100.0])
KD = np.array([60.0, 60.0, 40.0, 12.0, 8.0, 6.0])
MIDDLE = np.array([0.0, -1.2, 1.2, -0.6, 0.5, 0.0])
AMPLITUDE = np.array([0.8, 0.5, 0.6, 0.8, 0.8, 0.9]) * 1.5 / np.sqrt(5)
POSITION_NOISE, TORQUE_NOISE = 2e-5, 0.05 * np.array([4.0, 4.0, 3.0, 1.0, 1.0, 1.0])
# Velocity over which dry friction turns in the simulation: it sticks but for a creep [rad/s].
CREEP = 1e-3


def arm_log(urdf: Path) -> dict[str, np.ndarray]:
    """Return the columns of a log of the arm by Pinocchio's forward dynamics; torques are held for a tick."""
    stated = pinocchio.buildModelFromUrdf(str(urdf))
    real, plain = stated.copy(), stated.createData()
    real.armature = ROTORS
    flange = real.frames[real.getFrameId("tool0")]
    real.appendBodyToJoint(flange.parentJoint, PAYLOAD, flange.placement)
    data, rng, step = real.createData(), np.random.default_rng(0), 1.0 / RATE / INNER
    frequency, phase = rng.uniform(0.08, 0.7, (5, 6)), rng.uniform(0.0, 2 * np.pi, (5, 6))

    def wanted(t: float) -> tuple[np.ndarray, np.ndarray]:
        angle, rate = 2 * np.pi * frequency * t + phase, 2 * np.pi * frequency
        return MIDDLE + (AMPLITUDE * np.sin(angle)).sum(0), (AMPLITUDE * rate * np.cos(angle)).sum(0)

    def acceleration(q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return pinocchio.aba(real, data, q, v, torque - VISCOUS * v - DRY * np.tanh(v / CREEP))

    (q, v), count = wanted(0.0), round(SECONDS * RATE)
    positions, torques = np.zeros((count, 6)), np.zeros((count, 6))
    for k in range(count):
        target, speed = wanted(k / RATE)
        weight = pinocchio.rnea(stated, plain, q, 0 * v, 0 * v)
        torque = KP * (target - q) + KD * (speed - v) + weight
        positions[k], torques[k] = q, torque
        for _ in range(INNER):
            # Runge and Kutta's fourth order.
            a1 = acceleration(q, v)
            a2 = acceleration(q + 0.5 * step * v, v + 0.5 * step * a1)
            a3 = acceleration(q + 0.5 * step * (v + 0.5 * step * a1), v + 0.5 * step * a2)
            a4 = acceleration(q + step * (v + 0.5 * step * a2), v + step * a3)
            q = q + step * v + step**2 / 6 * (a1 + a2 + a3)
            v = v + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
    positions += POSITION_NOISE * rng.standard_normal(positions.shape)
    torques += TORQUE_NOISE * rng.standard_normal(torques.shape)
    names = list(stated.names)[1:]
    columns = {"time": np.arange(count) / RATE}
    columns |= {f"pos_{name}": positions[:, k] for k, name in enumerate(names)}
    return columns | {f"effort_{name}": torques[:, k] for k, name in enumerate(names)}


def main() -> int:
    """Run the commands, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    options = parser.parse_args()
    urdf = SHARE / "ur_description" / "urdf" / "ur5_robot.urdf"
    if not urdf.is_file():
        parser.error("example-robot-data is not installed: pip install 'jaxid[robots]'")

    with tempfile.TemporaryDirectory() as folder:
        log = str(write_csv(Path(folder) / "log.csv", arm_log(urdf), digits="%.8g"))
        out = {name: Path(folder) / name for name in ("discover", "identify")}
        ran = {name: Ran.of([name, str(urdf), log, "-o", str(out[name])]) for name in out}
        files = [out["discover"] / "discovery.json", out["identify"] / "result.json"]
        if not all(file.is_file() for file in files):
            print(*(x.error for x in ran.values()), file=sys.stderr)
            return 1
        results = dict(zip(out, (json.loads(file.read_text()) for file in files), strict=True))
    text = page(ran, results)
    (options.o / "silent_urdf.md").write_text(text)
    print(text)
    return 0


def truth() -> dict[str, float]:
    """Return the true values by the names that `discover` gives; other rotors are in sums of the links."""
    of = {f"added_mass[{k}].mass": ROTORS[k - 1] for k in range(3, 7)}
    of |= {f"viscous_friction[{k}].coefficient": x for k, x in enumerate(VISCOUS, start=1)}
    return of | {f"coulomb_friction[{k}].level": x for k, x in enumerate(DRY, start=1)}


def page(ran: dict[str, Ran], results: dict[str, dict]) -> str:
    """Return the page of the results."""
    found, fitted = results["discover"], results["identify"]
    nats = {f"{effect['kind']}[{effect['joint']}]": effect["evidence"] for effect in found["effects"]}
    named, true = set(nats), truth()
    others = named - {name.split(".")[0] for name in true}
    said = {True: "complete", False: "incomplete", None: "not known"}
    seconds = ", ".join(f"`{name}` {x.wall:.0f} s, {x.cpu:.0f} s of a processor" for name, x in ran.items())
    lines = [
        "# An arm whose URDF states no friction, no rotors and no payload",
        "",
        f"Written by `python -m benchmarks.silent_urdf` on {date.today()}, at {commit_of(ROOT)}.",
        f"UR5, {SECONDS:g} s at {RATE} Hz by Pinocchio, with a payload of {PAYLOAD.mass:g} kg. No case was",
        f"written: `jaxid discover ur5.urdf log.csv`, `jaxid identify ur5.urdf log.csv`. {seconds}.",
        f"Verdict of `discover`: {found['verdict']}; its model is then {said[found['model_complete']]}.",
        f"Named beside what the machine has: {', '.join(sorted(others)) or 'nothing'}.",
        f"The model of `identify` is {said[fitted['model_complete']]}.",
        "Behind ± stands one standard deviation.",
        "",
        "| effect | true | evidence | `discover` | `identify` |",
        "|---|---|---|---|---|",
    ]
    values = of_effects(found), of_parameters(fitted)
    for name, value in true.items():
        kind = name.split(".")[0]
        evidence = f"{nats[kind]:.0f} nats" if kind in nats else "not named"
        cells = [f"{x[name][0]:.4g} ± {x[name][1]:.2g}" if name in x else "-" for x in values]
        lines.append(f"| {kind} | {value:g} | {evidence} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def of_effects(found: dict) -> dict[str, tuple[float, float]]:
    """Return values and standard deviations of what was found, by name."""
    return {
        f"{effect['kind']}[{effect['joint']}].{name}": (entry["value"], entry["std"])
        for effect in found["effects"]
        for name, entry in effect["parameters"].items()
    }


def of_parameters(fitted: dict) -> dict[str, tuple[float, float]]:
    """Return values and standard deviations of a fit, by name, rotors as the effect `added_mass`."""
    entries, rotors = fitted["parameters"], fitted["parameters"]["rotor_inertia"]
    out = {name: (entry["value"], entry["std"]) for name, entry in entries.items() if "." in name}
    pairs = enumerate(zip(rotors["value"], rotors["std"], strict=True), start=1)
    return out | {f"added_mass[{k}].mass": pair for k, pair in pairs if pair[1] is not None}


if __name__ == "__main__":
    sys.exit(main())
