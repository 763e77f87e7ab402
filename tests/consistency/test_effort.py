"""A current or load that is a magnitude, smoothed and late, held against a force."""

import numpy as np
import pytest

from jaxid.consistency.effort import witness

PERIOD, SAMPLES = 0.002, 3000
GAIN, OFFSET, DELAY, LAG = 0.8, 0.1, 0.03, 0.05


def red(rng: np.random.Generator, correlation: float = 0.98) -> np.ndarray:
    """A signal that forgets itself over some fifty samples."""
    out = np.zeros(SAMPLES)
    for k, step in enumerate(rng.standard_normal(SAMPLES)):
        out[k] = correlation * out[k - 1] + np.sqrt(1 - correlation**2) * step
    return out


def reported(force: np.ndarray) -> np.ndarray:
    """Return the force as a servo reports it: a lag in small steps, then a delay of whole samples."""
    finer, smooth, out = 50, force[0], np.empty(SAMPLES)
    for k in range(SAMPLES):
        before = force[max(k - 1, 0)]
        for j in range(finer):
            smooth += PERIOD / finer / LAG * (before + (force[k] - before) * (j + 0.5) / finer - smooth)
        out[k] = smooth
    late = round(DELAY / PERIOD)
    return OFFSET + GAIN * np.concatenate([np.full(late, out[0]), out[:-late]])


@pytest.mark.parametrize("unsigned", [True, False])
def test_gain_delay_and_lag_are_found_within_their_deviations(unsigned):
    rng = np.random.default_rng(1)
    force = red(rng)
    effort = reported(np.abs(force) if unsigned else force) + 0.1 * red(rng)
    found = witness(effort, force, PERIOD, unsigned)
    assert found is not None
    assert found.agrees
    values = np.array([found.gain, found.offset, found.shape.delay, found.shape.lag])
    assert np.all(np.abs(values - [GAIN, OFFSET, DELAY, LAG]) < 4 * found.std[:4])
    assert np.all(found.std[[0, 2, 3]] < 0.2 * values[[0, 2, 3]])


def test_two_slow_signals_that_have_nothing_in_common_agree_by_chance_only():
    """Slow signals look alike: the share that a delay and a lag find must be judged by their spectrum."""
    rng = np.random.default_rng(2)
    found = [witness(red(rng), red(rng), PERIOD, False) for _ in range(10)]
    shares = [w.agreement for w in found if w is not None]
    assert max(shares) > 0.05
    assert not any(w is None or w.agrees for w in found)


def test_a_magnitude_that_falls_while_the_force_grows_does_not_agree():
    force = red(np.random.default_rng(3))
    found = witness(2.0 - reported(np.abs(force)), force, PERIOD, unsigned=True)
    assert found is not None
    assert not found.agrees


def test_a_constant_effort_says_nothing():
    assert witness(np.ones(SAMPLES), red(np.random.default_rng(4)), PERIOD, unsigned=True) is None
