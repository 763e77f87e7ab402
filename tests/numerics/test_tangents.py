"""Carries of loops that have a derivative from the start."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.numerics.tangents import varying


@pytest.mark.parametrize("begins", [True, False])
def test_a_value_stays_and_gets_a_derivative(begins):
    x = (jnp.asarray([1.5, -2.0]), jnp.zeros(()))
    theta = jnp.asarray([3.0, 4.0])
    seen = []

    def of(theta):
        out = varying(x, theta) if begins else x
        seen.append([isinstance(leaf, jax.core.Tracer) for leaf in out])
        return out

    values, slopes = jax.jvp(of, (theta,), (jnp.ones(2),))
    assert seen == [[begins, begins]]
    for value, slope, wanted in zip(values, slopes, x, strict=True):
        np.testing.assert_array_equal(value, wanted)
        np.testing.assert_array_equal(slope, jnp.zeros_like(wanted))
