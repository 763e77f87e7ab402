"""Commands on coupled machines, which take far longer than on an axis: searches and a fit of an arm."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from experiments import pa10_arm, tx40
from tests.discovery.test_five_bar_search import CASE, CASES, NOISE, SECOND
from truth.arm import stepper
from truth.five_bar.stepper import followed

# What is hidden in the robot: friction of a passive hinge, or a payload at the tool.
FIVE_BAR = {"payload": "five-bar, payload", "coulomb": "five-bar, friction of a hinge"}
# Rate of the loop of seven joints [Hz], length of its log [s], slowest of its waves [Hz] and their number.
RATE, DURATION, BASE, WAVES = 200.0, 10.0, 0.1, 4


def five_bar(folder: Path, name: str) -> list[str]:
    """Write case, log and validation of a five-bar robot; return the arguments of `discover`."""
    for file, seed in (("log", 0), ("second", 7)):
        rows = followed(CASES[name][0], seed=seed, **NOISE)
        values = np.stack(list(rows.values()), axis=1)
        np.savetxt(folder / f"{file}.csv", values, "%.17g", ",", header=",".join(rows), comments="")
    (folder / "case.toml").write_text(CASE + SECOND)
    return [str(folder / "case.toml"), str(folder / "log.csv")]


def tx40_search(folder: Path) -> list[str] | None:
    """Write case and log of the measured arm TX40; return the arguments of `discover`, None without data."""
    if not (Path(os.environ.get("JAXID_DATA", "")) / "tx40").is_dir():
        return None
    tx40.logs(folder, every=tx40.SEARCHED)
    text = tx40.without_shaft((folder / "tx40.toml").read_text()).replace("[log]", tx40.SLOW)
    (folder / "case.toml").write_text(text.partition("[[validation]]")[0])
    return [str(folder / "case.toml"), str(folder / "log.csv")]


def seven_joints(folder: Path) -> list[str]:
    """Write case and log of the PA-10 in its loop; return the arguments of a fit of its simulation.

    The log comes from the exact stepper on Pinocchio's links, along drawn sums of waves that begin at rest.
    """
    rng = np.random.default_rng(0)
    arm = pa10_arm.arm_of(pa10_arm.random_bodies(rng))
    t = np.arange(0.0, DURATION, 1.0 / RATE)
    numbers = np.arange(1, WAVES + 1)
    phases = 2.0 * np.pi * (BASE * numbers * t[:, None, None] + rng.uniform(size=(7, WAVES)))
    waves = np.sum(rng.uniform(0.2, 0.6, (7, WAVES)) / numbers * np.sin(phases), axis=2)
    begins = np.sin(0.5 * np.pi * np.minimum(t, 1.0)) ** 2
    reference = begins[:, None] * (waves - waves[0])

    run = stepper.followed(arm, reference, rate=RATE, kp=pa10_arm.KP, kd=pa10_arm.KD)
    q, u = (
        run[name] + noise * rng.standard_normal(run[name].shape)
        for name, noise in (("q", 1e-6), ("u", pa10_arm.NOISE))
    )
    names = [f"{name}{k}" for name in "qur" for k in range(1, 8)]
    table = np.column_stack([t, q, u, reference])
    np.savetxt(folder / "log.csv", table, "%.17g", ",", header=",".join(["t", *names]), comments="")

    references = ", ".join(f'"r{k}"' for k in range(1, 8))
    law = (
        f'\n[controller]\nkind = "pd"\nkp = {pa10_arm.KP.tolist()}\nkd = {pa10_arm.KD.tolist()}\n'
        f"period = {1.0 / RATE}\n"
    )
    text = (pa10_arm.CASES / "pa10.toml").read_text("utf-8")
    (folder / "case.toml").write_text(text.replace("[log]\n", f"[log]\nreference = [{references}]\n") + law)
    return [
        "identify",
        "--method",
        "output_error",
        str(folder / "case.toml"),
        str(folder / "log.csv"),
        "--quiet",
    ]
