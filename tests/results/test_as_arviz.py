"""Results as draws from the posterior: their container, and what they follow."""

import numpy as np
import pytest
import xarray

import jaxid
from jaxid.errors import InputError
from tests.support.cli_setup import place, recorded


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("arviz")
    place(made, recorded())
    return made


@pytest.fixture(scope="module")
def fitted(folder):
    return jaxid.identify(folder / "case.toml", folder / "log.csv", method="inverse_dynamics")


def matrix(tree) -> np.ndarray:
    """Draws of all parameters, (draws, p)."""
    posterior = tree["posterior"].to_dataset()
    return np.stack([np.ravel(posterior[name]) for name in posterior.data_vars], axis=1)


def test_the_draws_have_the_names_and_the_covariance_of_the_result(fitted):
    tree = fitted.to_arviz(5000, chains=2, seed=1)
    assert isinstance(tree, xarray.DataTree)
    posterior = tree["posterior"]
    assert list(posterior.data_vars) == fitted.estimate.names
    assert dict(posterior.sizes) == {"chain": 2, "draw": 5000}
    assert posterior["inertia"].attrs["units"] == "kg"
    assert posterior.attrs["source"].startswith("normal distribution")
    draws, std = matrix(tree), fitted.estimate.std
    np.testing.assert_allclose(draws.mean(0), fitted.estimate.theta, atol=0.05 * std.max())
    scaled = np.cov(draws.T) / np.outer(std, std)
    np.testing.assert_allclose(scaled, fitted.covariance.correlation, atol=0.05)
    assert tree["observed_data"]["position"].sizes["time"] == fitted.session.fit.log.samples
    same = fitted.to_arviz(5000, chains=2, seed=1)
    assert posterior.to_dataset().equals(same["posterior"].to_dataset())


def test_exact_draws_need_a_likelihood_and_draws_a_number(fitted):
    with pytest.raises(InputError, match="not made of inverse_dynamics"):
        fitted.to_arviz(exact=True)
    with pytest.raises(InputError, match="chains = 0"):
        fitted.to_arviz(chains=0)


def test_arviz_takes_the_tree(fitted):
    arviz = pytest.importorskip("arviz_stats")
    table = arviz.summary(fitted.to_arviz(500), round_to="none")
    assert list(table.index) == fitted.estimate.names
    assert float(table.loc["inertia", "mean"]) == pytest.approx(fitted.value("inertia"), rel=1e-2)


@pytest.mark.slow
def test_exact_draws_have_the_covariance_of_the_hessian(folder):
    fitted = jaxid.identify(folder / "case.toml", folder / "log.csv", method="prediction_error")
    curved = jaxid.identify(folder / "case.toml", folder / "log.csv", method="prediction_error", hessian=True)
    tree = fitted.to_arviz(500, chains=4, exact=True)
    assert tree["posterior"].attrs["acceptance_rate"] > 0.5
    draws, std = matrix(tree), curved.estimate.std
    assert curved.estimate.precision.kind == "full_hessian"
    np.testing.assert_allclose((draws.mean(0) - fitted.estimate.theta) / std, 0.0, atol=0.15)
    np.testing.assert_allclose(np.std(draws, axis=0), std, rtol=0.1)
    np.testing.assert_allclose(np.corrcoef(draws.T), curved.covariance.correlation, atol=0.1)
    # The draws themselves hold the curvature: widening is that of Fisher's information in both.
    assert np.all(np.isfinite(tree["sample_stats"]["lp"]))
