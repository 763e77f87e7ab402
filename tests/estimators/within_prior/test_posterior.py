"""Where guesses and log agree, and how far off that may be: against quadrature and algebra."""

from types import SimpleNamespace

import numpy as np
import pytest

from jaxid.estimators.common.levenberg_marquardt import Minimum
from jaxid.estimators.within_prior import fit, posterior, quantisation, subspace
from jaxid.estimators.within_prior.posterior import (
    maximum_a_posteriori,
    negative_log_posterior,
    posterior_second_moment,
    restarted_maximum_a_posteriori,
)
from jaxid.estimators.within_prior.precision import SubspacePrecision, add_profiles
from jaxid.estimators.within_prior.subspace import SubspaceFit
from jaxid.numerics.lanes import run_alone

NOISE = 0.3


def problem_of(residual, jacobian, size, rows):
    """Stands for a problem: its residual and derivative are functions of the point."""
    return SimpleNamespace(
        residual=residual,
        jacobian=jacobian,
        sharpnesses=(1.0,),
        prior=SimpleNamespace(base=np.ones(size)),
        replay=SimpleNamespace(position=np.zeros(1)),
        measured=np.zeros((rows, 1)),
        places=(None,) * size,
        encoders=(0,),
    )


@pytest.fixture(autouse=True)
def simulated(monkeypatch):
    def linearise(problem, sharpness, w):
        e, jacobian = problem.residual(w), problem.jacobian(w)
        return Minimum(w, np.asarray(0.5 * e @ e), np.asarray(1), np.asarray(True), e, jacobian)
        yield

    def residuals_at(problem, w, starts=None):
        return np.array([problem.residual(x) for x in w])
        yield

    monkeypatch.setattr(posterior, "linearise", linearise)
    for module in (posterior, subspace):
        monkeypatch.setattr(module, "residuals_at", residuals_at)


def linear(rng, size=4, rows=30):
    a, b = rng.standard_normal((rows, size)) * [8.0, 2.0, 0.5, 0.05], rng.standard_normal(rows)
    return problem_of(lambda w: a @ w - b, lambda w: a, size, rows), a / NOISE, b / NOISE


def test_a_line_ends_where_guesses_and_log_agree():
    problem, a, b = linear(np.random.default_rng(0))
    w, here, settled = run_alone(maximum_a_posteriori(problem, NOISE, np.array([3.0, -2.0, 1.0, 1.0])))
    assert settled
    np.testing.assert_allclose(w, np.linalg.solve(a.T @ a + np.eye(4), a.T @ b), atol=2e-3)
    np.testing.assert_allclose(here.residual / NOISE, a @ w - b)


def test_a_held_direction_stays():
    problem, a, b = linear(np.random.default_rng(1))
    along = np.array([0.6, 0.8, 0.0, 0.0])
    start = 0.7 * along + np.array([0.0, 0.0, 1.0, -1.0])
    w, _, settled = run_alone(maximum_a_posteriori(problem, NOISE, start, held=along))
    assert settled
    assert along @ w == pytest.approx(0.7, abs=1e-9)
    slope = a.T @ (a @ w - b) + w
    across = slope - along * (along @ slope)
    assert np.linalg.norm(across) < 1e-3 * np.linalg.norm(slope)


def test_a_cost_with_a_kink_ends_all_the_same():
    """Where the derivative jumps no step keeps what it promises."""
    residual = lambda w: np.array([4.0 * abs(w[0] - 0.4) + 1.0, 3.0 * (w[1] - 0.2)])
    jacobian = lambda w: np.diag([4.0 * np.sign(w[0] - 0.4), 3.0])
    w, _, _ = run_alone(
        maximum_a_posteriori(problem_of(residual, jacobian, 2, 2), NOISE, np.array([0.9, -1.0]))
    )
    np.testing.assert_allclose(w, [0.4, 0.2], atol=0.1)


