"""Filters, derivatives and delays against closed forms and scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxid.numerics import filters as signals

PERIOD = 1e-3
TIME = PERIOD * np.arange(3000)
W1, W2 = 2 * np.pi * 7.0, 2 * np.pi * 31.0


def tones(t: np.ndarray) -> np.ndarray:
    """7 and 31 Hz on a ramp: band-limited but for the ends, where it neither starts nor stops."""
    return np.sin(W1 * t) + 0.4 * np.cos(W2 * t + 0.5) + 0.3 * t


def mean_of_tones(t: np.ndarray, length: float) -> np.ndarray:
    """Mean over the `length` seconds before t."""

    def integral(t: np.ndarray) -> np.ndarray:
        return -np.cos(W1 * t) / W1 + 0.4 * np.sin(W2 * t + 0.5) / W2 + 0.15 * t**2

    return (integral(t) - integral(t - length)) / length


SIGNAL = tones(TIME)[:, None]


@pytest.mark.parametrize(("factor", "atol"), [(4, 1e-6), (10, 1e-4)])
def test_decimator_is_scipys_inside(factor, atol):
    ours = np.asarray(signals.Decimator(factor, 0)(jnp.asarray(SIGNAL)))
    theirs = scipy.signal.decimate(SIGNAL, factor, axis=0, zero_phase=True)
    assert ours.shape == theirs.shape
    # the ends differ: scipy extends them by fewer samples than its filter rings. A second
    # inside, that has died to 1e-4 of it for the slower filter
    inside = slice(1000 // factor, -1000 // factor)
    np.testing.assert_allclose(ours[inside], theirs[inside], atol=atol)
    assert np.abs(ours - SIGNAL[::factor])[inside].max() > 10 * atol  # it does filter


@pytest.mark.parametrize("edge", [None, 0.1])
@pytest.mark.parametrize("factor", [1, 5])
def test_decimator_keeps_the_samples_that_it_says(factor, edge):
    decimator = signals.Decimator(factor, 7, edge)
    index = np.arange(1003.0)[:, None]
    # a ramp passes a zero-phase filter unchanged, its odd extensions being the same ramp; a
    # Chebyshev filter of even order has the gain of its ripple at zero frequency
    gain = decimator.response(np.zeros(1), 1.0)
    assert 0.98 < gain[0] <= 1.0
    kept = np.asarray(decimator(jnp.asarray(index)))[:, 0] / gain
    expected = decimator.kept(1003)
    assert len(kept) == len(expected)
    inside = slice(20, -20)
    np.testing.assert_allclose(kept[inside], index[expected, 0][inside], atol=0.5)


@pytest.mark.parametrize("factor", [2, 3, 11, 25])
@pytest.mark.parametrize("samples", [977, 1000])
def test_decimating_is_leaving_samples_out(factor, samples):
    x = jnp.asarray(np.cumsum(np.random.default_rng(1).standard_normal((samples, 2)), axis=0))
    all_of_them = signals.Decimator(1, 0, 0.06)(x)
    few = signals.Decimator(factor, 0, 0.06)(x)
    np.testing.assert_allclose(few, all_of_them[::factor], rtol=0, atol=1e-12 * float(jnp.abs(x).max()))


def test_decimator_without_a_filter_passes_everything():
    decimator = signals.Decimator(1, 3)
    np.testing.assert_array_equal(np.asarray(decimator(jnp.asarray(SIGNAL))), SIGNAL[3:-3])
    assert decimator.band_hz(1000.0) == 500.0


def test_decimator_treats_columns_batches_and_sums_alike():
    decimator = signals.Decimator(4, 5)
    x = np.random.default_rng(1).standard_normal((2, 400, 3))
    batch = np.asarray(jax.jit(jax.vmap(decimator))(x))
    for k in range(2):
        for j in range(3):
            alone = np.asarray(decimator(jnp.asarray(x[k, :, j : j + 1])))
            np.testing.assert_allclose(batch[k, :, j : j + 1], alone, atol=1e-13)
    together = np.asarray(decimator(jnp.asarray(x[0] + 2 * x[1])))
    np.testing.assert_allclose(together, batch[0] + 2 * batch[1], atol=1e-13)


def test_stated_edge_is_where_a_tenth_is_left():
    decimator = signals.Decimator(5, 0, 0.1)
    gain = decimator.response(np.array([0.0, decimator.band_hz(1000.0), 50.0]), 1000.0)
    # one at zero, 3 dB down at the band's edge, a tenth at the stated one
    np.testing.assert_allclose(gain, [1.0, np.sqrt(0.5), 0.1], atol=1e-12)


@pytest.mark.parametrize(("cutoff", "rtol"), [(100.0, 1e-4), (200.0, 1e-5)])
def test_spectral_derivatives_inside_the_band(cutoff, rtol):
    got = signals.spectral_derivatives(SIGNAL, PERIOD, cutoff)
    exact = (
        tones(TIME),
        W1 * np.cos(W1 * TIME) - 0.4 * W2 * np.sin(W2 * TIME + 0.5) + 0.3,
        -(W1**2) * np.sin(W1 * TIME) - 0.4 * W2**2 * np.cos(W2 * TIME + 0.5),
    )
    for ours, theirs in zip(got, exact, strict=True):
        # what the ends leave 0.3 s inside; it falls with the cut-off
        off = np.abs(ours[300:-300, 0] - theirs[300:-300]).max()
        assert off < rtol * np.abs(theirs).max()


def test_spectral_derivatives_beat_differences_near_the_top():
    """At a tenth of the rate central differences lose 13 % of an acceleration."""
    w = 2 * np.pi * 100.0
    x = np.sin(w * TIME)[:, None]
    expected = -(w**2) * np.sin(w * TIME)
    inside = slice(300, -300)
    spectral = signals.spectral_derivatives(x, PERIOD, 250.0)[2][inside, 0]
    central = signals.central_difference(signals.central_difference(x, PERIOD), PERIOD)[inside, 0]
    assert np.abs(spectral - expected[inside]).max() < 1e-3 * w**2
    assert np.abs(central - expected[inside]).max() > 0.1 * w**2


def test_central_difference_is_exact_for_parabolas_to_the_ends():
    x = (1.0 + 3.0 * TIME - 2.0 * TIME**2)[:, None]
    expected = (3.0 - 4.0 * TIME)[:, None]
    np.testing.assert_allclose(signals.central_difference(x, PERIOD), expected, atol=1e-10)


def test_median_leaves_a_ramp_and_takes_single_and_double_outliers_out():
    ramp = np.stack([0.5 * np.arange(60.0), 7.0 - 2.0 * np.arange(60.0)], axis=1)
    np.testing.assert_array_equal(signals.running_median(ramp, 5), ramp)
    spoilt = ramp.copy()
    spoilt[[0, 12, 30, 31, 59], 0] = [1e3, 1e3, -1e3, -1e3, 1e3]
    spoilt[[20, 21, 58, 59], 1] = [1e3, -1e3, -1e3, -1e3]
    off = np.abs(signals.running_median(spoilt, 5) - ramp)
    # of four neighbours that are right, two samples of the ramp away at most
    assert off[2:-2].max() <= 2 * 2.0
    # at an end as far again
    assert off.max() <= 4 * 2.0
    far = np.ones(60, bool)
    far[[*range(4), *range(10, 15), *range(28, 34), *range(56, 60)]] = False
    np.testing.assert_array_equal(off[far, 0], 0.0)
    # three in a row are the signal
    spoilt[40:43, 0] = 1e3
    assert np.abs(signals.running_median(spoilt, 5) - ramp)[41, 0] > 900.0


@pytest.mark.parametrize("width", [1, 4, 61, 60])
def test_median_of_an_impossible_width_is_refused(width):
    with pytest.raises(ValueError, match="must be odd"):
        signals.running_median(np.zeros((60, 1)), width)


@pytest.mark.parametrize("width", [3, 5, 9])
def test_noise_behind_a_median_is_read_back(width):
    white = 0.3 * np.random.default_rng(8).standard_normal((50_000, 1))
    seen = signals.high_band_std(signals.running_median(white, width))
    assert seen[0] < 0.5 * 0.3
    np.testing.assert_allclose(seen / signals.median_noise(width), 0.3, rtol=0.05)


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_parabolic_derivatives_are_exact_for_parabolas_to_the_ends(reach):
    x = np.stack([1.0 + 3.0 * TIME - 2.0 * TIME**2, 5.0 * TIME**2], axis=1)
    first, second = signals.parabolic_derivatives(x, PERIOD, reach)
    np.testing.assert_allclose(first, np.stack([3.0 - 4.0 * TIME, 10.0 * TIME], axis=1), atol=1e-8)
    np.testing.assert_allclose(second, np.broadcast_to([-4.0, 10.0], x.shape), atol=1e-5)


@pytest.mark.parametrize("reach", [1, 2, 5])
def test_noise_of_the_parabolas_derivatives(reach):
    """Slope of a line over an odd number of samples, and the fit's curvature by its normal equations."""
    white = np.random.default_rng(2).standard_normal((40_000, 1))
    first, second = signals.parabolic_derivatives(white, PERIOD, reach)
    expected = np.sqrt(3 / (reach * (reach + 1) * (2 * reach + 1))) / PERIOD
    assert first.std() == pytest.approx(expected, rel=0.02)
    columns = np.arange(-reach, reach + 1)[:, None] ** np.arange(3.0)
    curvature = 2 * np.sqrt(np.linalg.inv(columns.T @ columns)[2, 2]) / PERIOD**2
    assert second.std() == pytest.approx(curvature, rel=0.02)


