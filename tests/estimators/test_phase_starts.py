"""A ripple of many periods whose period is known well and its phase not at all, or within a few turns."""

import tomllib

import numpy as np
import pytest

import jaxid
from tests.consistency.test_noise import EFFECTS, setup
from truth.axis.cases import case_text
from truth.axis.machines import Setup
from truth.axis.stepper import Loop, Machine, Sensor

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


@pytest.mark.parametrize("more", [-2, 1])
def test_a_ripple_is_found_from_a_period_with_turns_too_many(more):
    """A motor turns fast within its stroke, where the ripple lies beyond the band, and slowly at its ends.

    A turn more or less over the stroke is right at both ends.
    """
    rate, period = 200.0, 2 * np.pi / 7
    t = np.arange(round(15 * rate)) / rate
    ripple = {"amplitude": 1e-3, "period": period, "phase": 0.4}
    friction = {"viscous_friction": {"coefficient": 2e-4}, "coulomb_friction": {"level": 2e-3}}
    motor = Setup(
        Machine(inertia=3e-5, effects=friction | {"cogging": ripple}, actuator_gain=6e-5),
        Loop(kind="open_loop", input=510 / np.pi * np.arcsin(np.sin(0.4 * np.pi * t))),
        Sensor(position_resolution=2 * np.pi / 2000),
        rate=rate,
        duration=15.0,
        seed=1,
    )
    run = motor.run()
    turns = np.ptp(run["position"]) / period
    text = case_text(motor, tuple(friction.items()), motion="rotary", sensor=False, closed=False)
    case = tomllib.loads(text)
    guess = {"amplitude": 5e-4, "period": period * turns / (turns + more), "phase": 0.0}
    case["effects"].append({"kind": "cogging"} | {name: {"guess": value} for name, value in guess.items()})
    log = {column: run[field] for column, field in {"t": "t", "q": "position", "u": "force"}.items()}

    found = jaxid.identify(case, log, method="inverse_dynamics").estimate
    assert found.value("cogging.period") == pytest.approx(period, rel=1e-4)
    assert found.value("cogging.amplitude") == pytest.approx(1e-3, rel=0.03)
