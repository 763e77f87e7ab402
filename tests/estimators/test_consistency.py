"""Links that bodies can be: the coordinates, a fit that noise would make impossible, and what it refuses."""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxid
from jaxid.arms.pseudo_inertia import log_cholesky, of_log_cholesky, pseudo_inertia
from jaxid.cli import main
from jaxid.estimators import _start
from jaxid.estimators.common.best_bodies import nearest_bodies
from jaxid.estimators.common.consistency import links_of, need_bodies
from jaxid.estimators.common.interior import inner_start
from jaxid.estimators.common.levenberg_marquardt import eliminated
from jaxid.numerics.lanes import run_alone
from tests.support.wrist import (
    FLAT,
    LOOP_RATE,
    NOISE,
    TRUE,
    case,
    eigenvalues,
    eigenvalues_of,
    left,
    loop_log,
    looped,
    missed,
    motion,
    one_link,
    swing,
    wrist_log,
)
from truth.arm import oracle as arm_oracle

RNG = np.random.default_rng(4)


def test_pseudo_inertia_is_the_sum_over_the_body():
    bodies = arm_oracle.bodies(3, RNG)
    ours = pseudo_inertia(jnp.asarray(bodies))
    np.testing.assert_allclose(ours, arm_oracle.pseudo_inertias(bodies), atol=1e-12)


def test_coordinates_go_there_and_back_and_cover_only_bodies():
    for body in arm_oracle.bodies(5, RNG):
        x = log_cholesky(jnp.asarray(body))
        np.testing.assert_allclose(of_log_cholesky(x), body, rtol=1e-10, atol=1e-12)
    for x in RNG.normal(scale=2.0, size=(50, 10)):
        ten = of_log_cholesky(jnp.asarray(x))
        assert np.linalg.eigvalsh(arm_oracle.pseudo_inertias([ten])[0])[0] > 0
        np.testing.assert_allclose(log_cholesky(ten), x, rtol=1e-5, atol=1e-5)
    slope = jax.jacfwd(log_cholesky)(ten) @ jax.jacfwd(of_log_cholesky)(jnp.asarray(x))
    np.testing.assert_allclose(slope, np.eye(10), atol=1e-5)


def test_an_unknown_without_effect_does_not_stop_the_start_inside():
    """A friction of a joint that never turns, say: the bodies beside it are found all the same."""
    true, guess = arm_oracle.bodies(2, np.random.default_rng(0))
    columns = np.column_stack([np.random.default_rng(0).normal(size=(50, 10)), np.zeros(50)])
    theta = jnp.asarray(np.append(guess, 0.3))
    found, _ = inner_start(columns, -columns[:, :10] @ true, theta, (tuple(range(10)),), eliminated)
    np.testing.assert_allclose(found[:10], true, rtol=0, atol=1e-6)
    assert found[10] == 0.3


def test_of_what_nothing_tells_bodies_stay_near_their_start():
    """Where a body may have any mass, nothing pulls it to infinity."""
    rng = np.random.default_rng(0)
    true, guess = arm_oracle.bodies(2, rng)
    # Six of the ten, as of a link near the base.
    columns = np.zeros((40, 10))
    columns[:, [1, 2, 4, 5, 7, 9]] = rng.normal(size=(40, 6))
    found, _ = inner_start(columns, -columns @ true, jnp.asarray(guess), (tuple(range(10)),), eliminated)
    assert guess[0] / 3 < found[0] < 3 * guess[0]
    np.testing.assert_allclose(columns @ found, columns @ true, atol=1e-4)


def test_no_body_has_less_than_the_floor():
    """Noise asks for what no body can be: the best has no extent some way, and is known to be the best."""
    rng = np.random.default_rng(0)
    true, guess = arm_oracle.bodies(2, rng)
    columns = rng.normal(size=(40, 10))
    rest = -columns @ (true * np.where(np.arange(10) == 9, -0.2, 1.0)) + 0.01 * rng.normal(size=40)
    found, floor = inner_start(columns, rest, jnp.asarray(guess), (tuple(range(10)),), eliminated)
    cost = lambda theta: 0.5 * np.sum((columns @ theta + rest) ** 2)
    assert cost(np.linalg.lstsq(columns, -rest)[0]) < 0.5 * cost(found)
    assert 0 <= cost(found) - floor < 1e-8 * cost(found)
    for body in arm_oracle.bodies(50, rng):
        assert cost(found + 1e-4 * rng.uniform() * (body - found)) > floor


