"""Clocks of force and position that drift apart: found with their drift, and not where there is one clock."""

import os
from pathlib import Path

import numpy as np
import pytest

from jaxid.logs.clock import clock_findings
from jaxid.logs.log import Log, read_log

RATE, SECONDS = 500.0, 40.0


def axis_force(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position and force of an axis in closed form: inertia, viscous and dry friction, an offset."""
    rates, sizes = (2.1, 5.3, 9.7), (0.3, 0.1, 0.03)
    q = sum(a * np.sin(w * t) for w, a in zip(rates, sizes, strict=True))
    v = sum(a * w * np.cos(w * t) for w, a in zip(rates, sizes, strict=True))
    a = sum(-s * w**2 * np.sin(w * t) for w, s in zip(rates, sizes, strict=True))
    return q, 2.0 * a + 1.5 * v + 0.8 * np.sign(v) + 0.2


def log(ppm: float, seed: int = 0, resolution: float = 1e-5) -> Log:
    t = np.arange(int(SECONDS * RATE)) / RATE
    rng = np.random.default_rng(seed)
    q, _ = axis_force(t)
    _, u = axis_force(t * (1 - 1e-6 * ppm))
    return Log(t, np.round(q / resolution) * resolution, u + rng.normal(0, 0.1, t.size))


@pytest.mark.parametrize("ppm", [-400.0, 150.0, 1000.0])
def test_a_drift_is_found_with_its_size(ppm):
    (finding,) = clock_findings(log(ppm), "log")
    assert finding.severity == "warning"
    found = float(finding.what.split("drift by ")[1].split(" ppm")[0])
    assert found == pytest.approx(ppm, rel=0.1)


@pytest.mark.parametrize("seed", range(10))
def test_one_clock_is_no_drift(seed):
    assert clock_findings(log(0.0, seed, resolution=1e-4), "log") == []


MEASURED = {
    "emps/DATA_EMPS.mat": {"time": "t", "position": "qm", "force": "vir"},
    "emps/DATA_EMPS_PULSES.mat": {"time": "t", "position": "qm", "force": "vir"},
    "odri_motor/speed_test1.csv": {"time": "Time", "position": "Position", "force": "Iq"},
    "odri_motor/acc_current.csv": {"time": "Time", "position": "Position", "force": "Iq"},
    "dfki_pendulum/swingup_1nm.csv": {"time": "time", "position": "position", "force": "torque"},
    "field/time_ros_jitter.csv": {"time": "t", "position": "q", "force": "tau"},
    "field/time_irregular.csv": {"time": "t", "position": "q", "force": "tau"},
    "field/sign_good.csv": {"time": "timestamp", "position": "position", "force": "voltage"},
}


@pytest.mark.parametrize("name", MEASURED)
def test_measured_logs_have_one_clock(name):
    if not os.environ.get("JAXID_DATA"):
        pytest.skip("JAXID_DATA is unset: no measured logs here")
    measured = read_log(Path(os.environ["JAXID_DATA"]) / name, MEASURED[name])
    assert clock_findings(measured, name) == []
