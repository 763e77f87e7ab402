"""Many descents side by side end where each of them ends alone."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.estimators.common.levenberg_marquardt import Transform, levenberg_marquardt
from jaxid.estimators.common.side_by_side import descend_side_by_side

T = np.linspace(0.0, 3.0, 200)
TRUTH = np.array([[2.0, 0.7, 1.0], [0.5, 3.0, -2.0], [1.0, 1.0, 0.3]])
# From the first start steps are refused; the third fit must stay at its bound.
STARTS = np.array([[3.0, 1.5, -0.5], [0.4, 2.5, -3.0], [1.2, 0.9, 0.6]])
LOWER = np.array([[1e-9, 1e-9, -np.inf], [1e-9, 1e-9, -np.inf], [1e-9, 1e-9, 0.5]])
UPPER = np.full((3, 3), np.inf)
TRANSFORM = Transform(np.array([True, True, False]))


def model(theta):
    return theta[0] * jnp.exp(-theta[1] * T) + theta[2] * jnp.sin(theta[1] * T)


MEASURED = np.stack([model(t) for t in TRUTH], axis=1)
MEASURED = MEASURED + 0.01 * np.random.default_rng(0).standard_normal(MEASURED.shape)


def test_each_ends_where_it_ends_alone():
    def residual(theta):
        return MEASURED[:, :, None] - jax.vmap(model, out_axes=1)(theta)[:, :, None]

    ends = jax.jit(lambda s: descend_side_by_side(residual, s, TRANSFORM, LOWER, UPPER))(STARTS)
    assert np.all(ends.converged)
    steps = []
    for k in range(3):
        alone = levenberg_marquardt(
            lambda theta, k=k: MEASURED[:, k] - model(theta), STARTS[k], TRANSFORM, LOWER[k], UPPER[k]
        )
        np.testing.assert_allclose(ends.theta[k], alone.theta, rtol=1e-9)
        assert int(ends.steps[k]) == int(alone.steps)
        # Residual and Jacobian are those of the end, however long the others took.
        np.testing.assert_allclose(ends.residual[:, k, 0], alone.residual, atol=1e-10)
        np.testing.assert_allclose(ends.jacobian[:, :, k, 0], alone.jacobian, atol=1e-8)
        np.testing.assert_allclose(ends.gram[k], alone.jacobian.T @ alone.jacobian, rtol=1e-8)
        steps.append(int(alone.steps))
    assert len(set(steps)) > 1
    assert float(ends.theta[2, 2]) == 0.5
