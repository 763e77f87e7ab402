"""Instrumental variables and DIDIM: what a simulated motion is good for, against the exact stepper."""

import dataclasses
from dataclasses import replace

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.estimators.common.rerun import span
from jaxid.estimators.didim import didim
from jaxid.estimators.instrumental_variable import instrumental_variable
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.logs.log import Log
from jaxid.session import open_session
from tests.support.axis_log import log_of
from tests.support.cli_setup import place, recorded, refused, text
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like, moves
from truth.axis.stepper import Loop, Sensor
from truth.chain.stepper import ChainMachine, simulate_chain

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
TRUTH = np.array([95.1, 203.5, 20.39])
# A cut-off far above the motion lets the encoder's noise into the regressor.
WIDE = "[preprocess]\ncutoff_hz = 150.0\ndecimation = 5\nalign_hold = true\nrest_velocity = 2e-3\n"


def session_of(folder, setup, declared=(VISCOUS, COULOMB), more="", log=None, **options):
    case = write_case(folder, case_text(setup, declared, **options) + more)
    return open_session(case, log or log_of(setup))


def noisy(noise: float, duration: float = 8.0):
    sensor = Sensor(position_resolution=1e-7, position_noise=noise, force_noise=2e-3)
    return dataclasses.replace(emps_like(0, duration=duration), sensor=sensor)


@pytest.fixture(scope="module")
def wide(tmp_path_factory):
    return session_of(tmp_path_factory.mktemp("wide"), noisy(3e-6), more=WIDE, off=3.0)


@pytest.fixture(scope="module")
def mild(tmp_path_factory):
    return session_of(tmp_path_factory.mktemp("mild"), noisy(1e-6), off=3.0)


def off(estimate, truth=TRUTH) -> np.ndarray:
    """Errors in standard deviations."""
    return (estimate.theta - np.asarray(truth)) / estimate.std


def test_instruments_take_the_noise_out_of_the_regressor(wide):
    machine, run = wide.machine, wide.fit
    plain = inverse_dynamics(machine, run.data)
    assert off(plain)[0] < -5  # 12 % too light
    seen = instrumental_variable(machine, run.log, run.data)
    assert seen.converged
    assert np.all(np.abs(off(seen)) < 3)
    np.testing.assert_allclose(seen.theta, TRUTH, rtol=5e-3)
    assert "in its loop" in seen.notes[0]


def test_forces_alone_tell_it_too(wide):
    estimate = didim(wide.machine, wide.fit.log, wide.fit.data)
    assert np.all(np.abs(off(estimate)) < 3)
    np.testing.assert_allclose(estimate.theta, TRUTH, rtol=5e-3)


def test_what_enters_nonlinearly(tmp_path):
    """A Stribeck velocity, linearised anew at every step."""
    setup = noisy(2e-7).with_effect("stribeck_friction", level=8.0, velocity=0.04)
    declared = [VISCOUS, COULOMB, ("stribeck_friction", {"level": 8.0, "velocity": 0.04})]
    session = session_of(tmp_path, setup, declared)
    truth = [*TRUTH, 8.0, 0.04]
    for method in (instrumental_variable, didim):
        estimate = method(session.machine, session.fit.log, session.fit.data)
        assert estimate.converged, method
        np.testing.assert_allclose(estimate.theta, truth, rtol=0.02)
        assert np.all(np.abs(off(estimate, truth)) < 4)


@pytest.mark.parametrize("factors", [(0.5, 3.0, 3.0), (3.0, 0.1, 0.1)])
def test_didim_from_a_bad_start(mild, factors):
    start = mild.machine.with_estimate(TRUTH * factors)
    estimate = didim(start, mild.fit.log, mild.fit.data)
    assert estimate.converged
    np.testing.assert_allclose(estimate.theta, TRUTH, rtol=1e-3)


def test_didim_looks_at_no_position_but_the_first(mild):
    log, data = mild.fit.log, mild.fit.data
    bent = log.position.copy()
    bent[50:] += 0.05 * np.sin(np.arange(len(bent) - 50))[:, None]
    other = replace(data, q=0 * data.q, qd=0 * data.qd, qdd=0 * data.qdd)
    one = didim(mild.machine, log, data)
    two = didim(mild.machine, replace(log, position=bent), other)
    np.testing.assert_array_equal(one.theta, two.theta)


CHAIN = """
[plant]
kind = "chain"
actuated = [1]
[plant.parameters]
mass = [{ guess = 1.6 }, { guess = 1.8 }]
damping = [{ guess = 6.0 }, { guess = 6.0 }]
stiffness = [{ guess = 1300.0 }, { guess = 1300.0 }, 1500.0]
[[effects]]
kind = "coulomb_friction"
joint = 1
level = { guess = 2.0 }
[log]
time = "t"
position = ["q1", "q2"]
force = "u"
reference = "r"
[controller]
kind = "pd"
kp = 2000.0
kd = 60.0
"""
CHAIN_TRUTH = [2.0, 1.5, 8.0, 8.0, 1500.0, 1500.0, 4.0]


