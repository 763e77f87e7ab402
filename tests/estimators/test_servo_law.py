"""Servos whose derivative acts on the error or on the velocity, which the case does not state."""

import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid
from jaxid.estimators import servo_law
from jaxid.results.found_case import case_text
from truth.axis.machines import multisine
from truth.axis.stepper import Loop, Machine, Sensor, simulate

RATE, EVERY, SECONDS = 500.0, 10, 8.0
TRUE = {
    "viscous_friction.coefficient": 0.02,
    "coulomb_friction.level": 0.12,
    "controller.kp": 6.0,
    "controller.kd": 0.12,
    "controller.delay": 0.024,
}
LAWS = {
    "error": {"kind": "pd", "kp": 6.0, "kd": 0.12},
    "velocity": {"kind": "cascade_pd", "kp": 50.0, "kv": 0.12},
}
CASE = """
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = 4e-3
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 0.05 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 0.05 }
[controller]
kind = "pd"
kp = { guess = 3.0 }
kd = { guess = 0.3 }
delay = { guess = 0.01 }
period = 0.002
[log]
time = "t"
position = "q"
reference = "r"
reference_hold = "zero_order"
"""


def log(law: str, seed: int) -> dict[str, np.ndarray]:
    """A servo of 4096 counts and 500 Hz on the exact stepper, with a command every tenth tick."""
    time = np.arange(round(SECONDS * RATE / EVERY)) * EVERY / RATE
    command = multisine(time, [0.3, 0.9, 1.7, 3.1], 0.35, seed) * np.minimum(time, 1.0)
    effects = {
        "viscous_friction": {"coefficient": 0.02},
        "coulomb_friction": {"level": 0.12},
        "command_delay": {"delay": 0.024},
    }
    run = simulate(
        Machine(4e-3, effects),
        Loop(**LAWS[law], reference=np.repeat(command, EVERY)),
        Sensor(position_resolution=2 * np.pi / 4096, position_noise=2e-4),
        rate=RATE,
        duration=SECONDS,
        seed=seed,
        step=5e-6,
        log_rate=RATE / EVERY,
        initial_position=float(command[0]),
    )
    return {"t": run["t"], "q": run["position"], "r": command}


def test_a_joint_at_rest_hides_none_that_moves(monkeypatch):
    """Readings that do not count have no residual."""
    monkeypatch.setattr(servo_law, "position_noise", lambda machine, log: np.array([1.0, 0.5]))
    arm = SimpleNamespace(
        log=SimpleNamespace(samples=4, measured=(True, True)), machine=lambda machine: machine
    )
    session = SimpleNamespace(fits=[arm], machine=None)
    fit = SimpleNamespace(residual=np.array([[np.nan, 1.5]] * 4))
    assert servo_law._over_noise(session, fit) == 3.0
    assert servo_law.leaves_far_more_than_noise(session, fit)


CASES = [(law, seed) for law in LAWS for seed in range(4)]


@pytest.mark.parametrize(
    ("law", "seed"), [c if c == ("velocity", 1) else pytest.param(*c, marks=pytest.mark.slow) for c in CASES]
)
def test_intervals_hold_whatever_the_derivative_acts_on(law, seed, tmp_path):
    """A derivative of the velocity was taken for viscous friction: up to 126 sigma, called complete."""
    result = jaxid.identify(tomllib.loads(CASE), log(law, seed))
    assert result.model_complete is True
    for name, true in TRUE.items():
        found = result.parameters[name]
        assert abs(found.value - true) < 3 * found.std, name

    gain = result.parameters["controller.kd"]
    if law == "error":
        assert gain.std < 0.05 * gain.value
        assert "derivative" not in result.settings
    else:
        assert "the 95 % intervals hold the values of both" in result.settings["derivative"]["reason"]
        assert any("does not state its derivative: 'velocity'" in note for note in result.estimate.notes)
        assert tomllib.loads(case_text(result, tmp_path))["controller"]["derivative"] == "velocity"


@pytest.mark.slow
@pytest.mark.parametrize("law", LAWS)
def test_nothing_is_missing_whatever_the_derivative_acts_on(law):
    """A derivative of the error, declared as one of the velocity, was named joint_flexibility."""
    found = jaxid.discover(tomllib.loads(CASE), log(law, 0))
    assert found.verdict == "nothing_missing"
    assert found.model_complete is True


@pytest.mark.slow
def test_a_stated_law_that_the_log_contradicts_is_said_first():
    """Its search names an effect that is not there, after a sentence on the law."""
    stated = tomllib.loads(CASE.replace('kind = "pd"', 'kind = "pd"\nderivative = "velocity"'))
    result = jaxid.identify(stated, log("error", 0))
    assert result.model_complete is False
    first = "With derivative = 'error' in place of the stated 'velocity' the fitted loop leaves"
    assert result.findings[0].startswith(first)
    found = jaxid.discover(stated, log("error", 0))
    assert found.findings[0] == result.findings[0]
    right = jaxid.identify(stated, log("velocity", 0))
    assert not any("With derivative" in line for line in right.findings)
