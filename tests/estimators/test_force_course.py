"""Course of a force between samples, chosen by the likelihood: logs at 200 Hz of the exact stepper."""

import tomllib

import numpy as np
import pytest

import jaxid
from truth.axis.cases import case_text
from truth.axis.machines import Setup
from truth.axis.stepper import Loop, Machine, Sensor

RATE, FINE, SECONDS = 200.0, 20_000.0, 5.0
# Noise of the encoder under which the two courses are the same [rad].
NOISY = 2e-3
TRUE = {"viscous_friction": {"coefficient": 0.15}, "coulomb_friction": {"level": 0.4}}
VALUES = {"inertia": 0.05, "viscous_friction.coefficient": 0.15, "coulomb_friction.level": 0.4}


def smooth(t: np.ndarray) -> np.ndarray:
    """Return a force of two sines, of 0.4 and 2.3 Hz."""
    return 2.0 * np.sin(2 * np.pi * 0.4 * t) + 1.2 * np.sin(2 * np.pi * 2.3 * t)


def identified(rate: float, hold: str | None = None, noise: float = 5e-5):
    """Fit a log whose force is joined by lines at a rate: far above that of the log it is a curve."""
    t = np.arange(round(SECONDS * rate)) / rate
    loop = Loop(input=smooth(t), hold="linear")
    sensor = Sensor(position_resolution=1e-4, position_noise=noise)
    setup = Setup(Machine(0.05, TRUE), loop, sensor, rate, SECONDS, seed=3)
    run = setup.run(log_rate=RATE)
    text = case_text(setup, tuple(TRUE.items()), motion="rotary", sensor=False)
    stated = "[log]\n" if hold is None else f'[log]\nhold = "{hold}"\n'
    columns = {"t": run["t"], "q": run["position"], "u": run["force"]}
    case = text.replace("[log]\n", stated) + "\n[sensor]\nposition_resolution = 1e-4\n"
    return jaxid.identify(tomllib.loads(case), columns)


def deviations(found) -> np.ndarray:
    estimate = found.estimate
    truth = np.array([VALUES[name] for name in estimate.names])
    return np.abs(estimate.theta - truth) / estimate.std


def test_a_smooth_force_is_recognised():
    found = identified(FINE)
    assert found.estimate.method == "prediction_error"
    assert found.session.settings["hold"]["value"] == "band_limited"
    assert found.session.fit.log.hold == found.estimate.machine.hold == "band_limited"
    assert "'band_limited' is used" in found.session.findings[-1].what
    assert deviations(found).max() < 3.0

    by_lines = identified(FINE, "linear")
    assert deviations(by_lines).max() > 5.0


def test_a_force_of_lines_keeps_them():
    found = identified(RATE)
    assert found.session.settings["hold"]["value"] == found.estimate.machine.hold == "linear"
    assert "'linear' is used" in found.session.findings[-1].what
    assert deviations(found).max() < 3.0


@pytest.mark.slow
def test_where_both_explain_the_log_the_intervals_hold_both():
    found = identified(FINE, noise=NOISY)
    assert found.session.settings["hold"]["value"] == "linear"
    assert any("lines or a smooth curve" in note for note in found.estimate.notes)

    other = identified(FINE, "band_limited", NOISY).estimate
    away = np.abs(other.theta - found.estimate.theta)
    assert np.all(away <= 1.96 * found.estimate.std)
    assert np.all(found.estimate.std > identified(FINE, "linear", NOISY).estimate.std)


def test_an_estimate_holds_other_values():
    estimate = identified(FINE, "band_limited").estimate
    far = estimate.theta + 10 * estimate.std
    wider = estimate.holding(estimate.theta, far)
    assert 1.96 * wider.std == pytest.approx(far - estimate.theta + 1.96 * estimate.std)
    assert estimate.holding() is estimate
