"""A loop that jerks from rest at a log's first sample: a line through the first readings is no velocity."""

import numpy as np

import jaxid
from jaxid.simulation.replay import start_shows
from truth.axis import stepper
from truth.chain.flexible_axes import RIGID

RATE = 200.0
TRUE = {"inertia": 90.0, "viscous_friction.coefficient": 200.0, "coulomb_friction.level": 20.0}
CASE = (
    RIGID
    + """[log]
time = "t"
position = "q"
force = "u"
reference = "ref"
[controller]
kind = "pd"
kp = 2e4
kd = 1e3
period = 0.005
[sensor]
position_resolution = 1e-6
"""
)


def test_a_long_log_that_starts_with_a_jerk_is_simulated_from_rest(tmp_path):
    machine = stepper.Machine(
        TRUE["inertia"],
        {
            "viscous_friction": {"coefficient": TRUE["viscous_friction.coefficient"]},
            "coulomb_friction": {"level": TRUE["coulomb_friction.level"]},
        },
    )
    t = np.arange(3000) / RATE
    reference = 0.1 * np.sin(2 * np.pi * 0.7 * t) + 0.02 * np.sin(2 * np.pi * 2.3 * t)
    loop = stepper.Loop("pd", reference=reference, kp=2e4, kd=1e3)
    log = stepper.simulate(machine, loop, stepper.Sensor(1e-6), rate=RATE, duration=t.size / RATE)
    assert log["true_velocity"][0] == 0.0
    stepper.write_csv(log, tmp_path / "log.csv")
    (tmp_path / "case.toml").write_text(CASE)
    found = jaxid.identify(tmp_path / "case.toml", tmp_path / "log.csv", method="output_error")
    for name, value, std in zip(found.estimate.names, found.estimate.theta, found.estimate.std, strict=True):
        assert abs(value - TRUE[name]) < 1e-3 * TRUE[name], name
        assert abs(value - TRUE[name]) < 4 * std, name
    # What is left is the reading's rounding.
    assert found.gaps[0].simulation.rms[0] < 1e-6


def test_a_start_shows_where_the_first_samples_are_far_off():
    e = np.ones((1000, 2))
    e[:, 1] = np.nan
    assert not start_shows(e)
    e[:20] = 12.0
    assert start_shows(e)
    e[500:] = 12.0
    assert not start_shows(e)
