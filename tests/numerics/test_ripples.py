"""Ripples over the position, from samples that are not even over it."""

import numpy as np
import pytest

from jaxid.numerics.ripples import strongest_ripples


def noisy_motion(seed: int, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw 8000 positions over 30 turns, at a speed that varies, and noise."""
    rng = np.random.default_rng(seed)
    return np.cumsum(rng.uniform(0.0, 0.05, 8000)), noise * rng.standard_normal(8000), rng.uniform(0, 6, 2)


def test_two_ripples_are_found_with_amplitude_period_and_phase():
    q, noise, phases = noisy_motion(0)
    true = np.array([[0.2, 2 * np.pi / 72, phases[0]], [0.04, 2 * np.pi / 18, phases[1]]])
    force = noise + sum(a * np.cos(2 * np.pi * q / p + phase) for a, p, phase in true)

    found = strongest_ripples(q, force, 20.0, 2)
    lines = [found[np.argmin(np.abs(found[:, 1] - p))] for _, p, _ in true]
    for (amplitude, period, phase, above), (a, p, true_phase) in zip(lines, true, strict=True):
        assert amplitude == pytest.approx(a, rel=0.1)
        assert abs(1 / period - 1 / p) < 0.1 / np.ptp(q)
        shift = 2 * np.pi * q.mean() * (1 / period - 1 / p) + phase - true_phase
        assert abs(np.angle(np.exp(1j * shift))) < 0.2
        assert above > 10.0


@pytest.mark.parametrize("seed", range(5))
def test_no_line_of_noise_stands_out_as_one_of_a_ripple_must(seed):
    q, noise, _ = noisy_motion(seed)
    assert strongest_ripples(q, noise, 20.0, 5)[:, 3].max() < 5.0


def test_a_ripple_beyond_the_limit_is_not_looked_for():
    q, noise, _ = noisy_motion(0)
    found = strongest_ripples(q, noise + 0.2 * np.cos(72 * q), 5.0, 3)
    assert found[:, 1].min() >= 0.2


@pytest.mark.parametrize("q", [np.zeros(0), np.full(50, 0.3)])
def test_without_a_stroke_there_is_none(q):
    assert strongest_ripples(q, np.ones(q.size), 10.0, 3).shape == (0, 4)
