"""A load column beside a loop without a force: what it says, and when it gives the scale."""

import tomllib

import numpy as np
import pytest

import jaxid
from tests.estimators.test_unforced import FREE, RATE, TRUE
from tests.estimators.test_unforced import log as servo

GAIN, LATE, LAG = 40.0, 0.025, 0.04  # per N m; s; s
COLUMN = '\neffort = "load"\n'


def reported(force: np.ndarray, seed: int = 0) -> np.ndarray:
    """What a servo reports: the magnitude, smoothed, late, with noise, in whole numbers."""
    smooth, keeps = np.empty(force.size), np.exp(-1 / (RATE * LAG))
    now = abs(force[0])
    for k, value in enumerate(np.abs(force)):
        now = keeps * now + (1 - keeps) * value
        smooth[k] = now
    late = round(LATE * RATE)
    delayed = np.concatenate([np.full(late, smooth[0]), smooth[:-late]])
    noise = 0.3 * np.random.default_rng(seed).standard_normal(force.size)
    return np.round(np.maximum(GAIN * delayed + noise, 0.0))


def log(seed: int = 0, **more: dict) -> dict[str, np.ndarray]:
    """The servo of the tests without a force, and its load."""
    run = servo(seed, force=True, **more)
    return {**{k: run[k] for k in ("t", "q", "r")}, "load": reported(run["u"], seed)}


@pytest.mark.slow
def test_a_known_gain_gives_the_scale_that_nothing_else_gives():
    result = jaxid.identify(tomllib.loads(FREE + COLUMN + f"effort_gain = {GAIN}"), log())
    print(result)
    for name, true in {**TRUE, "controller.kp": 2.0}.items():
        found = result.parameters[name]
        assert abs(found.value - true) < 4 * found.std, name
        assert found.std < 0.06 * true, name
