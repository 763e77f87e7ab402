"""Every controller in its loop, tick by tick, against plain Python on the same readings."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.controllers import CONTROLLERS
from jaxid.effects import EFFECTS
from jaxid.plants import Axis
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.loops import Drive, closed_loop

PERIOD, TICKS, MASS, GAIN = 2e-3, 250, 2.0, 5.0
TIME = PERIOD * np.arange(TICKS)
REFERENCE = 0.02 + 0.1 * np.sin(12.0 * TIME)
START = (0.01, 0.3)  # m, m/s: the loop begins in mid-motion

CASES: dict[str, dict[str, Any]] = {
    "cascade_pd": {"kp": 30.0, "kv": 12.0},
    "cascade_pd averaged": {"kp": 30.0, "kv": 12.0, "velocity_average": 3},
    "cascade_pd limited": {"kp": 30.0, "kv": 12.0, "limit": 6.0},
    "pd": {"kp": 300.0, "kd": 10.0},
    "pd on velocity": {"kp": 300.0, "kd": 10.0, "velocity_average": 2, "derivative": "velocity"},
    "pd disturbed": {"kp": 300.0, "kd": 10.0, "limit": 11.0, "velocity_average": 2},
    "friction_compensation": {"kp": 300.0, "kd": 10.0, "coulomb": 0.7, "viscous": 3.0, "inertia": 1.5},
    "pid": {"kp": 300.0, "ki": 900.0, "kd": 10.0},
    "pid filtered": {"kp": 300.0, "ki": 900.0, "kd": 10.0, "derivative_filter": 8e-3},
    "pid winding up": {"kp": 300.0, "ki": 4e3, "kd": 10.0, "limit": 6.0},
    "pid anti-windup": {"kp": 300.0, "ki": 4e3, "kd": 10.0, "limit": 6.0, "anti_windup": True},
}
DISTURBED = ("pd disturbed", "pid winding up", "pid anti-windup")


def disturbance(name: str) -> np.ndarray:
    return np.where((TIME > 0.1) & (TIME < 0.2), 4.0, 0.0) * (name in DISTURBED)


def plain(name: str, reading: np.ndarray) -> np.ndarray:
    """The command at every tick as the case file defines it."""
    law = {"limit": np.inf, "velocity_average": 1, "derivative_filter": 0.0} | CASES[name]
    back = law["velocity_average"]
    before = START[0] - PERIOD * START[1] * np.arange(back, 0, -1)
    q = np.concatenate([before, reading])
    integral, slope, out = 0.0, 0.0, []
    for k, extra in enumerate(disturbance(name)):
        velocity = (q[k + 1 : k + back + 1].mean() - q[k : k + back].mean()) / PERIOD
        error = REFERENCE[k] - reading[k]
        aim = (REFERENCE[k] - REFERENCE[max(k - 1, 0)]) / PERIOD
        # A loop that starts in motion starts with a reference that moves as fast.
        aim = START[1] if k == 0 else aim
        if name.startswith("cascade"):
            u = law["kv"] * (law["kp"] * error - velocity)
        elif name.startswith("pid"):
            slope += (aim - velocity - slope) * PERIOD / (PERIOD + law["derivative_filter"])
            grown = integral + PERIOD * error
            u = law["kp"] * error + law["ki"] * grown + law["kd"] * slope
            winds_up = abs(u + extra) > law["limit"] and u * error > 0
            if law.get("anti_windup") and winds_up:
                u -= law["ki"] * PERIOD * error
            else:
                integral = grown
        elif name.startswith("friction"):
            ends = [2 * REFERENCE[0] - REFERENCE[1]], [2 * REFERENCE[-1] - REFERENCE[-2]]
            wider = np.concatenate([ends[0], REFERENCE, ends[1]])
            before, here, after = wider[k : k + 3]
            u = law["kp"] * error + law["kd"] * ((after - before) / (2 * PERIOD) - velocity)
            u += law["inertia"] * (after - 2 * here + before) / PERIOD**2
            u += law["viscous"] * velocity + law["coulomb"] * np.sign(velocity)
        else:
            aim = 0.0 if law.get("derivative") == "velocity" else aim
            u = law["kp"] * error + law["kd"] * (aim - velocity)
        out.append(np.clip(u + extra, -law["limit"], law["limit"]))
    return np.array(out)


def in_loop(name: str, sensor: Sensor | None = None):
    static = ("velocity_average", "anti_windup", "derivative")
    arrays = {k: v if k in static else jnp.asarray(v) for k, v in CASES[name].items()}
    law = CONTROLLERS[name.split()[0]](period=PERIOD, **arrays)
    plant = Axis(MASS, effects=(EFFECTS["viscous_friction"](coefficient=4.0),))
    columns = [jnp.asarray(x)[:, None] for x in (REFERENCE, disturbance(name))]
    start = [jnp.asarray([x]) for x in START]
    return closed_loop(plant, Drive(jnp.asarray([GAIN]), PERIOD), law, *columns, *start, sensor)


@pytest.mark.parametrize("name", CASES)
def test_command_is_the_laws(name):
    run = in_loop(name)
    reading, command = np.asarray(run.reading)[:, 0], np.asarray(run.command)[:, 0]
    # commands of up to 100 from readings divided by 2 ms: rounding
    np.testing.assert_allclose(command, plain(name, reading), atol=1e-10)
    limit = CASES[name].get("limit")
    if limit is not None:
        assert np.any(np.abs(command) == limit)  # the case does saturate


def test_held_command_moves_the_plant():
    """Between ticks the exact response of mass and drag to the held command."""
    run = in_loop("pd")
    q, v, u = (np.asarray(x)[:, 0] for x in (run.position, run.velocity, run.command))
    decay = np.exp(-4.0 / MASS * PERIOD)
    end = GAIN * u / 4.0
    # RK4 of one linear decay: (c h / m)^5 / 120 = 1e-14 a tick
    np.testing.assert_allclose(v[1:], end[:-1] + (v[:-1] - end[:-1]) * decay, atol=1e-12)
    away = (v[:-1] - end[:-1]) * MASS / 4.0 * (1 - decay)
    np.testing.assert_allclose(np.diff(q), end[:-1] * PERIOD + away, atol=1e-12)


def test_loop_sees_the_rounded_reading():
    sensor = Sensor(position_resolution=jnp.asarray(1e-3))
    run = in_loop("pd", sensor)
    reading, q = np.asarray(run.reading)[:, 0], np.asarray(run.position)[:, 0]
    np.testing.assert_allclose(reading, 1e-3 * np.round(q / 1e-3), atol=1e-15)
    assert np.abs(reading - q).max() > 4e-4
    np.testing.assert_allclose(np.asarray(run.command)[:, 0], plain("pd", reading), atol=1e-9)


def test_anti_windup_needs_less_integral():
    """Both saturate alike; the one that winds up overshoots more after the pulse."""
    errors = [
        np.abs(REFERENCE - np.asarray(in_loop(name).position)[:, 0])[125:].max()
        for name in ("pid winding up", "pid anti-windup")
    ]
    assert errors[1] < 0.8 * errors[0]
