"""A force whose zero drifts, held against effects found in its place; logs of the exact stepper."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.consistency.slow_force import SlowForce, slow_force
from jaxid.session import open_session
from truth.axis.hidden_effects import SEARCH_CASES

# Drifts of the force in units of the command, by time over the length of the log.
DRIFTS = {
    "ramp": lambda s: 0.2 * s,
    "warming up": lambda s: 0.3 * (1 - np.exp(-3 * s)),
    "swing": lambda s: 0.1 * np.sin(2 * np.pi * 0.75 * s + 1),
}


def drawn(drift=None):
    text, log, _ = MACHINES["axis"](3, "unknown", "not stated")
    if drift is not None:
        log = log | {"u": log["u"] + DRIFTS[drift](log["t"] / log["t"][-1])}
    return tomllib.loads(text), log


def held(case: dict, log: dict, *effects: dict) -> SlowForce | None:
    """Hold a slow force against effects, all of which the balance fits."""
    named = [effect["kind"] for effect in effects]
    plain = open_session(case, log, method="discover")
    whole = open_session(case | {"effects": [*case["effects"], *effects]}, log, method="discover")
    unknowns = len(whole.machine.parameters.free) - len(plain.machine.parameters.free)
    return slow_force(plain.machine, whole.machine, plain.fit.data, named, unknowns)


FOUND = (
    {"kind": "constant_force", "level": {"guess": 1.0}},
    {"kind": "linear_stiffness", "coefficient": {"guess": 10.0}},
    {"kind": "friction_drift", "rate": {"guess": 0.01}},
)


@pytest.mark.parametrize("drift", list(DRIFTS))
def test_a_drift_is_not_taken_for_springs(drift):
    found = held(*drawn(drift), *FOUND)
    assert found is not None
    assert found.degree <= 4
    assert found.gap[0] < 0.32 < found.rival[0]
    assert found.findings[0].startswith("The force seems to drift: a slow course of time")


def test_a_complete_model_has_no_drift():
    assert held(*drawn(), *FOUND) is None


@pytest.mark.parametrize("duration", [3.0, pytest.param(8.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", list(SEARCH_CASES))
def test_a_missing_effect_is_no_drift(kind, duration):
    row = replace(SEARCH_CASES[kind], duration=duration)
    case, run = tomllib.loads(row.text()), row.setup(1).run()
    case = {name: case[name] for name in ("plant", "effects", "actuator") if name in case}
    case["log"] = {"time": "t", "position": "q", "force": "u"}
    log = {"t": run["t"], "q": run["position"], "u": run["force"]}
    effects = [{"kind": kind, **row.values}, *({"kind": k, **values} for k, values in row.extra.items())]
    assert held(case, log, *effects) is None


@pytest.mark.slow
@pytest.mark.parametrize("drift", list(DRIFTS))
def test_a_search_says_first_that_the_force_drifts(drift):
    found = jaxid.discover(*drawn(drift))
    assert isinstance(found.force_reading, SlowForce)
    assert found.findings[0].startswith("The force seems to drift")
    assert not found.model_complete


@pytest.mark.slow
def test_a_force_that_wanders_is_called_unexplained():
    """Models that diverge on a playback of an experiment give no evidence, and no warning."""
    case, log = drawn()
    walk = 0.02 * np.cumsum(np.random.default_rng(0).standard_normal(len(log["t"])))
    found = jaxid.discover(case, log | {"u": log["u"] + walk})
    assert found.model_complete is False
