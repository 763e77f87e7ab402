"""Standard deviations that hold for the values that fit best, by Monte Carlo over motions."""

import numpy as np
import pytest

from jaxid.numerics.misspecified import std_under_misspecification
from jaxid.numerics.precision import assess

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