def test_a_fit_goes_on_along_a_valley_with_a_kink_at_its_floor():
    """Where slopes end at the kink, points drawn about it show the way along the floor, a parabola."""
    kink = lambda w0, w1: 4.0 * np.abs(w1 - w0**2) + 1.0
    residual = lambda w: np.array([kink(*w), 1.5 * (w[0] - 2.0)])
    jacobian = lambda w: np.array([4.0 * np.sign(w[1] - w[0] ** 2) * np.array([-2 * w[0], 1.0]), [1.5, 0.0]])
    problem, start = problem_of(residual, jacobian, 2, 2), np.array([-1.0, 1.0])
    floor = np.linspace(-3.0, 3.0, 10_001)
    guessed = 0.5 * (floor**2 + floor**4)
    least = np.min(guessed + 0.5 * (1.0 + (1.5 * (floor - 2.0)) ** 2) / NOISE**2)
    w, here, settled = run_alone(maximum_a_posteriori(problem, NOISE, start))
    assert not settled
    assert negative_log_posterior(NOISE, here, w) > least + 3.0
    on, there, settled = run_alone(restarted_maximum_a_posteriori(problem, NOISE, start))
    assert settled
    # No point drawn about it is half a nat more probable; the least may be a little further.
    assert negative_log_posterior(NOISE, there, on) < least + 1.0
    assert int(there.steps) > int(here.steps)


def found_at(problem, w, told):
    jacobian = problem.jacobian(w)
    e = problem.residual(w)
    minimum = Minimum(w, np.asarray(0.5 * e @ e), np.asarray(1), np.asarray(True), e, jacobian)
    return SubspaceFit(problem, np.eye(w.size), told, minimum, 1, True)


def test_the_spread_of_a_line_is_the_quadratic_pictures():
    problem, a, b = linear(np.random.default_rng(2))
    whole = np.linalg.inv(a.T @ a + np.eye(4))
    found = run_alone(posterior_second_moment(found_at(problem, whole @ (a.T @ b), 2), NOISE))[0]
    # Directions of the linear problem are not quite the axes: fitted ones and others are correlated.
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(np.diag(whole)), rtol=0.15)


def test_the_spread_of_what_is_held_wrongly_is_found():
    """x is told well, but only beside the square of y, of which the log says nothing."""
    problem = problem_of(
        lambda w: np.array([10.0 * (w[0] + 0.5 * w[1] ** 2)]),
        lambda w: np.array([[10.0, 10.0 * w[1]]]),
        2,
        1,
    )
    best = np.zeros(2)
    found, _ = run_alone(posterior_second_moment(found_at(problem, best, 1), NOISE))
    x, y = np.meshgrid(np.linspace(-8, 3, 2201), np.linspace(-5, 5, 801), indexing="ij")
    nats = -0.5 * (10.0 * (x + 0.5 * y**2) / NOISE) ** 2 - 0.5 * x**2 - 0.5 * y**2
    weight = np.exp(nats - nats.max())
    exact = [np.sum(weight * v**2) / weight.sum() for v in (x, y)]
    # The quadratic picture at the fit has 0.03 for x.
    assert np.sqrt(exact[0]) > 0.4
    np.testing.assert_allclose(np.sqrt(np.diag(found)), np.sqrt(exact), rtol=0.25)


def test_of_two_valleys_the_spread_has_both_and_knows_the_better():
    """They differ by 2 nats: a fit that ended in the worse one is off by as far as they lie apart."""
    residual = lambda w: np.array([2.0 * (w[0] ** 2 - 1.0), 0.3 * (w[0] - 1.0)])
    jacobian = lambda w: np.array([[4.0 * w[0]], [0.3]])
    problem = problem_of(residual, jacobian, 1, 2)
    place = np.linspace(-3, 3, 6001)
    nats = np.array([-0.5 * np.sum((residual([x]) / NOISE) ** 2) for x in place]) - 0.5 * place**2
    weight = np.exp(nats - nats.max())
    for start in (-0.99, 0.99):
        exact = np.sqrt(np.sum(weight * (place - start) ** 2) / weight.sum())
        whole, best = run_alone(posterior_second_moment(found_at(problem, np.array([start]), 1), NOISE))
        assert np.sqrt(whole[0, 0]) == pytest.approx(exact, rel=0.3)
        assert best[0] == pytest.approx(place[np.argmax(nats)], abs=0.01)