@pytest.mark.parametrize("reach", [1, 2, 5])
@pytest.mark.parametrize("f", [5.0, 40.0])
def test_response_of_the_parabola_is_what_it_leaves_of_a_tone(reach, f):
    w, inside = 2 * np.pi * f, slice(20, -20)
    x = np.sin(w * TIME)[:, None]
    first, second = signals.parabolic_derivatives(x, PERIOD, reach)
    gain = [signals.parabolic_response(np.array([0.0, f * PERIOD]), reach, k) for k in (1, 2)]
    assert gain[0][0] == gain[1][0] == 1.0
    np.testing.assert_allclose(first[inside, 0], gain[0][1] * w * np.cos(w * TIME)[inside], atol=1e-8 * w)
    np.testing.assert_allclose(second[inside], -gain[1][1] * w**2 * x[inside], atol=1e-7 * w**2)
    cutoff = np.array([signals.parabolic_cutoff(reach)])
    assert signals.parabolic_response(cutoff, reach, 1)[0] == pytest.approx(0.5)


def test_butterworth_has_no_phase_and_six_decibels_at_the_cut_off():
    x = np.sin(2 * np.pi * 20.0 * TIME)[:, None]
    y = signals.butterworth_zero_phase(x, 20.0, 4, 1000.0)
    # twice 3 dB: a half; the ends' transients have died a second inside
    np.testing.assert_allclose(y[1000:-1000], 0.5 * x[1000:-1000], atol=1e-3)
    with pytest.raises(ValueError, match="half the sampling rate"):
        signals.butterworth_zero_phase(x, 500.0, 4, 1000.0)


