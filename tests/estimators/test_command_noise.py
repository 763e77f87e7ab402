"""Extrapolation of the shift by noise of the logged command, and the steps and lanes of such fits."""

import numpy as np
import pytest

from benchmarks.interval_machines import MACHINES
from jaxid.estimators.command_noise import Shift, shift_from_none
from jaxid.estimators.innovations import fit_steps
from jaxid.estimators.likelihood import likelihood_of
from jaxid.session import open_session
from jaxid.simulation.noisy_loop import _levels_beside

LINE, BEND = np.array([1.0, -2.0, 0.5]), np.array([0.05, 0.02, -0.03])
INFORMATION = np.diag([1.0, 4.0, 0.25])


def shifts(line: np.ndarray, bend: np.ndarray) -> list[Shift]:
    """The shifts by half of the variance and by all of it, if a shift is line v + bend v^2."""
    return [Shift(line * v + bend * v**2, INFORMATION) for v in (0.5, 1.0)]


def likelihood(folder, machine: str):
    text, log, _ = MACHINES[machine](0, "known", "stated")
    path = folder / "case.toml"
    path.write_text(text)
    session = open_session(path, log)
    rest = np.asarray(session.fit.data.recipe.rest_velocity)
    return session, likelihood_of(session.machine, session.fit.log, rest_velocity=rest)


def test_a_shift_that_follows_a_parabola_is_taken_back_to_no_noise():
    assert shift_from_none(*shifts(LINE, BEND)) == pytest.approx(LINE - BEND, rel=1e-12)


def test_a_shift_that_bends_far_is_taken_for_a_line():
    far = 20 * BEND
    assert shift_from_none(*shifts(LINE, far)) == pytest.approx(LINE + far, rel=1e-12)


@pytest.mark.parametrize(("machine", "least"), [("axis", 4), ("flexible_axis", 8)])
def test_samples_at_rest_behind_a_spring_take_finer_steps(tmp_path, machine, least):
    """With four steps the Coulomb friction of a flexible axis was 1.5 standard deviations off on average."""
    _, made = likelihood(tmp_path, machine)
    assert made.problem.kalman.drive.substeps == 1
    assert made.at_rest_too(made.problem).kalman.drive.substeps == least


@pytest.mark.parametrize(("machine", "alone"), [("axis", False), ("stage", True)])
def test_machines_with_memory_are_fitted_one_by_one(tmp_path, machine, alone):
    session, made = likelihood(tmp_path, machine)
    request = next(fit_steps(made.problem, session.machine.parameters.guess, made.noise, 1))
    assert request.alone == alone


def test_levels_of_noise_beside_one_go_by_joint():
    levels = [np.array([k, 10.0 * k]) for k in (1.0, 2.0, 3.0)]
    beside = np.stack(_levels_beside(np.array([1.0, 20.0]), levels))
    assert np.array_equal(beside, [[1.0, 10.0], [1.0, 20.0], [2.0, 30.0]])
    (only,) = _levels_beside(np.array([5.0, 5.0]), levels[:1])
    assert np.array_equal(only, levels[0])
