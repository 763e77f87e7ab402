"""The demo: its logs come from the stepper, it ships, and it finds what was hidden in it."""

import json
import tomllib
from importlib import resources
from pathlib import Path, PurePosixPath

import pytest

import jaxid
from jaxid.cli import main
from truth.axis import demo_logs as make_demo

ROOT = Path(__file__).parents[2]
SHIPPED = resources.files("jaxid.demo")


def test_the_shipped_logs_are_those_that_the_stepper_makes(tmp_path, monkeypatch):
    monkeypatch.setattr(make_demo, "FOLDER", tmp_path)
    make_demo.main()
    made = sorted(tmp_path.iterdir())
    assert [path.name for path in made] == ["log.csv", "validation.csv"]
    for path in made:
        assert (SHIPPED / path.name).read_text("utf-8") == path.read_text("utf-8"), path.name


def test_all_that_is_no_code_is_shipped():
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    patterns = settings["tool"]["setuptools"]["package-data"]["jaxid"]
    package = ROOT / "jaxid"
    data = [p.relative_to(package).as_posix() for p in package.rglob("*.*")]
    data = [name for name in data if not name.endswith((".py", ".pyc"))]
    assert {"demo/case.toml", "demo/log.csv", "demo/validation.csv"} <= {*data}
    for name in data:
        assert any(PurePosixPath(name).match(pattern) for pattern in patterns), name


def test_the_demo_log_is_sound():
    with resources.as_file(SHIPPED) as folder:
        checked = jaxid.check(folder / "case.toml", folder / "log.csv")
    assert checked.warnings == []
    assert checked.session.validations[0].name == "second run"
    assert all(checked.precision.identifiable)
    assert "cogging" not in {effect.kind for effect in checked.session.machine.plant.effects}


@pytest.mark.slow
def test_the_demo_finds_what_was_hidden(tmp_path, capsys):
    folder = tmp_path / "demo"
    assert main(["demo", "-o", str(folder)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for words in ("$ jaxid check ", "$ jaxid identify ", "$ jaxid discover ", "report: "):
        assert f"\n{words}" in f"\n{out}"
    made = {p.name for p in folder.iterdir()}
    results = {"check.json", "result.json", "discovery.json", "report.html", "case_found.toml"}
    # The report of identify keeps a name of its own beside that of discover.
    results |= {"result.npz", "discovery.npz", "report_identify.html"}
    assert made == {".jaxid", "case.toml", "log.csv", "validation.csv"} | results
    found = json.loads((folder / "discovery.json").read_text("utf-8"))
    assert found["verdict"] == "found"
    (effect,) = found["effects"]
    assert effect["kind"] == "cogging"
    for name, true in make_demo.HIDDEN.items():
        told = effect["parameters"][name]
        assert abs(told["value"] - true) < max(3 * told["std"], 0.03 * abs(true)), name
    assert found["gap"]["on"] == "validation"
    assert found["gap"]["after"] < 0.1 * found["gap"]["before"]
    # The fit with the effect simulates better in the loop, on the log that it has not seen.
    assert found["method"] == "prediction_error"
    assert found["gap"]["simulation"]["after"] < 0.1 * found["gap"]["simulation"]["before"]
    assert "inverse dynamics" not in " ".join(found["notes"])
    assert "cogging" in (folder / "report.html").read_text("utf-8")
