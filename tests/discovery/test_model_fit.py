"""The batched least squares of searches without a force, on curves in place of simulated loops."""

from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import scipy.optimize

from jaxid.discovery.candidates import Candidate
from jaxid.discovery.in_loop.afar import Afar
from jaxid.discovery.in_loop.model_fit import ModelFit
from jaxid.model.unknowns import Free

TIME = np.linspace(0.0, 3.0, 61)
TRUE = np.array([2.0, 1.5, -0.3])


def superset(upper: float = np.inf) -> SimpleNamespace:
    """Unknowns of a decay over an offset; level and rate are positive, and the rate is bounded above."""
    free = (
        Free("level", ("a",), "1", "positive", 1.0),
        Free("rate", ("b",), "1", "positive", 1.0, upper=upper),
        Free("offset", ("c",), "1", "free", 0.0),
    )
    return SimpleNamespace(machine=SimpleNamespace(parameters=SimpleNamespace(free=free)))


@dataclass(frozen=True)
class Decay(ModelFit):
    """A decay, in place of a loop; it diverges at levels of 100."""

    logs: tuple = ()
    measured: np.ndarray = field(default_factory=lambda: curve(TRUE))

    def linearised(self, thetas, moving):
        e = np.array([self.measured - curve(theta) for theta in thetas])
        fast = [np.exp(-rate * TIME) for _, rate, _ in thetas]
        columns = [
            -np.array([f, -level * TIME * f, np.ones_like(TIME)]).T
            for f, (level, *_) in zip(fast, thetas, strict=True)
        ]
        e[thetas[:, 0] > 100.0] = np.inf
        return e, np.array(columns)[..., moving]

    def squares(self, thetas):
        return np.sum(self.linearised(thetas, np.arange(3))[0] ** 2, axis=1)


def curve(theta: np.ndarray) -> np.ndarray:
    level, rate, offset = theta
    return level * np.exp(-rate * TIME) + offset


def test_each_start_reaches_the_optimum_and_one_that_diverged_stays_out():
    starts = np.array([[1.0, 1.0, 0.0], [0.1, 0.2, 3.0], [10.0, 5.0, -3.0], [1e3, 1.0, 0.0]])
    ends, squares = Decay(superset()).fit(starts, np.arange(3))
    np.testing.assert_allclose(ends[:3], np.tile(TRUE, (3, 1)), rtol=1e-6)
    assert np.all(squares[:3] < 1e-12)
    assert squares[3] == np.inf


def test_a_bound_holds_and_the_others_end_where_scipy_ends():
    """The rate wants to be above its bound; an unknown that does not move stays."""
    fit = Decay(superset(upper=1.0))
    (end,), (squares,) = fit.fit(np.array([[1.0, 0.5, 0.0]]), np.arange(3))
    residual = lambda x: fit.measured - curve(np.array([x[0], 1.0, x[1]]))
    known = scipy.optimize.least_squares(residual, [1.0, 0.0])
    np.testing.assert_allclose(end, [known.x[0], 1.0, known.x[1]], rtol=1e-5)
    assert abs(squares - 2 * known.cost) < 1e-6 * squares

    (end,), _ = Decay(superset()).fit(np.array([[1.0, 0.5, -0.3]]), np.array([0, 1]))
    np.testing.assert_allclose(end, TRUE, rtol=1e-6)


def test_fits_from_afar_begin_at_the_starts_near_the_guesses_with_both_signs():
    """At the start of the candidate, and at the unknowns where the model ended, no fit comes back."""
    c = Candidate("offset", "offset", 0, np.array([2]), np.zeros(1), np.array([[1e9]]), np.array([True]))
    asked = []

    def about(added, theta, count):
        asked.append(theta[2])
        spread = 3 ** np.random.default_rng(0).uniform(-1, 1, (count, 2))
        points = np.tile(theta, (count + 1, 1))
        points[0, :2], points[1:, :2] = 1.0, spread
        return points

    afar = Afar(about, lambda: {("offset", 0): np.array([[1.0], [1.0]])})
    ends, squares = afar.begun(Decay(superset()), (c,), np.array([1e3, 1e-3, 0.0]), np.arange(3))
    assert sorted(asked) == [-1.0, -0.1, 0.1, 1.0]
    assert np.all(np.diff(squares) >= 0)
    np.testing.assert_allclose(ends[0], TRUE, rtol=1e-3)
