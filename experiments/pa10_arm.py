"""Studies of the whole arm of the PA-10, for `pa10.py`."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from common import Table

import jaxid
from jaxid.base_parameters import base_parameters, inertial_regressor
from jaxid.plants import SerialArm, pa10
from jaxid.regrouping import base_parameters_by_rules

CASES = Path(__file__).parent / "cases"
# Table 4.1, by row from the first: of d11 ... d77 those that a base parameter stands in, "1" as it is, "t"
# times a function of the angles. As printed: row 6 lacks d22 = 1, and row 36 is mY_R6.
PRINTED = (
    "1", "t", "t", "", "", "", "", "", "tt", "tt", "t", "t", "t 1", "t", "t", "ttt", "ttt", "tt", "tt",
    "tt 1", "tt", "tt", "tttt", "tttt", "ttt", "ttt", "ttt 1", "ttt", "ttt", "ttttt", "ttttt", "tttt", "tttt",
    "tttt 1", "tttt", "tttt", "tttttt", "tttttt", "ttttt", "ttttt", "ttttt 1", "ttttt", "ttttt",
)
# In the report's order: tensor, then first moments.
ORDER = ("xx", "xy", "xz", "yz", "zz", "x", "y")
# Where links are symmetric: masses and centres of mass, and products of inertia, which follow from them.
KNOWN = (
    "mass", "first_moment_x", "first_moment_y", "first_moment_z", "inertia_xy", "inertia_xz", "inertia_yz",
)


def dependencies(folder: Path) -> None:
    """Table 4.1: base parameters of which each diagonal entry of the mass matrix is a sum."""
    del folder
    start = time.perf_counter()
    arm = SerialArm(*np.ones((10, 7)), geometry=pa10())
    base = base_parameters_by_rules(arm)
    states = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 7))
    columns = []
    for k in range(7):
        with_and_without = (np.broadcast_to(a, states.shape) for a in (np.eye(7)[k], np.zeros(7)))
        torque = [np.asarray(inertial_regressor(arm, states, 0 * states, a)) for a in with_and_without]
        columns.append((torque[0] - torque[1])[:, k, list(base.chosen)])
    table = Table(
        "Table 4.1 by differentiation; 1: as it is, t: times a function of the angles",
        ["row", "base parameter", *[f"d{k}{k}" for k in range(1, 8)], "printed otherwise"],
    )
    place = lambda i: (base.places[i][1], ORDER.index(base.places[i][0].rpartition("_")[2]))
    rows = sorted(range(len(base.chosen)), key=place)
    for row, (i, printed) in enumerate(zip(rows, PRINTED, strict=True), start=1):
        found = "".join(_cell(c[:, i]) for c in columns)
        told = "" if found.rstrip() == printed else f"'{printed}'"
        table.row(row, base.chosen_names[i], *found.replace(" ", "."), told)
    table.show(time.perf_counter() - start)
    left = base_parameters(arm, known=KNOWN).chosen_names
    print(f"known masses, centres of mass and symmetric links leave {len(left)} unknowns: {', '.join(left)}")


def excitation(folder: Path) -> None:
    """Trajectories for the base parameters and friction, by either criterion."""
    begun = time.perf_counter()
    table = Table(
        "excitation of 43 base parameters and 14 of friction, 10 s; beside the best of 20 drawn at random",
        ["criterion", "condition drawn", "improved", "nats gained", "s"],
    )
    whole = (CASES / "pa10.toml").read_text("utf-8")
    for criterion in ("determinant", "condition"):
        start = time.perf_counter()
        (folder / f"{criterion}.toml").write_text(f'{whole}criterion = "{criterion}"\n')
        found = jaxid.design(folder / f"{criterion}.toml")
        found.save(folder / f"{criterion}.csv")
        seconds = time.perf_counter() - start
        table.row(criterion, *[f"{c:.2f}" for c in found.condition], f"{found.nats:.1f}", f"{seconds:.0f}")
    table.show(time.perf_counter() - begun)


def _cell(x: np.ndarray) -> str:
    if np.abs(x).max() < 1e-12:
        return " "
    return "1" if np.abs(x - 1).max() < 1e-12 else "t"
