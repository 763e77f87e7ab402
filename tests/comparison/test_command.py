"""The command `compare`: what it refuses, its files and what it says."""

import dataclasses
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import jaxid
from jaxid import cli
from jaxid.comparison.result import Comparison, Difference, LogGap, Rival, Value
from jaxid.results.comparison_schema import comparison_schema
from tests.support.cli_setup import place, recorded, refused, run, text
from tests.support.written_logs import write_csv
from truth.hidden.pairs import Pair


@pytest.fixture(scope="module")
def sound():
    return recorded()


@pytest.fixture
def files(tmp_path, sound):
    case, log = place(tmp_path / "in", sound)
    return case, log, write_csv(tmp_path / "in" / "other.csv", dict(sound))


def test_one_log_is_refused(tmp_path, files, capsys):
    refused(capsys, tmp_path, "compare", *files[:2], told="compare takes two logs or more, not one")
    refused(capsys, tmp_path, "compare", files[0], told="there is no log to fit")


def test_a_log_of_other_joints_is_refused(tmp_path, files, capsys, sound):
    three = tmp_path / "in" / "three.csv"
    write_csv(three, {name: x for name, x in sound.items() if name != "q"} | {"q_1": sound["q"]})
    refused(capsys, tmp_path, "compare", *files[:2], three, told="'q'")
    one = jaxid.Log(sound["t"], sound["q"], sound["u"], reference=sound["ref"], source="one.csv")
    both = np.stack([sound["q"], sound["q"]], axis=1)
    two = jaxid.Log(sound["t"], both, sound["u"], reference=sound["ref"], source="two.csv")
    with pytest.raises(jaxid.InputError, match="position has 2 column"):
        jaxid.compare(files[0], [one, two])


def test_an_unknown_key_of_the_case_is_refused(tmp_path, files, capsys, sound):
    case, _ = place(tmp_path / "wrong", sound, text().replace("[sensor]", "[sensors]", 1))
    refused(capsys, tmp_path, "compare", case, *files[1:], told="did you mean 'sensor'?")


def test_other_wrong_arguments_are_refused(tmp_path, files, capsys):
    refused(capsys, tmp_path, "compare", *files, "--max-changes", 0, told="--max-changes is 0; give one")
    refused(capsys, tmp_path, "compare", files[0], files[1], files[1], told="is named twice")
    with pytest.raises(jaxid.InputError, match="logs is not a list"):
        jaxid.compare(files[0], "log.csv")


def test_logs_of_which_only_some_have_a_force_are_refused(files, sound):
    bare = {name: x for name, x in sound.items() if name != "u"}
    logs = [
        jaxid.Log(x["t"], x["q"], x.get("u"), reference=x["ref"], source=f"{k}.csv")
        for k, x in enumerate((dict(sound), bare))
    ]
    with pytest.raises(jaxid.InputError, match="the force is zero throughout"):
        jaxid.compare(files[0], logs)


def test_help_has_examples(capsys):
    with pytest.raises(SystemExit):
        cli.main(["compare", "--help"])
    out = capsys.readouterr().out
    assert "jaxid compare axis.toml monday.csv friday.csv -o friday\n" in out


@pytest.fixture
def differing(tmp_path, files):
    """A result without the search."""
    session = jaxid.open_session(files[0], [str(f) for f in files[1:]])
    newton = lambda value: Value(value, 0.1, "N")
    rival = Rival("hysteresis", "", "hysteresis", ("joint", 1), ("other",), 119.0)
    parameter = "coulomb_friction.level"
    found = (
        Difference(
            parameter, parameter, "", ("joint", 1), {"log": newton(20.0), "other": newton(24.0)},
            120.3, 17.0, 1e-40, (rival,),
        ),
        Difference(
            "cogging", "", "cogging", ("joint", 1), {"log": None, "other": {"amplitude": newton(3.0)}},
            50.0, 17.0, 1e-13,
        ),
    )  # fmt: skip
    time = np.arange(5.0)
    one = np.ones(1)
    gaps = tuple(
        LogGap(name, 4 * one, one, one, time, np.ones((5, 1)), np.zeros((5, 1))) for name in ("log", "other")
    )
    shared = {"inertia": Value(95.0, np.nan, "kg")}
    return Comparison(session, "differs", found, ("stribeck_friction",), gaps, "", 55, 17.0, shared)


