"""A load column beside a loop without a force: what it says, and when it gives the scale."""

import json
import tomllib
from functools import cache

import numpy as np
import pytest

import jaxid
from jaxid.build import build_machine
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.estimators.effort import Scale, with_effort
from jaxid.estimators.estimate import Estimate
from jaxid.estimators.unforced import with_known_scale, without
from jaxid.numerics.precision import Precision
from jaxid.session import open_session
from tests.estimators.test_unforced import FREE, RATE, TRUE
from tests.estimators.test_unforced import log as servo

GAIN, LATE, LAG = 40.0, 0.025, 0.04  # per N m; s; s
COLUMN = 'effort = "load"\n'
# The same machine with its force in the log, which needs no loop.
FORCED = FREE[: FREE.index("[controller]")] + FREE[FREE.index("[log]") :].replace(
    'reference = "r"', 'force = "u"'
)


def reported(force: np.ndarray, seed: int = 0, *, noise: float = 0.3, whole: bool = True) -> np.ndarray:
    """What a servo reports: the magnitude, smoothed, late, with noise, in whole numbers."""
    smooth, keeps = np.empty(force.size), np.exp(-1 / (RATE * LAG))
    now = abs(force[0])
    for k, value in enumerate(np.abs(force)):
        now = keeps * now + (1 - keeps) * value
        smooth[k] = now
    late = round(LATE * RATE)
    delayed = np.concatenate([np.full(late, smooth[0]), smooth[:-late]])
    noisy = np.maximum(GAIN * delayed + noise * np.random.default_rng(seed).standard_normal(force.size), 0.0)
    return np.round(noisy) if whole else noisy


@cache
def log(seed: int = 0) -> dict[str, np.ndarray]:
    """The servo of the tests without a force, with its force and its load."""
    run = servo(seed, force=True)
    return {**run, "load": reported(run["u"], seed)}


def identify(case: str, log: dict[str, np.ndarray]) -> jaxid.Identification:
    return jaxid.identify(tomllib.loads(case), log)


def said(result: jaxid.Identification | Estimate) -> dict:
    """The entry of the one effort, which must stand in a note too."""
    estimate = result if isinstance(result, Estimate) else result.estimate
    (entry,) = estimate.details["effort"]
    assert sum("effort" in note for note in estimate.notes) == 1
    return entry


def beside_a_force(log: dict[str, np.ndarray], keys: str = "") -> dict:
    """The entry of a load whose log holds the force, which needs no fit."""
    session = open_session(load_case(tomllib.loads(FORCED + COLUMN + keys)), log)
    machine = session.machine
    theta = np.asarray(machine.parameters.guess, float)
    precision = Precision.unknown(machine.parameters.names)
    estimate = Estimate("output_error", machine, theta, precision, True, "", np.zeros((1, 1)), 1)
    return said(with_effort(estimate, session, [None]))


def test_beside_a_force_the_gain_is_compared():
    """The load was made of the force in the log, so that its figures are those of the servo."""
    entry = beside_a_force(log(), f"effort_gain = {GAIN}")
    assert entry["use"] == "check"
    clean = reported(log()["u"], noise=0.0, whole=False)
    assert abs(entry["agreement"] - np.corrcoef(clean, log()["load"])[0, 1] ** 2) < 0.01
    for name, true in (("gain", GAIN), ("delay", LATE), ("lag", LAG)):
        assert abs(entry[name]["value"] - true) < 4 * entry[name]["std"], name
        assert entry[name]["std"] < 0.1 * true, name


def test_a_load_of_something_else_is_left_out():
    rng = np.random.default_rng(1)
    other = np.abs(np.convolve(rng.standard_normal(log()["t"].size + 999), np.ones(1000), "valid"))
    entry = beside_a_force({**log(), "load": other})
    assert entry["use"] == "nothing"
    assert "no better than chance" in entry["reason"]


def test_a_load_that_stands_still_is_left_out():
    entry = beside_a_force({**log(), "load": np.zeros(log()["t"].size)})
    assert entry["use"] == "nothing"
    assert "agreement" not in entry


def test_a_load_that_grows_like_the_square_has_no_one_gain():
    entry = beside_a_force({**log(), "load": log()["u"] ** 2})
    assert entry["use"] == "nothing"
    assert "faster than in proportion" in entry["reason"]


@pytest.mark.parametrize(
    ("keys", "what"),
    [
        ('effort = ["load", "u"]', "does not fit 1 drive"),
        ('effort = "Load"', "Load"),
        ('effort = "load"\neffort_gain = 0.0', "effort_gain"),
    ],
)
def test_an_effort_that_cannot_be_is_refused(keys, what):
    with pytest.raises(InputError, match=what):
        open_session(load_case(tomllib.loads(FORCED + keys)), log())


def test_the_scale_goes_into_values_and_covariance():
    """By the spread of drawn estimates whose scale depends on one of the unknowns."""
    machine = build_machine(load_case(tomllib.loads(FREE + COLUMN)))
    names = machine.parameters.names
    group = tuple(k for k, name in enumerate(names) if name != "controller.delay")
    base = names.index("inertia")
    held = without(machine, base)
    theta = np.asarray(held.parameters.guess, float)
    std = 0.02 * np.abs(theta)
    precision = Precision(np.diag(std**2), np.ones(theta.size, bool), [], np.ones(theta.size))
    estimate = Estimate("output_error", held, theta, precision, True, "", np.zeros((1, 1)), 1)
    scale = Scale(1.7, 0.03, np.array([0.5 / theta[0], *np.zeros(theta.size - 1)]))
    found = with_known_scale(estimate, machine, group, base, scale)

    rng = np.random.default_rng(0)
    draws = theta + std * rng.standard_normal((200_000, theta.size))
    factor = scale.factor + (draws - theta) @ scale.slopes + scale.std * rng.standard_normal(len(draws))
    whole = np.insert(draws, base, machine.parameters.guess[base], axis=1)
    whole[:, group] *= factor[:, None]
    assert np.all(found.identifiable)
    np.testing.assert_allclose(found.theta, np.mean(whole, axis=0), rtol=2e-3)
    size = np.sqrt(np.diag(np.cov(whole.T)))
    np.testing.assert_allclose(
        found.precision.covariance / np.outer(size, size), np.corrcoef(whole.T), atol=0.02
    )


@pytest.mark.slow
def test_a_known_gain_gives_the_scale_that_nothing_else_gives(tmp_path):
    result = identify(FREE + COLUMN + f"effort_gain = {GAIN}", log())
    entry = said(result)
    assert entry["use"] == "scale"
    for name, true in {**TRUE, "controller.kp": 2.0}.items():
        found = result.parameters[name]
        assert abs(found.value - true) < 4 * found.std, name
        assert found.std < 0.06 * true, name
    result.save(tmp_path)
    content = json.loads((tmp_path / "result.json").read_text())
    assert content["effort"] == [entry]
    assert content["unidentifiable"] == []
    assert "relative" not in content


@pytest.mark.slow
def test_without_its_gain_a_load_agrees_and_gives_no_scale():
    result = identify(FREE + COLUMN, log())
    entry = said(result)
    assert entry["use"] == "nothing"
    assert entry["agreement"] > 0.5 > entry["chance"]
    assert entry["gain"] is None
    assert "relative" in result.estimate.details


@pytest.mark.slow
def test_the_load_of_another_motion_gives_no_scale_although_its_gain_is_known():
    late = {**log(), "load": np.roll(log()["load"], 2500)}
    result = identify(FREE + COLUMN + f"effort_gain = {GAIN}", late)
    assert said(result)["use"] == "nothing"
    assert "relative" in result.estimate.details