def test_a_step_that_rounding_leads_out_of_the_set_is_refused():
    """Directions that only rounding determines, on the edge of the set: each result is a body."""
    start_inside = jax.jit(
        lambda columns, rest, theta: inner_start(columns, rest, theta, (tuple(range(10)),), eliminated)[0]
    )
    for seed in range(100):
        rng = np.random.default_rng(seed)
        true, guess = arm_oracle.bodies(2, rng)
        seen = rng.permutation(10)[:5]
        columns = 1e-13 * rng.normal(size=(40, 10))
        columns[:, seen] = 100 * rng.normal(size=(40, 5))
        rest = -columns @ (true * np.where(np.isin(np.arange(10), seen), rng.uniform(-1, 1, 10), 1.0))
        found = start_inside(columns, rest, jnp.asarray(guess))
        assert np.linalg.eigvalsh(arm_oracle.pseudo_inertias([found])[0])[0] > 0, seed
        assert np.all(np.isfinite(log_cholesky(found))), seed


@pytest.fixture(scope="module")
def log():
    return wrist_log(0, NOISE, 9)


def fitted(folder, log, consistent, method="inverse_dynamics"):
    (folder / "case.toml").write_text(case(consistent))
    return jaxid.identify(folder / "case.toml", log, method=method)


@pytest.fixture(scope="module")
def fits(tmp_path_factory, log):
    folder = tmp_path_factory.mktemp("fits")
    return {consistent: fitted(folder, log, consistent) for consistent in (False, True)}


@pytest.mark.slow
def test_noise_makes_plain_least_squares_impossible_and_not_the_other(fits):
    plain, kept = fits[False], fits[True]
    # the moment about its own axis is told, and negative: no choice of the others makes a body of it
    at = plain.estimate.names.index("inertia_zz[3]")
    assert plain.estimate.identifiable[at]
    assert plain.estimate.theta[at] < -0.001
    assert eigenvalues(plain).min() < -0.001
    assert kept.estimate.converged
    assert eigenvalues(kept).min() > 0
    assert kept.value("inertia_zz[3]") > 0
    assert left(kept) < 1.05
    assert left(kept) < left(plain)


def test_results_hold_the_links(fits, tmp_path):
    saved = json.loads((fits[True].save(tmp_path / "out") / "result.json").read_text())
    assert len(saved["links"]) == 3
    for link, true in zip(saved["links"], eigenvalues(fits[True]), strict=True):
        assert link["mass"] > 0
        assert link["eigenvalue_ratio"] == pytest.approx(true[0] / true[-1], rel=1e-6)
    assert any("links are physically consistent" in note for note in fits[True].estimate.notes)
    assert "links" not in json.loads((fits[False].save(tmp_path / "plain") / "result.json").read_text())


def test_output_error_starts_at_the_bodies_that_inverse_dynamics_finds(fits):
    """Sums that no log tells are no reason to start at the guesses, far from what was told."""
    start = run_alone(_start(need_bodies(fits[True].session)))
    np.testing.assert_allclose(start, fits[True].estimate.theta)
    # without, what is untold may be anything
    assert run_alone(_start(fits[False].session)) is None


@pytest.mark.slow
def test_power_keeps_links_too(log, tmp_path):
    found = fitted(tmp_path, log, True, "power")
    assert found.estimate.converged
    assert eigenvalues(found).min() > 0
    assert left(found) < 1.1


@pytest.mark.slow
def test_a_recursion_ends_at_real_bodies(log, tmp_path):
    found = fitted(tmp_path, log, True, "recursive")
    assert found.estimate.converged
    assert eigenvalues(found).min() > 0
    assert left(found) < 1.1
    plain = fitted(tmp_path, log, False, "recursive")
    assert eigenvalues(plain).min() < -0.001