def test_a_fit_in_the_worse_valley_goes_on_from_the_better(monkeypatch):
    """By 11 nats: of the worse next to nothing is left in the deviation."""
    residual = lambda w: np.array([2.0 * (w[0] ** 2 - 1.0), 0.7 * (w[0] - 1.0)])
    problem = problem_of(residual, lambda w: np.array([[4.0 * w[0]], [0.7]]), 1, 2)
    problem.noise, problem.on = lambda minimum, count: NOISE, "position"
    white = lambda found: SubspacePrecision(
        1e-3 * np.eye(found.count), np.full(found.count, 0.03), np.zeros(0)
    )
    monkeypatch.setattr(fit, "precision_of_directions", white)
    machine = SimpleNamespace(sensor=SimpleNamespace(position_resolution=None))
    for drawn, end in ((True, 1.0), (False, -1.0)):
        start = found_at(problem, np.array([-0.9]), 1)
        found, told = run_alone(fit._posterior_fit(machine, start, drawn))
        assert found.point[0] == pytest.approx(end, abs=0.1)
        assert told.std[0] == pytest.approx(NOISE / 4.0, rel=0.3)


def test_a_profile_holds_one_direction_and_all_others_give_way():
    """Of a line it rises by the square of the place over the variance that is left."""
    problem, a, b = linear(np.random.default_rng(3))
    whole = np.linalg.inv(a.T @ a + np.eye(4))
    found = found_at(problem, whole @ (a.T @ b), 2)
    stated = [{"std": 0.02}, {"std": 0.1}]
    assert run_alone(add_profiles(found, NOISE, stated)) == []
    for k, direction in enumerate(stated):
        assert direction["profile"]["at_std"] == [-3, -2, -1, 1, 2, 3]
        places = direction["std"] * np.array([-3, -2, -1, 1, 2, 3])
        np.testing.assert_allclose(direction["profile"]["rise"], places**2 / whole[k, k], rtol=0.02)
    # Beside a point that is not the most probable the profile falls.
    words = run_alone(add_profiles(found_at(problem, found.point + [0.3, 0, 0, 0], 2), NOISE, stated))
    assert [w[:26] for w in words] == ["the profile of direction 1", "the profile of direction 2"]


def test_a_fit_begins_in_the_deeper_valley():
    depth = lambda x: np.array([np.where(x < 0.4, 3.0 + abs(x), 5.0 * abs(x - 1.1))])
    problem = problem_of(lambda w: depth(w[0]), None, 3, 1)
    told = np.eye(3)[:, :1]
    w = run_alone(subspace._best_start(problem, told, np.array([0.0, 0.3, -0.2])))
    assert w[0] == pytest.approx(1.1, abs=0.1)
    np.testing.assert_allclose(w[1:], [0.3, -0.2])
    # And stays where nothing is better.
    w = run_alone(subspace._best_start(problem, told, np.array([1.1, 0.0, 0.0])))
    np.testing.assert_allclose(w[0], 1.1)


@pytest.mark.parametrize("lost", [(), (0,), (0, 1, 2)])
def test_guesses_that_do_not_simulate_are_left_for_points_that_do(monkeypatch, lost):
    """Of three likely points those that do not simulate either are passed over."""
    problem, a, b = linear(np.random.default_rng(2))
    problem.noise = lambda minimum, count: float(np.sqrt(2 * minimum.cost / (30 - count)))
    points = np.array([[1.0, 0.5, 0.0, 0.0], [-1.0, 0.0, 0.5, 0.0], [0.0, 2.0, 0.0, 0.0]])
    whole = problem.residual
    at = lambda w: any(np.array_equal(w, points[k]) for k in lost)
    problem.residual = lambda w: whole(w) * (np.nan if at(w) else 1.0)
    jacobian = problem.jacobian
    problem.jacobian = lambda w: jacobian(w) * (np.nan if at(w) else 1.0)

    def likely(problem, count):
        return points
        yield

    monkeypatch.setattr(fit, "likeliest_prior_draws", likely)
    monkeypatch.setattr(fit, "linearise", posterior.linearise)
    gone = Minimum(
        np.zeros(4),
        np.asarray(np.nan),
        np.asarray(1),
        np.asarray(False),
        np.full(30, np.nan),
        np.full((30, 4), np.nan),
    )
    found = run_alone(fit._restarted(SubspaceFit(problem, np.eye(4), 0, gone, 5, False), False))
    if len(lost) == len(points):
        np.testing.assert_array_equal(found.minimum.jacobian, gone.jacobian)
        return
    assert found.evaluations > 5
    assert found.settled
    left, least = problem.residual(found.point), np.linalg.lstsq(a, b)[0]
    assert left @ left < 1.5 * np.sum((NOISE * (a @ least - b)) ** 2)


