"""Solvers of optimistix in place of jaxid's, and jaxid's as one of optimistix."""

import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import jaxid
from jaxid import cli
from jaxid.command_line import inputs, parser
from jaxid.estimators.common.levenberg_marquardt import BoundedLevenbergMarquardt, Transform
from jaxid.estimators.common.minimise import failure_text, minimise
from jaxid.estimators.common.minimisers import MINIMISERS, minimiser_name, minimiser_of
from jaxid.estimators.output_error import output_error
from jaxid.logs.log import Log
from jaxid.simulation.replay import Numerics
from tests.estimators import test_levenberg_marquardt as curve
from tests.estimators.within_prior import test_within_prior as directions
from tests.simulation import test_solvers as axis
from truth.chain import stages

NOISY = curve.DATA + 0.05 * np.random.default_rng(0).standard_normal(curve.TIME.size)
START = np.array([6.0, 1.0, 1.0, 2.0])
# Both last unknowns end at a bound of these.
BINDING = {"lower": (0, 0, -9, 0.2), "upper": (np.inf, np.inf, -0.9, np.inf)}


def fitted(name, bounds=None, data=NOISY, active=None, start=START):
    parameters, solver = curve.unknowns(start, **(bounds or {})), minimiser_of(name)
    return jax.jit(
        lambda: minimise(
            lambda theta: data - curve.model(theta),
            parameters.guess,
            Transform.of(parameters),
            *parameters.bounds,
            active,
            solver,
        )
    )()


def sigma(minimum) -> np.ndarray:
    jacobian = np.asarray(minimum.jacobian)
    variance = 2 * float(minimum.cost) / (len(jacobian) - jacobian.shape[1])
    return np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian)))


@functools.cache
def ours(binding: bool):
    return fitted(None, BINDING if binding else None)


@pytest.mark.parametrize("binding", [False, True])
@pytest.mark.parametrize("name", ["LevenbergMarquardt", "Dogleg", "BFGS", "LBFGS"])
def test_all_end_at_one_minimum_within_bounds(name, binding):
    """A hundred-thousandth of a standard deviation; those at a bound are there exactly."""
    here, there = ours(binding), fitted(f"optimistix.{name}", BINDING if binding else None)
    assert bool(there.converged)
    assert int(there.steps) != int(here.steps)
    assert np.all(np.abs(there.theta - here.theta) < 1e-4 * sigma(here))
    np.testing.assert_allclose(there.jacobian, here.jacobian, atol=1e-4)
    if binding:
        np.testing.assert_array_equal(np.asarray(there.theta)[2:], [-0.9, 0.2])


def test_inactive_unknowns_stay_put_in_any_minimiser():
    active, start = np.array([True, True, True, False]), np.array([6.0, 1.0, 1.0, 0.0])
    names = (None, "optimistix.GaussNewton")
    one, other = (fitted(name, active=active, start=start) for name in names)
    assert float(other.theta[3]) == 0.0
    np.testing.assert_allclose(other.theta, one.theta, rtol=1e-6)


def test_where_the_cost_can_still_fall_nothing_has_converged():
    """Nelder and Mead's simplex collapses here; and two steps of any other are too few."""
    lost = fitted("optimistix.NelderMead")
    assert not bool(lost.converged)
    assert float(lost.cost) > 1.1 * float(ours(False).cost)
    assert failure_text(lost, "optimistix.NelderMead").endswith("it stopped where the cost can still fall")
    gone = fitted("optimistix.Dogleg", data=NOISY * np.nan)
    assert not bool(gone.converged)
    assert "not finite" in failure_text(gone, "Dogleg")


def test_a_minimiser_that_runs_out_of_steps_is_told():
    slow = optx.GradientDescent(learning_rate=1e-7, rtol=1e-12, atol=1e-12)
    minimum = fitted(slow)
    assert minimiser_name(slow) == "optimistix.GradientDescent"
    assert not bool(minimum.converged)
    assert failure_text(minimum, "it") == f"it: no convergence within its {int(minimum.steps)} steps"