@pytest.fixture(scope="module")
def chain():
    """One drive for two masses, in a loop so loose that the motion depends on all unknowns."""
    t = np.arange(5000) / 1000.0
    machine = ChainMachine(
        [2.0, 1.5], [8.0, 8.0], [1500.0] * 3, {("coulomb_friction", 1): {"level": 4.0}}, actuated=[1]
    )
    tour = moves(t, [0.0, 0.03, -0.02, 0.01], [0.2, 0.3, 0.15, 0.25], 4.0)
    sensor = Sensor(position_noise=1e-6, force_noise=0.05)
    loop = Loop("pd", reference=tour, kp=2000.0, kd=60.0)
    run = simulate_chain(machine, [loop], sensor, rate=1000.0, duration=5.0, seed=1)
    return Log(run["t"], run["position"], run["force"], reference=tour, source="chain.csv")


@pytest.mark.parametrize("method", [instrumental_variable, didim])
def test_a_mass_without_a_drive(tmp_path, chain, method):
    session = open_session(write_case(tmp_path, CHAIN), chain)
    estimate = method(session.machine, session.fit.log, session.fit.data)
    assert estimate.converged
    np.testing.assert_allclose(estimate.theta, CHAIN_TRUTH, rtol=0.02)
    assert np.all(np.abs(off(estimate, CHAIN_TRUTH)) < 4)


@pytest.mark.slow
def test_instruments_of_an_open_loop(tmp_path, chain):
    """Springs keep a run under the measured force by the log; friction alone lets it drift."""
    lines = CHAIN[: CHAIN.index("[controller]")].replace('reference = "r"\n', "")
    log = Log(chain.time, chain.position, chain.force, source="chain.csv")
    session = open_session(write_case(tmp_path, lines), log)
    estimate = instrumental_variable(session.machine, session.fit.log, session.fit.data)
    assert "in open loop" in estimate.notes[0]
    np.testing.assert_allclose(estimate.theta, CHAIN_TRUTH, rtol=0.02)


def test_an_open_loop_that_loses_the_log_is_told(tmp_path):
    session = session_of(tmp_path, noisy(1e-6), more=WIDE, closed=False)
    wrong = session.machine.with_plant(
        session.machine.plant, session.machine.parameters.with_guess(TRUTH * [0.2, 0.1, 0.1])
    )
    idle = replace(session.fit.data, force=0 * session.fit.data.force)
    with pytest.raises(InputError, match=r"loses the log.*name the controller"):
        instrumental_variable(wrong, session.fit.log, idle)


@pytest.mark.slow
def test_a_loose_loop_has_the_precision_of_its_true_slope(tmp_path):
    """Gains thirty times lower: the motion gives way, and forces tell less than the regressor says."""
    sensor = Sensor(position_resolution=1e-7, position_noise=1e-6, force_noise=0.06)
    tight = dataclasses.replace(emps_like(0, duration=8.0), sensor=sensor)
    loose = dataclasses.replace(tight, loop=dataclasses.replace(tight.loop, kp=6.0, kv=25.0))
    ratio = []
    for name, setup in (("tight", tight), ("loose", loose)):
        folder = tmp_path / name
        folder.mkdir()
        session = session_of(folder, setup)
        plain = inverse_dynamics(session.machine, session.fit.data)
        estimate = didim(session.machine, session.fit.log, session.fit.data)
        assert np.all(np.abs(off(estimate)) < 4)
        ratio.append(estimate.std[0] / plain.std[0])
    assert ratio[1] > 1.15 * ratio[0]


def test_guesses_that_cannot_be_simulated_are_told(mild):
    """A thousandth of the inertia: the loop is unstable, and nothing limits it."""
    loop = replace(mild.machine.controller, limit=np.asarray(1e12))
    start = replace(mild.machine, controller=loop).with_estimate(TRUTH * [1e-3, 0.0, 0.0])
    estimate = didim(start, mild.fit.log, mild.fit.data)
    assert not estimate.converged
    assert "simulation diverged" in estimate.message


def test_without_a_controller_didim_is_refused_in_one_line(tmp_path, capsys):
    case = text()
    open_case = case[: case.index("[controller]")].replace('reference = "ref"\n', "")
    files = place(tmp_path / "in", recorded(), open_case)
    argv = ("identify", *files, "--method", "didim", "-o", tmp_path / "out")
    assert "[controller]" in refused(capsys, tmp_path, *argv, told="the controller is not known")


def test_a_column_of_rounding_is_no_instrument():
    """Normed to one it would be a direction of its own, another one in each step: the search never ended."""
    columns = np.random.default_rng(0).standard_normal((200, 4))
    rounding = 1e-16 * np.random.default_rng(1).standard_normal((200, 1))
    assert span(columns).shape == (200, 4)
    assert span(np.hstack([columns, rounding])).shape == (200, 4)
    small = 1e-9 * np.random.default_rng(2).standard_normal((200, 1))
    assert span(np.hstack([columns, small])).shape == (200, 5)
    assert span(np.zeros((200, 3))).shape == (200, 0)
