"""The Durbin-Wu-Hausman test: its size where nothing is correlated, and its power where something is."""

import dataclasses

import numpy as np
import pytest

from jaxid.commands.identify import identify_many
from jaxid.estimators import _start, loop_noise
from jaxid.estimators.common.endogeneity import endogeneity
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.estimators.loop_noise import with_loop_noise
from jaxid.numerics.coloured_noise import NoiseModel
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session
from tests.estimators.test_simulated_motion import COULOMB, VISCOUS, WIDE
from tests.support.axis_log import log_of
from tests.support.cli_setup import place, recorded, run
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like
from truth.axis.stepper import Sensor

COLOUR = NoiseModel(np.array([1.4, -0.6]), 1.0)
SAMPLES = 1500


def drawn(seed: int, common: float):
    """A regressor whose acceleration has coloured noise, and a part of the coloured residual in it."""
    rng, t = np.random.default_rng(seed), 0.01 * np.arange(SAMPLES)
    v = np.sin(2.0 * t) + 0.6 * np.sin(3.3 * t + 1.0)
    a = 2.0 * np.cos(2.0 * t) + 1.98 * np.cos(3.3 * t + 1.0)
    true = np.stack([a, v, np.tanh(v / 0.05), np.ones(SAMPLES)], axis=1)
    e, own = COLOUR.sample(rng, SAMPLES, 2)
    x = true.copy()
    x[:, 0] += 0.15 * (own + common * e)
    basis = np.linalg.qr(true)[0]
    by_instruments = np.linalg.lstsq(basis.T @ x, basis.T @ e)[0]
    rest = e - x @ by_instruments
    counts = np.ones((SAMPLES, 1), bool)
    return endogeneity(rest[:, None], x[:, None, :], basis, counts)


@pytest.mark.parametrize(("common", "least", "most"), [(0.0, 0.02, 0.10), (0.1, 0.35, 0.7), (0.3, 0.98, 1.0)])
def test_size_and_power(common, least, most):
    """Of 200 draws: binomial deviations of 1.5 % at a twentieth and 3.5 % at one half."""
    results = [drawn(seed, common) for seed in range(200)]
    assert {r.degrees_of_freedom for r in results} == {1}
    assert least <= np.mean([r.biased for r in results]) <= most


def test_a_regressor_that_is_known_exactly_has_nothing_to_test():
    rng = np.random.default_rng(0)
    x, e = rng.standard_normal((300, 1, 2)), rng.standard_normal((300, 1))
    basis = np.linalg.qr(x[:, 0])[0]
    assert endogeneity(e, x, basis, np.ones((300, 1), bool)) is None


def test_the_bias_is_that_of_least_squares():
    """Its step is the ordinary least-squares solution; its sign says what noise does to the acceleration."""
    result = drawn(0, 0.3)
    assert result.bias.shape == (4,)
    assert int(np.argmax(np.abs(result.bias))) == 0
    words = result.text(["inertia", "viscous", "coulomb", "offset"])
    assert words.startswith("least squares is biased by noise in the loop, most by ")
    assert "of its standard deviations in inertia (Durbin-Wu-Hausman test: chi-squared " in words
    content = result.json(["inertia", "viscous", "coulomb", "offset"])
    assert content["biased"] is True
    assert content["bias_in_std"]["inertia"] == pytest.approx(float(result.bias[0]))


def exact_logs(
    folder, noise: float, force: float, more: str, runs: int, method: str = "instrumental_variable"
):
    sensor = Sensor(position_resolution=1e-12, position_noise=noise, force_noise=force)
    setup = dataclasses.replace(emps_like(0, duration=4.0), sensor=sensor)
    case = write_case(folder, case_text(setup, (VISCOUS, COULOMB)) + more)
    logs = [log_of(dataclasses.replace(setup, seed=k)) for k in range(runs)]
    return [e.details["durbin_wu_hausman"] for e in identify_many(case, logs, method=method)]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["instrumental_variable", "inverse_dynamics"])
def test_size_and_power_on_the_exact_axis(tmp_path, method):
    """In its loop: readings without noise, and a micrometre of it through a filter that is far too wide."""
    exact = exact_logs(tmp_path, 0.0, 0.1, "", 100, method)
    # Never above the size; spikes at the reversals make it smaller.
    assert np.mean([r["biased"] for r in exact]) <= 0.1
    assert np.median([r["p_value"] for r in exact]) > 0.35
    assert exact[0]["text"].startswith("least squares is not biased by noise in the loop")
    noisy = exact_logs(tmp_path, 1e-6, 2e-3, WIDE, 20, method)
    assert all(r["biased"] and r["bias_in_std"]["inertia"] < -3 for r in noisy)
    assert all("most by -" in r["text"] and "in inertia" in r["text"] for r in noisy)


def test_it_stands_beside_inverse_dynamics_in_a_known_loop(tmp_path, capsys):
    case, log = place(tmp_path / "loop", recorded())
    ran = run(capsys, "identify", case, log, "--method", "inverse_dynamics", folder=tmp_path / "out")
    assert ran.status == 0
    assert "Durbin-Wu-Hausman test: chi-squared" in ran.out
    assert ran.json("result.json")["durbin_wu_hausman"]["degrees_of_freedom"] > 0


def test_instruments_of_one_simulation_find_what_iterated_ones_find(tmp_path):
    noisy = (1e-6, 2e-3, WIDE, 1)
    (one,) = exact_logs(tmp_path, *noisy, "inverse_dynamics")
    (iterated,) = exact_logs(tmp_path, *noisy)
    assert one["biased"]
    assert one["bias_in_std"]["inertia"] < -3
    # The scatter of the statistic is sqrt(2 (3 + 2 * 234)) = 31; a bias matters from one deviation on.
    assert one["statistic"] == pytest.approx(iterated["statistic"], abs=10)
    assert one["bias_in_std"] == pytest.approx(iterated["bias_in_std"], abs=0.1)


@pytest.fixture
def loop(tmp_path):
    """A log in its loop."""
    setup = emps_like(0, duration=4.0)
    return open_session(write_case(tmp_path, case_text(setup, (VISCOUS, COULOMB))), log_of(setup))


def is_tested(session, **changes):
    """Whether an estimate of inverse dynamics is tested, with other parts of the machine."""
    machine = dataclasses.replace(session.machine, **changes)
    estimate = inverse_dynamics(session.machine, session.fit.data)
    assert estimate.all_identified
    found = run_alone(with_loop_noise(dataclasses.replace(session, machine=machine), estimate))
    return "durbin_wu_hausman" in found.details


def test_it_needs_a_loop_that_stays_at_the_log(loop):
    assert is_tested(loop)
    assert not is_tested(loop, controller=None)
    law = loop.machine.controller
    assert not is_tested(loop, controller=dataclasses.replace(law, kp=law.kp / 1000))


def test_starts_of_other_methods_are_not_tested(loop, monkeypatch):
    monkeypatch.setattr(loop_noise, "endogeneity", lambda *of: pytest.fail("tested"))
    assert run_alone(_start(loop)) is not None
    with pytest.raises(pytest.fail.Exception):
        is_tested(loop)