@pytest.mark.slow
def test_a_search_ends_at_real_bodies(log, tmp_path):
    """A friction of the second joint is hidden; links that fit best without the demand are of no body."""
    rubbing = np.array([0.0, 5.0, 0.0]) * motion(0)[2]
    rubbed = replace(log, force=log.force + rubbing)
    found = {}
    for consistent in (False, True):
        (tmp_path / "case.toml").write_text(case(consistent))
        found[consistent] = jaxid.discover(tmp_path / "case.toml", rubbed)
        assert [e.label for e in found[consistent].effects] == ["viscous_friction[2]"]
        p = found[consistent].parameters["viscous_friction[2].coefficient"]
        assert abs(p.value - 5.0) < 4 * p.std < 2.0
    least = {k: eigenvalues_of(f.after.machine.plant).min() for k, f in found.items()}
    assert least[False] < -0.001
    assert least[True] > 0


@pytest.mark.slow
@pytest.mark.parametrize("method", ["instrumental_variable", "didim"])
def test_methods_that_simulate_the_motion_keep_links_too(tmp_path, method):
    """From a loop of other physics; without, the noise of the torque asks for what no body can be."""
    (tmp_path / "case.toml").write_text(looped(True))
    (tmp_path / "plain.toml").write_text(looped(False))
    log = loop_log()
    cases = (tmp_path / f"{name}.toml" for name in ("case", "plain"))
    kept, plain = (jaxid.identify(path, log, method=method) for path in cases)
    assert kept.estimate.converged
    assert eigenvalues(kept).min() > 0
    assert eigenvalues(plain).min() < -0.001
    assert left(kept) < 1.02


@pytest.mark.slow
def test_output_error_keeps_links_too(tmp_path):
    """One link that swings; its moment about the joint, and its first moments, are told."""
    true = TRUE[0]
    (tmp_path / "case.toml").write_text(one_link())
    found = jaxid.identify(tmp_path / "case.toml", swing(0))
    assert found.estimate.method == "output_error"
    assert found.estimate.converged
    assert eigenvalues(found).min() > 0
    for name, value in (("first_moment_x", true[1]), ("first_moment_y", true[2]), ("inertia_zz", true[9])):
        at = found.estimate.names.index(f"{name}[1]")
        assert abs(found.estimate.theta[at] - value) < 4 * found.estimate.std[at], name
        assert found.estimate.std[at] < 0.01 * np.abs(true[9])


@pytest.fixture(scope="module")
def flat():
    """Four seconds of a loop of two joints, of which the second carries a flat link."""
    log = loop_log(0, 1, FLAT, 0.2)
    first = slice(0, int(4 * LOOP_RATE))
    columns = {name: getattr(log, name)[first] for name in ("time", "position", "force", "reference")}
    return replace(log, **columns)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "text"),
    [
        ("prediction_error", case(True, 2)),
        ("output_error", looped(True, 2) + "[output_error]\nprior = 0.5\ndrawn = false\n"),
    ],
)
def test_methods_without_bodies_end_at_the_nearest(tmp_path, flat, method, text):
    """The moments of a flat link are on the edge of what bodies can have, and noise leads beyond it."""
    (tmp_path / "case.toml").write_text(text)
    (tmp_path / "plain.toml").write_text(text.replace("= true", "= false", 1))
    cases = (tmp_path / f"{name}.toml" for name in ("case", "plain"))
    kept, plain = (jaxid.identify(path, flat, method=method) for path in cases)
    assert kept.estimate.method == method
    assert kept.estimate.converged
    assert eigenvalues(kept).min() > 0
    assert eigenvalues(plain).min() < -0.01
    assert missed(kept, FLAT) < 1.05 * missed(plain, FLAT) < 0.02
    assert any("nearest to the fit" in note for note in kept.estimate.notes)


