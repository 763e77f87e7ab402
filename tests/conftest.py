"""float64 and the loop flag, before any test module starts JAX; commands keep nothing on disk."""

import gc
import os
from pathlib import Path

import pytest

import jaxid as jaxid

os.environ["JAXID_CACHE"] = "off"

# Each compiled function takes about a dozen memory maps, of which Linux gives a process 65 530: what the
# whole suite compiles does not fit, and then the compiler dies.
_MAPS, _MANY = Path("/proc/self/maps"), 20_000


@pytest.fixture(scope="module", autouse=True)
def _forget_compiled_code():
    yield
    if _MAPS.exists() and _MAPS.read_bytes().count(b"\n") > _MANY:
        import jax

        jax.clear_caches()
        gc.collect()
