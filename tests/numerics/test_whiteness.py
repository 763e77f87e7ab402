"""Test of residuals for whiteness, and the band that holds half of their excess over white noise."""

import numpy as np
import pytest
import scipy.signal

from jaxid.numerics.whiteness import band_of_half_the_excess, whiteness


def test_whiteness_is_uniform_for_white_noise_and_small_for_coloured():
    rng = np.random.default_rng(1)
    p = np.array([whiteness(rng.standard_normal(500)) for _ in range(400)])
    assert 0.02 < np.mean(p < 0.05) < 0.09
    coloured = np.convolve(rng.standard_normal(500), [1.0, 0.5])
    assert whiteness(coloured) < 1e-6


def noise(seed: int, samples: int, resonance: float, damping: float, rate: float) -> np.ndarray:
    """White noise through a resonance."""
    pole = np.exp(2j * np.pi * resonance / rate - damping)
    den = np.real(np.poly([pole, pole.conjugate()]))
    return scipy.signal.lfilter([1.0], den, np.random.default_rng(seed).standard_normal(samples))


@pytest.mark.parametrize(("rate", "resonance"), [(1000.0, 120.0), (300.0, 52.0), (50.0, 3.0)])
def test_the_band_of_a_resonance_holds_it(rate, resonance):
    z = noise(1, 1200, resonance, 0.03, rate)
    band = band_of_half_the_excess(z, rate)
    assert band is not None
    low, high = band
    assert low < resonance < high
    power = np.abs(np.fft.rfft(z)) ** 2
    frequency = np.fft.rfftfreq(len(z), 1 / rate)
    inside = np.sum(power[(frequency >= low) & (frequency < high)]) / np.sum(power)
    assert inside == pytest.approx(0.5, abs=0.12)


@pytest.mark.parametrize("seed", range(5))
def test_white_noise_has_no_band(seed):
    assert band_of_half_the_excess(np.random.default_rng(seed).standard_normal(1000), 100.0) is None


def test_a_slow_error_has_a_band_from_zero():
    z = np.cumsum(np.random.default_rng(2).standard_normal(2000))
    band = band_of_half_the_excess(z - z.mean(), 100.0)
    assert band is not None
    assert band[0] == 0.0
    assert band[1] < 1.0


def test_a_slow_error_below_white_noise_has_its_band():
    rng = np.random.default_rng(3)
    slow = np.sin(2 * np.pi * 1.0 * np.arange(2000) / 1000.0)
    z = 0.6 * slow + rng.standard_normal(2000)
    assert np.mean((0.6 * slow) ** 2) < 0.2 * np.mean(z**2), "most of the power is white noise"
    band = band_of_half_the_excess(z, 1000.0)
    assert band is not None
    assert band[1] < 10.0


@pytest.mark.parametrize("z", [np.ones(20), np.zeros(1000)])
def test_nothing_is_no_band(z):
    assert band_of_half_the_excess(z, 1.0) is None
