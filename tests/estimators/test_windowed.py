"""Least squares on integrals over windows: their covariance, against the scatter of drawn noise."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
import scipy.sparse
import scipy.stats

import jaxid
from benchmarks.interval_machines import MACHINES
from jaxid.estimators.algebraic.windows import kernels_of, weak_residual
from jaxid.estimators.common.halts import Friction, errors_at_halts
from jaxid.estimators.common.windowed import row_covariance_steps, weights_of_rows
from jaxid.numerics.lanes import run_alone
from jaxid.numerics.precision import assess
from jaxid.numerics.rows import Rows
from jaxid.session import open_session
from jaxid.simulation.force_balance import ForceData, sharpened
from tests.support.axis_log import log_of
from truth.axis.cases import case_text, write_case
from truth.axis.machines import emps_like

DRAWS = 400


@pytest.fixture(scope="module")
def axis(tmp_path_factory):
    """An axis without dry friction, its readings and its force noisy."""
    setup = emps_like(0, noise=10.0, duration=2.0)
    case = case_text(setup, [("viscous_friction", {"coefficient": 203.5})])
    return open_session(write_case(tmp_path_factory.mktemp("axis"), case), log_of(setup))


def test_rows_of_overlapping_windows_scatter_as_their_covariance_says(axis):
    """Noise of force and readings in the rows of `weak_residual`, which knows nothing of kernels."""
    machine, log, data = axis.machine, axis.fit.log, axis.fit.data
    length = 200
    starts = np.arange(0, log.samples - length + 1, length // 2)
    kernels = kernels_of(length, np.ones((len(starts), 1), bool), data.period)
    expected = run_alone(row_covariance_steps(machine, data, kernels, log)).toarray()

    plant, arrays = sharpened(machine.plant, data), ForceData.of(data)
    rng, std = np.random.default_rng(0), machine.sensor.force_noise * machine.gain
    pushed = std * rng.standard_normal((DRAWS, *data.force.shape))
    moved = machine.sensor.position_std * rng.standard_normal((DRAWS, *log.position.shape))

    @jax.jit
    def rows(pushed, moved):
        noisy = ForceData(**{**vars(arrays), "force": arrays.force + pushed})
        return weak_residual(plant, noisy, log.position + moved, length)[:, 0]

    e = np.asarray(jax.lax.map(lambda noise: rows(*noise), (pushed, moved)))
    size = np.diag(expected)
    error = np.sqrt((np.outer(size, size) + expected**2) / DRAWS)
    off = np.cov(e.T) - expected
    np.testing.assert_array_less(np.abs(off), 5 * error)
    # What neighbours share is seen, and is right.
    shared, of_shared = np.sum(np.diag(expected, 1)), np.linalg.norm(np.diag(error, 1))
    assert abs(np.sum(np.diag(off, 1))) < 5 * of_shared < shared


def regression(rng) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian of 40 rows by two unknowns, and a covariance of neighbours and of six rows with one halt."""
    t = np.linspace(0.0, 1.0, 40)
    jacobian = np.stack([1.0 + 0 * t, np.sin(3 * t)], axis=1)
    covariance = np.eye(40) + 0.4 * (np.eye(40, k=1) + np.eye(40, k=-1))
    halted = np.zeros(40)
    halted[[7, 8, 9, 10, 24, 25]] = [6.0, 10.0, 10.0, 6.0, 8.0, 8.0]
    return jacobian, covariance + np.outer(halted, halted)


def fitted(jacobian, e, covariance) -> tuple[np.ndarray, np.ndarray]:
    """Estimates of unknowns that are zero, and their standard deviations."""
    counts = np.ones((len(e), 1), bool)
    rows = Rows(jacobian[:, None], e[:, None], counts, 1e3)
    weight, known = weights_of_rows(rows, covariance)
    weighted = weight * jacobian
    precision = assess(["a", "b"], weighted[:, None], e[:, None], counts, 1e3, np.ones(2), covariance=known)
    return np.linalg.lstsq(weighted, weight[:, 0] * e, rcond=None)[0], precision.std


