"""A fit that needs more noise of the force than its log shows is not called complete."""

import dataclasses
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from jaxid.results.verdict.needed_noise import needed_noise
from jaxid.session import open_session
from truth.axis.cases import case_text
from truth.axis.machines import Setup
from truth.axis.stepper import Loop, Machine, Sensor

# A small DC motor with an encoder of 2000 counts under random steps of its duty cycle, at 100 Hz.
RATE, SECONDS = 100.0, 15.0
EFFECTS = {"viscous_friction": {"coefficient": 2e-4}, "coulomb_friction": {"level": 2e-3}}
DUTY = np.round(np.random.default_rng(3).uniform(-255, 255, round(2 * SECONDS)))
MOTOR = Setup(
    Machine(inertia=3e-5, effects=EFFECTS, actuator_gain=6e-5),
    Loop(kind="open_loop", input=np.repeat(DUTY, round(RATE / 2))),
    Sensor(position_resolution=2 * np.pi / 2000),
    rate=RATE,
    duration=SECONDS,
    seed=1,
)
LAG = {"actuator_lag": {"time_constant": 8e-3}}


def case_and_log(setup: Setup, noise: float = 0.0) -> tuple[dict, dict[str, np.ndarray]]:
    run = setup.run()
    text = case_text(MOTOR, tuple(EFFECTS.items()), motion="rotary", sensor=False, closed=False)
    noisy = run["force"] + noise * np.random.default_rng(0).standard_normal(len(run["t"]))
    return tomllib.loads(text), {"t": run["t"], "q": run["position"], "u": noisy}


@pytest.mark.parametrize(("needed", "named"), [(1.5, False), (6.0, True)])
def test_three_times_the_noise_of_the_log_is_named(needed, named):
    case, log = case_and_log(MOTOR, noise=1.0)
    session = open_session(case, log)
    assert session.fit.data.force_noise == pytest.approx(1.0, rel=0.1)
    fit = {"method": "prediction_error", "machine": session.machine}
    details = {"noise": {"force": np.array([needed])}}
    clause = needed_noise(session, SimpleNamespace(**fit, details=details))
    assert clause.startswith("the fit needs noise of force with a standard deviation of") == named
    assert bool(clause) == named


@pytest.mark.slow
def test_a_lag_that_passes_for_a_delay_is_not_complete():
    """The inertia is ten standard deviations off: the fit needs six times the noise of a rounded duty."""
    lagging = dataclasses.replace(MOTOR.machine, effects=EFFECTS | LAG)
    case, log = case_and_log(dataclasses.replace(MOTOR, machine=lagging))
    fitted = jaxid.identify(case, log)
    assert fitted.model_complete is not True
    noise = {"noise": {"force": fitted.estimate.details["noise"]["force"]}}
    fit = SimpleNamespace(method="prediction_error", machine=fitted.estimate.machine, details=noise)
    assert "the log shows at most 0.289 in the units of its column" in needed_noise(fitted.session, fit)

    found = jaxid.discover(case, log)
    assert found.kinds == ["actuator_lag"]
    assert found.model_complete is True
    assert found.after.value("inertia") == pytest.approx(3e-5, rel=1e-3)


@pytest.mark.slow
def test_the_motor_without_a_lag_is_complete():
    fitted = jaxid.identify(*case_and_log(MOTOR))
    assert fitted.model_complete is True
    assert np.all(np.abs(fitted.estimate.theta - [3e-5, 2e-4, 2e-3]) < 3.5 * fitted.estimate.std)
