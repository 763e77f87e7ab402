"""The ground-truth stepper's mechanics and drive against closed forms."""

from typing import Any

import numpy as np
import pytest

from truth.axis.stepper import Loop, Machine, Sensor, simulate

IDEAL = Sensor()
RATE = 1000.0


def free_run(machine: Machine, duration: float, force: Any = 0.0, hold: str = "zero_order", **options: Any):
    """Open loop under a constant force or one given by sample."""
    count = round(duration * RATE)
    given = np.broadcast_to(np.asarray(force, dtype=float), count)
    return simulate(machine, Loop(input=given, hold=hold), IDEAL, rate=RATE, duration=duration, **options)


def test_coulomb_stops_after_the_right_time_and_distance():
    mass, level, speed = 2.0, 3.0, 1.0
    log = free_run(Machine(mass, {"coulomb_friction": {"level": level}}), 1.0, initial_velocity=speed)
    stop = mass * speed / level
    expected = np.maximum(speed - level / mass * log["t"], 0.0)
    np.testing.assert_allclose(log["true_velocity"], expected, atol=1e-12)
    assert np.all(log["true_velocity"][log["t"] > stop] == 0.0)
    # within the step of the stop the drift is off by less than step * velocity = step^2 F / m
    assert log["true_position"][-1] == pytest.approx(mass * speed**2 / (2.0 * level), abs=5e-11)


def test_sticks_exactly_and_leaves_at_level_plus_static():
    machine = Machine(2.0, {"coulomb_friction": {"level": 3.0}, "static_friction": {"level": 1.5}})
    ramp = 10.0 * np.arange(1000) / RATE
    log = free_run(machine, 1.0, ramp, hold="linear", initial_position=0.1)
    stuck = log["t"] < 0.45
    assert np.all(log["true_velocity"][stuck] == 0.0)
    assert np.all(log["true_position"][stuck] == 0.1)
    since = np.maximum(log["t"] - 0.45, 0.0)  # net = 10 t - 3 from there on: a jump of 1.5 N
    # it leaves at most one step late: 5 us * 0.75 m/s^2, twice
    np.testing.assert_allclose(log["true_velocity"], (1.5 * since + 5.0 * since**2) / 2.0, atol=8e-6)


def test_passes_through_zero_velocity_without_losing_time():
    """A force above break-away reverses the slide; its two slopes meet inside a step."""
    machine = Machine(1.0, {"coulomb_friction": {"level": 2.0}, "static_friction": {"level": 1.0}})
    log = free_run(machine, 1.0, -5.0, initial_velocity=1.0)
    after = log["t"] - 1.0 / 7.0
    expected = np.where(after < 0.0, -7.0 * after, -3.0 * after)
    np.testing.assert_allclose(log["true_velocity"], expected, atol=1e-11)


def test_a_mass_off_the_axis_swings_with_its_energy_kept():
    inertia, moment = 0.5, 1.2
    machine = Machine(inertia, {"unbalance": {"moment": moment, "phase": -np.pi / 2}})
    log = free_run(machine, 5.0, initial_position=1.0)
    kinetic = 0.5 * inertia * log["true_velocity"] ** 2
    potential = -moment * 9.81 * np.cos(log["true_position"])
    assert np.ptp(kinetic) > 5.0
    np.testing.assert_allclose(kinetic + potential, potential[0], atol=2e-8)


def test_undamped_oscillator_keeps_its_energy():
    mass, stiffness = 2.0, 2.0e4
    machine = Machine(mass, {"linear_stiffness": {"coefficient": stiffness}})
    log = free_run(machine, 5.0, initial_position=0.01)
    energy = 0.5 * (mass * log["true_velocity"] ** 2 + stiffness * log["true_position"] ** 2)
    # leapfrog's energy swings by (w h)^2 / 4 = 6e-8 and does not drift
    assert np.ptp(energy) / energy[0] < 1e-7