def test_the_files_hold_the_result(tmp_path, differing):
    differing.save(tmp_path / "out")
    content = json.loads((tmp_path / "out" / "comparison.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(comparison_schema())
    jsonschema.validate(content, comparison_schema())
    first, second = content["differences"]
    assert first["parameter"] == "coulomb_friction.level"
    assert first["by_log"]["other"] == {"value": 24.0, "std": 0.1, "unit": "N"}
    assert first["alternatives"] == [{"kind": "hysteresis", "logs": ["other"], "joint": 1, "evidence": 119.0}]
    assert "parameter" not in second
    assert second["by_log"] == {"log": None, "other": {"amplitude": {"value": 3.0, "std": 0.1, "unit": "N"}}}
    assert content["parameters"]["inertia"]["std"] is None
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "hysteresis in other" in page
    assert page.count("<img") == 3  # values by log, and the residual of each log
    assert page.count('class="numbers"') == page.count('class="zoom') == 2


def test_a_wrong_result_does_not_pass_the_schema(differing):
    content = differing.json()
    content["differences"][0]["kind"] = "cogging"
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(content, comparison_schema())


def test_the_text_says_what_differs(differing):
    printed = str(differing)
    assert printed.startswith("verdict: differs\n")
    assert "coulomb_friction.level differs and cogging acts in other only; the case lacks strib" in printed
    assert "24.00 ± 0.10" in printed
    assert repr(differing) == "verdict: differs"


def test_the_schema_is_printed(capsys):
    assert json.loads(run(capsys, "schema", "comparison").out) == comparison_schema()


def records(pair: Pair, folder):
    case = pair.write_case(folder)
    logs = [jaxid.Log(**(log | {"source": f"{k}.csv"})) for k, log in enumerate(pair.logs())]
    return jaxid.compare(case, logs)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["friction", "torque_constant", "payload", "temperature", "nothing"])
def test_what_differs_between_two_exact_axes_is_named(tmp_path, what):
    # An oracle does not see the change of temperature of the first pair.
    pair = Pair(what, "servo", 1.0, 49_001 if what == "temperature" else 49_000)
    assert pair.visible
    found = records(pair, tmp_path)
    assert sorted(d.label for d in found.differences) == sorted(pair.names)
    assert found.verdict == ("differs" if pair.names else "same")


@pytest.mark.slow
@pytest.mark.parametrize(
    "pair",
    [
        # The residual of one model for both is 60 times the noise: a drive effect's column is its scale.
        Pair("payload", "heavy_slide", 0.3, 60_134),
        # A short log: lags and delays of several lengths reproduce the noise of the force.
        Pair("friction", "servo", 3.0, 60_110, sensor=False),
    ],
    ids=lambda pair: pair.id,
)
def test_drive_effects_do_not_whiten_a_difference_away(tmp_path, pair):
    found = records(pair, tmp_path)
    assert sorted(d.label for d in found.differences) == sorted(pair.names)


@pytest.mark.slow
def test_the_logs_of_the_demo_are_of_one_axis():
    folder = Path(jaxid.__file__).parent / "demo"
    found = jaxid.compare(folder / "case.toml", [folder / "log.csv", folder / "validation.csv"])
    assert found.verdict == "same"


@pytest.mark.slow
def test_an_effect_that_both_lack_is_no_difference(tmp_path):
    found = records(Pair("nothing", "servo", 1.0, 49_001, alike="cogging"), tmp_path)
    assert found.verdict == "same"
    assert found.alike == ("cogging",)


def test_an_incomplete_model_is_said_to_hide_small_differences(differing):
    same = dataclasses.replace(differing, verdict="same", differences=())
    assert "incomplete" not in str(same)
    loud = [dataclasses.replace(gap, explained=np.array([7.0])) for gap in same.gaps]
    lines = str(dataclasses.replace(same, gaps=tuple(loud))).splitlines()
    assert any("note: the model is incomplete: it leaves up to 7 times the noise" in line for line in lines)
    # Where something differs the verdict speaks for itself.
    assert "incomplete" not in str(dataclasses.replace(differing, gaps=tuple(loud)))
