"""An option of pytest, `--outcomes FILE`: what every test did, with its commit, its date and the machine.

Each test adds a line of JSON as it ends, so that a run which is cut off leaves what it saw. Tests that the
file already holds for the same commit are not run again: the same command goes on. Those of other commits
stay until they are run again.
"""

import datetime
import json
import os
import platform
import subprocess
from pathlib import Path

import pytest


def _commit():
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True)
    changed = subprocess.run(["git", "status", "--porcelain", "-uno"], capture_output=True, text=True)
    # The file itself changes as it is written.
    others = [line for line in changed.stdout.splitlines() if not line.endswith(".jsonl")]

    return found.stdout.strip() + ("+changes" if others else "")


def stored(path: Path) -> dict[str, dict]:
    """Return the last row of each test in a file."""
    if not path.exists():
        return {}
    rows = [json.loads(line) for line in path.read_text().splitlines()]

    return {row["test"]: row for row in rows}


class Outcomes:
    """A results file of runs of tests."""

    def __init__(self, path: Path):
        self.path = path
        self.of_run = {
            "commit": _commit(),
            "date": datetime.date.today().isoformat(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        }
        self.rows = stored(path)
        self.seen = {test for test, row in self.rows.items() if row["commit"] == self.of_run["commit"]}

    def tidy(self):
        """Write one row a test, in their order."""
        self.path.write_text("".join(json.dumps(self.rows[test]) + "\n" for test in sorted(self.rows)))

    def pytest_collection_modifyitems(self, config, items):
        done = [item for item in items if item.nodeid in self.seen]
        if done:
            config.hook.pytest_deselected(items=done)
            items[:] = [item for item in items if item.nodeid not in self.seen]

    def pytest_runtest_logreport(self, report):
        # A test that is skipped in its set-up, or fails there, has no call.
        if report.when != "call" and report.outcome == "passed":
            return

        row = {"test": report.nodeid, "outcome": report.outcome, "seconds": round(report.duration, 1)}
        if hasattr(report, "wasxfail"):
            row["outcome"] = "xfailed" if report.outcome == "skipped" else "xpassed"
        elif report.outcome == "skipped" and isinstance(report.longrepr, tuple):
            row["why"] = report.longrepr[2]
        elif report.failed:
            crash = getattr(report.longrepr, "reprcrash", None)
            row["why"] = (crash.message if crash else str(report.longrepr)).splitlines()[0][:300]

        with self.path.open("a") as file:
            file.write(json.dumps(row | self.of_run) + "\n")


def pytest_addoption(parser):
    parser.addoption(
        "--outcomes", type=Path, help="a file for the outcome of every test, a line of JSON each"
    )


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    path = config.getoption("--outcomes")
    if path is not None:
        # Workers of xdist only skip what was seen; their controller writes.
        outcomes = Outcomes(path)
        if hasattr(config, "workerinput"):
            outcomes.pytest_runtest_logreport = lambda report: None
        else:
            outcomes.tidy()
        config.pluginmanager.register(outcomes, "outcomes")
