"""Where guesses and log agree, and how far off that may be: against quadrature and algebra."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.estimators import directions, directions_posterior, directions_rounding
from jaxid.estimators.directions_posterior import most_probable, spread
from jaxid.estimators.directions_precision import add_profiles
from jaxid.estimators.directions_problem import Found
from jaxid.estimators.least_squares import Minimum
from jaxid.estimators.steps import alone

NOISE = 0.3


def problem_of(residual, jacobian, size, rows):
    """Stands for a problem: its residual and derivative are functions of the point."""
    return SimpleNamespace(
        residual=residual, jacobian=jacobian, ladder=(1.0,), prior=SimpleNamespace(base=np.ones(size)),
        replay=SimpleNamespace(position=np.zeros(1)), measured=np.zeros((rows, 1)), places=(None,) * size,
    )


@pytest.fixture(autouse=True)
def simulated(monkeypatch):
    def read(problem, sharpness, w):
        e, jacobian = problem.residual(w), problem.jacobian(w)
        return Minimum(w, np.asarray(0.5 * e @ e), np.asarray(1), np.asarray(True), e, jacobian)
        yield

    def at_each(problem, w, starts=None):
        e = np.array([problem.residual(x) for x in w])
        return SimpleNamespace(function=lambda: e.reshape(len(w), *problem.measured.shape), args=())

    monkeypatch.setattr(directions_posterior, "read", read)
    for module in (directions_posterior, directions):
        monkeypatch.setattr(module, "at_each", at_each)


def linear(rng, size=4, rows=30):
    a, b = rng.standard_normal((rows, size)) * [8.0, 2.0, 0.5, 0.05], rng.standard_normal(rows)
    return problem_of(lambda w: a @ w - b, lambda w: a, size, rows), a / NOISE, b / NOISE


def test_a_line_ends_where_guesses_and_log_agree():
    problem, a, b = linear(np.random.default_rng(0))
    w, here, settled = alone(most_probable(problem, NOISE, np.array([3.0, -2.0, 1.0, 1.0])))
    assert settled
    np.testing.assert_allclose(w, np.linalg.solve(a.T @ a + np.eye(4), a.T @ b), atol=2e-3)
    np.testing.assert_allclose(here.residual / NOISE, a @ w - b)


def test_a_held_direction_stays():
    problem, a, b = linear(np.random.default_rng(1))
    along = np.array([0.6, 0.8, 0.0, 0.0])
    start = 0.7 * along + np.array([0.0, 0.0, 1.0, -1.0])
    w, _, settled = alone(most_probable(problem, NOISE, start, held=along))
    assert settled
    assert along @ w == pytest.approx(0.7, abs=1e-9)
    slope = a.T @ (a @ w - b) + w
    across = slope - along * (along @ slope)
    assert np.linalg.norm(across) < 1e-3 * np.linalg.norm(slope)


def test_a_cost_with_a_kink_ends_all_the_same():
    """Where the derivative jumps no step keeps what it promises."""
    residual = lambda w: np.array([4.0 * abs(w[0] - 0.4) + 1.0, 3.0 * (w[1] - 0.2)])
    jacobian = lambda w: np.diag([4.0 * np.sign(w[0] - 0.4), 3.0])
    w, _, _ = alone(most_probable(problem_of(residual, jacobian, 2, 2), NOISE, np.array([0.9, -1.0])))
    np.testing.assert_allclose(w, [0.4, 0.2], atol=0.1)


def found_at(problem, w, told):
    jacobian = problem.jacobian(w)
    e = problem.residual(w)
    minimum = Minimum(w, np.asarray(0.5 * e @ e), np.asarray(1), np.asarray(True), e, jacobian)
    return Found(problem, np.eye(w.size), told, minimum, 1, True, False)


def test_the_spread_of_a_line_is_the_quadratic_pictures():
    problem, a, b = linear(np.random.default_rng(2))
    whole = np.linalg.inv(a.T @ a + np.eye(4))
    found = alone(spread(found_at(problem, whole @ (a.T @ b), 2), NOISE))
    # Directions of the linear problem are not quite the axes: fitted ones and others are correlated.
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(whole)), rtol=0.15)


def test_the_spread_of_what_is_held_wrongly_is_found():
    """x is told well, but only beside the square of y, of which the log says nothing."""
    problem = problem_of(
        lambda w: np.array([10.0 * (w[0] + 0.5 * w[1] ** 2)]),
        lambda w: np.array([[10.0, 10.0 * w[1]]]), 2, 1,
    )
    best = np.zeros(2)
    found = alone(spread(found_at(problem, best, 1), NOISE))
    x, y = np.meshgrid(np.linspace(-8, 3, 2201), np.linspace(-5, 5, 801), indexing="ij")
    nats = -0.5 * (10.0 * (x + 0.5 * y**2) / NOISE) ** 2 - 0.5 * x**2 - 0.5 * y**2
    weight = np.exp(nats - nats.max())
    exact = [np.sum(weight * v**2) / weight.sum() for v in (x, y)]
    # The quadratic picture at the fit has 0.03 for x.
    assert np.sqrt(exact[0]) > 0.4
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(exact), rtol=0.25)


def test_a_profile_holds_one_direction_and_all_others_give_way():
    """Of a line it rises by the square of the place over the variance that is left."""
    problem, a, b = linear(np.random.default_rng(3))
    whole = np.linalg.inv(a.T @ a + np.eye(4))
    found = found_at(problem, whole @ (a.T @ b), 2)
    stated = [{"std": 0.02}, {"std": 0.1}]
    assert alone(add_profiles(found, NOISE, stated)) == []
    for k, direction in enumerate(stated):
        assert direction["profile"]["at_std"] == [-3, -2, -1, 1, 2, 3]
        places = direction["std"] * np.array([-3, -2, -1, 1, 2, 3])
        np.testing.assert_allclose(direction["profile"]["rise"], places**2 / whole[k, k], rtol=0.02)
    # Beside a point that is not the most probable the profile falls.
    words = alone(add_profiles(found_at(problem, found.point + [0.3, 0, 0, 0], 2), NOISE, stated))
    assert [w[:26] for w in words] == ["the profile of direction 1", "the profile of direction 2"]


def test_a_fit_begins_in_the_deeper_valley():
    depth = lambda x: np.array([np.where(x < 0.4, 3.0 + abs(x), 5.0 * abs(x - 1.1))])
    problem = problem_of(lambda w: depth(w[0]), None, 3, 1)
    told = np.eye(3)[:, :1]
    w = alone(directions._looked(problem, told, np.array([0.0, 0.3, -0.2])))
    assert w[0] == pytest.approx(1.1, abs=0.1)
    np.testing.assert_allclose(w[1:], [0.3, -0.2])
    # And stays where nothing is better.
    np.testing.assert_allclose(alone(directions._looked(problem, told, np.array([1.1, 0.0, 0.0])))[0], 1.1)


def one_told(monkeypatch, residual):
    """A fit of the first of two unknowns, whose loop with rounding leaves another residual."""
    problem = problem_of(None, None, 2, 8)
    jacobian = np.zeros((8, 2))
    jacobian[0, 0] = 1.0
    e = 1e-3 * np.random.default_rng(0).standard_normal(8)
    minimum = Minimum(np.zeros(2), np.asarray(0.0), np.asarray(1), np.asarray(True), e, jacobian)

    def at_each(problem, w, starts):
        rounded = np.zeros((len(w), 8, 1))
        rounded[:, 0, 0] = residual(w, starts[:, 0])
        return SimpleNamespace(function=lambda: rounded, args=())

    monkeypatch.setattr(directions_rounding, "at_each", at_each)
    monkeypatch.setattr(directions_rounding, "_rounding", lambda machine, problem: problem)
    machine = SimpleNamespace(sensor=SimpleNamespace(position_resolution=0.1))
    return machine, Found(problem, np.eye(2), 1, minimum, 1, True, False)


def test_rounding_is_drawn_over_what_is_held_too(monkeypatch):
    """The log tells w0 + (w1^2 - 1) / 2, of which w1 is held: off by as much as that scatters."""
    machine, found = one_told(monkeypatch, lambda w, start: w[:, 0] + 0.5 * (w[:, 1] ** 2 - 1.0))
    off, covariance = alone(directions_rounding._within(machine, found, np.array([2.0])))
    h = np.linspace(-6, 6, 2001)
    place = 0.5 * (1.0 - h**2)
    weight = np.exp(-0.5 * h**2 - 0.5 * place**2)
    mean = np.average(place, weights=weight)
    exact = np.sqrt(np.average((place - mean) ** 2, weights=weight))
    assert off[0] == pytest.approx(mean, abs=0.1)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize(("shift", "corrected"), [(0.3, 0.3), (0.02, 0.0)])
def test_what_rounding_does_on_average_is_corrected(monkeypatch, shift, corrected):
    """Where it is more than it scatters: by 0.058, from a start anywhere within a count of 0.1."""
    machine, found = one_told(monkeypatch, lambda w, start: w[:, 0] - shift + 2.0 * start)
    off, covariance = alone(directions_rounding.off_by_rounding(machine, found, np.array([1e-3])))
    assert off[0] == pytest.approx(corrected, abs=0.02)
    assert np.sqrt(covariance[0, 0]) == pytest.approx(np.hypot(0.058, shift - corrected), abs=0.015)
