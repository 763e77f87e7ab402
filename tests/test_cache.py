"""Compiled code on disk: used again, healed where it is broken, and left to the user where they say so."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from jaxid import _cache

# The smallest compiled program, started as the installed command starts.
CODE = """
from jaxid import _cache
_cache.configure()
import jax
jax.jit(lambda x: (x @ x).sum())(jax.numpy.ones((3, 3))).block_until_ready()
print("compiled")
"""


INHERITED = {k: v for k, v in os.environ.items() if not k.startswith("JAX")}


def run(folder: Path, **environment: str) -> str:
    """Complaints of a fresh process."""
    environment = INHERITED | {
        "XDG_CACHE_HOME": str(folder), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    } | environment  # fmt: skip
    ended = subprocess.run(
        [sys.executable, "-c", CODE], env=environment, capture_output=True, text=True, check=True
    )
    assert ended.stdout == "compiled\n"
    return ended.stderr


def entries(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*-cache")}


@pytest.fixture(scope="module")
def filled(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    assert run(folder) == ""
    assert entries(folder)
    return folder


def test_a_second_run_compiles_nothing_new(filled):
    before = entries(filled)
    assert run(filled) == ""
    assert entries(filled) == before


@pytest.mark.parametrize("left", [0, 100])
def test_a_broken_entry_is_compiled_again_and_goes(filled, left):
    run(filled)
    for path, content in entries(filled).items():
        path.write_bytes(content[:left])
    assert run(filled) == "", "the user need not know"
    assert not entries(filled)
    run(filled)
    assert all(len(content) > 100 for content in entries(filled).values())


def test_runs_at_once_do_not_disturb_each_other(tmp_path):
    environment = INHERITED | {"XDG_CACHE_HOME": str(tmp_path)}
    several = [
        subprocess.Popen([sys.executable, "-c", CODE], env=environment, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert [p.communicate()[1] for p in several] == ["", "", ""]
    assert [p.returncode for p in several] == [0, 0, 0]


def test_of_entries_only_those_that_cannot_be_read_go(filled):
    run(filled)
    whole = entries(filled)
    broken = next(iter(whole))
    broken.write_bytes(b"")
    beside = broken.with_name("of-another-function-0123-cache")
    beside.write_bytes(b"kept")
    assert run(filled) == ""
    assert beside.read_bytes() == b"kept"
    assert not broken.exists()
    beside.unlink()


def test_the_users_own_cache_stays(tmp_path):
    own = tmp_path / "own"
    run(tmp_path, JAX_COMPILATION_CACHE_DIR=str(own))
    assert list(own.iterdir())
    assert not (tmp_path / "jaxid").exists()


def test_it_can_be_switched_off(tmp_path):
    assert run(tmp_path, JAXID_CACHE="off") == ""
    assert not list(tmp_path.iterdir())


def test_a_home_that_cannot_be_written_to_only_slows(tmp_path):
    (tmp_path / "jaxid").write_text("a file where the folder would be")
    assert run(tmp_path) == ""


def test_what_was_written_first_goes_where_it_is_too_much(tmp_path, monkeypatch):
    monkeypatch.setattr(_cache, "_MOST_BYTES", 25)
    for k in range(4):
        path = tmp_path / f"{k}-cache"
        path.write_bytes(bytes(10))
        os.utime(path, (k, k))
    _cache._shrink(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["2-cache", "3-cache"]
