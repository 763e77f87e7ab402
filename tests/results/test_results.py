"""What check, identify and discover write: promised keys, numbers, a page that stands alone."""

import re

import pytest

from jaxid.effects import EFFECTS
from tests.support.cli_setup import COULOMB, TRUTH, VISCOUS, place, recorded, run, text

UNITS = {
    "inertia": "kg",
    "viscous_friction.coefficient": "N s/m",
    "coulomb_friction.level": "N",
}
METHODS = ("inverse_dynamics", "output_error", "algebraic", "recursive")
ADDED_MASS = ("added_mass", {"mass": 1.0})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """One log, a second run of the machine, and cases that know more or less."""
    made = tmp_path_factory.mktemp("results")
    place(made, recorded())
    place(made / "second", recorded(1))
    (made / "blind.toml").write_text(text([VISCOUS, COULOMB, ADDED_MASS]))
    (made / "poor.toml").write_text(text([VISCOUS]))
    return made


def number(value, least=0.0):
    assert isinstance(value, float)
    assert value >= least


def stands_alone(page):
    assert page.lstrip().startswith("<!DOCTYPE html>")
    # The one script comes with the page, and the page asks for nothing.
    assert page.count("<script") == 1
    assert "default-src 'none'" in page
    assert not re.search(r"https?://", page.partition("<script>")[0])
    targets = re.findall(r'(?:src|href)="([^"]*)"', page)
    assert all(target.startswith(("#", "data:image/")) for target in targets)
    assert page.count("<img") >= 3


def near_truth(parameters, names=tuple(TRUTH), part=0.05):
    for name in names:
        found = parameters[name]
        assert {"value", "std", "unit"} <= {*found}
        assert found["unit"] == UNITS[name]
        number(found["std"])
        assert found["value"] == pytest.approx(TRUTH[name], rel=part), name


def judge_gap(gap, *, validated):
    """The gap of result.json, on a log that the model explains to its noise."""
    promised = {"unit", "band_hz", "fit", "validation", "noise_floor", "relative", "simulation"}
    assert promised <= {*gap}
    simulation = gap["simulation"]
    assert (gap["unit"], simulation["unit"]) == ("N", "m")
    for value in (
        gap["band_hz"],
        gap["fit"],
        gap["noise_floor"],
        gap["relative"]["fit"],
        simulation["fit"],
        simulation["relative"]["fit"],
    ):
        number(value)
    assert gap["relative"]["fit"] < 0.01
    assert simulation["relative"]["fit"] < 1e-4
    others = (
        gap["validation"],
        gap["relative"]["validation"],
        simulation["validation"],
        simulation["relative"]["validation"],
    )
    if validated:
        [number(other) for other in others]
        assert gap["validation"] == pytest.approx(gap["fit"], rel=1.0)
    else:
        assert others == (None,) * 4


def test_check(folder, capsys):
    ran = run(capsys, "check", folder / "case.toml", folder / "log.csv", folder=folder / "check")
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("time: 2000 samples, one every 2 ms (500 Hz), even to 1 %\nthe log is sound\n")
    assert "\n2000 samples at 500 Hz, 4 s; stroke " in ran.out
    assert [p.name for p in sorted(ran.folder.iterdir())] == [".jaxid", "check.json"]
    found = ran.json("check.json")
    assert (found["sound"], found["warnings"], found["unidentifiable"]) == (True, [], [])
    assert found["log"]["samples"] == 2000
    assert {*found["parameters"]} == {*UNITS}
    for name, told in found["parameters"].items():
        assert told["identifiable"] is True
        assert told["unit"] == UNITS[name]
        assert re.search(rf"{re.escape(name)} .* {re.escape(told['unit'])}\n", ran.out + "\n")
        # What noise alone leaves; the guess is off by half.
        assert 0 < told["expected_std"] < 0.01 * told["guess"]


@pytest.mark.parametrize("method", METHODS)
def test_identify(folder, capsys, method):
    inputs = [folder / "case.toml", folder / "log.csv", folder / "second" / "log.csv"]
    before = [(p.stat().st_mtime_ns, p.read_bytes()) for p in inputs]
    case, log, second = inputs
    # Absent, the method is output_error.
    words = [] if method == "output_error" else ["--method", method]
    ran = run(capsys, "identify", case, log, "--validate", second, *words, folder=folder / method)
    assert (ran.status, ran.err) == (0, "")
    assert ran.out.startswith("The model is complete for this log: ")
    assert f"\n\n{method}: converged, " in ran.out
    assert [(p.stat().st_mtime_ns, p.read_bytes()) for p in inputs] == before
    written = [p.name for p in sorted(ran.folder.iterdir())]
    assert written == [".jaxid", "report.html", "result.json", "result.npz"]
    found = ran.json("result.json")
    assert (found["method"], found["converged"], found["unidentifiable"]) == (method, True, [])
    assert found["model_complete"] is found["explains_log"] is True
    assert 0 < found["samples"] <= 2000
    assert isinstance(found["samples"], int)
    assert {*found["parameters"]} == {*TRUTH}
    assert all(p["identifiable"] is True for p in found["parameters"].values())
    near_truth(found["parameters"])
    judge_gap(found["gap"], validated=True)
    page = (ran.folder / "report.html").read_text("utf-8")
    stands_alone(page)
    for name in TRUTH:
        assert re.search(rf"\n{re.escape(name)} +[0-9]", ran.out)
        assert name in page


