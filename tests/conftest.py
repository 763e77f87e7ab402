"""float64 and the loop flag, before any test module starts JAX; a session leaves nothing on disk."""

import atexit
import gc
import os
import shutil
import tempfile
from pathlib import Path

import pytest

import jaxid as jaxid
from tests.support.outcomes import pytest_addoption, pytest_configure

__all__ = ["pytest_addoption", "pytest_configure"]

os.environ["JAXID_CACHE"] = "off"

# Most of a session's time goes into compiling. The folder is made once, before there are workers, which
# inherit the variable, as do commands that tests run: what one compiles, or forgets below, no other does.
_FOLDER = "JAX_COMPILATION_CACHE_DIR"
if _FOLDER not in os.environ:
    os.environ[_FOLDER] = tempfile.mkdtemp(prefix="jaxid-tests-")
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.02"  # [s], as of commands
    os.environ["JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES"] = "-1"
    atexit.register(shutil.rmtree, os.environ[_FOLDER], ignore_errors=True)

# Compiled functions are many small objects that stay: looking for garbage after every 700 new ones, as Python
# does, takes 6 % of the time.
gc.set_threshold(20_000, 20, 20)

# Each compiled function takes about a dozen memory maps, of which Linux gives a process 65 530: what the
# whole suite compiles does not fit, and then the compiler dies.
_MAPS, _MANY = Path("/proc/self/maps"), 20_000


def _forget_compiled_code():
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MANY:
        import jax

        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module", autouse=True)
def _after_each_module():
    yield
    _forget_compiled_code()


@pytest.fixture(autouse=True)
def _after_each_slow_test(request):
    """A hundred searches of one module do not fit either."""
    yield
    if request.node.get_closest_marker("slow"):
        _forget_compiled_code()