def test_damped_oscillator_follows_its_closed_form():
    mass, damping, stiffness, force = 2.0, 30.0, 2.0e4, 40.0
    effects = {
        "viscous_friction": {"coefficient": damping},
        "linear_stiffness": {"coefficient": stiffness},
    }
    log = free_run(Machine(mass, effects), 1.0, force)
    decay, t = damping / (2.0 * mass), log["t"]
    omega = np.sqrt(stiffness / mass - decay**2)
    wave = np.exp(-decay * t) * (np.cos(omega * t) + decay / omega * np.sin(omega * t))
    np.testing.assert_allclose(log["true_position"], force / stiffness * (1.0 - wave), atol=1e-9)


def test_friction_takes_four_levels_over_stiffness_a_cycle():
    mass, stiffness, level = 1.0, 400.0, 0.5
    effects = {"linear_stiffness": {"coefficient": stiffness}, "coulomb_friction": {"level": level}}
    log = free_run(Machine(mass, effects), 4.0, initial_position=0.0112)
    turns = 0.0112 - 2.0 * level / stiffness * np.arange(5)  # the fifth turn is inside F / k = 1.25 mm
    half = np.pi / np.sqrt(stiffness / mass)
    at = np.round(half * np.arange(1, 5) * RATE).astype(int)
    # the nearest sample is within 0.5 ms of the turn: k A (0.5 ms)^2 / 2 m < 0.6 um
    np.testing.assert_allclose(log["true_position"][at], turns[1:] * np.array([-1, 1, -1, 1]), atol=6e-7)
    assert log["true_position"][-1] == pytest.approx(turns[4], abs=1e-9)
    assert np.all(log["true_velocity"][at[3] + 2 :] == 0.0)


def test_dahl_follows_its_exponential_in_each_stroke():
    mass, stiffness, level = 1.0, 1e4, 2.0
    machine = Machine(mass, {"hysteresis": {"stiffness": stiffness, "level": level}})
    force = np.where(np.arange(300) < 100, 5.0, -5.0)
    log = free_run(machine, 0.3, force)
    friction = log["true_force"] - mass * log["true_acceleration"]
    x, v = log["true_position"], log["true_velocity"]
    np.testing.assert_allclose(friction[:100], level * (1 - np.exp(-stiffness * x[:100] / level)), atol=1e-9)
    reach = level / stiffness
    turn = int(np.flatnonzero(v < 0.0)[0])
    back = friction[turn:] + level  # falls by e for every `reach` of the way back
    stroke = (x[turn] - x[turn:]) / reach
    np.testing.assert_allclose(back, back[0] * np.exp(-stroke), atol=1e-9)
    # that exponential starts from +level at the turn, whose place the energy gives,
    # to the (5 us)^2 7 m/s^2 = 0.2 nm of 2 um by which one step blurs a turn
    away = reach * np.log(2.0 * level / back[0])
    work = 5.0 * away + level * (2.0 * reach * -np.expm1(-away / reach) - away)
    assert 0.5 * mass * v[turn] ** 2 == pytest.approx(work, rel=1e-4)


def test_delay_off_the_grid_shifts_the_response_exactly():
    force = np.where(np.arange(50) < 10, 0.0, 6.0)
    log = free_run(Machine(2.0, {"input_delay": {"delay": 1.37e-3}}), 0.05, force)
    since = np.maximum(log["t"] - 0.01 - 1.37e-3, 0.0)
    np.testing.assert_allclose(log["true_velocity"], 3.0 * since, atol=1e-14)
    linear = free_run(
        Machine(2.0, {"input_delay": {"delay": 1.37e-3}}),
        0.05,
        100 * np.arange(50) / RATE,
        "linear",
    )
    np.testing.assert_allclose(linear["true_force"], 100 * np.maximum(linear["t"] - 1.37e-3, 0.0), atol=1e-12)


def test_a_supply_lets_speed_settle_where_it_says():
    """From rest, under more: v0 (1 - exp(-t stall / (m v0))); an offset leaves less on one side."""
    values = {"stall": 400.0, "velocity": 0.7}
    t, u = np.arange(2000) * 1e-3, np.full(2000, 900.0)
    for side in (1.0, -1.0):
        machine = Machine(100.0, {"voltage_limit": values})
        v = simulate(machine, Loop(input=side * u), Sensor(), rate=1e3, duration=2.0)["true_velocity"]
        # second order at 5 us: (5e-6 / 0.175)^2
        np.testing.assert_allclose(v, side * 0.7 * -np.expm1(-t * 400.0 / 70.0), atol=1e-9)
    machine = machine.with_effect("saturation", limit=150.0).with_effect("actuator_offset", level=20.0)
    force = [
        simulate(machine, Loop(input=c * u), Sensor(), rate=1e3, duration=1e-3)["true_force"][0]
        for c in (-0.16, 0.1, 0.16)
    ]
    np.testing.assert_allclose(force, [-124.0, 110.0, 150.0], rtol=1e-14)