def through(
    monkeypatch,
    residual,
    *,
    unknowns=2,
    told=1,
    best=None,
    little=None,
    vectors=None,
    places=None,
    unknown_reference=None,
):
    """A fit whose loop with rounding leaves another residual: where it ends, and how it is told."""
    problem = problem_of(None, None, unknowns, 8)
    problem.places = (None,) * (places or unknowns)
    problem.noise = lambda minimum, count: 1e-3
    jacobian = np.zeros((8, unknowns))
    jacobian[np.arange(told), np.arange(told)] = 1.0
    if little is not None:
        jacobian[told, told] = little
    e = 1e-3 * np.random.default_rng(0).standard_normal(8)
    best = np.zeros(unknowns) if best is None else best
    minimum = Minimum(best, np.asarray(0.0), np.asarray(1), np.asarray(True), e, jacobian)

    def residuals_at(problem, w, starts):
        rounded = np.tile(e, (len(w), 1))
        some = residual(w, starts)
        rounded[:, : some.shape[1]] = some
        return rounded
        yield

    monkeypatch.setattr(quantisation, "residuals_at", residuals_at)
    monkeypatch.setattr(quantisation, "_with_quantisation", lambda machine, problem: problem)
    white = lambda found: SubspacePrecision(np.eye(found.count), np.ones(found.count), np.zeros(0))
    monkeypatch.setattr(quantisation, "precision_of_directions", white)
    machine = SimpleNamespace(
        sensor=SimpleNamespace(position_resolution=0.1), unknown_reference=unknown_reference
    )
    found = SubspaceFit(problem, np.eye(unknowns) if vectors is None else vectors, told, minimum, 1, True)
    return run_alone(quantisation.fit_with_quantisation(machine, found))


