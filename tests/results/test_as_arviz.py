"""Exact draws from the posterior, beside the picture of the Hessian."""

import numpy as np
import pytest

import jaxid
from tests.support.cli_setup import place, recorded


@pytest.mark.slow
def test_exact_draws_have_the_covariance_of_the_hessian(tmp_path):
    place(tmp_path, recorded())
    files = tmp_path / "case.toml", tmp_path / "log.csv"
    fitted = jaxid.identify(*files, method="prediction_error")
    curved = jaxid.identify(*files, method="prediction_error", hessian=True)
    tree = fitted.to_arviz(500, chains=4, exact=True)
    assert tree["posterior"].attrs["acceptance_rate"] > 0.5
    draws = np.stack([np.ravel(v) for v in tree["posterior"].data_vars.values()], axis=1)
    std = curved.estimate.std
    assert curved.estimate.precision.kind == "full_hessian"
    np.testing.assert_allclose((draws.mean(0) - fitted.estimate.theta) / std, 0.0, atol=0.15)
    np.testing.assert_allclose(np.std(draws, axis=0), std, rtol=0.1)
    np.testing.assert_allclose(np.corrcoef(draws.T), curved.covariance.correlation, atol=0.1)
    assert np.all(np.isfinite(tree["sample_stats"]["lp"]))
