"""A fan drive as a PLC logs it at 20 Hz: speed in rpm, torque in per cent, no sensor stated."""

import numpy as np
import pytest

import jaxid
from truth.axis.machines import Setup, moves
from truth.axis.stepper import Loop, Machine, Sensor

RATE, EVERY, SECONDS, RATED = 1000.0, 50, 60.0, 40.0
EFFECTS = {
    "viscous_friction": {"coefficient": 0.01},
    "coulomb_friction": {"level": 2.0},
    "quadratic_drag": {"coefficient": 4e-4},
}

CASE = """
[plant]
kind = "axis"
motion = "rotary"
[plant.parameters]
inertia = { guess = 0.1 }
[[effects]]
kind = "viscous_friction"
coefficient = { guess = 0.05 }
[[effects]]
kind = "coulomb_friction"
level = { guess = 1.0 }
[actuator]
gain = 0.4
[log]
time = "t"
velocity = "speed"
force = "torque"
units = { velocity = "rpm", force = "%" }
"""


def record(drag: bool) -> dict[str, np.ndarray]:
    """Record speeds of up to 150 rad/s both ways, in a loop at 1 kHz that is not declared."""
    t = np.arange(round(RATE * SECONDS)) / RATE
    reference = moves(
        t, [0.0, 400.0, 900.0, 250.0, 700.0], [60.0, 140.0, 100.0, 150.0, 120.0], 150.0, rest=0.3
    )
    law = Loop(kind="cascade_pd", kp=6.0, kv=1.2, velocity_average=4, limit=60.0, reference=reference)
    effects = {kind: values for kind, values in EFFECTS.items() if drag or kind != "quadratic_drag"}
    read = Sensor(position_resolution=2 * np.pi / 65536)
    run = Setup(Machine(inertia=0.08, effects=effects), law, read, rate=RATE, duration=SECONDS, seed=4).run()

    rng = np.random.default_rng(7)
    speed, torque = run["true_velocity"][::EVERY] * 30 / np.pi, 100 * run["force"][::EVERY] / RATED
    return {
        "t": run["t"][::EVERY],
        "speed": np.round(speed + 0.5 * rng.standard_normal(speed.size)),
        "torque": np.round(torque + 0.25 * rng.standard_normal(torque.size), 1),
    }


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    path = tmp_path_factory.mktemp("plc") / "case.toml"
    path.write_text(CASE)
    return path


@pytest.mark.slow
def test_the_drag_of_the_fan_is_named_with_its_value(case):
    found = jaxid.discover(case, record(drag=True))
    assert found.kinds == ["quadratic_drag"]
    assert found.after.value("quadratic_drag.coefficient") == pytest.approx(4e-4, rel=0.05)
    assert found.after.value("inertia") == pytest.approx(0.08, rel=0.02)


@pytest.mark.slow
def test_nothing_is_named_without_a_fan(case):
    found = jaxid.discover(case, record(drag=False))
    assert found.kinds == []
    assert found.verdict == "nothing_missing"
