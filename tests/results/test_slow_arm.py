"""Arms whose loop is faster than their log: intervals, and the verdict on a complete model."""

import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.session import open_session
from truth.arm.slow_logs import slow_arm


@pytest.mark.parametrize("seed", [4, 7])
def test_a_complete_arm_is_complete(seed):
    """The filter's band ends far below half the rate of the kept samples; beyond it there is no noise."""
    text, log, true = slow_arm(seed, 200.0)
    found = jaxid.identify(tomllib.loads(text), log)
    assert found.model_complete is True
    fit = found.estimate
    assert fit.method == "inverse_dynamics"
    for name, value, std in zip(fit.names, fit.theta, fit.std, strict=True):
        assert abs(value - true[name]) < 3.5 * std, name


def test_an_arm_that_lacks_a_friction_is_incomplete():
    text, log, _ = slow_arm(4, 200.0)
    case = tomllib.loads(text)
    case["effects"] = [e for e in case["effects"] if e["kind"] != "coulomb_friction"]
    assert jaxid.identify(case, log).model_complete is False


@pytest.mark.parametrize("noise", [1000, 1002, 1004])
def test_one_drive_shows_that_the_loop_is_faster(noise):
    """Motion in the high band hides half of it, and all of it at the other drive."""
    text, log, _ = slow_arm(3, 100.0, noise)
    session = open_session(tomllib.loads(text), log)
    assert session.fit.data.faster_loop
    assert np.all(session.fit.data.answer < 0)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100.0, 200.0, 500.0])
def test_intervals_of_slow_arms_hold(rate):
    runs = [slow_arm(seed, rate) for seed in range(10, 50)]
    fits = jaxid.identify_many([tomllib.loads(text) for text, *_ in runs], [log for _, log, _ in runs])
    z = []
    for fit, (_, _, true) in zip(fits, runs, strict=True):
        assert not isinstance(fit, Exception), fit
        z += [
            (value - true[name]) / std for name, value, std in zip(fit.names, fit.theta, fit.std, strict=True)
        ]
    # Of 360 draws at 95 % at least 92 % hold in 99 of 100 cases.
    assert np.mean(np.abs(z) < 1.96) >= 0.92
