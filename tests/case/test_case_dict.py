"""Cases that are dicts: the same checks as of files, and the same results."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

import jaxid
from jaxid.case.case import load_case
from jaxid.studies.plan import fingerprint
from tests.support.case_faults import FAULTS

DEMO = Path(jaxid.__file__).parent / "demo"
SCENE = {
    "reference": {"kind": "multisine", "band_hz": [0.5, 10.0], "amplitude": 0.05},
    "simulation": {"duration": 2.0, "sample_rate": 500.0},
}


def demo() -> dict:
    return tomllib.loads((DEMO / "case.toml").read_text(encoding="utf-8"))


def simulated() -> dict:
    case = {k: v for k, v in demo().items() if k not in ("log", "validation", "reference", "input")}
    return case | SCENE | {"study": {"runs": 2, "estimators": ("inverse_dynamics",)}}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_as_of_a_file(tmp_path, fault):
    text, words = FAULTS[fault]
    try:
        tables = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return
    with pytest.raises(jaxid.InputError) as caught:
        load_case(tables)
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(jaxid.InputError) as of_file:
        load_case(path)
    assert str(caught.value) == str(of_file.value).replace(str(path), "case")


def test_it_has_no_path_and_starts_from_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "second.csv").write_text("t,q,u\n")
    monkeypatch.chdir(tmp_path)
    case = load_case(demo() | {"validation": [{"name": "second", "log": "second.csv"}]})
    assert case.path is None
    assert (case.where, case.name, case.title) == ("case", "case", "case")
    assert case.validations[0].log.is_file()
    assert load_case(case) is case


def test_numpy_and_tuples_are_taken():
    tables = demo()
    tables["plant"] = {
        "kind": "axis",
        "parameters": {"inertia": {"guess": np.float64(80.0), "min": np.asarray(1.0), "max": None}},
    }
    tables["limits"] = {"stroke": (-0.1, 0.2)}
    case = load_case(tables)
    assert case.plant.parameters["inertia"].lower == 1.0
    assert case.limits.stroke == (-0.1, 0.2)


def test_identify_gives_the_numbers_of_the_file(tmp_path):
    of_file = jaxid.identify(DEMO / "case.toml", DEMO / "log.csv", method="inverse_dynamics")
    tables = {k: v for k, v in demo().items() if k != "validation"}
    result = jaxid.identify(tables, DEMO / "log.csv", method="inverse_dynamics")
    np.testing.assert_array_equal(result.estimate.theta, of_file.estimate.theta)
    result.save(tmp_path)
    assert "Identification of the axis" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_simulate_and_study_take_it(tmp_path):
    log = jaxid.simulate(simulated()).log
    assert log.source == "simulation of case"
    study = jaxid.study(simulated(), folder=tmp_path / "study")
    assert study.table.attrs["case"] == "case"
    again = jaxid.study(simulated(), folder=tmp_path / "study", resume=True)
    np.testing.assert_array_equal(again.table["estimate"], study.table["estimate"])


def test_discover_takes_it():
    case = demo()
    case.pop("validation", None)
    result = jaxid.discover(case, DEMO / "log.csv", max_effects=0, refit=False)
    assert result.session.case.path is None


def test_a_fingerprint_is_of_the_contents():
    one, other = simulated(), simulated()
    assert fingerprint(load_case(one)) == fingerprint(load_case(other))
    other["simulation"] = {**SCENE["simulation"], "duration": 2.5}
    assert fingerprint(load_case(one)) != fingerprint(load_case(other))
    # A key that is stated at its default does not make another case.
    other["simulation"] = {**SCENE["simulation"], "substeps": 4}
    assert fingerprint(load_case(one)) == fingerprint(load_case(other))


def test_a_session_builds_one_machine(monkeypatch):
    from jaxid.session import opening

    built = []
    build = opening.build_machine
    monkeypatch.setattr(opening, "build_machine", lambda *a, **k: built.append(1) or build(*a, **k))
    case = demo()
    case["log"].pop("reference")
    case["reference"] = {"kind": "csv", "file": str(DEMO / "log.csv"), "column": "ref", "time": "t"}
    case["validation"] = [{"name": "second", "log": str(DEMO / "validation.csv")}]
    opened = jaxid.open_session(case, DEMO / "log.csv")
    assert len(built) == 1
    assert all(run.log.reference is not None for run in opened.runs)
