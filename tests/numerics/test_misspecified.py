"""Standard deviations that hold for the values that fit best, by Monte Carlo over motions."""

import numpy as np
import pytest

from jaxid.numerics.misspecified import block_covariance, std_under_misspecification, widening
from jaxid.numerics.precision import Precision, assess

MOVES, SAMPLES = 48, 40  # of one log: moves, and samples a move


def fits(drag, noise, runs=200):
    """Fit y = b v to moves of random speed, where y may hold a quadratic drag too.

    Returns:
        Estimates, standard deviations for coloured noise, and those under misspecification, (runs,) each.
    """
    random = np.random.default_rng(1)
    shape = np.sin(np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES)
    out = []
    for _ in range(runs):
        speeds = random.uniform(0.2, 1.8, MOVES) * (-1) ** np.arange(MOVES)
        v = (speeds[:, None] * shape).ravel()
        y = v + drag * v * np.abs(v) + noise * random.standard_normal(v.size)
        b = v @ y / (v @ v)
        jacobian, residual = -v[:, None, None], (y - b * v)[:, None]
        counts = np.ones(residual.shape, bool)
        plain = assess(["b"], jacobian, residual, counts, float(np.linalg.norm(y)), np.ones(1)).std
        out.append((b, *plain, *std_under_misspecification(jacobian, residual, counts)))
    return np.transpose(out)


def rms(x):
    return np.sqrt(np.mean(np.square(x)))


def test_spread_over_motions_of_an_incomplete_model():
    """The deviation for noise is two thirds of the spread, that of the scores the whole of it."""
    b, plain, robust = fits(drag=0.3, noise=0.01)
    spread = np.std(b, ddof=1)
    assert rms(plain) < 0.75 * spread
    assert spread == pytest.approx(rms(robust) / 1.12, rel=0.2)
    inside = np.mean(np.abs(b - b.mean()) < 1.96 * robust)
    assert 0.92 < inside < 0.98
    assert np.mean(np.abs(b - b.mean()) < 1.96 * plain) < 0.87


def test_a_complete_model_has_the_usual_deviation():
    b, plain, robust = fits(drag=0.0, noise=0.1)
    spread = np.std(b, ddof=1)
    assert rms(plain) == pytest.approx(spread, rel=0.15)
    assert rms(robust) / 1.12 == pytest.approx(spread, rel=0.2)


def test_directions_that_the_log_does_not_hold_and_short_logs():
    random = np.random.default_rng(2)
    column = random.standard_normal((200, 1, 1))
    jacobian = np.concatenate([column, np.zeros_like(column)], axis=2)
    residual = random.standard_normal((200, 1))
    counts = np.ones((200, 1), bool)
    one, none = std_under_misspecification(jacobian, residual, counts)
    assert one == pytest.approx(1 / np.sqrt(200), rel=0.5)
    assert none == 0
    scaled = std_under_misspecification(jacobian / 1e3, residual, counts)[0]
    assert scaled == pytest.approx(1e3 * one)
    assert np.all(np.isnan(std_under_misspecification(jacobian[:20], residual[:20], counts[:20])))
    assert std_under_misspecification(jacobian[..., :0], residual, counts).shape == (0,)


def test_errors_that_last_for_a_block_widen_the_deviations():
    rng = np.random.default_rng(2)
    blocks, length = 40, 50
    jacobian = np.ones((blocks * length, 1, 1))
    z = np.repeat(rng.standard_normal(blocks), length)[:, None]
    counts = np.ones(z.shape, bool)
    white = Precision(np.full((1, 1), 1 / z.size), np.ones(1, bool), [], np.ones(1))
    got = white.std * widening(white, jacobian, z, counts)
    # The mean of 40 independent blocks, however many samples each has.
    assert got[0] == pytest.approx(1 / np.sqrt(blocks), rel=4 / np.sqrt(2 * blocks))
    assert widening(white, jacobian, 1e-3 * z, counts)[0] == 1.0
    assert widening(white, jacobian[:79], z[:79], counts[:79])[0] == 1.0
    unseen = Precision(np.full((1, 1), np.nan), np.zeros(1, bool), [], np.ones(1))
    assert widening(unseen, jacobian, z, counts)[0] == 1.0


def test_few_blocks_that_hold_all_that_is_known_do_not_look_precise():
    """Five of forty blocks move the regressor, and the error of each lasts: its own fit hides it."""
    rng, blocks, length, errors, stds = np.random.default_rng(4), 40, 25, [], []
    for _ in range(400):
        level = rng.standard_normal((blocks, 1)) * np.ones(length)
        x = np.zeros((blocks, length))
        x[:5] = rng.uniform(0.5, 1.5, (5, 1))
        best = np.sum(x * level) / np.sum(x**2)
        jacobian, z = -x.reshape(-1, 1, 1), (level - best * x).reshape(-1, 1)
        white = Precision(np.full((1, 1), 1 / np.sum(x**2)), np.ones(1, bool), [], np.ones(1))
        stds.append(white.std[0] * widening(white, jacobian, z, np.ones(z.shape, bool))[0])
        errors.append(best)
    assert rms(stds) == pytest.approx(rms(errors), rel=0.25)
    # Student's distribution with four degrees of freedom holds 88 % within 1.96.
    assert np.mean(np.abs(np.divide(errors, stds)) < 1.96) > 0.86


def test_blocks_are_left_out_as_by_fits_without_them():
    """Blocks of two regressors against fits without each block."""
    rng = np.random.default_rng(3)
    samples, edges = 90, np.array([20, 50, 70])
    x = rng.standard_normal((samples, 1, 2)) * [1.0, 1e4]
    beta, noise = np.array([2.0, 3e-4]), np.cumsum(rng.standard_normal(samples))
    y = x[:, 0] @ beta + noise
    counts = rng.random(samples) < 0.8
    best = np.linalg.lstsq(x[counts, 0], y[counts])[0]
    residual = x[:, 0] @ best - y
    given = (x, residual[:, None], counts[:, None], edges)
    parts = np.split(np.arange(samples), edges)
    without = [counts & ~np.isin(np.arange(samples), k) for k in parts]
    fits = np.array([np.linalg.lstsq(x[k, 0], y[k])[0] for k in without])
    off = fits - fits.mean(axis=0)
    np.testing.assert_allclose(block_covariance(*given), 0.75 * off.T @ off, rtol=1e-8)