@pytest.mark.parametrize("loud", [1.0, 3.0])
def test_estimates_scatter_as_their_deviations_say(loud):
    """Also where the residual is louder than all that is known of its noise."""
    rng = np.random.default_rng(1)
    jacobian, covariance = regression(rng)
    root = np.linalg.cholesky(covariance + (loud**2 - 1) * np.eye(40))
    fits = [
        fitted(jacobian, root @ rng.standard_normal(40), scipy.sparse.csr_array(covariance))
        for _ in range(300)
    ]
    theta, std = (np.array(x) for x in zip(*fits, strict=True))
    scatter = theta.std(axis=0) / np.mean(std, axis=0)
    # Three standard deviations of a scatter from 300 draws.
    assert np.all(np.abs(scatter - 1.0) < 3 / np.sqrt(2 * 300)), scatter
    # Rows that count as independent give deviations too small.
    apart = scipy.sparse.csr_array(np.diag(np.diag(covariance)))
    naive = fitted(jacobian, root @ rng.standard_normal(40), apart)[1]
    if loud == 1.0:
        assert np.all(theta.std(axis=0) / naive > 1.2)
        # A row with a halt counts for little: with equal weights the estimates scatter by two fifths more.
        plain = np.linalg.pinv(jacobian)
        assert np.all(np.sqrt(np.diag(plain @ covariance @ plain.T)) > 1.4 * theta.std(axis=0))


def test_friction_errs_where_a_joint_halts_or_turns():
    """A joint that rests for 5 samples of 100, and one without dry friction."""
    qd = np.ones((100, 2))
    qd[60:, 0], qd[40:45, 0] = -1.0, 1e-4
    recipe = SimpleNamespace(rest_velocity=(1e-3, 1e-3), motion_hz=lambda rate: 50.0)
    data = SimpleNamespace(qd=qd, period=1e-3, recipe=recipe)
    friction = Friction(np.diag([20.0, 0.0]), np.ones(2), np.zeros(2))
    errors = errors_at_halts(data, friction).toarray()
    assert np.flatnonzero(np.any(errors, axis=1)).tolist() == [40, 41, 42, 43, 44, 59, 60]
    np.testing.assert_allclose(errors[40:45, 0], 20.0)
    # A jump of the acceleration leaves a filtered velocity off by jump / (2 pi^2 f): here by 0.01.
    late = errors_at_halts(data, friction._replace(jump=np.array([0.01 * 2 * np.pi**2 * 50.0, 0.0])))
    assert late.shape == errors.shape


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell", "method"),
    [
        ("axis/unknown/not stated", "algebraic"),
        ("axis/unknown/not stated", "power"),
        ("chain/known/stated", "algebraic"),
        ("chain/known/stated", "power"),
        ("chain/known/stated", "output_error"),
    ],
)
def test_intervals_hold_on_logs_that_no_one_looked_at(cell, method, tmp_path):
    """Twelve logs, of seeds beyond those of `benchmarks.intervals`: no fewer hold than 95 % would."""
    machine, loop, sensor = cell.split("/")
    cases, logs, truths = [], [], []
    for seed in range(100, 112):
        text, log, true = MACHINES[machine](seed, loop, sensor)
        cases.append(tmp_path / f"{seed}.toml")
        cases[-1].write_text(text)
        logs.append(log)
        truths.append(true)
    fits = jaxid.identify_many(cases, logs, method=method)
    z = [
        (fit.value(name) - true[name]) / std
        for fit, true in zip(fits, truths, strict=True)
        if not isinstance(fit, Exception) and fit.converged
        for name, std, ok in zip(fit.names, fit.std, fit.identifiable, strict=True)
        if ok
    ]
    assert len(z) > 0.8 * len(fits) * len(truths[0])
    held = np.sum(np.abs(z) < 1.96)
    assert held >= scipy.stats.binom.ppf(0.005, len(z), 0.95), held / len(z)