def test_where_the_machine_stood_counts_once(monkeypatch):
    """What the fit tells is the unknown and its start, alike; drawn logs begin within their first count."""
    along = np.array([[0.8, -0.6], [0.6, 0.8]])

    def residual(w, starts):
        np.testing.assert_array_equal(w[:, 1], 0.0)
        return 0.8 * w[:, :1] - 0.1 + 2.0 * starts

    found, told = through(monkeypatch, residual, vectors=along, places=1)
    assert found.point[0] == pytest.approx(0.1 / 0.8, abs=0.01)
    assert told.std[0] == pytest.approx(2 * 0.1 / np.sqrt(12) / 0.8, rel=0.1)
    np.testing.assert_allclose(found.vectors, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(told.whitened_covariance, np.diag([told.std[0] ** 2, 1.0]))
    # Where it is the start alone that the log tells nothing of the machine is.
    found, told = through(monkeypatch, residual, vectors=np.eye(2)[::-1], places=1)
    assert (found.count, told) == (0, None)


def test_rounding_is_drawn_over_what_is_held_too(monkeypatch):
    """The log tells w0 + w1 / 2, of which w1 is held: off by as much as that scatters."""
    found, told = through(monkeypatch, lambda w, starts: w[:, :1] + 0.5 * w[:, 1:])
    assert found.point[0] == pytest.approx(0.0, abs=0.05)
    # Beside the guess: a variance of 1 / 4 and one of 1.
    assert told.std[0] == pytest.approx(np.sqrt(1 / 5), rel=0.1)
    np.testing.assert_allclose(np.diag(told.whitened_covariance), [told.std[0] ** 2, 1.0])


@pytest.mark.parametrize(("little", "count"), [(1e-3, 2), (5e-4, 1)])
def test_what_is_told_a_little_is_seen_with_what_is_told_well(monkeypatch, little, count):
    """As above, and a second reading is of w1 alone, with noise about as large as its guess's deviation."""
    residual = lambda w, starts: np.column_stack([w[:, 0] + 0.5 * w[:, 1], little * w[:, 1]])
    found, told = through(monkeypatch, residual, little=little)
    # What is left of the valley is 0.593 and 0.827 priors; up to 0.6 counts as told.
    assert found.count == count
    np.testing.assert_allclose(found.vectors[:, 0], np.array([2.0, 1.0]) / np.sqrt(5), atol=0.01)
    assert told.std[0] < 0.01
    # Of w1 its guess, its reading, with noise as in the residual of the fit, and the guess of w0 = -w1 / 2.
    noise = np.mean((1e-3 * np.random.default_rng(0).standard_normal(8)) ** 2)
    covariance = np.array([[0.25, -0.5], [-0.5, 1.0]]) / (1.0 + little**2 / noise + 0.25)
    np.testing.assert_allclose(told.whitened_covariance, covariance, rtol=0.1)


def test_settled_logs_are_drawn_where_the_truth_may_be(monkeypatch):
    """Over a box about it they would be drawn 1.4 times as wide."""
    widths = []

    def residual(w, starts):
        widths.append(w[:, 0].std())
        return w[:, :1] + 0.5 * w[:, 1:]

    _, told = through(monkeypatch, residual)
    np.testing.assert_allclose(widths[-6:], told.std[0], rtol=0.15)


def test_a_log_that_rounding_moves_more_than_the_measured_does_not_count(monkeypatch):
    """A fifth of all starts move it by a thousand times the noise, and what is told by 0.3."""

    def residual(w, starts):
        far = np.abs(starts) > 0.04
        return np.column_stack([w[:, :1] - 0.3 * far, 0.0 * w[:, 1:], far])

    found, told = through(monkeypatch, residual)
    assert found.point[0] == pytest.approx(0.0, abs=1e-3)
    assert told.std[0] < 2e-3


def test_noise_fills_what_rounding_leaves_of_the_measured():
    rng = np.random.default_rng(0)
    measured = rng.standard_normal((4000, 2)) * [1.0, 0.1]
    size = rng.uniform(0.0, 2.0, (500, 1, 1))
    drawn = size * measured[::-1]
    noise, alike = quantisation._missing_noise(drawn, measured)
    np.testing.assert_array_equal(alike, size[:, 0, 0] <= 1.0)
    # Of one minus the square, a tenth at least, between zero and one.
    np.testing.assert_allclose(noise, 0.67 * np.mean(measured**2, axis=0), rtol=0.05)
    # Where all leave more, those of least count.
    _, alike = quantisation._missing_noise(2.0 + drawn, 0.1 * measured)
    assert alike.sum() == quantisation._CLOSEST
    over = np.max(np.mean((2.0 + drawn) ** 2, axis=1) / np.mean(measured**2, axis=0), axis=1)
    assert over[alike].max() < over[~alike].min()


def test_what_is_not_told_is_drawn_about_its_guess(monkeypatch):
    """The fit without rounding left it three priors off, and the log says nothing of it."""
    drawn = []

    def residual(w, starts):
        drawn.append(w[:, 1])
        return w[:, :1] - 0.3

    found, _ = through(monkeypatch, residual, best=np.array([0.0, 3.0]))
    np.testing.assert_allclose(found.point, [0.3, 0.0], atol=0.01)
    assert np.mean(drawn) == pytest.approx(0.0, abs=0.1)


def test_what_rounding_does_beside_what_is_told_tells_how_it_moved_that(monkeypatch):
    """Where the machine stood within a count moves what is told, and a sample that tells the fit nothing."""
    moved = 2 * 0.1 / np.sqrt(12)
    beside = lambda w, starts: np.column_stack([w[:, :1] + 2.0 * starts, 0.0 * starts, 0.03 * starts])
    _, told = through(monkeypatch, beside)
    noise = (np.sum((1e-3 * np.random.default_rng(0).standard_normal(8)[3:]) ** 2) - (0.015 * moved) ** 2) / 8
    assert told.std[0] == pytest.approx(moved / np.sqrt(1.0 + (0.015 * moved) ** 2 / noise), rel=0.1)
    assert told.std[0] < 0.7 * moved
    # Not where the reference is unknown: logs that it moves in time lie on no line. Starts near the end of
    # the first count move that sample more than was measured, and do not count.
    _, told = through(monkeypatch, beside, unknown_reference=SimpleNamespace(names=("onset",)))
    assert 0.85 * moved < told.std[0] < moved


def numbers_of(samples, draws):
    """Of logs that rounding moves along one line most; and what the fit sees, and that line."""
    rng = np.random.default_rng(0)
    seen, most = np.linalg.qr(rng.standard_normal((samples, 2)))[0].T, rng.standard_normal(samples)
    at = rng.standard_normal((draws, 1))
    left = at * seen[0] + 9.0 * rng.standard_normal((draws, 1)) * most + rng.standard_normal((draws, samples))
    none = dict.fromkeys(("problem", "resolution", "axes", "count", "point", "noise", "step", "along"))
    summary = quantisation._SummaryStatistics(
        **none, residual=np.zeros(samples), jacobian=5.0 * seen.T, shifts=False
    )
    drawn = quantisation._SimulatedLogs(at, left, np.ones(samples))
    return summary.basis(drawn, np.zeros(1)), seen, most / np.linalg.norm(most)


def test_a_log_is_seen_in_all_its_samples_or_in_those_numbers_that_the_draws_tell():
    np.testing.assert_array_equal(numbers_of(100, 200)[0], np.eye(100))
    numbers, seen, most = numbers_of(100, 130)
    assert numbers.shape == (100, 65)
    np.testing.assert_allclose(numbers.T @ numbers, np.eye(65), atol=1e-9)
    for known in (*seen, most):
        assert np.linalg.norm(numbers.T @ known) > 0.99
    # A long one in what the fit sees.
    numbers, seen, _ = numbers_of(300, 500)
    np.testing.assert_allclose(numbers @ numbers.T, seen.T @ seen, atol=1e-9)


@pytest.mark.parametrize("shift", [0.3, 0.02])
def test_what_rounding_does_on_average_is_corrected(monkeypatch, shift):
    """From a start anywhere within a count of 0.1."""
    found, told = through(monkeypatch, lambda w, starts: w[:, :1] - shift + 2.0 * starts)
    assert found.point[0] == pytest.approx(shift, abs=0.01)
    assert told.std[0] == pytest.approx(2 * 0.1 / np.sqrt(12), rel=0.1)


def test_the_truth_is_where_logs_look_alike_to_the_fit_though_that_is_no_line(monkeypatch):
    """Five unknowns at once, each far from the fit in its own deviations, and pulling at its neighbour."""
    true = np.array([0.4, -0.3, 0.2, 0.5, -0.4])
    bent = lambda w: w + 0.5 * w**2 + 0.3 * np.roll(w, 1, axis=-1)
    residual = lambda w, starts: bent(w[:, :5]) - bent(true) + 0.2 * starts
    found, told = through(monkeypatch, residual, unknowns=6, told=5)
    np.testing.assert_allclose(found.point[:5], true, atol=0.02)
    assert found.count == 5
    assert np.all(told.std < 0.04)
    assert np.all(np.diff(told.std) >= 0)
    np.testing.assert_allclose(found.vectors.T @ found.vectors, np.eye(6), atol=1e-12)
    np.testing.assert_allclose(np.asarray(found.minimum.theta), found.vectors.T @ found.point, atol=1e-12)


def test_logs_that_run_away_do_not_count(monkeypatch):
    def residual(w, starts):
        out = w[:, :1] - 0.1 + 2.0 * starts
        out[:40], out[40:80] = 1e6, np.nan
        return out

    found, told = through(monkeypatch, residual)
    assert found.point[0] == pytest.approx(0.1, abs=0.01)
    assert told.std[0] == pytest.approx(2 * 0.1 / np.sqrt(12), rel=0.1)


def test_where_all_logs_run_away_nothing_is_told(monkeypatch):
    found, told = through(monkeypatch, lambda w, starts: np.full((len(w), 1), np.nan))
    assert (found.count, told) == (0, None)


def test_what_rounding_leaves_hardly_told_is_let_go(monkeypatch):
    """The first unknown is told, the second scatters by more than its guess."""

    def residual(w, starts):
        return w[:, :2] + np.array([0.1, 60.0]) * starts

    found, told = through(monkeypatch, residual, unknowns=3, told=2)
    assert found.count == 1
    np.testing.assert_allclose(np.abs(found.vectors[:, 0]), [1.0, 0.0, 0.0], atol=0.02)
    assert told.std[0] < 0.01
    assert np.sqrt(told.whitened_covariance[1, 1]) > 0.6
