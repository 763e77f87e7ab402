"""The report's section on precision: correlations of a few parameters, the strong ones of many."""

from types import SimpleNamespace

import numpy as np

from jaxid.numerics.precision import Precision
from jaxid.results.precision import precision_content, precision_lines


def estimate(covariance: np.ndarray, kind: str = "gauss_newton") -> SimpleNamespace:
    told = np.isfinite(np.diag(covariance))
    precision = Precision(covariance, told, [], np.ones(len(told)), kind)
    names = [f"p{k}" for k in range(len(told))]
    return SimpleNamespace(names=names, identifiable=told, precision=precision, details={})


def test_all_correlations_of_a_few():
    covariance = np.array([[4.0, 1.8, np.nan], [1.8, 1.0, np.nan], [np.nan, np.nan, np.nan]])
    content = precision_content(estimate(covariance))
    assert content["names"] == ["p0", "p1"]
    assert [[cell["text"] for cell in row["cells"]] for row in content["matrix"]] == [
        ["+1.00", "+0.90"],
        ["+0.90", "+1.00"],
    ]
    assert content["words"] == (
        "Source of the standard deviations (σ): the Gauss-Newton matrix and the colour of the residual."
    )
    assert content["pairs"] == []


def test_strong_correlations_of_many():
    covariance = np.eye(12)
    covariance[3, 7] = covariance[7, 3] = -0.8
    covariance[1, 2] = covariance[2, 1] = 0.49
    content = precision_content(estimate(covariance))
    assert content["matrix"] == []
    assert [(pair["names"], pair["text"]) for pair in content["pairs"]] == [(("p7", "p3"), "-0.80")]
    covariance[3, 7] = covariance[7, 3] = 0.0
    assert precision_content(estimate(covariance))["pairs_words"].startswith("No correlation of 12")


def test_the_usual_covariance_needs_no_line():
    assert precision_lines(estimate(np.eye(2))) == []
    assert precision_lines(estimate(np.eye(2), "full_hessian")) == [
        "σ from the full Hessian and the colour of the residual"
    ]
    assert precision_content(estimate(np.full((2, 2), np.nan))) is None
