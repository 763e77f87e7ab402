"""SO-101 as a whole: what its servos lack, joint by joint, from command and encoder alone.

    JAXID_DATA=FOLDER python -m benchmarks.so101_discover [--joint N]... [--again] [--kept FOLDER] [-o DIR]

`discover` searches the community's MJCF along stretches of three motions, those of `benchmarks.so101_arm`:
all joints move in them, within the servos' limit of acceleration, and the arm touches nothing. With and
without what was found the arm then follows six other motions from their commands. The search of each joint
is kept in a folder, so that an interrupted call goes on; --again searches anew. Writes so101_discover.json
and so101_discover.md.
"""

import argparse
import json
import pickle
import tempfile
import time
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measured import measured_folder
from benchmarks.so101 import ROW, ROWS, TICKS
from benchmarks.so101_arm import FITTED, JOINTS, LEFT_OUT
from benchmarks.stored_runs import commit_of
from jaxid.discovery.in_loop.arm_search import ArmSearch
from jaxid.discovery.result import Discovery
from jaxid.gap import Gap, gaps
from jaxid.machine import Machine
from jaxid.results.as_json import discovery_json
from jaxid.results.report.first_page import values_words
from jaxid.session import Session, open_session

ROOT = Path(__file__).parents[1]
HERE = Path(__file__).parent / "results"
KEPT = Path(tempfile.gettempdir()) / "so101_discover"
# Most effects at a joint.
MOST = 4


def case_of(data: Path, folder: Path) -> dict[str, Any]:
    """Return the case of the arm; its file is written to a folder with the time step of the servos' loop."""
    text = (data / "so101.xml").read_text()
    file, step = folder / "so101.xml", f'<option timestep="{ROW / TICKS:.9g}"/>'
    file.write_text(text.replace("<worldbody>", f"{step}<worldbody>", 1))

    def columns(name: str) -> dict[str, str]:
        return {joint: f"{name}{k}" for k, joint in enumerate(JOINTS, start=1)}

    unknown = ["damping", "frictionloss", "kp", "kv", "delay", "forcerange"]
    motions = [{"name": name, "log": str(data / f"{name}.csv"), "rows": [0, ROWS]} for name in FITTED]
    return {
        "plant": {"kind": "tree", "mjcf": str(file), "unknown": unknown},
        # A count of the encoder is 1.534 mrad.
        "sensor": {"position_noise": 1.534e-3 / 12**0.5},
        "log": {
            "time": "t_us",
            "units": {"time": "us"},
            "position": columns("q"),
            "reference": columns("cmd"),
            "reference_hold": "zero_order",
        },
        "fit": motions,
    }


def searched(arm: ArmSearch, joint: int, kept: Path, *, again: bool) -> tuple[Discovery, float]:
    """Return the search of a joint, 0-based, and its seconds; one that is kept is not repeated."""
    file = kept / f"joint_{joint + 1}.pickle"
    if file.exists() and not again:
        return pickle.loads(file.read_bytes())
    begin = time.perf_counter()
    found = arm.searched(
        joint, max_effects=MOST, progress=lambda text: print(f"{JOINTS[joint]}: {text}", flush=True)
    )
    out = found, time.perf_counter() - begin
    file.write_bytes(pickle.dumps(out))
    return out


def errors(found: tuple[Gap, ...]) -> dict[str, list[float] | None]:
    """Return RMS by motion and joint [mrad]; None where the simulation diverges."""
    return {
        gap.name: None if gap.simulation is None else [round(1e3 * float(x), 3) for x in gap.simulation.rms]
        for gap in found
    }


def record_of(result: Discovery, seconds: dict[int, float], session: Session) -> dict[str, Any]:
    """Return all that the page needs."""
    content = discovery_json(result)
    others = session.validations

    def along(machine: Machine) -> dict[str, Any]:
        return errors(gaps(machine, others))

    return {
        "verdict": content["verdict"],
        "joints": content["joints"],
        "effects": content["effects"],
        # What `check` says of single columns names files of this machine.
        "notes": [note for note in content["notes"] if ".csv" not in note],
        "parameters": content["parameters"],
        "seconds": {str(joint + 1): round(s, 1) for joint, s in seconds.items()},
        "fitted": {"before": errors(result.gaps_before), "after": errors(result.gaps_after)},
        "left_out": {"before": along(result.before.machine), "after": along(result.after.machine)},
    }


