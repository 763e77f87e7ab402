"""A small machine on disk for the command line: its case, its log, and what a command did."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.cli import main
from tests.support.written_logs import write_csv
from truth.axis.cases import Declared, case_text, write_case
from truth.axis.machines import emps_like

TRUTH = {
    "inertia": 95.1,
    "viscous_friction.coefficient": 203.5,
    "coulomb_friction.level": 20.39,
}
VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
SECONDS = 4.0
COLUMNS = {"t": "t", "q": "position", "u": "force", "ref": "reference"}


class Ran(NamedTuple):
    """What a command left: exit status, what it printed, and its folder."""

    status: int
    out: str
    err: str
    folder: Path

    def json(self, name: str) -> dict:
        """A result; NaN and Infinity, which Python would read, are no JSON."""

        def refuse(word: str) -> None:
            raise AssertionError(f"{word} in {name}")

        return json.loads((self.folder / name).read_text("utf-8"), parse_constant=refuse)


def run(capsys, *argv: object, folder: Path | None = None) -> Ran:
    """Run a command in this process; with a folder, its results go there."""
    capsys.readouterr()
    words = [str(word) for word in argv]
    status = main([*words, "-o", str(folder)] if folder else words)
    out, err = capsys.readouterr()
    return Ran(status, out, err, folder)


def recorded(seed: int = 0) -> dict[str, np.ndarray]:
    """A log at half the loop's rate, by the names of its columns."""
    run = emps_like(seed, duration=SECONDS).run()
    return {column: run[name][::2] for column, name in COLUMNS.items()}


def text(declared: Declared = (VISCOUS, COULOMB), more: str = "") -> str:
    """The case of that log, its guesses off by half."""
    written = case_text(emps_like(0), declared)
    # The log holds every second tick of the loop.
    return written.replace("[controller]\n", "[controller]\nperiod = 0.001\n") + more


def place(folder: Path, log: Mapping[str, np.ndarray], case: str | None = None) -> list[Path]:
    """Case and log in a folder, as the commands take them."""
    folder.mkdir(exist_ok=True)
    return [write_case(folder, case or text()), write_csv(folder / "log.csv", dict(log))]


def held(folder):
    """Every file below a folder with its content."""
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def refused(capsys, folder, *argv, told):
    """Exit status 2, one line on stderr, nothing on stdout, nothing written."""
    before, entries = held(folder), sorted(folder.rglob("*"))
    ran = run(capsys, *argv)
    assert ran.status == 2, ran.err
    assert ran.out == ""
    assert ran.err.startswith("jaxid: ")
    assert ran.err.endswith("\n")
    assert ran.err.count("\n") == 1
    assert told in ran.err, ran.err
    assert sorted(folder.rglob("*")) == entries
    assert held(folder) == before
    return ran.err
