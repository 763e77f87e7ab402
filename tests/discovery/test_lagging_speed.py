"""A DC motor under steps of voltage, whose drive filters the speed that it reports.

To a model the filter is a lag of the drive: both delay the speed behind the voltage.
"""

import numpy as np
import pytest
from scipy.signal import lfilter

import jaxid
from truth.axis.machines import Setup
from truth.axis.stepper import Loop, Machine, Sensor

# kg m^2, N m s/rad, N m; the filter's time constant in s.
TRUE = {"inertia": 2e-4, "viscous_friction.coefficient": 3e-3, "coulomb_friction.level": 4e-3}
LAG, NOISE = 0.02, 0.05
# Samples a second of the log; the filter runs this many times as fast.
RATE, FINER, SECONDS = 200.0, 25, 10.0

CASE = """
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = { guess = 4e-4 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 1e-3 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 1e-3 }
[log]
time = "t"
velocity = "w"
force = "u"
"""


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    path = tmp_path_factory.mktemp("motor") / "case.toml"
    path.write_text(CASE)
    return path


def record(lag: float) -> dict[str, np.ndarray]:
    """Record ten seconds of random steps, each of a quarter of a second."""
    rate = RATE * FINER
    steps = np.random.default_rng(3).uniform(-0.1, 0.1, round(4 * SECONDS))
    effects = {
        "viscous_friction": {"coefficient": TRUE["viscous_friction.coefficient"]},
        "coulomb_friction": {"level": TRUE["coulomb_friction.level"]},
    }
    law = Loop(kind="open_loop", input=np.repeat(steps, round(0.25 * rate)))
    machine = Machine(inertia=TRUE["inertia"], effects=effects)
    run = Setup(machine, law, Sensor(0.0, 0.0, 0.0), rate=rate, duration=SECONDS, seed=1).run()

    speed = run["true_velocity"]
    if lag:
        keeps = np.exp(-1 / (rate * lag))
        speed = lfilter([1 - keeps], [1.0, -keeps], speed)
    noise = NOISE * np.random.default_rng(5).standard_normal(len(speed[::FINER]))
    return {"t": run["t"][::FINER], "w": speed[::FINER] + noise, "u": run["force"][::FINER]}


@pytest.mark.slow
def test_values_of_a_lagging_speed_are_said_to_be_of_an_incomplete_model(case):
    found = jaxid.identify(case, record(LAG))
    assert found.model_complete is False
    assert str(found).startswith("The model is incomplete")
    assert found.estimate.theta[0] > 1.2 * TRUE["inertia"], "the lag looks like inertia"


@pytest.mark.slow
def test_the_lag_is_named_alone_with_its_time(case):
    found = jaxid.discover(case, record(LAG))
    assert found.kinds == ["actuator_lag"]
    assert found.after.value("actuator_lag.time_constant") == pytest.approx(LAG, rel=0.03)
    for name, true in TRUE.items():
        assert found.after.value(name) == pytest.approx(true, rel=0.05)


@pytest.mark.slow
def test_a_speed_without_a_lag_gets_none(case):
    assert jaxid.discover(case, record(0.0)).verdict == "nothing_missing"