def mean(by_motion: dict[str, list[float] | None], joint: int) -> float:
    """Return the mean RMS of a joint, 0-based, over motions [mrad]; infinite if a simulation diverges."""
    values = list(by_motion.values())
    return float(np.mean([np.inf if v is None else v[joint] for v in values]))


def page(content: dict[str, Any]) -> str:
    """Return the page."""
    lines = [
        "# What the servos of the SO-101 lack, joint by joint",
        "",
        f"Written by `python -m benchmarks.so101_discover` on {content['date']}, at {content['commit']}.",
        f"Searched: the first {ROWS} rows each of {', '.join(FITTED)}; at most {MOST} effects a joint.",
        f"Left out: {', '.join(LEFT_OUT)}.",
        "Declared: the community's MJCF, with damping, friction, kp, kv, force range and delay of each joint",
        "unknown. Errors are RMS of simulated minus measured position of the whole arm in mrad, a mean over",
        "the motions; a count of the encoder is 1.5. Evidence in nats; σ of noise alone.",
        "",
        "| joint | found | evidence | rivals | left out before | after | fitted before | after | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for k, joint in enumerate(content["joints"]):
        if str(k + 1) not in content["seconds"]:
            continue
        own = [e for e in content["effects"] if e.get("joint") == k + 1]
        sizes = [
            f"{mean(content[of][when], k):.2f}"
            for of in ("left_out", "fitted")
            for when in ("before", "after")
        ]
        sizes.append(f"{content['seconds'][str(k + 1)]:.0f}")
        for number, cells in enumerate(map(_cells, own or [None])):
            name, last = (joint["joint_name"], sizes) if number == 0 else ("", [""] * len(sizes))
            found = cells or (joint["verdict"].replace("_", " "), "", "")
            lines.append(f"| {' | '.join([name, *found, *last])} |")
    for of, title in (("left_out", "Left out"), ("fitted", "Fitted")):
        lines += ["", f"{title}, by motion, before -> after [mrad]:", ""]
        lines += [f"| motion | {' | '.join(JOINTS)} |", "|---" * (len(JOINTS) + 1) + "|"]
        for name, before in content[of]["before"].items():
            after = content[of]["after"][name]
            cells = [f"{_size(before, k)} -> {_size(after, k)}" for k in range(len(JOINTS))]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", "Notes of the search:", "", *(f"- {note}" for note in content["notes"])]
    return "\n".join(lines) + "\n"


def _cells(effect: dict[str, Any] | None) -> tuple[str, str, str] | None:
    """Return an effect with its values, its evidence and its rivals; None for none."""
    if effect is None:
        return None
    rivals = ", ".join(a["kind"] for a in effect["alternatives"]) or "-"
    return f"`{effect['kind']}`: {values_words(effect['parameters'])}", f"{effect['evidence']:.0f}", rivals


def _size(values: list[float] | None, joint: int) -> str:
    return "diverges" if values is None else f"{values[joint]:.3g}"


def main() -> None:
    """Search the joints, simulate the arm, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--joint", type=int, action="append", default=[], help="1 to 6; may be repeated")
    parser.add_argument("--again", action="store_true", help="search anew what was kept")
    parser.add_argument(
        "--kept", type=Path, default=KEPT, help=f"folder of finished joints (default: {KEPT})"
    )
    parser.add_argument("-o", metavar="DIR", type=Path, default=HERE)
    args = parser.parse_args()
    data = measured_folder(parser, "so101")
    args.kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        left = [str(data / f"{name}.csv") for name in LEFT_OUT]
        session = open_session(case_of(data, Path(folder)), validate=left, align_hold=True, method="discover")
        arm = ArmSearch.of(_without_others(session))
        joints = [number - 1 for number in args.joint] or list(arm.declared)
        runs = {joint: searched(arm, joint, args.kept, again=args.again) for joint in joints}
        result = arm.together({joint: found for joint, (found, _) in runs.items()})
        content = record_of(result, {joint: seconds for joint, (_, seconds) in runs.items()}, session)
    content |= {"commit": commit_of(ROOT), "date": date.today().isoformat()}
    (args.o / "so101_discover.json").write_text(json.dumps(content, indent=1) + "\n")
    (args.o / "so101_discover.md").write_text(page(content))
    print(page(content))


def _without_others(session: Session) -> Session:
    """Return a session without the motions that are left out, which would else confirm effects."""
    return replace(session, validations=())


if __name__ == "__main__":
    main()
