"""Accuracy of the simulator that made the logs of field/, which are not exact to a count of the encoder."""

import os
from pathlib import Path

import numpy as np
import pytest

from truth.axis.stepper import Loop, Machine, Sensor, simulate

MEASURED = os.environ.get("JAXID_DATA")
pytestmark = pytest.mark.skipif(not MEASURED, reason="JAXID_DATA is not set: no measured logs")


def exact(inertia: float, viscous: float, coulomb: float, force: np.ndarray, rate: float, hold: str):
    """Return the positions of an axis whose friction is exact, at every sample of its force."""
    effects = {"viscous_friction": {"coefficient": viscous}, "coulomb_friction": {"level": coulomb}}
    loop = Loop(input=force, hold=hold)
    run = simulate(Machine(inertia, effects), loop, Sensor(), rate=rate, duration=len(force) / rate)
    return run["true_position"]


def read(name: str) -> np.ndarray:
    return np.genfromtxt(Path(str(MEASURED)) / "field" / name, delimiter=",", names=True)


def test_a_log_of_a_smooth_torque_leaves_the_exact_motion_by_some_counts():
    """Its torque is two sines, between its samples too."""
    log, fine = read("time_seconds.csv"), 100
    wave = lambda t: 2.0 * np.sin(0.8 * np.pi * t) + 1.2 * np.sin(3.4 * np.pi * t)
    assert np.max(np.abs(wave(log["t"]) - log["tau"])) < 1e-8

    torque = wave(np.arange(fine * len(log)) / (200.0 * fine))
    away = log["q"] - exact(0.05, 0.15, 0.4, torque, 200.0 * fine, "linear")[::fine]
    assert 3 < np.max(np.abs(away)) / 1e-4 < 10


def test_a_log_of_a_held_voltage_leaves_the_exact_motion_by_some_counts():
    log = read("sign_good.csv")
    away = log["position"] - exact(0.02, 0.12, 0.25, log["voltage"], 50.0, "zero_order")
    assert 3 < np.max(np.abs(away)) / 3.068e-3 < 10
