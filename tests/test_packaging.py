"""What is shipped: one version everywhere, and extras that bring what the folders import."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
EXTRAS = SETTINGS["project"]["optional-dependencies"]


def test_the_citation_states_the_version_and_licence():
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    stated = dict(re.findall(r"^(\w[\w-]*): (.+)$", text, flags=re.M))
    project = SETTINGS["project"]
    assert stated["title"] == project["name"]
    assert stated["version"] == project["version"]
    assert stated["license"] == project["license"]
    assert stated["abstract"].rstrip(".") == project["description"]


def test_the_changelog_has_the_version_and_what_comes_next():
    heads = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text("utf-8"), flags=re.M)
    assert heads[0] == "Unreleased"
    assert heads[1].split()[0] == SETTINGS["project"]["version"]


def test_only_the_package_is_installed():
    assert SETTINGS["tool"]["setuptools"]["packages"]["find"]["include"] == ["jaxid*"]
    beside = {p.parent.name for p in ROOT.glob("*/__init__.py")}
    assert {name for name in beside if name.startswith("jaxid")} == {"jaxid"}


def test_the_tests_bring_what_the_experiments_need():
    assert {*EXTRAS["experiments"]} <= {*EXTRAS["tests"]}
