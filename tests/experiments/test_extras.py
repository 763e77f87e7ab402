"""Scripts without their extra: one line that names it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# A module of None counts as absent.
WITHOUT = "import runpy, sys; sys.modules[{0!r}] = None; runpy.run_module({1!r}, run_name='__main__')"


@pytest.mark.parametrize(
    ("script", "absent", "extra"),
    [
        ("experiments.emps", "numba", "experiments"),
        ("experiments.pa10", "pinocchio", "experiments"),
        ("benchmarks.speed", "numba", "benchmarks"),
    ],
)
def test_a_script_names_the_extra_that_it_lacks(script, absent, extra):
    code = WITHOUT.format(absent, script)
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stdout == ""
    assert run.stderr == f"{absent} not installed; run: pip install '.[{extra}]'\n"


@pytest.mark.parametrize("package", ["experiments", "benchmarks"])
def test_every_script_states_the_command_that_runs_it(package):
    for path in sorted((ROOT / package).glob("*.py")):
        text = path.read_text("utf-8")
        assert text.startswith('"""'), path
        if "__main__" in text and "python -m" in text:
            assert f"python -m {package}.{path.stem}" in text, path


def test_help_of_an_experiment():
    environment = {**os.environ, "PYTHONPATH": ""}
    line = [sys.executable, "-m", "experiments.emps", "--help"]
    run = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, env=environment)
    assert run.returncode == 0
    assert "python -m experiments.emps" in run.stdout