@pytest.mark.parametrize("hold", [0.0, 1e-3, 4e-3])
@pytest.mark.parametrize("delay", [0.0, 0.4e-3, 2.3e-3])
def test_delayed_is_the_exact_fractional_delay(hold, delay):
    got = np.asarray(signals.delayed(jnp.asarray(SIGNAL), jnp.asarray(delay), PERIOD, hold=hold))
    late = TIME - delay
    expected = mean_of_tones(late, hold) if hold else tones(late)
    # the corners where the signal is continued, 0.1 s inside
    np.testing.assert_allclose(got[100:-100, 0], expected[100:-100], atol=5e-5)


def test_delay_of_a_held_command_is_the_mean_of_its_staircase():
    """A controller at 1 kHz in a log at 5 kHz: what acted on average around each sample."""
    fast = 5
    t = PERIOD / fast * np.arange(15_000)
    # the mean of both sides where it jumps, so that sums over samples are integrals over time
    sides = [tones(PERIOD * np.floor(t / PERIOD + side)) for side in (-1e-6, 1e-6)]
    commands = 0.5 * (sides[0] + sides[1])
    got = signals.delayed(jnp.asarray(tones(t))[:, None], jnp.zeros(()), PERIOD / fast, hold=PERIOD)
    smooth = np.ones(50 * fast) / (50 * fast)  # differ at the 1 kHz of the staircase, not below
    off = np.convolve(np.asarray(got)[:, 0] - commands, smooth, "valid")[1000:-1000]
    wrong = np.convolve(tones(t) - commands, smooth, "valid")[1000:-1000]
    assert np.abs(off).max() < 0.02 * np.abs(wrong).max()


