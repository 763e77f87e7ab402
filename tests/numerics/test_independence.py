"""The independence sampler: densities whose moments are known."""

import numpy as np
import pytest
import scipy.stats

from jaxid.numerics.independence import independence_chains


def drawn(log_density, centre, covariance, draws=3000, seed=0):
    rng = np.random.default_rng(seed)
    return independence_chains(
        log_density, np.asarray(centre), np.asarray(covariance), draws=draws, chains=2, rng=rng
    )


def test_a_normal_density_has_its_mean_and_covariance():
    mean, covariance = np.array([1.0, -2.0]), np.array([[2.0, 0.9], [0.9, 0.5]])
    density = scipy.stats.multivariate_normal(mean, covariance)
    # The proposals are off in place, size and direction.
    found = drawn(density.logpdf, mean + 0.3, [[1.5, 0.0], [0.0, 0.8]])
    points = found.points.reshape(-1, 2)
    np.testing.assert_allclose(points.mean(0), mean, atol=0.12)
    np.testing.assert_allclose(np.cov(points.T), covariance, rtol=0.12)
    np.testing.assert_allclose(found.log_density, density.logpdf(found.points))
    assert found.points.shape == (2, 3000, 2)
    assert 0.2 < found.accepted < 1


def test_a_skewed_density_with_a_bound_keeps_its_quantiles():
    gamma = scipy.stats.gamma(3.0)
    found = drawn(lambda x: gamma.logpdf(x[:, 0]), [2.0], [[3.0]])
    points = found.points.ravel()
    assert points.min() > 0
    shares = [0.05, 0.5, 0.95]
    # The normal distribution with the same mean and variance has -0.2, 3 and 5.8.
    assert np.quantile(points, shares) == pytest.approx(gamma.ppf(shares), rel=0.08)


def test_a_chain_leaves_a_start_where_the_density_is_zero():
    far = drawn(lambda x: np.where(x[:, 0] > 0, -0.5 * x[:, 0] ** 2, np.nan), [-1.0], [[1.0]])
    assert far.points.min() > 0
    assert np.all(np.isfinite(far.log_density))
