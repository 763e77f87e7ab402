"""A ripple of many periods whose period is known well and its phase not at all."""

import tomllib

import numpy as np
import pytest

import jaxid
from tests.consistency.test_noise import EFFECTS, setup
from truth.axis.cases import case_text

# 95 periods along the stroke of 0.38 m.
RIPPLE = {"amplitude": 30.0, "period": 4e-3, "phase": 2.2}


@pytest.fixture(scope="module")
def log() -> dict[str, np.ndarray]:
    run = setup(noise=0.0).with_effect("cogging", **RIPPLE).run()
    return {column: run[field] for column, field in {"t": "t", "q": "position", "u": "force"}.items()}


@pytest.mark.parametrize("phase", [2.2, 2.2 - np.pi, 0.0])
def test_the_ripple_is_found_from_any_phase(log, phase):
    case = tomllib.loads(case_text(setup(), tuple(EFFECTS.items()), sensor=False, closed=False))
    guess = {"amplitude": {"guess": 10.0}, "period": {"guess": 4e-3}, "phase": {"guess": phase}}
    case["effects"].append({"kind": "cogging", **guess})
    case["preprocess"] = {"cutoff_hz": 200.0, "order": 4, "decimation": 1, "trim": 100, "rest_velocity": 1e-3}
    found = jaxid.identify(case, log, method="inverse_dynamics").estimate
    assert found.value("cogging.period") == pytest.approx(RIPPLE["period"], rel=1e-4)
    assert found.value("cogging.amplitude") == pytest.approx(RIPPLE["amplitude"], rel=0.03)
    assert np.cos(found.value("cogging.phase") - RIPPLE["phase"]) > 0.99
