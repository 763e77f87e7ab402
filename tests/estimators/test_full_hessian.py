"""Covariance by the full Hessian: against differences of the gradient, and the scatter of many logs."""

import json
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

import jaxid
from jaxid.build import build_machine
from jaxid.estimators.output_error import output_error, output_error_steps
from jaxid.estimators.simulated_output import output_residual
from jaxid.logs.log import Log
from jaxid.numerics.full_hessian import full_hessian, hessian_covariance
from jaxid.numerics.lanes import run_batched
from jaxid.numerics.precision import assess, hessian_notes
from jaxid.simulation.replay import Numerics, make_replay, with_fitted_start
from tests.support.cli_setup import place, recorded, refused, run

PERIOD, SAMPLES, STIFFNESS = 0.02, 300, 200.0
MASS, DAMPING = 2.0, 0.5
# Noise of 20 cm on a swing of 8 cm: the stiffness is known to 4 %, and the cost is no parabola.
NOISE = 0.2
CASE = {
    "plant": {"kind": "axis", "parameters": {"inertia": MASS}},
    "effects": [
        {"kind": "viscous_friction", "coefficient": DAMPING},
        {"kind": "linear_stiffness", "coefficient": {"guess": STIFFNESS, "min": 1.0}},
    ],
    "log": {"time": "t", "position": "q", "force": "u"},
    "sensor": {"position_noise": NOISE},
}
NUMERICS = Numerics(substeps=4)
# The log whose noise makes the cost flattest, of the first sixteen.
BENT = 12


def swing() -> tuple[np.ndarray, np.ndarray]:
    """A pulse of force on a mass at a spring, and its exact swing: by the matrix exponential."""
    a = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    b = np.array([[0.0], [1.0 / MASS]])
    step, push, *_ = scipy.signal.cont2discrete((a, b, np.eye(2), np.zeros((2, 1))), PERIOD)
    u, x = np.zeros(SAMPLES), np.zeros((SAMPLES, 2))
    u[5:15] = 10.0
    for k in range(SAMPLES - 1):
        x[k + 1] = step @ x[k] + push[:, 0] * u[k]
    return u, x[:, 0]


def logs(count: int, noise: float = NOISE) -> list[Log]:
    u, q = swing()
    noisy = [q + noise * np.random.default_rng(k).standard_normal(SAMPLES) for k in range(count)]
    time = PERIOD * np.arange(SAMPLES)
    return [Log(time=time, position=y[:, None], force=u[:, None], source="swing") for y in noisy]


@pytest.fixture(scope="module")
def machine():
    return build_machine(jaxid.load_case(CASE), period=PERIOD)


@dataclass(frozen=True)
class Curvature:
    """Half the sum of squares at a fit, by the stiffness and the start: its matrices."""

    differenced: np.ndarray
    full: np.ndarray
    normal: np.ndarray


def curvature(machine, log, theta) -> Curvature:
    """Differences of the gradient, jaxid's Hessian, and J'J, at an estimate and its best start."""
    replay = with_fitted_start(make_replay(machine, log, NUMERICS), machine.plant, log)
    residual = jax.jit(
        output_residual(
            replay,
            machine.parameters.places,
            machine.plant,
            jnp.asarray(log.position),
            jnp.ones((SAMPLES, 1)),
        )
    )
    jacobian = jax.jit(jax.jacfwd(residual))
    x = np.concatenate([theta, np.zeros(2)])
    # The swing is linear in its start.
    x[1:] -= np.linalg.lstsq(np.asarray(jacobian(x))[:, 0, 1:], np.asarray(residual(x))[:, 0])[0]
    gradient = lambda x: np.asarray(jacobian(x))[:, 0].T @ np.asarray(residual(x))[:, 0]
    steps = np.diag([1e-3, 1e-6, 1e-6])
    rows = [(gradient(x + d) - gradient(x - d)) / (2 * d[k]) for k, d in enumerate(steps)]
    j = np.asarray(jacobian(x))[:, 0]
    assert abs(gradient(x)[0]) < 1e-3 * np.linalg.norm(j[:, 0]) * NOISE
    return Curvature(np.array(rows), np.asarray(jax.jit(lambda x: full_hessian(residual, x))(x)), j.T @ j)


