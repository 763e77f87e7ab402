"""The servo in closed form between its ticks, against the stepped axis and against energy."""

import numpy as np
import pytest

from truth.axis.held_loop import Servo, drawn, log_of
from truth.axis.machines import Loop, Machine, Sensor, Setup


def test_positions_are_those_of_the_stepped_axis():
    """The same servo with differenced positions, whose law is that of a cascade."""
    servo, target = drawn(3, 10, own_velocity=False, rows=100)
    ours = log_of(servo, target, 1)
    effects = {
        "viscous_friction": {"coefficient": servo.viscous},
        "coulomb_friction": {"level": servo.coulomb},
    }
    loop = Loop(kind="cascade_pd", kp=servo.kp / servo.kd, kv=servo.kd, reference=target)
    rate = 1 / servo.period
    made = Setup(Machine(servo.inertia, effects), loop, Sensor(), rate, len(target) / rate, 0)
    run = made.run()
    # The stepper has second order at 5 us.
    assert np.abs(ours["q"] - run["true_position"]).max() < 1e-7 * np.ptp(ours["q"])
    assert np.abs(ours["u"] - run["force"]).max() < 1e-5 * np.ptp(ours["u"])


def test_a_coasting_servo_stops_where_its_friction_has_taken_its_energy():
    servo = Servo(inertia=0.03, viscous=1e-9, coulomb=0.3, kp=1.0, kd=1.0, period=0.01)
    q, v = servo.move(0.0, 2.0, 0.0, 1.0)
    assert v == 0.0
    assert q == pytest.approx(0.5 * 0.03 * 2.0**2 / 0.3, rel=1e-6)
    assert servo.move(q, 0.0, 0.29, 1.0) == (q, 0.0)
