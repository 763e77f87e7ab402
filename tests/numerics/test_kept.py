"""Compiled functions on disk: the same numbers in a later process, without a trace."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxid.numerics import kept

ROOT = Path(__file__).parents[2]
# In a module whose name is of jaxid; `solve` calls LAPACK, which a fresh process must know of.
CODE = """
import sys, types
import jaxid, numpy as np, jax.numpy as jnp
from jaxid.effects import EFFECTS
from jaxid.numerics.kept import kept_jit
def solved(matrix, right, effect, factor):
    print("traced")
    x = jnp.linalg.solve(matrix, right) * factor
    return {"x": x, "level": effect.level, "factor": factor, "none": None}
solved.__module__ = "jaxid.tested"
solved.__qualname__ = "solved"
f = kept_jit(solved)
effect = EFFECTS["coulomb_friction"](level=3.0)
matrix = np.array([[2.0, 1.0], [1.0, 3.0]])
out = f(matrix, np.array([1.0, 2.0]), effect, float(sys.argv[1]))
again = f(2 * matrix, np.array([1.0, 2.0]), effect, float(sys.argv[1]))
print(np.asarray(out["x"]).tolist(), np.asarray(again["x"]).tolist(), float(out["level"]), out["factor"])
"""


def lines(folder: Path, factor: float, code: str = CODE) -> list[str]:
    """What a new process prints."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environment |= {kept.FOLDER: str(folder), "JAX_COMPILATION_CACHE_DIR": str(folder)}
    environment |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    run = subprocess.run(
        [sys.executable, "-c", code, str(factor)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return run.stdout.splitlines()


def test_a_later_process_does_not_trace_and_has_the_same_numbers(tmp_path):
    first = lines(tmp_path, 1.0)
    x = np.linalg.solve([[2.0, 1.0], [1.0, 3.0]], [1.0, 2.0])
    assert first[:-1] == ["traced"]
    assert np.allclose(eval(first[-1].split("] ")[0] + "]"), x, rtol=1e-14)
    files = list(tmp_path.glob("kept_solved-*-cache"))
    assert len(files) == 1
    assert not list(tmp_path.glob("jit_kept_solved*")), "one copy is enough"
    assert lines(tmp_path, 1.0) == first[-1:]
    # Another value that is no array is another function.
    assert lines(tmp_path, 2.0)[0] == "traced"

    files[0].write_bytes(files[0].read_bytes()[:100])
    assert lines(tmp_path, 1.0) == first
    assert lines(tmp_path, 1.0) == first[-1:]


def test_a_class_from_elsewhere_is_not_kept(tmp_path):
    own = CODE.replace(
        'effect = EFFECTS["coulomb_friction"](level=3.0)',
        'effect = type("Mine", (EFFECTS["coulomb_friction"],), {"__module__": "jaxid_user_mine"})(level=3.0)',
    )
    assert own != CODE
    first = lines(tmp_path, 1.0, own)
    assert first[0] == "traced"
    assert not list(tmp_path.glob("kept_*"))
    assert lines(tmp_path, 1.0, own) == first


def test_a_call_back_into_python_is_not_kept(tmp_path):
    code = CODE.replace("* factor", "* factor + jax.pure_callback(lambda: np.float64(0), np.float64(0))")
    code = code.replace("import sys", "import jax, sys")
    assert lines(tmp_path, 1.0, code)[0] == "traced"
    assert not list(tmp_path.glob("kept_*"))


@pytest.mark.parametrize("what", ["version", "XLA_FLAGS", "source"])
def test_the_key_holds_what_code_depends_on(monkeypatch, what):
    kept._surroundings.cache_clear()
    before = kept._surroundings()
    kept._surroundings.cache_clear()
    assert kept._surroundings() == before
    kept._surroundings.cache_clear()
    if what == "version":
        monkeypatch.setattr(kept, "version", lambda name: "0")
    elif what == "XLA_FLAGS":
        monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
    else:
        monkeypatch.setattr(kept, "__file__", str(ROOT / "truth" / "axis" / "x.py"))
    assert kept._surroundings() != before
    kept._surroundings.cache_clear()


def test_without_a_folder_nothing_is_kept():
    assert kept.FOLDER not in os.environ, "tests compile as they did"