def test_delay_has_a_derivative():
    def one(delay):
        return signals.delayed(jnp.asarray(SIGNAL), delay, PERIOD, hold=PERIOD)[100:-100, 0]

    delay, step = jnp.asarray(1.7e-3), 1e-6
    slope = np.asarray(jax.jacfwd(one)(delay))
    difference = np.asarray(one(delay + step) - one(delay - step)) / (2 * step)
    # curvature over a microsecond: (W2 step)^2 / 6
    np.testing.assert_allclose(slope, difference, atol=1e-6 * np.abs(slope).max())


@pytest.mark.parametrize("sigma", [1e-6, 0.3])
def test_high_band_std_reads_the_noise_under_a_signal(sigma):
    noise = sigma * np.random.default_rng(2).standard_normal((20_000, 2))
    t = PERIOD * np.arange(20_000)[:, None]
    x = 5 * sigma * np.sin(2 * np.pi * 400.0 * t) + 100 * np.sin(2 * np.pi * 3.0 * t) + noise
    # median of 7000 bins of the periodogram, neighbours alike under the window: 1 %
    np.testing.assert_allclose(signals.high_band_std(x), sigma, rtol=0.05)


@pytest.mark.parametrize("samples", [100, 101, 5000])
def test_high_band_std_is_that_of_a_periodogram(samples):
    """Of coloured noise on a drift, whose spectrum is no constant anywhere."""
    walk = np.cumsum(np.random.default_rng(1).standard_normal((samples, 2)), axis=0)
    x = walk + np.arange(samples)[:, None]
    f, p = scipy.signal.periodogram(x, 50.0, window="hann", detrend="linear", axis=0)
    density = np.median(p[(f > 15.0) & (f < 23.75)], axis=0) / np.log(2.0)
    np.testing.assert_allclose(signals.high_band_std(x), np.sqrt(density * 25.0), rtol=1e-9)


@pytest.mark.parametrize("samples", [600, 601])
def test_compiled_filters_of_rows_are_those_of_arrays(samples):
    """Studies filter in compiled code what a session filters outside; the medians there are bisected."""
    rng = np.random.default_rng(5)
    rows = np.cumsum(rng.standard_normal((2, samples)), axis=1)
    spectra = lambda x: signals.spectral_rows(x, PERIOD, 60.0)
    for ours, compiled in zip(spectra(rows), jax.jit(spectra)(rows), strict=True):
        np.testing.assert_allclose(compiled, ours, rtol=1e-10, atol=1e-10 * np.abs(ours).max())
    # Counts of an encoder give many equal powers; a row of zeros gives nothing else.
    rows = np.stack([rows[0], np.round(rows[1]), np.zeros(samples), np.resize([0.0, 1.0], samples)])
    std = signals.high_band_std_of_rows(rows)
    np.testing.assert_allclose(jax.jit(signals.high_band_std_of_rows)(rows), std, rtol=1e-11, atol=1e-15)
