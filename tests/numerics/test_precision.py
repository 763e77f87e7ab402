"""Covariance under coloured noise, its coverage, and what a log cannot tell."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxid.dynamics.residuals import residual_along
from jaxid.effects import EFFECTS
from jaxid.model.smoothing import Smoothing
from jaxid.model.unknowns import scatter
from jaxid.numerics.coloured_noise import NoiseModel, autoregressions, sandwich
from jaxid.numerics.full_hessian import full_hessian
from jaxid.numerics.precision import assess, assess_from_sums, deviations
from jaxid.plants import Axis

AR2 = np.array([1.4, -0.6])


def regressor(samples: int = 1500, period: float = 0.01) -> np.ndarray:
    """Inertia, viscous and Coulomb friction, offset along a two-tone motion."""
    t = period * np.arange(samples)
    v = np.sin(2.0 * t) + 0.6 * np.sin(3.3 * t + 1.0)
    a = 2.0 * np.cos(2.0 * t) + 1.98 * np.cos(3.3 * t + 1.0)
    return np.stack([a, v, np.tanh(v / 0.05), np.ones(samples)], axis=1)


TRUTH = np.array([2.0, 3.0, 1.5, 0.3])
NAMES = ["inertia", "viscous", "coulomb", "offset"]


def precision_of(x: np.ndarray, e: np.ndarray, counts: np.ndarray | None = None, signal=None):
    counts = np.ones(e.shape, bool) if counts is None else counts
    size = np.linalg.norm(x @ TRUTH) if signal is None else signal
    return assess(
        NAMES[: x.shape[1]],
        x[:, None, :],
        e[:, None],
        counts.reshape(-1, 1),
        size,
        np.ones(x.shape[1]),
    )


def test_noise_model_recovers_a_known_colour():
    e = NoiseModel(AR2, 0.5).sample(np.random.default_rng(1), 50_000, 1)[0]
    model = NoiseModel.fit(e, np.ones(e.size, bool))
    # standard error of an AR coefficient: sqrt((1 - a2^2) / N) = 0.0036; the taper adds 0.1 %
    a = np.zeros(40)
    a[: len(model.coefficients)] = model.coefficients
    np.testing.assert_allclose(a[:2], AR2, atol=4 * 0.0036)
    assert model.innovation == pytest.approx(0.5, rel=0.02)
    # and so is its spectrum: the density of the true model within 15 % at every line
    truth = NoiseModel(AR2, 0.5).density(256)
    np.testing.assert_allclose(model.density(256), truth, rtol=0.15)


def test_noise_model_reads_across_gaps():
    """Stops leave holes: the colour is that of what counts, whatever stands in the holes."""
    random = np.random.default_rng(2)
    e = NoiseModel(AR2, 1.0).sample(random, 60_000, 1)[0]
    counts = (np.arange(e.size) // 700) % 3 > 0
    dirty = np.where(counts, e, 1e6)
    model = NoiseModel.fit(dirty, counts, largest=2)
    np.testing.assert_allclose(model.coefficients, AR2, atol=0.03)
    assert NoiseModel.fit(np.zeros(100), np.ones(100, bool)).innovation == 0.0


def test_whitening_leaves_white_noise():
    model = NoiseModel(AR2, 0.5)
    e = model.sample(np.random.default_rng(4), 20_000, 1)[0][:, None]
    counts = np.ones(20_000, bool)
    counts[5000:5010] = False
    white = model.whiten(e)[2:, 0]
    assert white.std() == pytest.approx(1.0, rel=0.02)  # 20 000 draws: 0.5 %
    for lag in (1, 2, 3):
        assert abs(np.mean(white[lag:] * white[:-lag])) < 4 / np.sqrt(20_000)
    kept = model.whitened_counts(counts)
    assert not kept[:2].any()
    assert not kept[5000:5012].any()
    assert kept[5012]


def test_sandwich_is_the_covariance_of_the_projected_noise():
    """Against the dense Toeplitz matrix, and against drawn noise."""
    x, noise = regressor(300), NoiseModel(AR2, 0.7)
    impulse = scipy.signal.lfilter([0.7], [1, *-AR2], np.eye(1, 3000)[0])
    lags = np.array([impulse[: 3000 - k] @ impulse[k:] for k in range(300)])
    dense = x.T @ scipy.linalg.toeplitz(lags) @ x
    # the padded transform wraps lags beyond 300 samples, where the colour has long died
    np.testing.assert_allclose(sandwich(x, noise), dense, rtol=1e-8, atol=1e-8 * dense.max())
    drawn = noise.sample(np.random.default_rng(5), 300, 4000) @ x
    # variances of 4000 draws: 2.2 % standard error, four of them
    np.testing.assert_allclose(drawn.var(axis=0), np.diag(dense), rtol=0.09)


RUNS = 800


@pytest.fixture(scope="module")
def studied():
    """Linear fits of RUNS noisy logs: estimates, coloured and naive standard deviations."""
    x, noise = regressor(), NoiseModel(np.array([1.5, -0.7]), 0.2)
    y = x @ TRUTH + noise.sample(np.random.default_rng(6), len(x), RUNS)
    inverse = np.linalg.inv(x.T @ x)
    theta = y @ x @ inverse
    residual = y - theta @ x.T
    white = np.sqrt(np.diag(inverse) * (residual.var(axis=1) * len(x) / (len(x) - 4))[:, None])
    coloured = np.array([precision_of(x, e).std for e in residual])
    return theta, coloured, white


def covered(theta: np.ndarray, std: np.ndarray) -> np.ndarray:
    return np.mean(np.abs(theta - TRUTH) < 1.96 * std, axis=0)


def test_intervals_cover_what_they_say(studied):
    """95 % intervals cover 93-97 %; 800 runs know that to 0.8 % (binomial standard error)."""
    theta, coloured, _ = studied
    rates = covered(theta, coloured)
    assert np.all((rates > 0.93) & (rates < 0.97)), rates


def test_intervals_that_take_noise_for_white_do_not_cover(studied):
    """What the colour is worth: the naive intervals of slow columns cover far less."""
    theta, _, white = studied
    rates = covered(theta, white)
    assert np.all(rates < 0.85), rates


def test_standard_deviation_is_the_scatter(studied):
    theta, coloured, _ = studied
    # 800 runs: 2.5 % standard error of a scatter, four of them
    np.testing.assert_allclose(coloured.mean(axis=0), theta.std(axis=0), rtol=0.1)


def axis_regressor() -> np.ndarray:
    """Columns of inertia, added mass, Coulomb and cogging on a horizontal axis."""
    t = 0.01 * np.arange(600)[:, None]
    motion = [jnp.asarray(f) for f in (np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t), 0 * t)]
    effects = (
        EFFECTS["added_mass"](mass=0.5),
        EFFECTS["coulomb_friction"](level=1.0),
        EFFECTS["friction_drift"](rate=0.0),
    )
    plant = Axis(2.0, effects=effects, smoothing=Smoothing(0.01))
    leaves = [("inertia",), ("effects", 0, "mass"), ("effects", 1, "level")]
    places = tuple((path, None) for path in leaves)

    def residual(theta):
        return residual_along(scatter(places, plant, theta), *motion, 0.01)[0][:, 0]

    return np.asarray(jax.jit(jax.jacfwd(residual))(jnp.asarray([2.0, 0.5, 1.0])))


def test_untold_combination_is_named():
    """On a horizontal axis added mass is inertia; their sum is told, the difference is not."""
    x = axis_regressor()
    e = 0.01 * np.random.default_rng(7).standard_normal(len(x))
    names = ["inertia", "added_mass.mass", "coulomb_friction.level"]
    size = np.linalg.norm(x @ [2.0, 0.5, 1.0])
    got = assess(names, x[:, None], e[:, None], np.ones((600, 1), bool), size, np.ones(3))
    np.testing.assert_array_equal(got.identifiable, [False, False, True])
    assert np.all(np.isnan(got.std[:2]))
    # White noise of known size; inertia and added mass are one column beside Coulomb's. The noise of 600
    # samples is known to 3 %, and three times that covers its estimated colour.
    told = x[:, [0, 2]]
    assert got.std[2] == pytest.approx(0.01 * np.sqrt(np.linalg.inv(told.T @ told)[1, 1]), rel=0.1)
    (combination,) = got.unidentifiable
    assert combination.keys() == {"inertia", "added_mass.mass"}
    assert combination["inertia"] == pytest.approx(-combination["added_mass.mass"], rel=1e-6)
    assert abs(combination["inertia"]) == pytest.approx(np.sqrt(0.5), rel=1e-6)
    assert got.information.min() < 1e-12


def test_column_that_is_dead_is_named_alone():
    x = regressor()
    x[:, 1] = 0.0
    e = 0.1 * np.random.default_rng(8).standard_normal(len(x))
    got = precision_of(x, e)
    np.testing.assert_array_equal(got.identifiable, [True, False, True, True])
    assert got.unidentifiable == [{"viscous": pytest.approx(1.0)}]


def test_parameter_below_the_noise_is_not_told():
    """A column that is there, but whose standard deviation exceeds half of the signal."""
    x = regressor()
    e = 500.0 * NoiseModel(AR2, 1.0).sample(np.random.default_rng(9), len(x), 1)[0]
    assert not precision_of(x, e).identifiable.any()
    assert precision_of(x, 1e-3 * e).identifiable.all()


def test_each_untold_combination_names_what_no_other_does():
    """Three columns proportional to one another, two others alike: whatever mixture eigenvectors are."""
    rng = np.random.default_rng(11)
    one, two, own = rng.standard_normal((3, 400))
    x = np.stack([one, 2 * one, -one, two, two, own], axis=1)
    e = 0.1 * rng.standard_normal((400, 1))
    names = ["a", "b", "c", "d", "e", "f"]
    got = assess(names, x[:, None], e, np.ones((400, 1), bool), np.linalg.norm(x @ np.ones(6)), np.ones(6))
    np.testing.assert_array_equal(got.identifiable, [False] * 5 + [True])
    assert len(got.unidentifiable) == 3
    assert sorted("".join(sorted(c)) for c in got.unidentifiable)[-1] == "de"
    for combination in got.unidentifiable:
        assert len(combination) == 2
        change = np.array([combination.get(n, 0.0) for n in names]) / np.linalg.norm(x, axis=0)
        assert np.linalg.norm(x @ change) < 1e-9


def test_what_small_weights_of_several_combinations_hold_is_named():
    rng = np.random.default_rng(3)
    one, two, shared = np.linalg.qr(rng.standard_normal((400, 3)))[0].T
    x = np.stack([one + 0.12 * shared, one, two + 0.12 * shared, two, shared], axis=1)
    e = 0.1 * rng.standard_normal((400, 1))
    got = assess(list("abcde"), x[:, None], e, np.ones((400, 1), bool), 2.0, np.ones(5))
    assert not got.identifiable.any()
    assert set().union(*got.unidentifiable) == set("abcde")


def test_first_leaves_nuisances_out():
    x = regressor()
    e = np.random.default_rng(10).standard_normal(len(x))
    whole = precision_of(x, e)
    part = whole.first(["a", "b"])
    np.testing.assert_array_equal(part.std, whole.std[:2])
    assert part.identifiable.size == 2
    # What cannot be told of nuisances alone is not named; what is of both is.
    blind = replace(whole, unidentifiable=[{"c": 1.0}, {"b": 0.7, "c": 0.7}])
    assert blind.first(["a", "b"]).unidentifiable == [{"b": 0.7, "c": 0.7}]


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_covariance_scales_with_the_units(scale):
    """Parameters in other units: standard deviations in other units, the verdict unmoved."""
    x = regressor()
    e = np.random.default_rng(11).standard_normal(len(x))
    units = np.array([scale, 1.0, 1 / scale, 1.0])
    a, b = precision_of(x, e), precision_of(x / units, e, signal=np.linalg.norm(x @ TRUTH))
    np.testing.assert_allclose(b.std, a.std * units, rtol=1e-9)
    np.testing.assert_array_equal(a.identifiable, b.identifiable)
    force = precision_of(1e3 * x, 1e3 * e)  # mN for N: nothing changes
    np.testing.assert_allclose(force.std, a.std, rtol=1e-9)


def test_uncounted_samples_do_not_matter():
    x = regressor()
    e = np.random.default_rng(12).standard_normal(len(x))
    counts = np.arange(len(x)) % 500 > 100
    dirty = np.where(counts, e, 1e9)
    a, b = precision_of(x, e * counts, counts), precision_of(x, dirty, counts)
    np.testing.assert_allclose(a.std, b.std, rtol=1e-12)


def test_full_hessian_is_jaxs_and_more_than_gauss_newtons():
    t = jnp.linspace(0.0, 1.0, 30)

    def residual(theta):
        return theta[0] * jnp.exp(-theta[1] * t) - jnp.cos(3 * t)

    theta = jnp.asarray([1.3, 0.7])
    ours = np.asarray(full_hessian(residual, theta))
    expected = np.asarray(jax.hessian(lambda x: 0.5 * jnp.sum(residual(x) ** 2))(theta))
    np.testing.assert_allclose(ours, expected, rtol=1e-12)
    jacobian = np.asarray(jax.jacfwd(residual)(theta))
    assert np.abs(ours - jacobian.T @ jacobian).max() > 0.1  # the curvature counts here


def test_models_of_many_residuals_are_those_of_each():
    rng = np.random.default_rng(3)
    e = np.stack([rng.standard_normal(4000), NoiseModel(AR2, 0.5).sample(rng, 4000, 1)[0], np.zeros(4000)])
    for coefficients, innovations in (autoregressions(e), jax.jit(autoregressions)(e)):
        for own, a, innovation in zip(e, coefficients, innovations, strict=True):
            alone = NoiseModel.fit(own, np.ones(own.shape, bool))
            order = len(alone.coefficients)
            np.testing.assert_allclose(a[:order], alone.coefficients, rtol=1e-9, atol=1e-12)
            assert not np.any(a[order:])
            assert innovation == pytest.approx(alone.innovation, rel=1e-12)


def test_deviations_of_many_fits_are_those_of_each():
    rng = np.random.default_rng(4)
    jacobian = rng.standard_normal((3, 500, 4)) * [1.0, 1e3, 1e-3, 1.0]
    jacobian[1, :, 3] = jacobian[1, :, 0]  # two unknowns that only their sum tells
    jacobian[2, :, 2] = 0.0
    gram = np.swapaxes(jacobian, 1, 2) @ jacobian
    meat = gram * np.array([0.5, 0.3, 0.2])[:, None, None]
    signal, scale = np.full(3, 20.0), np.ones((3, 4))
    std, known = deviations(gram, meat, signal, scale)
    alone = [assess_from_sums(list("abcd"), *each) for each in zip(gram, meat, signal, scale, strict=True)]
    assert list(known) == [bool(a.identifiable.all()) for a in alone] == [True, False, False]
    np.testing.assert_allclose(std[0], alone[0].std, rtol=1e-12)


def test_the_sandwich_of_white_noise_needs_no_transform():
    x = regressor()
    white, nearly = NoiseModel(np.zeros(0), 0.5), NoiseModel(np.zeros(1), 0.5)
    np.testing.assert_allclose(sandwich(x, white), sandwich(x, nearly), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("column", [[1], [0, 1, 2, 3]], ids=["one column", "all columns"])
def test_a_column_that_is_not_finite_is_not_identifiable(column):
    """A likelihood without slopes ended in an eigenvalue solver that did not converge."""
    x = regressor()
    x[7, column] = np.nan
    e = 0.1 * np.random.default_rng(3).standard_normal(len(x))
    got = precision_of(x, e, signal=10.0)
    assert not np.any(got.identifiable[column])
    assert np.all(np.isfinite(got.std) == got.identifiable)
    assert got.identifiable.sum() == 4 - len(column)
