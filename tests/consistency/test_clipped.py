"""Clipped recordings of a force, beside forces that a drive limits; logs of the exact steppers."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.consistency.clipped import SEEMS, at_extremes
from jaxid.session import open_session
from truth.axis.hidden_effects import SEARCH_CASES


def clipped(log: dict, percent: float, channel: str = "u") -> dict:
    """Columns of a log whose force is recorded up to so many per cent of its rows."""
    range_ = np.percentile(np.abs(log[channel]), percent)
    return {**log, channel: np.clip(log[channel], -range_, range_)}


def said(session) -> list[str]:
    """Return the warnings on a clipped force."""
    return [f"{f.where}: {f.what}; {f.hint}" for f in session.findings if f.what.startswith(SEEMS)]


def drawn(machine: str, loop: str = "unknown", sensor: str = "not stated"):
    text, log, true = MACHINES[machine](1, loop, sensor)
    return tomllib.loads(text), log, true


def test_clipped_rows_are_left_out():
    case, log, true = drawn("axis")
    log = clipped(log, 95)
    rows = np.abs(log["u"]) >= np.abs(log["u"]).max() * (1 - 1e-12)
    found = jaxid.identify(case, log)
    np.testing.assert_array_equal(found.session.fit.log.clipped[:, 0], rows)
    assert found.estimate.converged
    assert found.model_complete
    z = (found.estimate.theta - [true[name] for name in found.estimate.names]) / found.estimate.std
    assert np.all(np.abs(z) < 3.0)
    share = f"{rows.sum()} rows ({100 * rows.mean():.2g} %)"
    assert found.findings[0] == f"{SEEMS.capitalize()} in {share}, which are left out."
    assert "record the force with a larger range" in said(found.session)[0]
    assert found.session.settings["clipped_force"]["value"] == f"{rows.sum()} rows"


def test_a_method_that_takes_every_row_says_so():
    case, log, _ = drawn("axis")
    found = jaxid.identify(case, clipped(log, 95), method="power")
    assert "power cannot leave them out, and its values may be off: use prediction_error" in found.findings[0]


def test_a_known_loop_makes_its_force_itself():
    case, log, _ = drawn("axis", "known", "stated")
    found = jaxid.identify(case, clipped(log, 95), method="output_error")
    assert found.session.fit.log.clipped is not None
    assert not any(SEEMS in text.lower() for text in found.findings)


def test_the_clipped_one_of_two_forces_is_named():
    case, log, _ = drawn("arm")
    session = open_session(case, clipped(log, 93, "u2"), method="inverse_dynamics")
    assert said(session)[0].startswith("arrays, force 2: ")
    assert not session.fit.log.clipped[:, 0].any()
    assert session.fit.log.clipped[:, 1].mean() == pytest.approx(0.07, abs=0.01)


def test_logs_to_validate_on_lose_the_same_level():
    case, log, _ = drawn("axis")
    log = clipped(log, 95)
    session = open_session(case, log, [log], method="inverse_dynamics")
    (other,) = session.validations
    np.testing.assert_array_equal(other.log.clipped, session.fit.log.clipped)
    np.testing.assert_array_equal(other.data.moving, session.fit.data.moving)


@pytest.mark.parametrize("machine", ["axis", "arm", "stage"])
def test_a_whole_force_is_not_clipped(machine):
    case, log, _ = drawn(machine)
    assert not said(open_session(case, log, method="inverse_dynamics"))


def test_a_coarse_force_is_not_clipped():
    case, log, _ = drawn("axis")
    step = np.abs(log["u"]).max() / 8
    log = log | {"u": np.round(log["u"] / step) * step}
    assert not said(open_session(case, log, method="inverse_dynamics"))


# A hidden saturation holds the loop at its limit for most of the log.
LIMITED = [kind for kind in SEARCH_CASES if kind != "saturation"]


@pytest.mark.parametrize("kind", LIMITED)
def test_a_drive_that_reaches_its_limit_is_not_clipped(kind):
    """The case lacks an effect of the machine; the force is logged without noise, so that it has plateaus."""
    row = replace(SEARCH_CASES[kind], duration=4.0)
    setup = row.setup(1)
    setup = replace(setup, sensor=replace(setup.sensor, force_noise=0.0))
    most = np.abs(setup.run()["force"]).max()
    run = replace(setup, loop=replace(setup.loop, limit=0.9 * most)).run()
    stands = at_extremes(np.reshape(run["force"], (-1, 1))).any(axis=0)
    assert 0.001 < stands.mean() < 0.25
    case = tomllib.loads(row.text())
    case = {name: case[name] for name in ("plant", "effects", "actuator") if name in case}
    case["log"] = {"time": "t", "position": "q", "force": "u"}
    columns = {"t": run["t"], "q": run["position"], "u": run["force"]}
    assert not said(open_session(case, columns, method="inverse_dynamics"))


@pytest.mark.slow
def test_a_search_names_what_is_hidden_and_not_the_clipping():
    case, log, _ = drawn("axis")
    for percent in (99, 97, 90):
        found = jaxid.discover(case, clipped(log, percent))
        assert found.verdict == "nothing_missing"
        assert found.model_complete
    case["effects"] = [e for e in case["effects"] if e["kind"] != "viscous_friction"]
    found = jaxid.discover(case, clipped(log, 97))
    assert found.kinds == ["viscous_friction"]