def test_lag_and_saturation_of_a_step():
    force, tau = 6.0, 4e-3
    log = free_run(Machine(2.0, {"actuator_lag": {"time_constant": tau}}), 0.05, force)
    rise = 1.0 - np.exp(-log["t"] / tau)
    np.testing.assert_allclose(log["true_force"], force * rise, atol=1e-11)
    np.testing.assert_allclose(log["true_velocity"], force / 2.0 * (log["t"] - tau * rise), atol=1e-8)
    effects = {
        "actuator_lag": {"time_constant": tau},
        "saturation": {"limit": 5.0},
        "actuator_gain": {"gain": 1.2},
    }
    clipped = free_run(Machine(2.0, effects), 0.05, force)
    np.testing.assert_allclose(clipped["true_force"], np.minimum(1.2 * force * rise, 5.0), atol=1e-11)
    impulse = np.cumsum(clipped["true_force"]) / RATE  # rectangles: off by 5 N half a tick at most
    np.testing.assert_allclose(clipped["true_velocity"], impulse / 2.0, atol=2.6e-3)


STATE_FORCES = [  # effect, parameters, force at position q and velocity v
    ("viscous_friction", {"coefficient": 3.0}, lambda q, v: -3.0 * v),
    ("coulomb_friction", {"level": 3.0}, lambda q, v: -3.0 * np.sign(v)),
    (
        "coulomb_friction",
        {"friction_coefficient": 0.1},
        lambda q, v: -0.1 * 2.0 * 9.81 * np.sign(v),
    ),
    ("static_friction", {"level": 3.0}, lambda q, v: 0.0),
    (
        "stribeck_friction",
        {"level": 3.0, "velocity": 0.5},
        lambda q, v: -3.0 * np.exp(-4 * v * v) * np.sign(v),
    ),
    ("asymmetric_viscous", {"coefficient": 3.0}, lambda q, v: -3.0 * abs(v)),
    ("quadratic_drag", {"coefficient": 3.0}, lambda q, v: -3.0 * v * abs(v)),
    ("cubic_friction", {"coefficient": 3.0}, lambda q, v: -3.0 * v**3),
    ("quartic_friction", {"coefficient": 3.0}, lambda q, v: -3.0 * v**3 * abs(v)),
    ("constant_force", {"level": 3.0}, lambda q, v: 3.0),
    ("linear_stiffness", {"coefficient": 3.0}, lambda q, v: -3.0 * q),
    ("quadratic_stiffness", {"coefficient": 3.0}, lambda q, v: -3.0 * q**2),
    ("cubic_stiffness", {"coefficient": 3.0}, lambda q, v: -3.0 * q**3),
    (
        "cogging",
        {"amplitude": 3.0, "period": 0.7, "phase": 0.4},
        lambda q, v: -3 * np.cos(2 * np.pi * q / 0.7 + 0.4),
    ),
]


@pytest.mark.parametrize(("kind", "parameters", "force"), STATE_FORCES)
@pytest.mark.parametrize(("q", "v"), [(0.3, 0.6), (-0.4, -0.8)])
def test_force_of_each_effect(kind, parameters, force, q, v):
    log = free_run(Machine(2.0, {kind: parameters}), 0.002, initial_position=q, initial_velocity=v)
    assert log["true_acceleration"][0] == pytest.approx(force(q, v) / 2.0, rel=1e-14)
    # and the integrator uses the same force: the velocity's slope, to second order in 2 ms
    slope = (log["true_velocity"][1] - v) * RATE
    assert slope == pytest.approx(np.mean(log["true_acceleration"]), abs=1e-4)


