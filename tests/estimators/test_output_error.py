"""Output error on position, on force, or on both: one loop, one fit, its precision, and what is refused."""

import re

import numpy as np
import pytest

import jaxid
from jaxid.numerics.precision import assess
from tests.support.axis_log import log_of
from tests.support.cli_setup import place, recorded, refused, run, text
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like

VISCOUS = ("viscous_friction", {"coefficient": 203.5})
COULOMB = ("coulomb_friction", {"level": 20.39})
TRUTH = np.array([95.1, 203.5, 20.39])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Ten times the usual noise of position and force."""
    setup = emps_like(2, noise=10.0, duration=4.0)
    folder = tmp_path_factory.mktemp("outputs")
    return write_case(folder, case_text(setup, [VISCOUS, COULOMB], off=2.0)), log_of(setup)


@pytest.fixture(scope="module")
def fits(files):
    return {on: jaxid.identify(*files, on=on).estimate for on in ("position", "force", "both")}


@pytest.mark.parametrize("on", ["position", "force", "both"])
def test_truth_is_recovered(fits, on):
    estimate = fits[on]
    assert estimate.converged
    np.testing.assert_allclose(estimate.theta, TRUTH, rtol=6e-3)
    # Sigmas are those of a loop that feeds the noise back, which the simulated one does not.
    assert np.all(np.abs(estimate.theta - TRUTH) < 6 * estimate.std)


@pytest.mark.parametrize("limit", ["", "limit = 10.0\n"], ids=["no limit", "between limits"])
def test_a_loop_that_diverges_at_the_first_values(files, tmp_path, limit):
    """A hundredth of the inertia makes the sampled loop unstable; the logged force leads back."""
    case, log = files
    said = re.sub(r"inertia = .*", "inertia = { guess = 1.0 }", case.read_text())
    said = said.replace("limit = 10.0\n", limit) + '[output_error]\nstart = "guess"\n'
    estimate = jaxid.identify(write_case(tmp_path, said), log, method="output_error").estimate
    assert estimate.converged
    assert any("diverged at the first values" in note for note in estimate.notes)
    np.testing.assert_allclose(estimate.theta, TRUTH, rtol=6e-3)


def test_each_compares_what_it_says(files, fits):
    samples = files[1].samples
    widths = {on: e.residual.shape for on, e in fits.items()}
    assert widths == {"position": (samples, 1), "force": (samples, 1), "both": (samples, 2)}
    # In newtons alone; in standard deviations where the two are added.
    assert 0.5 < np.std(fits["force"].residual) < 5.0
    np.testing.assert_allclose(np.std(fits["both"].residual, axis=0), 1.0, rtol=0.05)
    assert not np.array_equal(fits["position"].theta, fits["force"].theta)


def test_the_case_may_say_it(files, fits):
    case, log = files
    said = write_case(case.parent, case.read_text() + '[output_error]\non = "force"\n')
    np.testing.assert_array_equal(jaxid.identify(said, log).estimate.theta, fits["force"].theta)


def test_noise_in_common_counts_once():
    """The same residual twice tells no more than once; an independent one does."""
    rng = np.random.default_rng(0)
    e, other = rng.standard_normal((2, 4000))
    column = np.sin(np.arange(4000) / 30.0)
    counts = np.ones((4000, 2), bool)

    def std(second, crossed):
        residual, jacobian = np.stack([e, second], axis=1), np.repeat(column[:, None, None], 2, axis=1)
        return assess(["a"], jacobian, residual, counts, 100.0, np.ones(1), crossed=crossed).std[0]

    alone = 1 / np.linalg.norm(column)
    assert std(e, True) == pytest.approx(alone, rel=0.05)
    assert std(e, False) == pytest.approx(alone / np.sqrt(2), rel=0.05)
    assert std(other, True) == pytest.approx(alone / np.sqrt(2), rel=0.1)


FAULTS = {
    "unknown": (("--on", "speed"), "on 'speed' is not known; "),
    "another method": (("--on", "force", "--method", "algebraic"), "on 'force' goes only with output_error"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_wrong_options(tmp_path, capsys, fault):
    words, told = FAULTS[fault]
    files = place(tmp_path / "in", recorded())
    refused(capsys, tmp_path, "identify", *files, *words, "-o", tmp_path / "out", told=told)


def test_an_open_loop_makes_no_force(tmp_path, capsys):
    case = text()
    case = case[: case.index("[controller]")].replace('reference = "ref"\n', "")
    files = place(tmp_path / "in", recorded(), case)
    argv = ("identify", *files, "--on", "both", "-o", tmp_path / "out")
    refused(capsys, tmp_path, *argv, told="output_error on both needs a loop")


def test_both_from_the_command_line(tmp_path, capsys):
    files = place(tmp_path / "in", recorded())
    ran = run(capsys, "identify", *files, "--on", "both", folder=tmp_path / "out")
    assert ran.status == 0
    assert "fitted on position and force" in ran.out
    assert (tmp_path / "out" / "report.html").exists()