def test_jaxids_solver_is_one_of_optimistix():
    """On a tree of unknowns with bounds and an auxiliary output, the minimum and its steps are the same."""
    lower = {"size": jnp.zeros(2), "rest": jnp.asarray([-9.0, 0.2])}
    upper = {"size": jnp.full(2, jnp.inf), "rest": jnp.asarray([-0.9, jnp.inf])}
    start = {"size": jnp.asarray(START[:2]), "rest": jnp.asarray(START[2:])}

    def residual(y, data):
        theta = jnp.concatenate([y["size"], y["rest"]])
        return {
            "first": data[:30] - curve.model(theta)[:30],
            "rest": data[30:] - curve.model(theta)[30:],
        }, theta

    def solve(data, **more):
        return optx.least_squares(
            residual,
            BoundedLevenbergMarquardt(rtol=1e-12),
            start,
            args=data,
            options={"lower": lower, "upper": upper, **more},
            has_aux=True,
            max_steps=60,
            throw=False,
        )

    solution = jax.jit(solve)(NOISY)
    theta = np.concatenate([solution.value["size"], solution.value["rest"]])
    assert solution.result == optx.RESULTS.successful
    assert np.all(np.abs(theta - ours(True).theta) < 1e-4 * sigma(ours(True)))
    np.testing.assert_array_equal(solution.aux, theta)
    # Held, and lost.
    held = jax.jit(lambda d: solve(d, active={"size": jnp.zeros(2, bool), "rest": jnp.ones(2, bool)}))(NOISY)
    np.testing.assert_array_equal(held.value["size"], START[:2])
    assert jax.jit(solve)(NOISY * np.nan).result == optx.RESULTS.nonfinite
    short = optx.least_squares(
        residual, BoundedLevenbergMarquardt(), start, args=NOISY, has_aux=True, max_steps=2, throw=False
    )
    assert short.result == optx.RESULTS.nonlinear_max_steps_reached


def test_a_fit_is_differentiated_by_the_implicit_function_theorem():
    parameters = curve.unknowns(START)

    def amplitude(data):
        residual = lambda theta: data - curve.model(theta)
        return minimise(residual, parameters.guess, Transform.of(parameters), *parameters.bounds).theta[0]

    slope = jax.jit(jax.grad(amplitude))(NOISY)
    step = 1e-4 * np.random.default_rng(1).standard_normal(NOISY.size)
    there, here = (float(jax.jit(amplitude)(NOISY + sign * step)) for sign in (1, -1))
    assert float(slope @ step) == pytest.approx((there - here) / 2, rel=1e-3)


@functools.cache
def axis_fit(closed: bool, name: str | None):
    m, data = axis.machine(closed, ("inertia", "viscous", "dry", "lag")), axis.log(closed)
    start = np.asarray(m.parameters.guess) * [1.3, 0.7, 1.2, 0.8]
    noise = 1e-4 * np.random.default_rng(1).standard_normal(data.position.shape)
    data = Log(axis.TIMES, data.position + noise, data.force, reference=data.reference, source="made.csv")
    coarse = Numerics(set_valued=False, substeps=4, longest_delay=4)
    return output_error(m, data, start=start, numerics=coarse, minimiser=name)


@pytest.mark.slow
@pytest.mark.parametrize(("closed", "name"), [(True, "optimistix.Dogleg"), (False, "optimistix.BFGS")])
def test_an_axis_is_fitted_alike_by_all(closed, name):
    here, there = axis_fit(closed, None), axis_fit(closed, name)
    assert there.converged
    assert np.all(np.abs(there.theta - here.theta) < 1e-3 * here.std)
    np.testing.assert_allclose(there.std, here.std, rtol=1e-3)
    assert there.notes[-1] == f"minimised by {name}"
    assert not any("minimised" in note for note in here.notes)


