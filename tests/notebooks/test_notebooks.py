"""The notebooks: each is its script's twin, and runs."""

import json
import os
import re
from pathlib import Path

import jupytext
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

from benchmarks.notebooks import computed

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
    "your_own_log": """
assert declared.model_complete is False
assert list(found.kinds) == ["stribeck_friction"], found.kinds
assert len(off) == 5 and max(map(abs, off.values())) < 4, off
assert found.model_complete
assert found.gaps[0].force.rms[0] < 0.3 * declared.gaps[0].force.rms[0]
""",
    "your_own_plant": """
assert apart < 1e-6, apart
assert fan.shape == (32, 601)
assert hessian_apart < 1e-4, hessian_apart
assert fitted.converged and np.abs(sigmas).max() < 4, sigmas
assert np.all(np.asarray(fitted.std) < 0.02 * np.asarray(theta))
""",
    "hundred_samples": """
assert len(log["t"]) == 100
# What the text says of the sum of both frictions in this one log.
assert not result.parameters["constant_force.level"].identifiable
assert abs(result.value("coulomb_friction.level") - 19) < 1
assert result.converged and 1 <= len(details["directions"]) <= 4
# Of 150 intervals of 95 % fewer than 88.6 % hold in one of a thousand experiments.
assert off.size == 150 and np.mean(abs(off) < 1.96) >= 0.886, off
""",
    "arm_from_mjcf": """
assert status == 0
assert result.model_complete
assert np.all(torque_off["found"] < 0.01 * torque_off["file"]), torque_off
assert len(friction_names) == 4
assert np.allclose([result.value(n) for n in friction_names], true_friction, rtol=0.01)
assert abs(result.value("rotor_inertia[2]") / TRUE["a2"] - 1) < 0.02
assert np.allclose([by_urdf.value(n) / result.value(n) for n in friction_names], 1, rtol=1e-3)
""",
    "monte_carlo": """
shares = held.sel(estimator="inverse_dynamics").values
assert shares.min() >= 0.867, shares
assert held.sel(estimator="algebraic").values.min() >= 0.867
assert "not at every level" in str(study)
assert table.sizes["run"] == 60
""",
    "paper_chain": """
assert worst["mass"] < 0.001 and worst["stiffness"] < 0.001, worst
assert worst["damping"] < 0.005 and worst["coulomb_friction"] < 0.005, worst
stiffness = [noisy[noise]["stiffness"] for noise in (1e-8, 1e-7, 1e-6)]
assert stiffness[0] < 0.01 and all(3 < b / a < 30 for a, b in zip(stiffness, stiffness[1:])), noisy
""",
    "paper_pa10": """
assert all(0.005 < inertia / INERTIA - 1 < 0.025 for inertia in by_period.values()), by_period
assert max(map(abs, off.values())) < 4, off
assert abs(result.value("inertia") / INERTIA - 1) < 0.02
""",
    "paper_five_bar": """
assert np.allclose(gains[-1], GAINS, rtol=0.02), gains[-1]
assert np.all(rms["last second"] < 0.2 * rms["first second"]), rms
""",
    "paper_flexible_axis": """
assert max(map(abs, off.values())) < 4, off
assert both.parameters["coulomb_friction[2].level"].identifiable
assert not motor.parameters["coulomb_friction[2].level"].identifiable
assert abs(both.value("stiffness") / 8e5 - 1) < 0.03
""",
    "paper_stage": """
assert len(log["t"]) == 100 and 1 <= len(directions) <= 4
error = {name: abs(entry["dry"] / sums["true"]["dry"] - 1) for name, entry in sums.items()}
assert error["found"] < 0.06 and error["guess"] > 0.2, error
""",
}


# The others take four minutes together.
QUICK = "first_tour"


@pytest.mark.parametrize(
    "script", [pytest.param(s, id=s.stem, marks=() if s.stem == QUICK else pytest.mark.slow) for s in SCRIPTS]
)
def test_the_notebook_runs(script, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXID_FAST", "1")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    # What another process writes just now may be read in part; the code is then compiled again.
    entry = "persistent compilation cache entry"
    monkeypatch.setenv("PYTHONWARNINGS", f"ignore:Error reading {entry},ignore:Error writing {entry}")
    # Notebooks find truth/ and experiments/ in the folder above theirs.
    monkeypatch.setenv("PYTHONPATH", str(FOLDER.parent))
    notebook = nbformat.read(script.with_suffix(".ipynb"), as_version=4)
    notebook.cells.append(nbformat.v4.new_code_cell(RESULTS[script.stem]))
    client = NotebookClient(notebook, timeout=600, kernel_name="python3")
    client.execute(cwd=str(FOLDER), env=dict(os.environ))
    outputs = [o for c in notebook.cells for o in c.get("outputs", [])]
    assert not [o for o in outputs if o.get("name") == "stderr"]
    assert [o for o in outputs if "image/png" in o.get("data", {})]


@pytest.mark.slow
@pytest.mark.parametrize("file", sorted((FOLDER / "results").glob("*.json")), ids=lambda file: file.stem)
def test_stored_results_are_those_of_the_command(file):
    stored, made = json.loads(file.read_text()), computed(file.stem)
    assert set(stored) == {"commit", "date", *made}
    theta, std = (np.array(stored[key], float) for key in ("theta", "std"))
    assert theta.size
    assert np.array_equal(np.isfinite(std), np.isfinite(np.array(made["std"], float)))
    # Both fits have converged: what is left is far below what noise does.
    apart = np.abs(np.array(made["theta"], float) - theta)
    assert np.all(apart < np.where(np.isfinite(std), 0.01 * std, 1e-3 * np.abs(theta)))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_the_notebook_uses_the_public_interface(script):
    internal = re.findall(
        r"^(?:from|import) jaxid\..*|^from jaxid import .*", script.read_text("utf-8"), re.M
    )
    assert internal == []
