"""The tutorial: its logs come from the stepper, and its commands print what the page shows."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import jaxid
from truth.axis import tutorial_logs

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
PAGE = (ROOT / "docs" / "tutorial.md").read_text("utf-8")
NUMBER = re.compile(r"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def test_the_logs_are_those_that_the_stepper_makes(tmp_path, monkeypatch):
    monkeypatch.setattr(tutorial_logs, "FOLDER", tmp_path)
    tutorial_logs.main()
    made = sorted(tmp_path.iterdir())
    assert [path.name for path in made] == ["slide.csv", "slide_again.csv"]
    for path in made:
        assert (EXAMPLES / path.name).read_text("utf-8") == path.read_text("utf-8"), path.name


def test_the_table_of_the_page_is_that_of_the_truth():
    true = {
        "inertia": tutorial_logs.INERTIA,
        "viscous friction": tutorial_logs.VISCOUS,
        "Coulomb friction": tutorial_logs.COULOMB,
        "Stribeck, level": tutorial_logs.HIDDEN["level"],
        "Stribeck, velocity": 1e3 * tutorial_logs.HIDDEN["velocity"],
    }
    for name, value in true.items():
        row = next(line for line in PAGE.splitlines() if line.startswith(f"| {name} |"))
        stated, found, std, off = (float(x) for x in NUMBER.findall(row.partition(name)[2]))
        assert stated == value
        assert off == pytest.approx(abs(found - value) / std, abs=0.06)


def alike(shown: str, printed: str) -> bool:
    """Compare two lines: words alike, and numbers within 2 %."""
    if NUMBER.sub("#", " ".join(shown.split())) != NUMBER.sub("#", " ".join(printed.split())):
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(float(a) == pytest.approx(float(b), rel=0.02) for a, b in pairs)


def test_lines_are_compared_by_words_and_numbers():
    assert alike("inertia  182.2  2.0  kg", "inertia    182.3    2.0    kg")
    assert not alike("inertia  182.2  2.0  kg", "inertia  192.3  2.0  kg")
    assert not alike("verdict: found", "verdict: unexplained")


@pytest.mark.slow
def test_the_commands_print_what_the_page_shows(tmp_path):
    for name in ("slide.csv", "slide_again.csv"):
        shutil.copy(EXAMPLES / name, tmp_path)
    (case,) = re.findall(r"```toml\n# slide\.toml\n(.*?)```", PAGE, re.S)
    (tmp_path / "slide.toml").write_text(case)
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    blocks = re.findall(r"```\n\$? ?(jaxid [^\n]*)\n(.*?)```", PAGE, re.S)
    assert [command.split()[1] for command, _ in blocks] == [
        "init",
        "check",
        "identify",
        "discover",
        "identify",
    ]
    for command, shown in blocks:
        start = [sys.executable, "-c", "from jaxid.cli import entry; entry()"]
        words = [*start, *shlex.split(command)[1:]]
        run = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        printed = run.stdout.splitlines()
        for line in filter(str.strip, shown.splitlines()):
            assert any(alike(line, other) for other in printed), f"{command}: {line}\n{run.stdout}"
    assert jaxid.load_case(tmp_path / "out" / "case.toml").effects
