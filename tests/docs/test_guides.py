"""The files of the guides on estimators and formats, run as the guides say."""

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxid
from jaxid import cli
from jaxid.errors import InputError
from jaxid.estimators import METHODS, register_method
from jaxid.logs.readers import READERS, read_columns, register_reader
from jaxid.names import USER_METHODS

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def example(name: str):
    """Run a file of the guides, and forget its module afterwards."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def log():
    return jaxid.simulate(EXAMPLES / "axis.toml").log


@pytest.fixture(scope="module")
def huber():
    yield example("huber")
    METHODS.pop("huber")
    USER_METHODS.remove("huber")


@pytest.fixture
def jsonl():
    yield example("jsonl_log")
    READERS.pop(".jsonl")


def truth(result) -> np.ndarray:
    return np.array([f.true for f in result.session.machine.parameters.free])


def test_an_estimator_of_the_guide_agrees_with_inverse_dynamics_on_a_clean_log(huber, log):
    found = jaxid.identify(EXAMPLES / "axis.toml", log, method="huber")
    other = jaxid.identify(EXAMPLES / "axis.toml", log, method="inverse_dynamics").estimate
    estimate = found.estimate
    assert found.converged
    assert estimate.method == "huber"
    assert np.all(np.abs(estimate.theta - truth(found)) < 3 * estimate.std)
    # Of the weights a few samples in a hundred are below one: the estimates differ by a part of their noise.
    assert np.all(np.abs(estimate.theta - other.theta) < 2 * other.std)
    np.testing.assert_allclose(estimate.std, other.std, rtol=0.3)


def test_it_does_what_it_promises_on_a_log_with_outliers(huber, log):
    random = np.random.default_rng(3)
    force = log.force.copy()
    for start in random.integers(100, log.samples - 100, 12):
        force[start : start + 30] += 3.0 * random.choice([-1, 1])
    spoilt = dataclasses.replace(log, force=force)
    found, other = (
        jaxid.identify(EXAMPLES / "axis.toml", spoilt, method=m) for m in ("huber", "inverse_dynamics")
    )
    errors = [np.abs(r.estimate.theta / truth(r) - 1).max() for r in (found, other)]
    assert errors[0] < 0.3 * errors[1]


def test_a_study_runs_it_beside_a_method_of_jaxid(huber, tmp_path):
    text = (EXAMPLES / "axis.toml").read_text()
    path = tmp_path / "case.toml"
    path.write_text(text + '\n[study]\nestimators = ["huber", "inverse_dynamics"]\nruns = 4\n')
    study = jaxid.study(path)
    assert list(study.table.estimator.values) == ["huber", "inverse_dynamics"]
    assert np.all(np.isfinite(study.table.estimate.values))


def test_it_refuses_what_it_cannot_fit(huber, log, tmp_path):
    text = (EXAMPLES / "axis.toml").read_text()
    path = tmp_path / "case.toml"
    path.write_text(text + '\n[[effects]]\nkind = "input_delay"\ndelay = { guess = 0.001 }\n')
    with pytest.raises(InputError, match="enter the balance in proportion"):
        jaxid.identify(path, log, method="huber")


def test_names_that_cannot_be_registered():
    for name, steps, word in (
        ("output_error", lambda session: None, "is taken"),
        ("discover", lambda session: None, "is taken"),
        ("my method", lambda session: None, "is not a name"),
    ):
        with pytest.raises(InputError, match=word):
            register_method(name, steps)
    with pytest.raises(InputError, match="another format"):
        register_reader(".csv", lambda path, names, rows: ({}, (0, 0)))
    with pytest.raises(InputError, match="not one dot and a name"):
        register_reader("jsonl", lambda path, names, rows: ({}, (0, 0)))


def test_a_study_still_refuses_a_name_that_nobody_registered(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text((EXAMPLES / "axis.toml").read_text() + '\n[study]\nestimators = ["hubr"]\n')
    with pytest.raises(InputError, match="hubr"):
        jaxid.load_case(path)


def written(log, path: Path) -> Path:
    """A log as JSON lines, by Python's own json."""
    columns = {"t": log.time, "q": log.position[:, 0], "u": log.force[:, 0], "ref": log.reference[:, 0]}
    rows = zip(*[c.tolist() for c in columns.values()], strict=True)
    path.write_text("\n".join(json.dumps(dict(zip(columns, row, strict=True))) for row in rows) + "\n")
    return path


def test_a_log_of_json_lines_is_identified(jsonl, log, tmp_path, capsys):
    path = written(log, tmp_path / "log.jsonl")
    columns, rows = read_columns(path, ["q", "u"], (10, 20))
    assert rows == (10, 20)
    np.testing.assert_array_equal(columns["q"], log.position[10:20])
    command = ["identify", str(EXAMPLES / "axis.toml"), str(path), "--method", "inverse_dynamics", "--quiet"]
    assert cli.main([*command, "-o", str(tmp_path / "out")]) == 0
    result = json.loads((tmp_path / "out" / "result.json").read_text())
    same = jaxid.identify(EXAMPLES / "axis.toml", log, method="inverse_dynamics")
    for name, value in result["parameters"].items():
        assert value["value"] == pytest.approx(same.value(name), rel=1e-9)


# What is done to the second line of the file, and words of the message.
BROKEN = {
    "cut off": ('{"t": 0.001, "q"', ["row 1 (0-based)", "is not JSON", "cut off"]),
    "a list": ("[0.001, 0.0]", ["row 1", "is not a JSON object"]),
    "no column": ('{"t": 0.001, "q": 0.0, "ref": 0.0, "U": 0.0}', ["row 1", "has no 'u'", "'U'"]),
    "a text": ('{"t": 0.001, "q": 0.0, "u": "3,5", "ref": 0.0}', ["row 1", "'u' is '3,5'", "not a number"]),
    "a null": ('{"t": 0.001, "q": null, "u": 3.5, "ref": 0.0}', ["row 1", "'q' is None", "not a number"]),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_file_is_one_line(jsonl, log, tmp_path, capsys, fault):
    line, words = BROKEN[fault]
    path = written(log, tmp_path / "log.jsonl")
    lines = path.read_text().splitlines()
    lines[1] = line
    path.write_text("\n".join(lines))
    assert cli.main(["identify", str(EXAMPLES / "axis.toml"), str(path), "--quiet"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert all(word in err for word in (str(path), *words)), err


def test_a_file_that_is_not_text_is_one_line(jsonl, tmp_path, capsys):
    path = tmp_path / "log.jsonl"
    path.write_bytes(b"\xff\xfe\x00")
    assert cli.main(["identify", str(EXAMPLES / "axis.toml"), str(path), "--quiet"]) == 2
    assert "UTF-8" in capsys.readouterr().err
