"""Delay between a logged force and the motion, by the likelihood: logs of the exact stepper."""

import tomllib
from dataclasses import replace

import numpy as np
import pytest

import jaxid
from truth.axis.cases import case_text
from truth.axis.hidden_effects import COULOMB, SEARCH_CASES, VISCOUS
from truth.axis.machines import Setup, emps_like
from truth.axis.stepper import Loop, Machine, Sensor

VALUES = {"inertia": 95.1089, "viscous_friction.coefficient": 203.5, "coulomb_friction.level": 20.39}


def logged(setup: Setup, late: int = 0) -> dict[str, np.ndarray]:
    """Return the columns of a log whose force is read so many samples late, or early below zero."""
    run = setup.run()
    force, rows = run["force"], np.arange(len(run["t"]))
    return {"t": run["t"], "q": run["position"], "u": force[np.clip(rows - late, 0, rows[-1])]}


def case_of(setup: Setup, **log: object) -> dict:
    """Return the case without controller and sensor."""
    case = tomllib.loads(case_text(setup, (VISCOUS, COULOMB)))
    table = {"time": "t", "position": "q", "force": "u", **log}
    return {name: case[name] for name in ("plant", "effects", "actuator")} | {"log": table}


def close(estimate, other) -> bool:
    """Check that two fits differ by less than a standard deviation, and are within 0.2 % of the truth."""
    near = np.abs(estimate.theta / [VALUES[name] for name in estimate.names] - 1) < 2e-3
    return bool(np.all(near & (np.abs(estimate.theta - other.theta) < other.std)))


def deviations(estimate, values) -> np.ndarray:
    return (estimate.theta - [values[name] for name in estimate.names]) / estimate.std


@pytest.fixture(scope="module")
def setup() -> Setup:
    return emps_like(1, 1.0, 3.0)


@pytest.fixture(scope="module")
def in_time(setup):
    return jaxid.identify(case_of(setup), logged(setup))


@pytest.mark.parametrize("late", [1, -1])
def test_a_force_that_is_a_sample_off_is_taken_back(setup, in_time, late):
    case, columns = case_of(setup), logged(setup, late)
    found = jaxid.identify(case, columns, validate=[logged(emps_like(2, 1.0, 3.0), late)])

    delay = found.estimate.details["force_delay"]
    assert delay["used"]
    assert abs(delay["value"] - 1e-3 * late) < 3 * delay["std"]
    assert close(found.estimate, in_time.estimate)
    assert found.model_complete

    side = "late" if late > 0 else "early"
    assert f"taken as logged 1 ms {side}" in found.findings[0]
    assert "to confirm it" in found.session.findings[-1].hint
    assert found.session.settings["force_delay"]["value"] == pytest.approx(f"{delay['value']:.3g} s")
    # The gaps are those of the force where it acts, and so are those of logs to validate on.
    assert found.gaps[0].force.rms[0] < 1.5 * found.noise_floor[0]
    assert found.gaps[1].force.rms[0] < 1.5 * found.gaps[0].force.rms[0]


def test_as_logged_the_values_are_off(setup):
    case = case_of(setup, delay={"force": 1e-9})
    taken = jaxid.identify(case, logged(setup, 1))
    assert "force_delay" not in taken.estimate.details
    assert abs(taken.estimate.value("viscous_friction.coefficient") / 203.5 - 1) > 0.01


def test_a_force_in_time_has_no_delay(in_time):
    assert "force_delay" not in in_time.estimate.details
    assert "force_delay" not in in_time.session.settings
    assert in_time.model_complete


def test_a_long_delay_is_said_and_not_taken(setup, in_time):
    found = jaxid.identify(case_of(setup), logged(setup, 3))
    delay = found.estimate.details["force_delay"]
    assert not delay["used"]
    assert delay["samples"] == pytest.approx(3.0, abs=0.01)
    assert "too long to be taken for timing" in found.findings[0]
    assert found.session.fit.log.force[:, 0] == pytest.approx(logged(setup, 3)["u"])

    stated = jaxid.identify(case_of(setup, delay={"force": delay["value"]}), logged(setup, 3))
    assert stated.model_complete
    assert close(stated.estimate, in_time.estimate)


@pytest.mark.parametrize(
    "kind", ["viscous_friction", "coulomb_friction", "stribeck_friction", "actuator_lag"]
)
def test_a_missing_effect_is_no_delay(kind):
    row = SEARCH_CASES[kind]
    hiding = replace(row, duration=3.0).setup(1)
    case = tomllib.loads(row.text())
    case = {name: case[name] for name in ("plant", "effects", "actuator")}
    found = jaxid.identify(case | {"log": case_of(hiding)["log"]}, logged(hiding))
    assert "force_delay" not in found.estimate.details
    assert found.model_complete is False


def test_a_part_of_a_sample_is_told():
    rate, fine, seconds, part = 200.0, 20_000.0, 5.0, 0.3
    true = {"viscous_friction": {"coefficient": 0.15}, "coulomb_friction": {"level": 0.4}}
    t = np.arange(round(seconds * fine)) / fine
    force = 2.0 * np.sin(2 * np.pi * 0.4 * t) + 1.2 * np.sin(2 * np.pi * 2.3 * t)
    sensor = Sensor(position_resolution=1e-4, position_noise=5e-5)
    whole = Setup(Machine(0.05, true), Loop(input=force, hold="linear"), sensor, fine, seconds, seed=3)
    run, every = whole.run(), round(fine / rate)
    rows = np.arange(1, round(seconds * rate)) * every
    columns = {"t": t[rows], "q": run["position"][rows], "u": force[rows - round(part * every)]}

    case = tomllib.loads(case_text(whole, tuple(true.items()), motion="rotary", sensor=False))
    case = {name: case[name] for name in ("plant", "effects")}
    case["log"] = {"time": "t", "position": "q", "force": "u", "hold": "band_limited"}
    found = jaxid.identify(case, columns)
    delay = found.estimate.details["force_delay"]
    assert abs(delay["value"] - part / rate) < 3 * delay["std"] < 0.1 / rate
    values = {"inertia": 0.05, "viscous_friction.coefficient": 0.15, "coulomb_friction.level": 0.4}
    assert np.abs(deviations(found.estimate, values)).max() < 3.0
