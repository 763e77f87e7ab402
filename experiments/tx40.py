"""TX40, a measured arm of six joints: what its links tell, and the friction of a shaft that two joints share.

Hypothesis: with the balance of the whole arm, base parameters and friction of every joint are found by least
squares, and less of the torque is left on the last third of the log than by a friction and an inertia of
each joint alone; what is left at the last two joints is the friction of the shaft that both turn, and
`discover` names it. Of the last half holds: it names the shaft's viscous friction, not its Coulomb friction.

    JAXID_DATA=... python -m experiments.tx40 [-o results/tx40] [--only models|hidden]
"""

from __future__ import annotations

import os
import re
import sys
import time
from pathlib import Path

import numpy as np
import scipy.signal

import jaxid
from experiments.common import Table, copied, parser_of
from jaxid.files import write_whole

JOINTS = 6
# Samples a second of the files, and of which one in so many is kept, after the same filter for all columns;
# for a search fewer, which takes as much less time.
RATE_HZ, EVERY, SEARCHED = 5000.0, 5, 20
# Published for this arm: of the shaft viscous [N m s/rad] and Coulomb friction [N m] and its inertia
# [kg m^2]; of the joints viscous and Coulomb friction. The viscous friction of the last two joints is printed
# as 1.86 and 0.65: the shaft's is in it.
SHAFT = {"viscous_friction": 0.616, "coulomb_friction": 1.95, "added_mass": 0.00964}
VISCOUS = (8.05, 5.53, 1.97, 1.11, 1.86 - 0.616, 0.65 - 0.616)
COULOMB = (7.14, 8.26, 6.34, 2.48, 3.03, 0.28)
# Six inertias with friction, which nothing joins.
ALONE = """[plant]
kind = "chain"
motion = "rotary"
[plant.parameters]
mass = { guess = [0.1, 0.1, 0.1, 0.1, 0.1, 0.1] }
damping = { guess = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0] }
stiffness = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
[[effects]]
kind = "coulomb_friction"
level = { guess = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0] }
[[effects]]
kind = "constant_force"
level = { guess = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0] }
"""
# Links of which all is unknown, from balls on.
BALL = """mass = { guess = 4.0 }
first_moment = { guess = [0.0, 0.0, 0.0] }
inertia = { guess = [0.04, 0.0, 0.0, 0.04, 0.0, 0.04] }
"""
CAN_EXIST = "[identification]\nphysically_consistent = true\n\n[log]"
# Beyond, the arm differs from its model by the edges of dry friction, and a search would first mend those.
# The joints swing below 3 Hz.
SLOW = "[preprocess]\ncutoff_hz = 15.0\n\n[log]"


def logs(folder: Path, every: int = EVERY) -> Path:
    """Write the measured log, decimated: two thirds to fit, and the last."""
    root = os.environ.get("JAXID_DATA")
    if not root or not (Path(root) / "tx40").is_dir():
        sys.exit("set JAXID_DATA to a folder that holds tx40/ with pos_read_data.csv, curr_data.csv")
    copied(folder, ("tx40.toml",))
    columns = (
        np.loadtxt(Path(root) / "tx40" / name, delimiter=",", skiprows=1)
        for name in ("pos_read_data.csv", "curr_data.csv")
    )
    columns = [scipy.signal.decimate(x, every, ftype="fir", axis=0, zero_phase=True) for x in columns]
    rows = np.column_stack([np.arange(len(columns[0])) * every / RATE_HZ, *columns])
    head = ",".join(["t", *[f"{x}{k + 1}" for x in "pu" for k in range(JOINTS)]])
    cut = 2 * len(rows) // 3
    for name, part in (("log.csv", rows[:cut]), ("last_third.csv", rows[cut:])):
        lines = [",".join(f"{x:.9g}" for x in row) for row in part]
        write_whole(folder / name, "\n".join([head, *lines]) + "\n")
    return folder


def without_shaft(text: str) -> str:
    """Return the case without the effects on the shaft, which stays as a place for effects."""
    head, *effects = text.split("[[effects]]")
    last, measured = effects.pop().split("# What is logged")
    kept = [e for e in (*effects, last) if "shaft" not in e]
    return "[[effects]]".join([head, *kept]) + "# What is logged" + measured


