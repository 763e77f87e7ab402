"""Fits of an arm of servos as a whole, from commands and encoders of the exact stepper."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.unforced import covered, of
from benchmarks.unforced_machines import NOISE
from jaxid.commands.identify import identify
from jaxid.estimators.apart.joint import is_arm_of_servos, stands_apart, unknowns_of_joints
from jaxid.estimators.apart.steps import apart_steps
from jaxid.estimators.apart.whole import why_not_whole
from jaxid.estimators.several.parts import parts_of
from jaxid.estimators.ticks import best_ticks_of_joints
from jaxid.numerics.lanes import run_alone
from jaxid.session import open_session


@pytest.fixture(scope="module")
def drawn():
    """An arm of 200 Hz whose commands are held over four ticks; every guess is two to five times off."""
    return replace(of("arm_nulls", 3), far=True)


@pytest.fixture(scope="module")
def columns(drawn):
    return drawn.columns()


def with_payload(case: dict, drawn) -> dict:
    """The case with a second link whose mass and first moment are unknown, and with known gains."""
    first, second = case["plant"]["links"]
    mass, along, across = drawn.links.mass[1], drawn.links.along[1], drawn.links.across[1]
    moment = [{"guess": 0.4 * mass * along}, mass * across, 0.0]
    links = [first, {**second, "mass": {"guess": 2.5 * mass}, "first_moment": moment}]
    gains = {**case["controller"], "kp": [servo.kp for servo in drawn.servos]}
    return {**case, "plant": {**case["plant"], "links": links}, "controller": gains}


def leaves(drawn, estimate) -> np.ndarray:
    """RMS of a fit's residual at each joint over the noise of the encoders."""
    noise = np.hypot(NOISE, drawn.count / np.sqrt(12))
    return np.sqrt(np.nanmean(np.square(estimate.residual), axis=0)) / noise


def test_an_unknown_link_belongs_to_no_joint(drawn, columns):
    session = open_session(with_payload(drawn.case(), drawn), columns)
    machine, parts = session.machine, parts_of(session)
    assert is_arm_of_servos(machine, parts)
    assert not stands_apart(machine, parts)
    names = np.array(machine.parameters.names)
    others = set(names) - set(names[unknowns_of_joints(machine)])
    assert others == {"mass[2]", "first_moment_x[2]"}


def test_an_arm_whose_joint_stays_or_whose_logs_are_long_is_not_fitted_as_a_whole(drawn, columns):
    def reason(log: dict) -> str:
        session = open_session(drawn.case(), log)
        return why_not_whole(session.machine, parts_of(session), None)

    assert reason(columns) == ""
    assert "never moves" in reason({**columns, "r2": np.full_like(columns["r2"], 0.3)})
    case = drawn.case()
    case["controller"]["period"] /= 200
    session = open_session(case, columns)
    assert "so long" in why_not_whole(session.machine, parts_of(session), None)


@pytest.mark.slow
def test_all_servos_are_found_from_guesses_two_to_five_times_off(drawn, columns):
    session = open_session(drawn.case(), columns)
    truth = np.array([drawn.truth()[name] for name in session.machine.parameters.names])
    guess = session.machine.parameters.guess
    assert np.all(np.maximum(guess / truth, truth / guess) > 1.9)
    # Joint by joint, along the measured motion, friction and rotors are off by more than a tenth.
    alone = run_alone(apart_steps(session.machine, parts_of(session)))
    assert np.max(np.abs(alone.theta / truth - 1)) > 0.1
    assert np.min(leaves(drawn, alone)) > 3.0

    result = identify(drawn.case(), columns)
    estimate = result.estimate
    assert estimate.converged
    assert np.max(leaves(drawn, estimate)) < 1.4
    assert np.all(np.abs(estimate.theta - truth) < 4 * estimate.std)
    assert np.all(np.abs(estimate.theta / truth - 1) < 0.05)
    notes = " ".join(estimate.notes)
    assert "all joints were fitted at once" in notes
    assert "the mean is fitted" in notes


@pytest.mark.slow
def test_a_payload_is_found_with_the_servos(drawn, columns):
    """Guesses are 2.5 times off, those of the servos two to five times; kp is known."""
    result = identify(with_payload(drawn.case(), drawn), columns)
    mass = drawn.links.mass[1]
    truth = {**drawn.truth(), "mass[2]": mass, "first_moment_x[2]": mass * drawn.links.along[1]}
    assert result.converged
    assert np.max(leaves(drawn, result.estimate)) < 1.4
    for name, found in result.parameters.items():
        assert abs(found.value - truth[name]) < 4 * found.std, name
        assert abs(found.value / truth[name] - 1) < 0.1, name


@pytest.mark.slow
def test_most_intervals_hold_on_another_arm():
    fit = covered(of("arm_coverage", 0))
    assert fit["converged"]
    assert len(fit["z"]) == 12
    assert max(map(abs, fit["z"].values())) < 4.0


@pytest.mark.slow
def test_noise_that_goes_round_the_loop_is_in_the_fitted_mean():
    """Without it 0.2 % of a gain and 0.3 % of a delay are noise: 3 standard deviations of each."""
    fit = covered(of("arm_coverage", 13))
    assert fit["converged"]
    assert max(map(abs, fit["z"].values())) < 2.5


@pytest.mark.slow
def test_a_fit_beside_the_true_tick_moves_to_it():
    """From a tick beside the true one at both joints; the delays are whole ticks of the exact stepper."""
    drawn = of("arm_coverage", 0)
    session = open_session(drawn.case(), drawn.columns())
    machine, parts = session.machine, parts_of(session)
    names, period = machine.parameters.names, 1 / drawn.rate
    true = np.array([drawn.truth()[name] for name in names])
    delays = np.array(["delay" in name for name in names])
    for steps in ((1, 1), (1, -1), (-2, 0)):
        start = true.copy()
        start[delays] += period * np.array(steps)
        found = run_alone(best_ticks_of_joints(machine, parts, start))
        np.testing.assert_allclose(found[delays], true[delays], atol=1e-9)
