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


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_the_notebook_runs(script, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXID_FAST", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    client = NotebookClient(notebook, timeout=600, kernel_name="python3")
    client.execute(cwd=str(tmp_path), env=dict(os.environ))
    outputs = [o for c in notebook.cells for o in c.get("outputs", [])]
    assert not [o for o in outputs if o.get("name") == "stderr"]
    assert [o for o in outputs if "image/png" in o.get("data", {})]
