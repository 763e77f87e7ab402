"""Process-wide settings, and which module may import which."""

import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from jaxid import _platform
from tests.support.imports import imports
from tests.support.rooms import AGAINST, ROOMS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "jaxid"
OPTION = "xla_cpu_small_while_loop_byte_threshold=1000000000"
KEY = "--xla_backend_extra_options="


def fresh(code: str, flags: str | None = None) -> list[str]:
    """Lines that a new Python process prints."""
    environment = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_ENABLE_X64")}
    if flags is not None:
        environment["XLA_FLAGS"] = flags
    run = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning", "-c", code],
        cwd=ROOT, env=environment, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    return run.stdout.split("\n")


def test_import_is_light_and_sets_float64():
    code = (
        "import jaxid, sys; print([m for m in ('jax', 'numpy', 'scipy') if m in sys.modules])\n"
        "import jax; print(jax.numpy.ones(1).dtype)"
    )
    assert fresh(code)[:2] == ["[]", "float64"]


def test_float64_after_jax_was_imported_first():
    code = "import jax, jaxid, os; print(jax.numpy.ones(1).dtype, os.environ['XLA_FLAGS'])"
    assert fresh(code)[0] == f"float64 {KEY}{OPTION}"


OWN = "--xla_cpu_enable_fast_math=false"
USER = "xla_cpu_use_acl=true"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (None, f"{KEY}{OPTION}"),
        (OWN, f"{OWN} {KEY}{OPTION}"),
        (f"{KEY}{USER} {OWN}", f"{KEY}{USER},{OPTION} {OWN}"),
        # the user's own threshold stays
        (f"{KEY}{OPTION[:-9]}", f"{KEY}{OPTION[:-9]}"),
    ],
)
def test_users_flags_are_kept(flags, expected):
    code = "import jaxid, os; print(os.environ['XLA_FLAGS'])"
    assert fresh(code, flags)[0] == expected


def test_warns_where_the_backend_is_already_up():
    code = (
        "import warnings, os, jax; jax.numpy.ones(1).block_until_ready()\n"
        "with warnings.catch_warnings(record=True) as told:\n"
        "    warnings.simplefilter('always')\n"
        "    import jaxid\n"
        "print(len(told), 'several times slower' in str(told[0].message))\n"
        "print(told[0].filename, os.environ.get('XLA_FLAGS'), jax.numpy.ones(1).dtype)"
    )
    lines = fresh(code)
    assert lines[0] == "1 True"
    assert lines[1].endswith("None float64")


@pytest.mark.parametrize(
    ("installed", "flags", "expected"),
    [
        ("0.10.2", OWN, OWN),
        ("0.12.0", OWN, OWN),
        ("0.11.2", OWN, f"{OWN} --xla_cpu_multi_thread_eigen=false"),
        ("0.11.2", "--xla_cpu_multi_thread_eigen=true", "--xla_cpu_multi_thread_eigen=true"),
    ],
)
def test_threads_of_jaxlib_0_11_need_a_flag(monkeypatch, installed, flags, expected):
    monkeypatch.setattr(_platform, "_installed_jaxlib", lambda: installed)
    assert _platform._with_threads_flag(flags) == expected


def test_the_installed_version_is_read_without_an_import():
    code = (
        "import sys; from jaxid import _platform as p; print(p._installed_jaxlib(), 'jaxlib' in sys.modules)"
    )
    assert fresh(code)[0] == f"{version('jaxlib')} False"


LOOP = """
import jaxid, jax, jax.numpy as jnp
from jaxid.effects import EFFECTS
from jaxid.plants import Axis
from jaxid.simulation.loops import Drive, open_loop
def end(level):
    plant = Axis(2.0, effects=(EFFECTS["coulomb_friction"](level=level),))
    u = jnp.ones((50, 1))
    return open_loop(plant, Drive(jnp.ones(1), 1e-3), u, jnp.zeros(1), jnp.zeros(1)).position[-1, 0]
print(jax.jit(jax.grad(end)).lower(jnp.asarray(3.0)).compile().as_text().count(
    'xla_cpu_small_call="true"'))
"""


def test_the_loop_and_its_gradient_are_one_kernel_each():
    """The undocumented option still works: without it the count is zero."""
    assert int(fresh(LOOP)[0]) >= 2
    off = f"{KEY}xla_cpu_small_while_loop_byte_threshold=1"
    assert int(fresh(LOOP, off)[0]) == 0


def room(module: str) -> str | None:
    """The room of a module's full name; None for `jaxid` itself."""
    parts = module.split(".")
    return parts[1] if parts[0] == "jaxid" and len(parts) > 1 and parts[1] in ROOMS else None


def test_every_module_has_its_room_and_every_room_is_there():
    there = {p.stem for p in PACKAGE.glob("*.py")} | {p.parent.name for p in PACKAGE.glob("*/__init__.py")}
    assert there - {"__init__"} == set(ROOMS)


def test_contributing_lists_the_rooms_in_their_order():
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    places = [f"jaxid/{r}/" if (PACKAGE / r).is_dir() else f"jaxid/{r}.py" for r in ROOMS]
    assert "".join(f"{p:<28}{what}\n" for p, what in zip(places, ROOMS.values(), strict=True)) in text


def test_imports_follow_the_order_of_rooms():
    order = list(ROOMS)
    against = set()
    for path in sorted(PACKAGE.rglob("*.py")):
        here = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if here == "__init__":
            continue
        for module in imports(path):
            there = room(module)
            if there and order.index(there) > order.index(here):
                assert (here, there) in AGAINST, f"{path.relative_to(ROOT)} imports {module}"
                against.add((here, there))
    assert against == set(AGAINST), "an exception that nothing needs any more"


def test_the_package_does_not_import_its_tests_or_experiments():
    strangers = {"tests", "truth", "experiments", "benchmarks"}
    assert all((ROOT / name / "__init__.py").is_file() for name in strangers)
    for path in PACKAGE.rglob("*.py"):
        assert not {m.split(".")[0] for m in imports(path)} & strangers, path


def test_every_method_has_its_estimator():
    from jaxid import estimators, names

    assert tuple(estimators.METHODS) == names.METHODS


def test_names_are_read_without_jax_or_numpy():
    path = PACKAGE / "names.py"
    assert imports(path) == set()