def test_names_stand_once():
    assert parser.MINIMISERS is inputs.MINIMISERS is MINIMISERS
    for name in MINIMISERS[1:]:
        assert minimiser_name(minimiser_of(name)) == name
    assert minimiser_of(None) is None is minimiser_of("levenberg_marquardt")
    assert minimiser_name(None) == "levenberg_marquardt"


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"minimiser": "optimistix.Doglegs"}, "did you mean 'optimistix.Dogleg'?"),
        ({"minimiser": optx.Newton(1e-6, 1e-6)}, "no solver of optimistix for least squares"),
        ({"minimiser": "optimistix.BFGS", "method": "algebraic"}, "only with output_error"),
    ],
)
def test_a_minimiser_that_cannot_be_is_refused(options, told):
    with pytest.raises(jaxid.InputError, match=re.escape(told)):
        jaxid.identify("none.toml", "none.csv", **options)


@pytest.mark.parametrize("command", ["identify", "discover"])
def test_a_wrong_name_on_the_command_line_is_one_line(command, capsys):
    assert cli.main([command, "none.toml", "none.csv", "--minimiser", "newton"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxid: minimiser 'newton' is not known")
    assert error.count("\n") == 1


def stage(tmp_path, more: str = ""):
    text = stages.text(
        1, guess=stages.drawn(3), resolution=0.0, more=directions.STATED + "drawn = false\n" + more
    )
    (tmp_path / "case.toml").write_text(text)
    return jaxid.identify(tmp_path / "case.toml", directions.logged(0)).estimate


@pytest.mark.slow
def test_a_fit_within_a_prior_takes_any(tmp_path):
    """Named in the case; identifiable directions end within a hundredth of their standard deviation."""
    here = stage(tmp_path)
    there = stage(tmp_path, 'minimiser = "optimistix.Dogleg"\n')
    assert there.converged
    assert "minimised by optimistix.Dogleg" in there.notes
    assert there.steps != here.steps
    one, other = (e.details["directions"] for e in (here, there))
    assert len(one) == len(other) > 1
    sure = here.identifiable & there.identifiable
    assert sure.sum() > 1
    assert np.all(np.abs(there.theta - here.theta)[sure] < 1e-2 * here.std[sure])


@pytest.mark.slow
def test_a_solver_goes_with_a_prior(tmp_path):
    there = stage(tmp_path, 'solver = "tsit5"\n')
    here = stage(tmp_path)
    assert there.converged
    assert any("diffrax's tsit5" in note for note in there.notes)
    sure = here.identifiable & there.identifiable
    assert np.all(np.abs(there.theta - here.theta)[sure] < 2.0 * here.std[sure])


STUDIED = """
[plant]
kind = "axis"
[plant.parameters]
inertia = {{ guess = 60.0, true = 95.1 }}
[[effects]]
kind = "viscous_friction"
coefficient = {{ guess = 100.0, true = 203.5 }}
[actuator]
gain = 35.15
[controller]
kind = "cascade_pd"
kp = 160.18
kv = 243.45
[sensor]
position_noise = 1e-6
force_noise = 0.02
[reference]
kind = "trapezoid"
targets = [0.1, 0.02, 0.15, 0.0]
speed = 0.12
acceleration = 0.8
[simulation]
duration = 4.0
sample_rate = 500.0
[study]
estimators = ["output_error"]
runs = 3
{more}
"""


@pytest.mark.slow
def test_a_study_takes_any(tmp_path):
    results = []
    for k, more in enumerate(("", '[output_error]\nminimiser = "optimistix.GaussNewton"\n')):
        (tmp_path / f"{k}.toml").write_text(STUDIED.format(more=more))
        results.append(jaxid.study(tmp_path / f"{k}.toml").table)
    one, other = results
    assert bool(other.converged.all())
    assert np.any(one.steps.to_numpy() != other.steps.to_numpy())
    off = np.abs(other.estimate - one.estimate).to_numpy()
    assert np.all(off < 1e-3 * one["std"].to_numpy())
