"""Searches on coupled machines, which take far longer than an axis: the five-bar robot and a measured arm."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from experiments import tx40
from tests.discovery.test_five_bar_search import CASE, CASES, NOISE, SECOND
from truth.five_bar.stepper import followed

# What is hidden in the robot: friction of a passive hinge, or a payload at the tool.
FIVE_BAR = {"payload": "five-bar, payload", "coulomb": "five-bar, friction of a hinge"}


def five_bar(folder: Path, name: str) -> list[str]:
    """Write case, log and validation of a five-bar robot; return the arguments of `discover`."""
    for file, seed in (("log", 0), ("second", 7)):
        rows = followed(CASES[name][0], seed=seed, **NOISE)
        values = np.stack(list(rows.values()), axis=1)
        np.savetxt(folder / f"{file}.csv", values, "%.17g", ",", header=",".join(rows), comments="")
    (folder / "case.toml").write_text(CASE + SECOND)
    return [str(folder / "case.toml"), str(folder / "log.csv")]


def arm(folder: Path) -> list[str] | None:
    """Write case and log of the measured arm TX40 likewise; None without its data."""
    if not (Path(os.environ.get("JAXID_DATA", "")) / "tx40").is_dir():
        return None
    tx40.logs(folder, every=tx40.SEARCHED)
    text = tx40.without_shaft((folder / "tx40.toml").read_text()).replace("[log]", tx40.SLOW)
    (folder / "case.toml").write_text(text.partition("[[validation]]")[0])
    return [str(folder / "case.toml"), str(folder / "log.csv")]
