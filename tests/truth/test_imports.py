"""The truth shares no code with what it judges, not even through another library."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.imports import imports

ROOT = Path(__file__).parents[2]
FILES = sorted((ROOT / "truth").rglob("*.py"))
STRANGERS = ("jax", "jaxlib", "jaxid", "diffrax", "equinox", "optimistix", "lineax")
# The checkout's other packages may import jaxid.
BESIDE = ("tests", "experiments", "benchmarks")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_no_file_imports_what_it_judges(path):
    assert not {module.split(".")[0] for module in imports(path)} & {*STRANGERS, *BESIDE}


def test_importing_all_of_the_truth_loads_neither_jax_nor_jaxid():
    names = [".".join(p.relative_to(ROOT).with_suffix("").parts) for p in FILES if p.stem != "__init__"]
    assert {"truth.axis.stepper", "truth.hidden.oracle"} <= {*names}
    lines = [f"import {name}" for name in names]
    code = "\n".join(["import sys", *lines, f"print([m for m in {STRANGERS} if m in sys.modules])"])
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.stdout.strip() == "[]", run.stderr
