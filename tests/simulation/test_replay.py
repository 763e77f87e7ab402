"""Where a run of a log starts: read as locally as the motion asks, as widely as noise does."""

import numpy as np
import pytest

from jaxid.logs.log import Log
from jaxid.simulation.replay import local_line, stands_still

PERIOD, SPEED, NOISE = 1e-3, 0.05, 1e-6
TIME = PERIOD * np.arange(400)


def log(position: np.ndarray) -> Log:
    return Log(time=TIME, position=position[:, None], force=np.zeros((TIME.size, 1)))


def test_a_start_with_a_jerk_is_read_before_it():
    """A parabola through the next twenty samples says -63 mm/s."""
    start = local_line(log(0.5 * 20.0 * np.maximum(TIME - 4 * PERIOD, 0.0) ** 2), 0)
    np.testing.assert_allclose(np.concatenate(start), 0.0, atol=1e-12)


def test_a_velocity_amid_noise_is_read_from_many_samples():
    noisy = log(SPEED * TIME + NOISE * np.random.default_rng(0).standard_normal(TIME.size))
    off = np.array([local_line(noisy, k)[1][0] - SPEED for k in range(20, 380, 5)])
    # Of five samples the slope is off by 0.32 NOISE / PERIOD, of twenty-one by 0.036.
    assert np.std(off) < 0.13 * NOISE / PERIOD


@pytest.mark.parametrize("k", [0, 200, 399])
def test_a_parabola_is_read_exactly_also_at_the_ends(k):
    position, velocity = local_line(log(0.3 + SPEED * TIME - 2.0 * TIME**2), k)
    assert position[0] == pytest.approx(0.3 + SPEED * TIME[k] - 2.0 * TIME[k] ** 2, rel=1e-12)
    assert velocity[0] == pytest.approx(SPEED - 4.0 * TIME[k], rel=1e-9)


@pytest.mark.parametrize(
    ("speed", "noise", "stands"),
    [(0.0, 1e-5, True), (0.5, 1e-5, False), (0.5, 0.2, False), (0.0, 0.2, False)],
)
def test_a_log_begins_at_rest_only_if_its_noise_would_show_motion(speed, noise, stands):
    """A joint that waits or moves for 0.1 s, then swings by a metre."""
    time = 0.01 * np.arange(400)
    path = speed * time + 0.5 * np.where(time > 0.1, 1.0 - np.cos(3.0 * (time - 0.1)), 0.0)
    read = path + noise * np.random.default_rng(4).standard_normal(400)
    assert stands_still(Log(time=time, position=read[:, None], force=0.0 * read[:, None])) is stands