def test_links_of_a_failed_fit_have_no_ratio(tmp_path):
    (tmp_path / "case.toml").write_text(case(True))
    machine = jaxid.open_session(tmp_path / "case.toml", wrist_log(0, NOISE, 9)).machine
    theta = machine.parameters.guess.copy()
    theta[0] = np.nan
    ratios = [link["eigenvalue_ratio"] for link in links_of(machine.with_estimate(theta).plant)]
    assert np.isnan(ratios[0])
    assert np.all(np.array(ratios[1:]) > 0)


def test_nearest_bodies_are_the_least_squares_of_another_solver(tmp_path):
    """A moment is not identified at all, and its value in the fit is huge; a friction has a bound."""
    rubbed = '[[effects]]\nkind = "viscous_friction"\njoint = 1\ncoefficient = { guess = 0.1 }\n'
    (tmp_path / "case.toml").write_text(case(True, 1) + rubbed)
    session = need_bodies(jaxid.open_session(tmp_path / "case.toml", wrist_log(0, NOISE, 9, TRUE[:1])))
    parameters = session.machine.parameters
    rng = np.random.default_rng(2)
    columns = rng.normal(size=(30, 11))
    columns[:, 3] = 0.0
    aim = np.append(TRUE[0], -0.05)
    aim[[4, 9]] *= -0.3
    theta = aim.copy()
    theta[3] = 1e14
    found, converged = nearest_bodies(parameters, columns, theta)
    assert converged

    of = lambda x: np.append(of_log_cholesky(jnp.asarray(x[:10])), x[10])
    cost = jax.jit(
        lambda x: jnp.sum((jnp.asarray(columns) @ (jnp.append(of_log_cholesky(x[:10]), x[10]) - aim)) ** 2)
    )
    start = np.append(log_cholesky(jnp.asarray(parameters.guess[:10])), 0.1)
    [body] = parameters.bodies
    bounds = [*zip(body.lower, body.upper, strict=True), (0.0, None)]
    other = scipy.optimize.minimize(
        cost,
        start,
        jac=jax.jit(jax.grad(cost)),
        bounds=bounds,
        method="SLSQP",
        options={"maxiter": 2000, "ftol": 1e-14},
    )
    least = float(np.sum((columns @ (found - aim)) ** 2))
    assert other.success
    # A residual of noise one: the distance is right to a few hundredths of a standard deviation.
    assert least == pytest.approx(float(other.fun), abs=1e-3)
    np.testing.assert_allclose(columns @ found, columns @ of(other.x), atol=0.05)
    assert np.linalg.eigvalsh(arm_oracle.pseudo_inertias([found[:10]])[0])[0] > 0
    assert abs(found[3]) < 1.0


@pytest.mark.parametrize(
    ("old", "new", "method", "words"),
    [
        ("mass = { guess = 1.0 }", "mass = 1.0", "power", ["link 1", "mass[1] is known and others are not"]),
        ("mass = { guess = 1.0 }", "mass = { guess = 1.0, max = 2.0 }", "power", ["mass[1] has min or max"]),
        ("mass = { guess = 1.0 }", "mass = { guess = 0.1 }", "power", ["link 1", "its guess is no body"]),
        (
            "mass = { guess",
            "mass = { guess",
            "minimal_model",
            ["does not go with minimal_model", "inverse_dynamics, power"],
        ),
        ("= true", "= 1", "power", ["physically_consistent", "true or false"]),
    ],
)
def test_what_is_no_body_is_refused_in_one_line(tmp_path, log, capsys, old, new, method, words):
    assert old in case(True)
    (tmp_path / "case.toml").write_text(case(True).replace(old, new, 1))
    rows = np.column_stack([log.time, log.position, log.force])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header="t,q1,q2,q3,u1,u2,u3", comments="")
    argv = ["identify", "case.toml", "log.csv", "--method", method]
    assert main([*argv[:1], *(str(tmp_path / a) for a in argv[1:3]), *argv[3:]]) == 2
    error = capsys.readouterr().err
    assert len(error.strip().splitlines()) == 1
    assert not [word for word in words if word not in error], error