def with_bodies(text: str) -> str:
    """Return the case with links that bodies can be, all ten parameters unknown."""
    links, count = re.subn(r"mass = .*\nfirst_moment = .*\ninertia = .*\n", BALL, text)
    assert count == JOINTS, "the case states a mass, a first moment and an inertia of each link"
    return links.replace("[log]", CAN_EXIST, 1)


def models(folder: Path) -> None:
    """Torque left over, by joint, on both parts of the log; friction beside what is published."""
    start = time.perf_counter()
    table = Table(
        "torque left by `identify --method inverse_dynamics`, % of its RMS, fitted and on the last third",
        ["model", *[f"joint {k + 1}" for k in range(JOINTS)]],
    )
    log, whole = folder / "log.csv", (folder / "tx40.toml").read_text()
    cell = lambda gaps, k: ", ".join(f"{100 * g.force.relative[k]:.1f}" for g in gaps)
    (folder / "tx40_alone.toml").write_text(ALONE + whole[whole.index("# What is logged") :])
    (folder / "tx40_joints.toml").write_text(without_shaft(whole))
    (folder / "tx40_bodies.toml").write_text(with_bodies(whole))
    names = {
        "tx40_alone": "each joint alone",
        "tx40_joints": "arm, friction of joints",
        "tx40_bodies": "arm of bodies that can exist, and of the shaft",
        "tx40": "arm, and of the shaft",
    }
    for name, what in names.items():
        found = jaxid.identify(folder / f"{name}.toml", log, method="inverse_dynamics")
        found.save(folder / name, overwrite=True)
        table.row(what, *[cell(found.gaps, k) for k in range(JOINTS)])
    table.show(time.perf_counter() - start)
    std = dict(zip(found.estimate.names, found.estimate.std, strict=True))
    both = lambda name: f"{found.value(name):.3g} +- {std[name]:.2g}"
    table = Table("friction found, and published", ["", "viscous [N m s/rad]", "", "Coulomb [N m]", ""])
    for k in range(JOINTS):
        table.row(
            f"joint {k + 1}",
            both(f"viscous_friction[{k + 1}].coefficient"),
            f"{VISCOUS[k]:.3g}",
            both(f"coulomb_friction[{k + 1}].level"),
            COULOMB[k],
        )
    table.row(
        "shaft",
        both("viscous_friction[shaft 1].coefficient"),
        SHAFT["viscous_friction"],
        both("coulomb_friction[shaft 1].level"),
        SHAFT["coulomb_friction"],
    )
    table.show(time.perf_counter() - start)
    print(f"inertia of the shaft {both('added_mass[shaft 1].mass')} kg m^2, published {SHAFT['added_mass']}")


def hidden(folder: Path) -> None:
    """Search for effects where the case knows the shaft but nothing that acts on it."""
    start = time.perf_counter()
    logs(folder, every=SEARCHED)
    text = without_shaft((folder / "tx40.toml").read_text()).replace("[log]", SLOW)
    # Three seconds are too few samples at this rate to confirm an effect.
    text = text.partition("[[validation]]")[0]
    (folder / "tx40_hidden.toml").write_text(text)
    say = lambda line: print(f"  {time.perf_counter() - start:5.0f} s: {line}", flush=True)
    found = jaxid.discover(folder / "tx40_hidden.toml", folder / "log.csv", refit=False, progress=say)
    found.save(folder / "hidden", overwrite=True)
    print(f"\nhidden: {found.verdict} ({time.perf_counter() - start:.1f} s)\n{found}")


STUDIES = {f.__name__: f for f in (models, hidden)}


def main() -> int:
    parser = parser_of(__doc__, "results/tx40")
    parser.add_argument("--only", choices=STUDIES, help="one of the studies")
    args = parser.parse_args()
    for name, study in STUDIES.items():
        if args.only in (None, name):
            study(logs(args.o))
    return 0


if __name__ == "__main__":
    sys.exit(main())
