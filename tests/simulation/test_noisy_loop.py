"""Mean readings of a loop with a noisy, coarse encoder, beside the mean of many runs of the exact stepper."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxid
from benchmarks.unforced_machines import COUNT, NOISE, servo
from jaxid.sensors.encoder import Sensor
from jaxid.simulation.noisy_loop import noisy_readings
from jaxid.simulation.replay import Numerics, make_replay


@pytest.mark.parametrize("part", [0.02, 0.13, 0.4, 0.7])
def test_the_mean_reading_is_that_of_many_roundings(part):
    count, runs = 0.01, 20_000
    q = count * np.linspace(-2.3, 2.3, 24)
    noise = part * count * np.random.default_rng(0).standard_normal((runs, len(q)))
    readings = count * np.round((q + noise) / count)
    expected = Sensor(np.array([count]), np.array([part * count])).expected(jnp.asarray(q)[:, None])[:, 0]
    scatter = np.std(readings, axis=0) / np.sqrt(runs)
    bias = 0.003 * count if part >= 0.5 else 0.0  # noise of half a count counts as dither, to 1 %
    assert np.all(np.abs(expected - readings.mean(axis=0)) < 4.5 * scatter + bias + 1e-4 * count)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20_001, 20_002])
def test_mean_readings_explain_what_a_loop_without_noise_leaves(seed):
    """Noise and counts move the mean of an exact servo by half of its noise; nothing is missing in it."""
    drawn = servo(seed)
    quiet = drawn.run(exact=True)["position"]
    moved = np.mean([drawn.run(seed=k)["position"] for k in range(60)], axis=0) - quiet
    result = jaxid.identify(drawn.case(), drawn.columns())
    truth = [drawn.truth()[name] for name in result.estimate.names]
    machine, log = result.estimate.machine.with_estimate(truth), result.session.fit.log
    replay = make_replay(machine, log, Numerics(substeps=4, longest_delay=100))
    found = noisy_readings(machine, log, replay)
    assert found is not None
    mean, draws = found
    assert np.max(np.abs(draws.mean(axis=0))) < 1e-9
    left = mean[:, 0] - quiet - moved
    noise = np.hypot(NOISE, COUNT / np.sqrt(12))
    assert np.sqrt(np.mean(moved**2)) > 0.4 * noise
    assert np.sqrt(np.mean(left**2)) < 0.3 * noise
