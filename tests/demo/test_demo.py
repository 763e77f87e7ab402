"""The demo: its logs come from the stepper, it ships, and it finds what was hidden in it."""

import json
import re
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
    values = dict(effect["parameters"])
    for name, true in make_demo.HIDDEN.items():
        assert abs(values[name]["value"] - true) < max(3 * values[name]["std"], 0.03 * abs(true)), name

    assert found["gap"]["on"] == "validation"
    assert found["gap"]["after"] < 0.1 * found["gap"]["before"]
    # The fit with the effect simulates better in the loop, on the log that it has not seen.
    assert found["method"] == "prediction_error"
    assert found["gap"]["simulation"]["after"] < 0.1 * found["gap"]["simulation"]["before"]
    assert "inverse dynamics" not in " ".join(found["notes"])
    assert "cogging" in (folder / "report.html").read_text("utf-8")

    # The intervals of all values hold.
    machine = make_demo.emps_like(1).machine
    true = {f"{kind}.{name}": value for kind, own in machine.effects.items() for name, value in own.items()}
    true |= {"inertia": machine.inertia} | {f"cogging.{name}": x for name, x in make_demo.HIDDEN.items()}
    fitted = found["parameters"] | {f"cogging.{name}": value for name, value in values.items()}
    assert fitted.keys() == true.keys()
    for name, value in fitted.items():
        assert abs(value["value"] - true[name]) < 3.5 * value["std"], name

    # README shows this output, and these two values.
    page = (ROOT / "README.md").read_text("utf-8")
    shown = page.split("$ jaxid discover jaxid-demo/case.toml jaxid-demo/log.csv\n")[1].split("```")[0]
    assert [line for line in shown.splitlines() if line not in out.splitlines()] == []
    stated = re.search(r"amplitude (\S+) ± (\S+) N, period (\S+) ± (\S+) mm", page)
    assert stated is not None
    exact = [values["amplitude"], {k: 1e3 * values["period"][k] for k in ("value", "std")}]
    numbers = [value[k] for value in exact for k in ("value", "std")]
    # To the last digit that stands there; a processor may round another way.
    for text, number in zip(stated.groups(), numbers, strict=True):
        assert float(text) == pytest.approx(number, abs=2 * 10.0 ** -len(text.split(".")[1]))