def test_what_the_data_cannot_tell_is_null(folder, capsys):
    argv = ("identify", folder / "blind.toml", folder / "log.csv", "--method", METHODS[0])
    ran = run(capsys, *argv, folder=folder / "blind")
    assert (ran.status, ran.err) == (0, "")
    found = ran.json("result.json")
    twins = ("inertia", "added_mass.mass")
    for name in twins:
        told = found["parameters"][name]
        assert told == {"value": None, "std": None, "unit": "kg", "identifiable": False}
        assert re.search(rf"\n{re.escape(name)} +- +not identifiable from this log +kg\n", ran.out)
    near_truth(found["parameters"], (*TRUTH,)[1:], part=0.01)
    (blind,) = found["unidentifiable"]
    weights = [blind["combination"][name] for name in twins]
    assert {*blind["combination"]} == {*twins}
    assert abs(weights[0]) == pytest.approx(0.7071, abs=1e-3)
    assert weights[0] == pytest.approx(-weights[1], abs=1e-3)
    assert "not identifiable in combination: " in ran.out
    judge_gap(found["gap"], validated=False)
    stands_alone((ran.folder / "report.html").read_text("utf-8"))


def judge_discovery(found, steps):
    keys = ("verdict", "where", "effects", "steps", "gap", "parameters")
    assert {*keys} <= {*found}
    assert [step["added"] for step in found["steps"]] == steps
    gap = found["gap"]
    promised = {"unit", "band_hz", "before", "after", "noise_floor", "on", "simulation"}
    assert promised <= {*gap}
    assert (gap["unit"], gap["simulation"]["unit"]) == ("N", "m")
    for value in (
        gap["band_hz"],
        gap["before"],
        gap["after"],
        gap["noise_floor"],
        gap["simulation"]["before"],
        gap["simulation"]["after"],
    ):
        number(value)


def test_discover_adds_nothing_where_nothing_is_missing(folder, capsys):
    argv = ("discover", folder / "case.toml", folder / "log.csv", "--max-effects", 0)
    ran = run(capsys, *argv, folder=folder / "nothing")
    assert (ran.status, ran.err) == (0, "")
    written = [p.name for p in sorted(ran.folder.iterdir())]
    assert written == [".jaxid", "case.toml", "discovery.json", "discovery.npz", "report.html"]
    found = ran.json("discovery.json")
    judge_discovery(found, [None])
    assert (found["verdict"], found["where"], found["effects"]) == ("nothing_missing", None, [])
    assert found["gap"]["on"] == "fit"
    (step,) = found["steps"]
    assert step["validation"] is None
    assert step["fit"] == found["gap"]["before"] == found["gap"]["after"]
    assert step["fit"] < 1.5 * found["gap"]["noise_floor"]
    near_truth(found["parameters"])
    assert ran.out.startswith("verdict: nothing_missing\n")
    assert ran.out.count("baseline") == 1
    stands_alone((ran.folder / "report.html").read_text("utf-8"))


@pytest.mark.slow
def test_discover_names_what_is_missing(folder, capsys):
    argv = ("discover", folder / "poor.toml", folder / "log.csv", "--max-effects", 1)
    validate = ("--validate", folder / "second" / "log.csv")
    ran = run(capsys, *argv, *validate, folder=folder / "found")
    assert (ran.status, ran.err) == (0, "")
    found = ran.json("discovery.json")
    judge_discovery(found, [None, "coulomb_friction"])
    assert found["verdict"] == "found"
    (effect,) = found["effects"]
    assert {"kind", "joint", "parameters", "evidence", "alternatives"} <= {*effect}
    assert (effect["kind"], effect["joint"]) == ("coulomb_friction", 1)
    level = effect["parameters"]["level"]
    near_truth({"coulomb_friction.level": level}, ["coulomb_friction.level"])
    number(effect["evidence"], 100.0)
    for other in effect["alternatives"]:
        assert other["kind"] in EFFECTS
        number(other["evidence"])
    where = found["where"]
    assert {"joint", "variable", "region", "intervals", "text"} <= {*where}
    assert where["joint"] == 1
    assert len(where["region"]) == 2
    assert all(len(interval) == 2 for interval in where["intervals"])
    # The case's own unknowns; the effect's stand with the effect.
    assert {*found["parameters"]} == {"inertia", "viscous_friction.coefficient"}
    near_truth(found["parameters"], [*found["parameters"]])
    assert found["gap"]["on"] == "validation"
    assert found["gap"]["after"] < 0.1 * found["gap"]["before"]
    first, second = found["steps"]
    assert second["validation"] < 0.1 * first["validation"]
    assert "effect:  coulomb_friction (evidence " in ran.out
    stands_alone((ran.folder / "report.html").read_text("utf-8"))
