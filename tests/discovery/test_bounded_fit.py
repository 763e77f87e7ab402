"""Least squares between bounds, from values that no fit may keep."""

import numpy as np
import pytest

from jaxid.discovery.bounded_fit import bounded_fit
from jaxid.model.unknowns import Free, Parameters

TIME = np.linspace(0.0, 1.0, 21)


def rows(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A constant of two, fitted by an offset and a slope that falls with a positive unknown."""
    stiffness, offset = values
    columns = np.stack([-TIME / stiffness**2, np.ones_like(TIME)], axis=1)
    return offset + TIME / stiffness - 2.0, columns


@pytest.mark.parametrize("start", [1.0, 1e200, np.inf])
def test_an_unknown_that_makes_no_difference_stays_finite(start):
    unknowns = Parameters(
        (Free("stiffness", ("k",), "1", "positive", 1.0), Free("offset", ("c",), "1", "free", 0.0))
    )
    values, _ = bounded_fit(unknowns, np.array([start, 0.0]), rows, most=60)
    assert np.all(np.isfinite(values))
    assert values[0] > 100.0
    assert values[1] == pytest.approx(2.0, abs=1e-2)
