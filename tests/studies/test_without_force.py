"""Studies of servos whose logs hold a command and an encoder, and no force."""

import tomllib

import numpy as np
import pytest

import jaxid
from jaxid.case.case import load_case
from jaxid.errors import InputError
from jaxid.scene import Scene

SERVO = """
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = { guess = 0.004, true = 0.0025 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 0.02, true = 0.008 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 0.01, true = 0.03 }
[controller]
kind = "pd"
kp = 1.5
kd = { guess = 0.2, true = 0.1 }
delay = { guess = 0.01, true = 0.02 }
period = 0.004
[sensor]
position_noise = 2e-4
position_resolution = 0.0015339807878856412
[log]
time = "t"
position = "q"
reference = "r"
reference_hold = "zero_order"
[reference]
kind = "trapezoid"
targets = [0.8, -0.5, 0.9, 0.0]
speed = 2.0
acceleration = 30.0
[simulation]
sample_rate = 250.0
duration = 3.0
[study]
draw = 0.1
"""


def servo(**tables: dict) -> dict:
    case = tomllib.loads(SERVO)
    for name, values in tables.items():
        case[name] |= values
    return case


def test_a_servo_is_identified_from_its_positions():
    table = jaxid.study(servo(), runs=3).table.isel(estimator=0, noise=0)
    assert np.all(table["converged"])
    estimate, std, truth = (np.asarray(table[name]) for name in ("estimate", "std", "truth"))
    assert np.ptp(truth, axis=0).min() > 0
    assert np.all(np.abs(estimate - truth) < 4 * std)
    assert np.all(np.abs(estimate / truth - 1) < 0.1)
    # The command is not known exactly, so that no bound holds.
    assert np.all(np.isnan(table["bound"]))


def test_a_method_that_needs_a_force_is_refused_before_any_run():
    with pytest.raises(InputError, match=r"inverse_dynamics needs a force, and \[log\] names none"):
        jaxid.study(servo(study={"estimators": ["output_error", "inverse_dynamics"]}), runs=2)


@pytest.mark.parametrize("hold", ["zero_order", "linear"])
def test_a_command_that_is_slower_than_its_loop_is_simulated_as_stated(hold):
    case = servo(simulation={"sample_rate": 50.0}, log={"reference_hold": hold})
    signal = Scene.of(load_case(case)).signal[:, 0]
    rows = signal[::5]
    between = signal[: 5 * (len(rows) - 1)].reshape(-1, 5)
    if hold == "zero_order":
        np.testing.assert_array_equal(between, np.repeat(rows[:-1, None], 5, axis=1))
    else:
        steps = np.arange(5) / 5
        np.testing.assert_allclose(between, rows[:-1, None] + steps * np.diff(rows)[:, None], atol=1e-12)
    case["log"]["reference_hold"] = "band_limited"
    assert np.abs(Scene.of(load_case(case)).signal[:, 0] - signal).max() > 1e-3


def test_gains_may_be_unknown_beside_a_force():
    case = servo()
    del case["log"]
    table = jaxid.study(case, runs=2).table
    assert np.all(table["converged"])
    assert np.all(np.isnan(table["bound"]))
