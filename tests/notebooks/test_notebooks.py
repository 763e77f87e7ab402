"""The notebooks: each is its script's twin, and runs."""

import os
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))


def test_no_notebook_without_its_script():
    assert SCRIPTS
    assert [p.stem for p in sorted(FOLDER.glob("*.ipynb"))] == [p.stem for p in SCRIPTS]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_the_notebook_is_what_jupytext_makes_of_the_script(script):
    # To mend: jupytext --to ipynb notebooks/<name>.py
    written = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    made = jupytext.read(script)
    assert written.metadata["kernelspec"]["name"] == "python3"
    assert [(c.cell_type, c.source) for c in written.cells] == [(c.cell_type, c.source) for c in made.cells]
    for cell in written.cells:
        assert cell.get("outputs", []) == []
        assert cell.get("execution_count") is None


# Of what each notebook computes: by an independent simulator, whose values these are.
RESULTS = {
    "first_tour": """
import numpy as np
assert declared.converged and extended.converged
assert found.verdict == "found"
assert found.kinds == ["cogging"] or list(found.kinds) == ["cogging"], found.kinds
true = {"inertia": 95.1, "viscous_friction.coefficient": 203.5, "coulomb_friction.level": 20.39,
        "cogging.amplitude": 4.0, "cogging.period": 0.02}
for name, value in true.items():
    p = extended.parameters[name]
    assert abs(p.value - value) < 4 * p.std, (name, p.value, p.std)
    assert p.std < 0.01 * value, (name, p.std)
before, after = declared.gaps[1].force.rms[0], extended.gaps[1].force.rms[0]
# A wave of 4 N has an RMS of 2.83 N.
assert 2.5 < before < 3.1, before
assert after < 2 * extended.noise_floor[0], after
difference = [np.linalg.norm(slope[:, k]) for k in range(theta.size)]
assert np.all(np.isfinite(difference)) and off < 1e-4, off
""",
}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_the_notebook_runs(script, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXID_FAST", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(RESULTS[script.stem]))
    client = NotebookClient(notebook, timeout=600, kernel_name="python3")
    client.execute(cwd=str(tmp_path), env=dict(os.environ))
    outputs = [o for c in notebook.cells for o in c.get("outputs", [])]
    assert not [o for o in outputs if o.get("name") == "stderr"]
    assert [o for o in outputs if "image/png" in o.get("data", {})]
