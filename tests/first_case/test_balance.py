"""Rough values from exact simulations and from curves of known coefficients."""

from dataclasses import replace

import numpy as np
import pytest

from jaxid.first_case.balance import free_swing, has_direction, rough_balance
from truth.axis.machines import emps_like
from truth.axis.slow_axis import slow_axis

RATE = 1000.0


def test_an_axis_with_friction():
    run = emps_like(0, duration=8.0).run()
    rough = rough_balance(35.15 * run["force"], run["position"], 1 / RATE, rotary=False)
    assert rough.inertia == pytest.approx(95.1, rel=0.02)
    assert rough.viscous == pytest.approx(203.5, rel=0.05)
    assert rough.coulomb == pytest.approx(20.39, rel=0.05)
    assert rough.weight is None
    assert rough.spring is None
    assert not rough.braked
    assert rough_balance(-run["force"], run["position"], 1 / RATE, rotary=False).braked


def test_an_axis_that_stands_still_most_of_the_time():
    run = emps_like(0, duration=8.0).run()
    part = slice(0, 5500)
    q, force = run["position"][part], 35.15 * run["force"][part]
    still = np.ones(20 * len(q))
    # At rest friction holds what the integral of a controller has left: another force at each place.
    position = np.concatenate([q[0] * still, q, q[-1] * still])
    held = np.concatenate([-15.0 * still, force, 15.0 * still])
    rough = rough_balance(held, position, 1 / RATE, rotary=False)
    assert rough.inertia == pytest.approx(95.1, rel=0.25)
    assert rough.spring is None


def courses():
    t = np.arange(8000) / RATE
    q = sum(a * np.sin(w * t + p) for a, w, p in ((0.9, 2.0, 0.1), (0.4, 5.3, 1.0), (0.2, 9.1, 2.0)))
    v, a = np.gradient(q, 1 / RATE), np.gradient(np.gradient(q, 1 / RATE), 1 / RATE)
    return q, v, 0.02 * a + 0.1 * v + 0.05 * np.sign(v)


def test_a_weight_that_turns_with_the_joint():
    q, _, friction = courses()
    rough = rough_balance(friction + 3.0 * np.sin(q) - 1.0 * np.cos(q), q, 1 / RATE, rotary=True)
    assert rough.weight == pytest.approx((3.0, -1.0), rel=0.01)
    assert rough.inertia == pytest.approx(0.02, rel=0.1)


def test_a_spring():
    q, _, friction = courses()
    rough = rough_balance(friction + 4.0 * q, q, 1 / RATE, rotary=False)
    assert rough.spring == pytest.approx(4.0, rel=0.01)
    assert rough.weight is None


def test_a_velocity_without_a_position():
    _, v, friction = courses()
    rough = rough_balance(friction, v, 1 / RATE, rotary=True, of_velocity=True)
    assert rough.inertia == pytest.approx(0.02, rel=0.1)
    assert rough.viscous == pytest.approx(0.1, rel=0.1)


def test_a_step_of_voltage_from_rest():
    """J a = u - c v - F: the slope of the speed falls from (u - F) / J with J / c, in closed form."""
    t = np.arange(2000) / RATE
    inertia, viscous, level = 0.02, 0.12, 7.0
    time_constant = inertia / viscous
    v = level / viscous * (1 - np.exp(-t / time_constant))
    q = level / viscous * (t - time_constant * (1 - np.exp(-t / time_constant)))
    rough = rough_balance(np.full_like(t, level), q, 1 / RATE, rotary=True)
    assert rough.inertia == pytest.approx(inertia, rel=0.1)
    assert rough.viscous == pytest.approx(viscous, rel=0.1)
    assert v[-1] == pytest.approx(58.3, rel=0.01)


def test_a_free_swing():
    """Small swings of a pendulum: a = -w0^2 q - 2 d v, whose solution is in every textbook."""
    t = np.arange(12000) / RATE
    stiffness, damping = 30.0, 0.05
    w = np.sqrt(stiffness - damping**2)
    q = 0.05 * np.exp(-damping * t) * np.cos(w * t) + 0.3
    swing = free_swing(q, 1 / RATE)
    assert swing is not None
    assert swing.inertia == pytest.approx(1 / stiffness, rel=0.01)
    assert swing.viscous == pytest.approx(2 * damping / stiffness, rel=0.05)
    assert swing.rest == pytest.approx(0.3, abs=1e-3)


def test_what_does_not_swing():
    t = np.arange(3000) / RATE
    assert free_swing(0.5 * t**2, 1 / RATE) is None
    assert free_swing(np.exp(-t), 1 / RATE) is None


def test_the_current_of_a_hoist_has_a_direction_and_a_magnitude_has_none():
    level = slow_axis(0)
    hoist = replace(level, machine=replace(level.machine, gravity_force=-180.0 * 9.81)).run()
    # A brake holds the load at first.
    held = np.where(np.arange(hoist["t"].size) < 50, 0.0, hoist["force"])
    assert held.min() == 0
    assert has_direction(held, hoist["position"])

    run = level.run()
    assert not has_direction(np.abs(run["force"]), run["position"])
