"""What `import jaxid` shows: to type checkers and to Python, the same names, each of them documented."""

import ast
import importlib
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import jaxid
from jaxid import cli
from tests.support.rooms import ROOMS

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "jaxid" / "__init__.py"


def static_homes() -> dict[str, tuple[str, str]]:
    """Module and attribute of each name that type checkers see, as they read it."""
    block = next(
        node
        for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    )
    homes, private = {}, {}
    for node in block.body:
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                shown = alias.asname or alias.name
                # A checker takes `X as X` for a name that is shown, anything else for a private one.
                (homes if shown == alias.name else private)[shown] = (node.module, alias.name)
        elif isinstance(node, ast.Assign):
            homes[node.targets[0].id] = private[node.value.id]
    return homes


def test_type_checkers_see_what_python_loads():
    assert static_homes() == jaxid._HOMES
    assert sorted(jaxid.__all__) == sorted(["__version__", *jaxid._HOMES])


@pytest.mark.parametrize("name", sorted(jaxid._HOMES))
def test_every_name_loads_and_no_module_shadows_it(name):
    module, attribute = jaxid._HOMES[name]
    assert getattr(jaxid, name) is getattr(importlib.import_module(module), attribute)
    assert name not in ROOMS


def test_unknown_name():
    with pytest.raises(AttributeError, match="'jaxid' has no attribute 'identfy'"):
        _ = jaxid.identfy
    assert set(jaxid.__all__) <= set(dir(jaxid))


def test_type_information_ships():
    assert (ROOT / "jaxid" / "py.typed").is_file()
    assert '"py.typed"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_version(capsys):
    assert jaxid.__version__ == version("jaxid")
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--version"])
    assert capsys.readouterr().out == f"jaxid {version('jaxid')}\n"


def test_help_and_version_load_neither_jax_nor_numpy():
    code = (
        "import sys; from jaxid import cli\n"
        "try: cli.main([sys.argv[1]])\n"
        "except SystemExit: print([m for m in ('jax', 'numpy', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    for option in ("--help", "--version"):
        ran = subprocess.run([sys.executable, "-c", code, option], cwd=ROOT, capture_output=True, text=True)
        assert ran.stdout.splitlines()[-1] == "[]", ran.stderr


@pytest.mark.parametrize("name", sorted(jaxid.__all__))
def test_every_name_is_documented(name):
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert re.search(rf"`(?:jaxid\.)?{name}\b[^`]*`", text), name


@pytest.mark.parametrize("name", ["FitResult", "Study"])
def test_every_plot_is_documented(name):
    from jaxid.results.plotting import KINDS, STUDY_KINDS
    from jaxid.results.result import FitResult

    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    cls, kinds = (FitResult, KINDS) if name == "FitResult" else (jaxid.Study, STUDY_KINDS)
    for kind in kinds:
        assert f'"{kind}"' in text
        assert f'"{kind}"' in cls.plot.__doc__