def test_drift_of_dry_levels_releases_a_held_mass():
    effects = {
        "coulomb_friction": {"level": 3.0},
        "static_friction": {"level": 1.0},
        "friction_drift": {"rate": -0.5},
    }
    log = free_run(Machine(2.0, effects), 1.0, 3.0)  # 4 (1 - t / 2) falls to 3 at t = 0.5
    assert np.all(log["true_velocity"][log["t"] <= 0.5] == 0.0)
    late = log["t"][-1] - 0.5  # from 0.5 on: net = 3 - 3 (1 - t / 2) = 0.75 + 1.5 (t - 0.5)
    assert log["true_velocity"][-1] == pytest.approx((0.75 * late + 0.75 * late**2) / 2.0, abs=1e-5)

    effects = {
        "hysteresis": {"stiffness": 1e4, "level": 2.0},
        "friction_drift": {"rate": -0.5},
    }
    log = free_run(Machine(2.0, effects), 1.0, 5.0)
    friction = log["true_force"] - 2.0 * log["true_acceleration"]
    # slipping: 2 (1 - t / 2), behind by the way the force still needs, under 1e-4 m of 1.8 m/s
    np.testing.assert_allclose(friction[500:], 2.0 - log["t"][500:], atol=1e-3)


def test_weight_added_mass_bursts_and_clock():
    fall = free_run(Machine(2.0, {"added_mass": {"mass": 3.0}}, gravity_force=-2.0 * 9.81), 0.5)
    np.testing.assert_allclose(fall["true_velocity"], -9.81 * fall["t"], atol=1e-11)
    burst = free_run(Machine(2.0, bursts=[(0.1000013, 0.01, 8.0), (0.3, 0.1, -1.0)]), 0.5)
    assert burst["true_velocity"][250] == pytest.approx(8.0 * 0.01 / 2.0, rel=1e-9)
    assert burst["true_velocity"][-1] == pytest.approx((0.08 - 0.1) / 2.0, rel=1e-9)
    clock = free_run(Machine(2.0, clock_force=(4.0, 7.0)), 0.5)
    w = 2.0 * np.pi * 7.0
    np.testing.assert_allclose(clock["true_velocity"], 2.0 / w * (1.0 - np.cos(w * clock["t"])), atol=1e-9)


SMOOTH: dict[str, tuple[dict, dict[str, Any]]] = {
    "oscillator": (
        {"cubic_stiffness": {"coefficient": 3e4}, "cubic_friction": {"coefficient": 5.0}},
        {"initial_position": 0.3},
    ),
    "sliding": (  # never at rest: dry friction is a smooth force there
        {
            "stribeck_friction": {"level": 5.0, "velocity": 2.0},
            "coulomb_friction": {"level": 1.0},
            "quadratic_drag": {"coefficient": 2.0},
            "actuator_lag": {"time_constant": 0.02},
            "hysteresis": {"stiffness": 500.0, "level": 3.0},
        },
        {"initial_velocity": 2.0},
    ),
}


@pytest.mark.parametrize("case", SMOOTH)
def test_error_falls_fourfold_when_the_step_is_halved(case):
    effects, start = SMOOTH[case]
    machine = Machine(2.0, effects, clock_force=(4.0, 9.0))
    fine, *coarse = (
        free_run(machine, 0.4, 12.0, step=step, **start)["true_position"][-1]
        for step in (5e-6, 5e-4, 2.5e-4, 1.25e-4)
    )
    errors = np.abs(np.array(coarse) - fine)
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4.0, rtol=0.05)  # the next order is about 1 % here


@pytest.mark.parametrize(
    ("machine", "options", "message"),
    [
        (Machine(1.0, {"backlash": {"gap": 1.0}}), {}, "backlash"),
        (Machine(1.0, {"viscous_friction": {"level": 1.0}}), {}, "coefficient"),
        (Machine(1.0), {"log_rate": 300.0}, "divide"),
        (Machine(1.0), {"hold": "cubic"}, "linear"),
    ],
)
def test_refuses_what_it_does_not_know(machine: Machine, options: Any, message: str):
    with pytest.raises(ValueError, match=message):
        free_run(machine, 0.01, **options)
