"""Intervals of an estimator, on logs of an exact simulator with fresh noise in each."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.stats

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.estimators import METHODS
from jaxid.estimators.inverse_dynamics import inverse_dynamics
from jaxid.estimators.simulated_output import choose_numerics
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_another, open_session
from jaxid.simulation.replay import from_rest, make_replay, with_fitted_start
from tests.support.axis_log import log_of
from tests.support.cli_setup import TRUTH
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like

RUNS = 60


def test_intervals_of_inverse_dynamics_hold_the_truth(tmp_path):
    """In its loop, with friction that sticks and noise of force and position: 95 %, by 60 runs."""
    setup = emps_like(0, noise=10.0, duration=4.0)
    path = write_case(tmp_path, case_text(setup, [*setup.machine.effects.items()]))
    session = open_session(path, log_of(setup), align_hold=True)
    truth = np.array([TRUTH[name] for name in session.machine.parameters.names])
    z = []
    for seed in range(RUNS):
        data = open_another(session, log_of(replace(setup, seed=1000 + seed))).data
        estimate = inverse_dynamics(session.machine, data)
        z.append((estimate.theta - truth) / estimate.std)
    z = np.array(z)
    inside = np.sum(np.abs(z) < 1.96, axis=0)
    low, high = scipy.stats.binom.ppf([5e-4, 1 - 5e-4], RUNS, 0.95)
    assert np.all((inside >= low) & (inside <= high)), inside / RUNS
    # Two-sided: a sigma twice too large is seen in the scatter.
    few, many = np.sqrt(scipy.stats.chi2.ppf([5e-4, 1 - 5e-4], RUNS - 1) / (RUNS - 1))
    assert np.all((z.std(axis=0, ddof=1) > few) & (z.std(axis=0, ddof=1) < many)), z.std(axis=0)


@pytest.mark.parametrize(
    ("loop", "sensor", "seed"), [("open", "stated", 0), ("unknown", "not stated", 11)], ids=["noise", "rest"]
)
def test_output_error_counts_the_noise_of_the_force(tmp_path, loop, sensor, seed):
    """Without it these two fits were 54 and 28 standard deviations off; the second starts at rest."""
    text, log, true = MACHINES["axis"](seed, loop, sensor)
    path = tmp_path / "case.toml"
    path.write_text(text)
    [fit] = jaxid.identify_many([path], [log], method="output_error")
    z = np.array(
        [(fit.value(name) - value) / std for (name, value), std in zip(true.items(), fit.std, strict=True)]
    )
    assert fit.converged
    assert np.all(np.abs(z) < 3.5), z
    assert any("was simulated" in note for note in fit.notes)
    # Not by intervals that hold everything: inertia to a part in a hundred.
    assert fit.std[0] < 0.01 * true["inertia"]


@pytest.mark.slow
@pytest.mark.parametrize("loop", ["known", "unknown"])
def test_intervals_of_an_arm_in_a_loop_hold(tmp_path, loop):
    """Of 100 logs without a declared loop 95 % of the intervals do; see benchmarks/results/intervals.md."""
    text, log, true = MACHINES["arm"](1, loop, "stated")
    path = tmp_path / "case.toml"
    path.write_text(text)
    fit = jaxid.identify(path, log).estimate
    assert fit.method == "prediction_error"
    z = [(value - true[name]) / std for name, value, std in zip(fit.names, fit.theta, fit.std, strict=True)]
    assert np.all(np.abs(z) < 3.5), z
    assert np.all(fit.std < 0.02 * np.abs(fit.theta) + 1e-3)


def test_a_machine_that_sticks_at_first_starts_at_rest(tmp_path):
    """The start that is fitted to its first readings once had 5.6 m/s."""
    text, log, true = MACHINES["chain"](7, "open", "stated")
    path = tmp_path / "case.toml"
    path.write_text(text)
    session = open_session(path, log)
    machine = session.machine.with_estimate(np.array([*true.values()]))
    replay = make_replay(machine, session.fit.log, choose_numerics(machine, session.fit.log))
    begun = with_fitted_start(from_rest(replay), machine.plant, session.fit.log)
    assert np.all(np.abs(np.asarray(begun.velocity)) < 1e-3)


def test_a_log_cut_into_segments_is_said_to_have_small_deviations(tmp_path):
    """A restart adds noise whose size is not known."""
    text, log, _ = MACHINES["axis"](0, "open", "stated")
    path = tmp_path / "case.toml"
    path.write_text(text)
    steps = METHODS["output_error"](open_session(path, log), numerics=jaxid.Numerics(segment=200))
    fit = run_alone(steps)
    assert any("the standard deviations are too small" in note for note in fit.notes)


@pytest.mark.slow
def test_the_noise_of_a_force_that_the_law_explains_falls_below_the_floors_before(tmp_path):
    """At those floors 98.7 % of 600 intervals held, because the standard deviations were too large."""
    noise = []
    for seed in (0, 87):
        text, log, _ = MACHINES["axis"](seed, "known", "stated")
        path = tmp_path / f"{seed}.toml"
        path.write_text(text)
        fit = jaxid.identify(path, log).estimate
        assert fit.converged
        noise.append(fit.details["noise"]["force"][0] / np.std(log["u"]))
        assert any("came to the lowest value that the filter allows" in note for note in fit.notes)
    # Where a fit at the lowest floor does not converge, that of the floor before counts.
    assert noise[0] < 0.5e-5
    assert noise[1] < 2e-5


@pytest.mark.slow
def test_an_exact_posterior_has_the_noise_of_its_fit(tmp_path):
    """Above the floor that the fit had left behind it was 1.6 times as wide."""
    text, log, _ = MACHINES["axis"](0, "known", "stated")
    path = tmp_path / "case.toml"
    path.write_text(text)
    result = jaxid.identify(path, log)
    drawn = result.to_arviz(exact=True)["posterior"]
    ratio = [float(drawn[name].std()) / found.std for name, found in result.parameters.items()]
    assert np.all(np.abs(np.log(ratio)) < 0.1)