def test_the_covariance_is_that_of_differences_of_the_gradient(machine):
    """A log whose noise bends the cost by half: with J'J for the Hessian each of these lines fails."""
    log = logs(BENT + 1)[BENT]
    full = output_error(machine, log, numerics=NUMERICS, hessian=True)
    gauss = output_error(machine, log, numerics=NUMERICS)
    np.testing.assert_array_equal(full.theta, gauss.theta)
    assert (full.precision.kind, gauss.precision.kind) == ("full_hessian", "gauss_newton")
    at = curvature(machine.with_estimate(full.theta), log, full.theta)
    size = np.sqrt(np.outer(np.diag(at.normal), np.diag(at.normal)))
    np.testing.assert_allclose(at.full / size, at.differenced / size, atol=1e-5)
    assert np.abs((at.normal - at.differenced) / size).max() > 0.2
    wanted, dropped = (np.sqrt(np.linalg.inv(m)[0, 0]) for m in (at.differenced, at.normal))
    assert wanted / dropped > 1.25
    assert full.std[0] / gauss.std[0] == pytest.approx(wanted / dropped, rel=0.02)


@pytest.mark.slow
def test_the_scatter_of_many_logs_is_that_of_the_full_hessian(machine):
    """256 logs in three groups, by how much their own noise bends the cost.

    Errors over the deviation by the full Hessian scatter alike in each; over that of Gauss-Newton the
    group of flat costs scatters more than 1.4 times as much as that of steep ones.
    """
    made = logs(256)
    steps = lambda **more: [output_error_steps(machine, log, numerics=NUMERICS, **more) for log in made]
    full, gauss = run_batched(steps(hessian=True), 16), run_batched(steps(), 16)
    assert {e.precision.kind for e in full} == {"full_hessian"}
    error = np.array([e.theta[0] - STIFFNESS for e in full])
    ours, theirs = (np.array([e.std[0] for e in of]) for of in (full, gauss))
    groups = np.array_split(np.argsort(ours / theirs), 3)
    assert np.mean((ours / theirs)[groups[2]]) > 1.35 * np.mean((ours / theirs)[groups[0]])
    scatter = lambda std: np.array([np.std(error[g] / std[g]) for g in groups])
    # A scatter of 85 logs is known to 8 %.
    assert scatter(theirs)[2] > 1.4 * scatter(theirs)[0]
    assert scatter(ours).max() < 1.25 * scatter(ours).min()
    assert np.all(np.abs(scatter(ours) - 1.15) < 0.2)


def test_a_curve_that_is_no_valley_is_said():
    """A Hessian that is not positive definite is not used."""
    rows = np.random.default_rng(0).standard_normal((200, 1, 2))
    e = np.random.default_rng(1).standard_normal((200, 1))
    counts, scale = np.ones((200, 1), bool), np.ones(2)
    plain = assess(["a", "b"], rows, e, counts, 100.0, scale)
    for matrix, kind in ((np.diag([50.0, -1.0]), "gauss_newton"), (np.diag([50.0, 800.0]), "full_hessian")):
        got = assess(["a", "b"], rows, e, counts, 100.0, scale, matrix)
        assert got.kind == kind
        assert (got.std == plain.std).all() == (kind == "gauss_newton")
        assert ("not positive definite" in hessian_notes(got, True)[0]) == (kind == "gauss_newton")
    assert hessian_notes(plain, False) == []


def test_white_noise_gives_the_inverse_of_the_observed_information():
    rng = np.random.default_rng(2)
    square = lambda: (lambda a: a @ a.T + np.eye(3))(rng.standard_normal((3, 3)))
    normal, hessian = square(), square()
    covariance, _ = hessian_covariance(normal, 0.3 * normal, hessian)
    np.testing.assert_allclose(covariance, 0.3 * np.linalg.inv(hessian), rtol=1e-9)
    meat = square()
    same, ratio = hessian_covariance(normal, meat, normal)
    np.testing.assert_allclose(same, np.linalg.inv(normal) @ meat @ np.linalg.inv(normal), rtol=1e-9)
    np.testing.assert_allclose(ratio, 1.0)


def test_it_is_asked_for_by_option_case_and_argument(tmp_path, capsys):
    case, log = place(tmp_path / "in", recorded())
    ran = run(capsys, "identify", case, log, "--hessian", folder=tmp_path / "out")
    assert ran.status == 0
    assert "σ from the full Hessian" in ran.out
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["covariance"]["kind"] == "full_hessian"
    stated = case.read_text() + "[identification]\nhessian = true\n"
    case.write_text(stated)
    by_case = jaxid.identify(case, log)
    np.testing.assert_allclose(by_case.covariance.matrix, content["covariance"]["matrix"], rtol=1e-9)
    plain = jaxid.identify(case, log, hessian=False)
    assert (by_case.covariance.kind, plain.covariance.kind) == ("full_hessian", "gauss_newton")
    for words in (("--method", "inverse_dynamics"), ("--method", "instrumental_variable", "--hessian")):
        told = f"hessian needs a method that maximises a likelihood, and {words[1]} does not"
        refused(capsys, tmp_path, "identify", case, log, *words, "-o", tmp_path / "none", told=told)
